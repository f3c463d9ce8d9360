"""Agents that come with the package, and the script that makes them."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch

from helpers_runs import same_weights, tiny, weights
from helpers_segments import crossing, straight_road
from helpers_store import contents, stored
from symphony.agents import choice as pretrained
from symphony.agents import load_agent
from symphony.agents.checkpoint import checkpoints, parts_of
from symphony.agents.choice import choose
from symphony.cli import main
from symphony.config import AgentSpec, EvaluateConfig, MGAILConfig, ValidationConfig, to_json
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError
from symphony.evaluation import evaluate
from symphony.recipes import train

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = pretrained.pretrained_names()
METHODS = ("bc_rl", "bc_ts_h")
PRUNING = EvaluateConfig(rule="best", prune_every=3)


def load_script(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


make_pretrained = load_script("make_pretrained")
store = stored(lambda: [straight_road(4, steps=5), crossing(4, seed=1, steps=5)], "town/train")


@pytest.fixture(scope="module")
def run(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two networks' making, evaluated once."""
    folder = tmp_path_factory.mktemp("runs")
    mgail = MGAILConfig(regression=1, head_start=0, rollouts=2)
    first = train(tiny("mgail_h", store, folder / "mgail_h-0", steps=2, mgail=mgail))
    shown = ValidationConfig(data=store, segments=1, rollouts=1)
    after = folder / "mgail_ts_h-0"
    out = train(tiny("mgail_ts_h", store, after, steps=2, warm_start=first, validation=shown, mgail=mgail))
    assert main(f"evaluate {out} --data {store} --rollouts 2 --rule best --prune-every 3".split()) == 0
    return out


@pytest.fixture
def made(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An agent `tiny` made from the run, in place of those that come with the package."""
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "pretrained")
    return make_pretrained.make(str(run), "tiny", pruning=PRUNING, folder=tmp_path / "pretrained")


def test_an_agent_is_its_run_without_what_only_training_needs(run, made, tmp_path):
    assert same_weights(weights("pretrained:tiny"), weights(run))
    (checkpoint,) = checkpoints(made / "checkpoints")
    assert checkpoint.name == choose(run).name
    assert parts_of(checkpoint) == {"policy", "goals", "discriminator"}
    assert not [name for name in contents(made) if "optimizer" in name]
    own, theirs = load_agent(str(run)), load_agent("pretrained:tiny")
    assert own.search.rule == "systematic"
    assert dataclasses.replace(own.search, rule="best", prune_every=3) == theirs.search
    assert (own.observation, own.dynamics) == (theirs.observation, theirs.dynamics)
    # Nothing tells on which machine it was made.
    for name, content in contents(made).items():
        assert str(tmp_path.parent).encode() not in content, name
        assert b"/tmp" not in content, name
    config = make_pretrained.read_run(made)
    assert (str(config.data), str(config.out)) == ("town/train", run.name)
    assert str(config.warm_start) == make_pretrained.read_run(run).warm_start.name


def test_the_same_run_gives_the_same_bytes(run, made, tmp_path):
    torch.manual_seed(5)
    again = make_pretrained.make(str(run), "tiny", pruning=PRUNING, folder=tmp_path / "again")
    assert contents(again) == contents(made)


def test_the_command_prints_every_card(made, capsys):
    assert main(["agents", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out) == {"agents": [pretrained.read_card(made)]}
    assert main(["agents"]) == 0
    shown = capsys.readouterr().out
    assert "pretrained:tiny" in shown
    assert "seed 0" in shown
    assert main(["agents", "pretrained:tiny"]) == 0
    assert " ".join(pretrained.read_card(made)["limits"].split()) in " ".join(capsys.readouterr().out.split())
    assert main(["agents", "pretrained:other"]) == 1
    (made / "card.json").unlink()
    assert main(["agents"]) == 1
    assert "no model card" in capsys.readouterr().err


OTHERS = "there are: pretrained:other, pretrained:tiny"


@pytest.mark.parametrize(("name", "message"), [
    ("pretrained:tinny", f"did you mean 'pretrained:tiny'\\? {OTHERS}"),
    ("pretrained:", f"no agent 'pretrained:' comes with this package; {OTHERS}"),
    ("pretrained:../pretrained/tiny", "no agent"), ("pretrained:tiny@3", "has no checkpoint yet"),
])  # fmt: skip
def test_unknown_names(name, message, tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    for known in ("tiny", "other"):
        (tmp_path / known).mkdir()
        spec = AgentSpec(action_space="bicycle", dt=0.2)
        (tmp_path / known / "agent.json").write_text(to_json(spec))
    (tmp_path / "no_agent").mkdir()
    with pytest.raises(ConfigError, match=message):
        load_agent(name)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped(name):
    agent = load_agent(f"pretrained:{name}")
    folder = pretrained.FOLDER / name
    config = make_pretrained.read_run(folder)
    assert config.method in METHODS
    assert agent.searches
    card = (folder / "README.md").read_text()
    assert f"# pretrained:{name}" in card
    facts, files = pretrained.read_card(folder), list((folder / "evaluations").iterdir())
    assert facts["training"]["checksum"] in card
    assert "not been evaluated" not in card
    assert make_pretrained.page(facts) == card
    rates = [found["rows"][""]["collision_rate"] for found in facts["scores"]]
    assert sorted(rates) == sorted(json.loads(file.read_text())["collision_rate"] for file in files)
    for place, content in contents(folder).items():
        assert "optimizer" not in place
        assert b"/work" not in content, place
        assert b"/tmp" not in content, place


@pytest.mark.parametrize("name", SHIPPED)
def test_what_is_shipped_does_not_take_unknown_speed_limits_for_slow_roads(name, tmp_path):
    known, config = SegmentStore(builtin_store("test")), EvaluateConfig(rollouts=2, search="none")
    stores = known, load_script("hide_limits").hide(known, tmp_path / "hidden", 1.0)
    found = (evaluate(load_agent(f"pretrained:{name}"), one, config, items=range(8)).numbers() for one in stores)
    fast, unknown = (numbers["agent_speed"] for numbers in found)
    assert unknown == pytest.approx(fast, rel=0.2)
