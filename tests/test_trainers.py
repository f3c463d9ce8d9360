"""Training and evaluation, end to end on tiny stores; what a recipe looks like, and that each runs."""

from __future__ import annotations

import ast
import copy
import inspect
import json
import math
import re
import runpy
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest
import torch

import symphony
from helpers_runs import run_of, tiny
from helpers_segments import crossing, straight_road
from helpers_store import fill, stored
from symphony.agents import build_agent, load_agent, observation_of
from symphony.agents.checkpoint import checkpoints
from symphony.cli import recipe as recipes
from symphony.config import METHODS, AgentConfig, AgentSpec, Method, TrainConfig, read_json, to_json
from symphony.config.files import from_dict
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.learning.demonstrations import SceneDataset
from symphony.objectives import GoalLoss
from symphony.recipes import recipe_of, train
from symphony.training import Phase, Processes, Trainer, Updates, cosine
from symphony.training.logging import read_metrics

TINY = AgentConfig(num_points=20, hidden=8)
ROADS = [straight_road(4, seed=seed, steps=11 + 3 * seed) for seed in range(3)]
store = stored(lambda: [*ROADS, *(crossing(4, seed=seed, steps=16) for seed in range(3))])


def config(store: Path, out: Path, method: Any = "bc", **changes: Any) -> TrainConfig:
    return tiny(method, store, out, **{"steps": 6, "agent": TINY, "segments": 3, "states": 32, **changes})


run = run_of(config)


def test_a_run_leaves_its_config_metrics_and_last_checkpoints(run: Path, store: Path) -> None:
    assert read_json(TrainConfig, run / "config.json") == config(store, run)
    spec = config(store, run).spec("bicycle", 0.2)
    assert spec.agent == TINY
    assert read_json(AgentSpec, run / "agent.json") == spec == load_agent(str(run)).spec
    assert [r["step"] for r in read_metrics(run)] == [1, 2, 3, 4, 5, 6]
    assert [int(p.name[-12:]) for p in checkpoints(run / "checkpoints")] == [2, 4, 6]


def test_one_that_failed_at_its_first_update_is_no_run(store: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="60 are asked for"):
        train(config(store, tmp_path / "run", duration=60))
    train(config(store, tmp_path / "run"))


def test_a_run_is_not_overwritten_nor_resumed_as_another(run: Path, store: Path, tmp_path: Path) -> None:
    before = [(run / name).read_bytes() for name in ("config.json", "agent.json")]
    with pytest.raises(ConfigError, match="holds a run already"):
        train(config(store, run))
    other = fill(tmp_path / "other", [crossing(5, dt=0.1)]).path
    refused: Any = ({"seed": 5}, r"another seed \(was \d+\)$"), ({"data": other}, "not the run segments")
    for change, why in (*refused, ({"steps": 5}, r"6 updates are done, more than steps \(5\)")):
        with pytest.raises((ConfigError, DataError), match=why):
            train(replace(config(store, run, resume=True), **change))
    assert before == [(run / name).read_bytes() for name in ("config.json", "agent.json")]


def test_a_recipe_of_ones_own_may_leave_the_policy_as_it_is(store: Path, tmp_path: Path) -> None:
    settings, rng = config(store, tmp_path / "goals", method="bc_h"), torch.Generator()
    data = SceneDataset(SegmentStore(store), routes=True, **settings.scenes)
    spec = settings.spec("bicycle", data.dt, goals=True)
    agent = build_agent("goals", spec)
    before, loss = copy.deepcopy(agent.policy.state_dict()), GoalLoss(agent.goals)

    def update(step: int) -> Updates:
        batch = data.sample_goals(data.draw(2, rng), 8, observation_of(spec), rng)
        yield "goals", loss(batch)

    phases = [Phase(settings.steps, update, cosine({"goals": 0.01}, settings.steps))]
    optimizers = {"goals": torch.optim.Adam(agent.goals.parameters())}
    alone = Processes(torch.device("cpu"))
    out = Trainer(settings, agent, data, phases, optimizers, rng, alone).run()
    assert [r["step"] for r in read_metrics(out) if "loss_goals" in r] == [1, 2, 3, 4, 5, 6]
    after = load_agent(str(out)).policy.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_training_lowers_the_loss(store: Path, tmp_path: Path) -> None:
    how = {"steps": 40, "states": 128, "learning_rate": 1e-2, "checkpoint_every": 40}
    out = train(config(store, tmp_path / "long", **how))
    losses, rates = ([r[name] for r in read_metrics(out)] for name in ("loss_policy", "learning_rate"))
    assert rates[0] == 1e-2
    assert rates[-1] == pytest.approx(1e-3, rel=0.05)
    assert losses[0] == pytest.approx(math.log(147), rel=0.1)
    assert sum(losses[-5:]) < 0.85 * sum(losses[:5])


