"""The scene knows its time step; an agent that learned another one refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from helpers_runs import tiny
from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony.cli import main
from symphony.config import EvaluateConfig
from symphony.data.resample import resample
from symphony.envs import collate, scene
from symphony.errors import ConfigError, DataError
from symphony.evaluation import evaluate
from symphony.recipes import train


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> dict[float, Path]:
    """Make stores of the same two logs, by steps of 0.1 and of 0.2 seconds."""
    logs, folder = [make(4, steps=61, dt=0.1) for make in (straight_road, crossing)], tmp_path_factory.mktemp("data")
    return {dt: fill(folder / str(dt), [resample(log, dt) for log in logs]).path for dt in (0.1, 0.2)}


@pytest.fixture(scope="module")
def run(stores: dict[float, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An agent that learned steps of 0.2 s."""
    return train(tiny("bc", stores[0.2], tmp_path_factory.mktemp("runs") / "run", steps=2))


def test_constant_velocity_is_as_far_off_at_any_rate(stores: dict[float, Path]) -> None:
    found = {dt: evaluate("constant_velocity", store).numbers() for dt, store in stores.items()}
    assert found[0.2]["ade"] > 0.5
    # The mean is over steps, and the finer ones lie between the coarser.
    assert found[0.1]["ade"] == pytest.approx(found[0.2]["ade"], rel=0.1)


def test_agents_refuse_another_rate_than_they_learned(stores, run, capsys):
    assert evaluate(str(run), stores[0.2], EvaluateConfig(rollouts=1)).metrics.compute()["segments"] == 2
    message = r"learned steps of 0\.2 s and can't drive in steps of 0\.1 s.*--rate 5"
    with pytest.raises(ConfigError, match=message):
        evaluate(str(run), stores[0.1])
    assert main(["evaluate", str(run), "--data", str(stores[0.1])]) == 1
    assert "--rate 5" in capsys.readouterr().err


def test_training_at_another_rate_is_refused_before_the_first_update(stores, run, tmp_path):
    """A warm start from another rate, and a validation at another one."""
    train(tiny("bc", stores[0.2], tmp_path / "same", steps=2, warm_start=run))
    with pytest.raises(ConfigError, match=r"run learned steps of 0\.2 s and can't drive in steps of 0\.1 s"):
        train(tiny("bc", stores[0.1], tmp_path / "other", steps=2, warm_start=run))
    assert not (tmp_path / "other").exists()
    config = tiny("bc", stores[0.2], tmp_path / "run", steps=2)
    config = replace(config, validation=replace(config.validation, data=stores[0.1], segments=1, rollouts=1))
    with pytest.raises(ConfigError, match="learned steps"):
        train(config)
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_stores_and_batches_of_several_rates_are_refused(tmp_path: Path) -> None:
    slow, fast = straight_road(3, dt=0.2, seed=1), straight_road(3, dt=0.1, seed=2)
    with pytest.raises(DataError, match=r"different time steps in one batch: 0\.1 s, 0\.2 s"):
        collate([scene(slow), scene(fast)])
    fill(tmp_path / "mixed", [slow, fast])
    with pytest.raises(DataError, match=rf"{fast.segment_id}.*has steps of 0\.1 s, others of 0\.2 s"):
        train(tiny("bc", tmp_path / "mixed", tmp_path / "run"))
