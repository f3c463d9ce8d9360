"""Runs that are validated while they train, and the checkpoints that become their agents."""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from helpers_runs import build, same_weights, tiny, weights
from helpers_segments import crossing, straight_road
from helpers_store import fill, stored
from symphony.agents import load_agent
from symphony.agents.checkpoint import CheckpointError, checkpoints, save_checkpoint
from symphony.agents.choice import Best, choose, split_name
from symphony.cli.agents import Train
from symphony.config import EvaluateConfig, TrainConfig, ValidationConfig
from symphony.errors import ConfigError, DataError
from symphony.evaluation import evaluate
from symphony.recipes import train
from symphony.training.hooks import METRICS, Validator
from symphony.training.logging import read_metrics

store = stored(lambda: [straight_road(4, steps=6), crossing(4, steps=5)])
held_out = stored(lambda: [crossing(6, seed=10 + seed, steps=5) for seed in range(4)])


def config(store: Path, out: Path, held_out: Path | None, method: Any = "bc", **changes: Any) -> TrainConfig:
    return tiny(method, store, out, **{"validation": ValidationConfig(data=held_out, rollouts=2), **changes})


@pytest.fixture(scope="module")
def run(store: Path, held_out: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(config(store, tmp_path_factory.mktemp("runs") / "bc", held_out, "bc_ts", steps=5))


def steps(run: Path) -> list[int]:
    return [int(path.name[-12:]) for path in checkpoints(run / "checkpoints")]


def test_every_checkpoint_and_the_last_weights_are_evaluated_as_the_evaluator_does(run, held_out):
    """With search, as the agent is simulated."""
    records = [r for r in read_metrics(run) if "validation_infractions" in r]
    assert [r["step"] for r in records] == [2, 4, 5]
    for record in records:
        total = record["validation_collision_rate"] + record["validation_offroad_time"]
        assert record["validation_infractions"] == total
    for record in records[::2]:
        found = evaluate(f"{run}@{record['step']}", held_out, EvaluateConfig(rollouts=2))
        assert found.search == "tree"
        numbers = found.numbers()
        assert {f"validation_{name}": numbers[name] for name in METRICS}.items() <= record.items()


def test_validations_are_compiled_as_the_run_says(store, held_out, tmp_path):
    """By itself on a device where all together are long enough to win, each of which may be too short."""
    for choice, device, length, compiled in (
        ("yes", "cpu", 4, True), ("no", "meta", 4000, False), ("auto", "cpu", 4000, False),
        ("auto", "meta", 4, False), ("auto", "meta", 4000, True),
    ):  # fmt: skip
        run = config(store, tmp_path, held_out, compile=choice, device=device, steps=length)
        found = Validator(run, load_agent("idm"), torch.device(device))
        assert (found.how.compile, found.dataset.few_shapes) == ("yes" if compiled else "no", compiled)


Scripted = Callable[..., None]


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> Scripted:
    """Let the evaluator find given infractions at the evaluations to come."""

    class Found:
        def __init__(self, value: float) -> None:
            self.metrics, self.value = self, value

        def compute(self) -> dict[str, float]:
            found = {"collision_rate": self.value, "offroad_time": 0.0, "offroad_segments": 1}
            return {**dict.fromkeys(METRICS, 1.0), **found}

    def script(*values: float) -> None:
        left = iter(values)
        monkeypatch.setattr("symphony.training.hooks.evaluate", lambda *_: Found(next(left)))

    return script


def test_the_best_checkpoint_stays_and_is_the_agent(store, held_out, tmp_path, scripted):
    scripted(30.0, 20.0, math.nan, 20.0, 25.0, 21.0)
    out = train(config(store, tmp_path / "run", held_out, steps=12))
    assert (steps(out), choose(out).name) == ([4, 8, 10, 12], "step-000000000004")
    assert same_weights(weights(out), weights(f"{out}@4"))
    assert not same_weights(weights(out), weights(f"{out}@last"))
    assert load_agent(f"{out}@last").name == f"{out}@last"


def test_a_warm_start_takes_the_best_too(store, held_out, tmp_path, scripted):
    scripted(1.0, 2.0)
    source = train(config(store, tmp_path / "source", held_out, steps=4))
    for name, step in ((str(source), 2), (f"{source}@last", 4)):
        still = config(store, tmp_path / str(step), None, warm_start=Path(name), learning_rate=1e-30, steps=2)
        assert same_weights(weights(train(still)), weights(f"{source}@{step}"))


def test_a_resumed_run_remembers_the_best(store, held_out, tmp_path, scripted, capsys):
    whole = config(store, tmp_path / "run", held_out, steps=12)
    scripted(30.0, 10.0, 20.0, 20.0, 20.0, 20.0)
    train(whole)
    for last in ("12", "10"):
        shutil.rmtree(choose(whole.out, last))
    scripted(15.0, 15.0)
    train(replace(whole, resume=True))
    assert (steps(whole.out), choose(whole.out).name[-2:]) == ([4, 8, 10, 12], "04")
    scripted(9.0)
    train(replace(whole, resume=True, steps=14))
    assert (steps(whole.out), choose(whole.out).name[-2:]) == ([10, 12, 14], "14")
    # And without evaluations from here on.
    Train(config=replace(whole, resume=True, steps=24, validation=ValidationConfig(rollouts=2)))()
    assert (steps(whole.out), choose(whole.out).name[-2:]) == ([14, 20, 22, 24], "14")
    assert "4: the best one, with collision rate plus off-road time of 9.00 % in val" in capsys.readouterr().out


def test_what_is_evaluated_stays_the_same_when_a_run_goes_on(store, held_out, tmp_path):
    short = config(store, tmp_path / "run", held_out, steps=2)
    train(short)
    for other in ({"rollouts": 3}, {"segments": 2}):
        with pytest.raises(ConfigError, match="another validation"):
            train(replace(short, resume=True, steps=4, validation=replace(short.validation, **other)))
    moved = shutil.copytree(held_out, tmp_path / "moved")
    train(replace(short, resume=True, steps=4, validation=replace(short.validation, data=moved)))
    # Nor can scores on other segments be compared, whether or not it was evaluated in between.
    others = fill(tmp_path / "others", [crossing(6, seed=20 + seed, steps=5) for seed in range(4)]).path
    for between in (False, True):
        if between:
            train(replace(short, resume=True, steps=6, validation=ValidationConfig(rollouts=2)))
        with pytest.raises(ConfigError, match=r"chosen by 4 segments of .*, 2 rollouts; can't be compared"):
            train(replace(short, resume=True, steps=8, validation=replace(short.validation, data=others)))
    # A run that was not evaluated so far may be from now on.
    plain = config(store, tmp_path / "plain", None, steps=2)
    train(plain)
    train(replace(plain, resume=True, steps=4, validation=ValidationConfig(data=held_out, rollouts=1)))
    assert choose(plain.out, "best").name.endswith("4")


def test_segments_are_spread_over_the_store(store: Path, held_out: Path, tmp_path: Path) -> None:
    for count, wanted in ((1, [0]), (2, [0, 2]), (3, [0, 1, 2]), (9, [0, 1, 2, 3])):
        some = ValidationConfig(data=held_out, rollouts=2, segments=count)
        validator = build(config(store, tmp_path, held_out, validation=some)).validator
        assert validator.dataset.indices == wanted


def test_stores_that_cannot_be_used_are_found_before_training(store: Path, tmp_path: Path) -> None:
    few = fill(tmp_path / "few", [straight_road(4, steps=8), straight_road(1, seed=1, steps=8)]).path
    empty = fill(tmp_path / "empty", []).path
    for data, message in ((few, "interactive"), (empty, "no run segments"), (tmp_path / "none", "none")):
        with pytest.raises(DataError, match=message):
            train(config(store, tmp_path / "run", data))
        assert not (tmp_path / "run").exists()


def test_settings_that_do_not_fit_are_refused(store: Path, held_out: Path, tmp_path: Path) -> None:
    many = ValidationConfig(data=held_out, rollouts=3)
    with pytest.raises(ConfigError, match=r"must not exceed search\.test-branches \(2\)"):
        build(config(store, tmp_path / "a", held_out, "bc_ts", validation=many))
    build(config(store, tmp_path / "b", held_out, "bc", validation=many))
    assert not list(tmp_path.iterdir())
    for bad in ({"segments": 0}, {"rollouts": 0}):
        with pytest.raises(ConfigError):
            ValidationConfig(**bad)


def made(folder: Path, best: dict[int, Best | None]) -> Path:
    """A run's folder with empty checkpoints, each of which knows the best so far."""
    for step, known in best.items():
        extra = {"best": None if known is None else dataclasses.asdict(known)}
        save_checkpoint(folder / "checkpoints", step=step, modules={"m": nn.Linear(1, 1)}, extra=extra)
    return folder


def test_names_of_checkpoints(tmp_path: Path) -> None:
    run = made(tmp_path / "a@home", {2: None, 4: Best(4, 1.0), 6: Best(4, 1.0)})
    names = {str(run): (run, ""), f"{run}@last": (run, "last"), "somewhere": (Path("somewhere"), "")}
    assert {name: split_name(name) for name in names} == names
    assert [choose(run, w).name[-1] for w in ("", "best", "last", "2", "step-6")] == ["4", "4", "6", "2", "6"]
    with pytest.raises(ConfigError, match="no checkpoint of step 3, it has those of the steps 2, 4, 6"):
        choose(run, "3")
    with pytest.raises(ConfigError, match="'first' is not a checkpoint; name best, last or a step"):
        choose(run, "first")
    shutil.rmtree(choose(run))
    with pytest.raises(CheckpointError, match="best checkpoint, of step 4, is gone; it has"):
        choose(run)
    assert choose(run, "last").name[-1] == "6"
    plain = made(tmp_path / "plain", {2: None})  # from before there was validation, or without
    assert choose(plain) == choose(plain, "last")
    with pytest.raises(ConfigError, match="not validated"):
        choose(plain, "best")
    with pytest.raises(ConfigError, match="no checkpoint yet"):
        choose(tmp_path)