def test_a_store_that_teaches_nothing_is_found_before_training(tmp_path: Path) -> None:
    fill(tmp_path / "store", [])
    for method in METHODS:
        with pytest.raises(DataError, match="no run segments") as caught:
            train(config(tmp_path / "store", tmp_path / "run", method=method))
        assert caught.value.file == tmp_path / "store"
        assert not (tmp_path / "run").exists()


def test_configurations_are_read_back_strictly(store: Path, tmp_path: Path) -> None:
    settings, file = config(store, tmp_path, "bc_ts"), tmp_path / "config.json"
    good = json.loads(to_json(settings))
    changes: list[tuple[dict[str, Any], str]] = [({"format": 99}, "configuration of another version")]
    changes += [({"learning_rat": 1}, "unknown setting 'learning_rat'"), ({"serach": {}}, ""), ({"method": "x"}, "")]
    for part, more in (("search", "branch"), ("discriminator", "feature"), ("discriminator", "features")):
        changes.append(({part: good[part] | {more: "papre"}}, ""))
    for change, message in changes:
        file.write_text(json.dumps(good | change))
        with pytest.raises(ConfigError, match=rf"config\.json: .*{message}"):
            read_json(TrainConfig, file)
    with pytest.raises(ConfigError, match="missing"):
        from_dict(TrainConfig, {"out": "x", "method": "bc"})
    for wrong, message in (({"seed": 1 << 40}, "seed must be at most"), ({"steps": 0}, "steps must be positive")):
        with pytest.raises(ConfigError, match=message):
            replace(config(store, tmp_path), **wrong)


SOURCE = Path(symphony.__file__).parent
RECIPES = get_args(Method)
SCRIPTS = Path(__file__).parents[1] / "recipes"
MAY_NAME_METHODS = ("recipes", "cli", "config")
ROWS_OF_TABLES = ("formats.py", "paper.py", "relations.py", "table.py")
"""Of ``evaluation``: methods are rows there."""


def test_there_is_a_recipe_for_every_method_and_the_file_that_one_opens_is_the_one_that_runs() -> None:
    assert {path.stem for path in SCRIPTS.glob("*.py")} == {"__init__", *RECIPES}
    assert (SOURCE / "recipes").resolve() == SCRIPTS.parent.resolve() / "recipes"


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_is_one_function_that_can_be_read_at_once(name: str) -> None:
    text, recipe = (SCRIPTS / f"{name}.py").read_text(encoding="utf-8"), recipe_of(name)  # type: ignore[arg-type]
    assert (recipe.__module__, recipe.__name__) == (f"symphony.recipes.{name}", name)
    assert list(inspect.signature(recipe).parameters) == ["config", "processes"]
    tree = ast.parse(text)
    assert [node.name for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)] == [name]
    assert "symphony.recipes" not in text  # they repeat one another, and don't lean on one another
    # All displace states as they are told to; those that search without TS keep all branches.
    assert ["config.perturb.at(step)" in text, "pruning_rule(config.search)" in text] == [True, "_ts" in name]
    assert not re.search(r"\.method\b", text)
    # As a script it runs itself.
    assert ast.unparse(tree).endswith(f":\n    from symphony.cli.recipe import main\n    main({name}, __doc__)")


