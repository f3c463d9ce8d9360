"""Agents that come with the package, and the script that makes them."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers_runs import same_weights, tiny, weights
from helpers_segments import crossing, straight_road
from symphony.agents import choice as pretrained
from symphony.agents import load_agent
from symphony.agents.checkpoint import checkpoints, parts_of
from symphony.agents.choice import choose
from symphony.cli import main
from symphony.cli.train import Train
from symphony.config import AgentSpec, EvaluateConfig, MGAILConfig, ValidationConfig, to_json
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError
from symphony.recipes import train

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = pretrained.pretrained_names()
METHODS = ("bc_ts_h", "mgail_ts_h")
PRUNING = EvaluateConfig(rule="best", prune_every=3)


def load_script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


make_pretrained = load_script("make_pretrained")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "town" / "train"
    with StoreWriter(path) as writer:
        writer.append(straight_road(4, steps=8))
        writer.append(crossing(4, seed=1, steps=6))
    return path


@pytest.fixture(scope="module", params=METHODS)
def run(request: pytest.FixtureRequest, store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two networks' making, evaluated once."""
    folder = tmp_path_factory.mktemp("runs")
    before = request.param.replace("_ts", "")
    adversarial = {"mgail": MGAILConfig(regression=1, head_start=0, rollouts=2)}
    first = train(tiny(before, store, folder / f"{before}-0", steps=2, **adversarial))
    second = tiny(
        request.param,
        store,
        folder / f"{request.param}-0",
        warm_start=first,
        validation=ValidationConfig(data=store, segments=1, rollouts=1),
        **adversarial,
    )
    out = train(second)
    command = [
        "evaluate",
        str(out),
        "--data",
        str(store),
        "--rollouts",
        "2",
        "--rule",
        "best",
        "--prune-every",
        "3",
    ]
    assert main(command) == 0
    return out