def test_nothing_below_the_recipes_names_a_method() -> None:
    """Nor looks which it is."""
    word = re.compile(rf"""config\.method\b|["'](?:{"|".join(RECIPES)})["']|endswith\("_h"\)""")
    found, looked = [], 0
    for path in sorted(SOURCE.rglob("*.py")):
        where = path.relative_to(SOURCE)
        if where.parts[0] in MAY_NAME_METHODS or (where.parts[0] == "evaluation" and path.name in ROWS_OF_TABLES):
            continue
        lines = enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        found += [f"{where}:{k}" for k, line in lines if word.search(line) and "``" not in line]
        looked += 1
    assert looked > 100
    assert found == []


COMMON = "--steps 3 --states 16 --agent.hidden 8 --agent.num-points 10 --wandb disabled --rollouts 2"
SEARCH = "--search.branches 2 --search.prune-every 3 --search.test-branches 2 --search.updates 2 --search.states 8"
ADVERSARIAL = "--mgail.regression 1 --mgail.head-start 1 --mgail.rollouts 2"
ARGUMENTS = {"bc": COMMON, "bc_h": COMMON}
ARGUMENTS |= dict.fromkeys(("bc_ts", "bc_ts_h", "bc_rl", "bc_rl_h"), f"{COMMON} {SEARCH} --checkpoint-every 2")
ARGUMENTS |= dict.fromkeys(("mgail", "mgail_h", "mgail_ts", "mgail_ts_h"), f"{ARGUMENTS['bc_ts']} {ADVERSARIAL}")


@pytest.fixture
def run_script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[Path, str], Any]:
    """Run a file as a script in an empty folder; returns its status."""

    def run(file: Path, words: str) -> Any:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(recipes, "settle", lambda: None)
        monkeypatch.setattr(sys, "argv", [file.name, *words.split()])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(file), run_name="__main__")
        return ended.value.code

    return run


@pytest.fixture(scope="module")
def splits(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data")
    for split, seed in (("train", 0), ("test", 1)):
        fill(path / split, [straight_road(4, seed=seed, steps=5), crossing(4, seed=seed, steps=5)])
    return path


@pytest.mark.parametrize("method", RECIPES)
def test_recipe(run_script: Any, splits: Path, tmp_path: Path, method: str, capsys: Any) -> None:
    words = f"--data {splits}/train --test {splits}/test --out run {ARGUMENTS[method]}"
    assert run_script(SCRIPTS / f"{method}.py", words) == 0
    (file,) = (tmp_path / "run" / "evaluations").iterdir()
    found = json.loads(file.read_text())
    assert found["run"]["method"] == method
    assert found["config"]["search"] == ("tree" if "_ts" in method else "none")
    assert found["playback"]["ade"] == 0
    assert found["ade"] > 0
    assert len(found["per_segment"]) == 2
    assert f"{found['ade']:.2f}" in capsys.readouterr().out


def test_a_changed_copy_elsewhere_is_what_runs(run_script, tmp_path, capsys, monkeypatch):
    fill(tmp_path / "data", [crossing(4, steps=8)])
    source, update = (SCRIPTS / "bc.py").read_text(encoding="utf-8"), 'yield "policy", policy_loss(experts)'
    changed = tmp_path / "mine.py"
    changed.write_text(source.replace(update, f'{update}; print("mine")'), encoding="utf-8")
    # Mistakes are told in a line before the training.
    for words, told in (("none", "none: no such directory"), ("data --rollouts 0", "rollouts must be positive")):
        assert run_script(changed, f"--data data --out run {COMMON} --test {words}") == 1
        assert told in capsys.readouterr().err
        assert not (tmp_path / "run").exists()
    monkeypatch.setenv("RANK", "1")  # of several processes the first evaluates
    assert run_script(changed, f"--data data --test data --out run {COMMON}") == 0
    assert capsys.readouterr().out.count("mine\n") == 3  # updates
    assert not (tmp_path / "run" / "evaluations").exists()