@pytest.fixture
def made(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An agent `tiny` made from the run, in place of those that come with the package."""
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "pretrained")
    return make_pretrained.make(str(run), "tiny", pruning=PRUNING, folder=tmp_path / "pretrained")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_an_agent_is_its_run_without_what_only_training_needs(run: Path, made: Path, tmp_path: Path) -> None:
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
    assert str(config.warm_start) == make_pretrained.read_run(run).warm_start.name  # type: ignore[union-attr]


def test_the_same_run_gives_the_same_bytes(run: Path, made: Path, tmp_path: Path) -> None:
    torch.manual_seed(5)
    again = make_pretrained.make(str(run), "tiny", pruning=PRUNING, folder=tmp_path / "again")
    assert contents(again) == contents(made)


def test_the_card_says_what_was_done_and_found(run: Path, made: Path, store: Path) -> None:
    card = (made / "README.md").read_text()
    (file,) = (made / "evaluations").iterdir()
    record = json.loads(file.read_text())
    assert "per_segment" not in record
    assert record["agent"] == "pretrained:tiny"
    for part in (
        "# pretrained:tiny",
        record["data"]["checksum"],
        f"{record['ade']:.2f} ± {record['ade_se']:.2f}",
        "with seed 0",
        f"the run `{make_pretrained.read_run(run).warm_start.name}`",  # type: ignore[union-attr]
        "2 updates",
        "every 3 steps by rule `best`",
        "which it was not trained with",
        "## Limits",
    ):
        assert part in card


def test_scores_on_further_data_are_added_and_replaced(made: Path, tmp_path: Path) -> None:
    """Each data set has one place on the card, and the files and the card say the same."""
    (file,) = (made / "evaluations").iterdir()
    record = json.loads(file.read_text())
    further, again = tmp_path / "further.json", tmp_path / "again.json"
    record["data"] = {"name": "roads", "checksum": "ab" * 32}
    further.write_text(json.dumps(record))
    record["collision_rate"] = 12.5
    again.write_text(json.dumps(record))
    for given in (further, again):
        make_pretrained.add_scores("tiny", [given], made.parent)
        facts = pretrained.read_card(made)
        assert [found["data"] for found in facts["scores"]] == ["roads", "train"]
        assert len(list((made / "evaluations").iterdir())) == 2
        assert (made / "README.md").read_text() == make_pretrained.page(facts)
    assert facts["scores"][0]["rows"][""]["collision_rate"] == 12.5


def test_the_command_prints_every_card(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_scores_of_another_agent_are_refused(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with pytest.raises(ConfigError, match="of another agent: rule best, not systematic"):
        make_pretrained.make(str(run), "x", folder=folder)
    (file,) = (run / "evaluations").iterdir()
    record = json.loads(file.read_text())
    record["run"]["seed"] = 7
    wrong = tmp_path / "wrong.json"
    wrong.write_text(json.dumps(record))
    with pytest.raises(ConfigError, match="of another agent: seed 7, not 0"):
        make_pretrained.make(str(run), "x", scores=[wrong], pruning=PRUNING, folder=folder)
    assert not folder.exists()


def test_its_name_works_wherever_an_agent_is_named(made: Path, store: Path, tmp_path: Path) -> None:
    before = contents(made)
    data = ["--data", str(store)]
    file = tmp_path / "numbers.json"
    command = ["evaluate", "pretrained:tiny", *data, "--rollouts", "2", "--json", str(file)]
    assert main(command) == 0
    found, (kept,) = json.loads(file.read_text()), (made / "evaluations").iterdir()
    # It does what its run did when that was evaluated.
    assert {key: found[key] for key in ("ade", "collision_rate", "config")} == {
        key: json.loads(kept.read_text())[key] for key in ("ade", "collision_rate", "config")
    }
    figure = ["plot", "curvature", "pretrained:tiny", "--out"]
    assert main([*figure, str(tmp_path / "a.png")]) == 0
    method = make_pretrained.read_run(made).method
    start = tiny(method, store, tmp_path / "further", warm_start=Path("pretrained:tiny"), learning_rate=1e-30)
    start = dataclasses.replace(start, mgail=MGAILConfig(head_start=0, rollouts=2, learning_rate=1e-30))
    further = weights(train(start))
    for name, value in weights("pretrained:tiny").items():
        if not name.startswith("discriminator"):
            assert torch.equal(value, further[name]), name
    assert contents(made) == before, "its folder is not the user's"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "pretrained:tinny",
            "did you mean 'pretrained:tiny'\\? there are: pretrained:other, pretrained:tiny",
        ),
        ("pretrained:", "no agent 'pretrained:' comes with this package; there are: pretrained:other"),
        ("pretrained:../pretrained/tiny", "no agent"),
        ("pretrained:tiny@3", "has no checkpoint yet"),
    ],
)
def test_unknown_names(name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    for known in ("tiny", "other"):
        (tmp_path / known).mkdir()
        spec = AgentSpec(action_space="bicycle", dt=0.2)
        (tmp_path / known / "agent.json").write_text(to_json(spec))
    (tmp_path / "no_agent").mkdir()
    with pytest.raises(ConfigError, match=message):
        load_agent(name)


# --- those that come with the package ---


def test_there_are_some() -> None:
    assert "bc_ts_h" in SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped(name: str) -> None:
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


def test_they_are_small_and_all_of_them_is_in_the_wheel(tmp_path: Path) -> None:
    files = contents(pretrained.FOLDER)
    assert sum(map(len, files.values())) < 5e6
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path / name)
    shutil.copytree(ROOT / "src" / "symphony", tmp_path / "src" / "symphony")
    code = "from setuptools.build_meta import build_wheel; build_wheel('dist')"
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], cwd=tmp_path, capture_output=True, check=True
    )
    (wheel,) = (tmp_path / "dist").iterdir()
    with zipfile.ZipFile(wheel) as archive:
        inside = {
            name.removeprefix("symphony/pretrained/"): archive.read(name)
            for name in archive.namelist()
            if name.startswith("symphony/pretrained/")
        }
        assert "symphony/data/builtin/train/store.json" in archive.namelist()
    assert inside == files


# --- the command ---


@pytest.mark.parametrize(("rank", "lines"), [(None, 1), ("0", 1), ("1", 0)])
def test_one_process_says_where_the_agent_is(
    rank: str | None,
    lines: int,
    store: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("RANK", raising=False)
    if rank is not None:
        monkeypatch.setenv("RANK", rank)
    Train(config=tiny("bc", store, tmp_path / "run", steps=1))()
    assert capsys.readouterr().out.count("trained agent ") == lines


def test_python_m_symphony() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "symphony", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("symphony ")
