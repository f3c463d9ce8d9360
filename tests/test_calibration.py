"""A threshold of the search from what the discriminator says of logged states."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from helpers_runs import tiny
from helpers_segments import crossing, straight_road
from symphony import keys
from symphony.agents import Agent, load_agent
from symphony.cli import main
from symphony.config import SearchConfig
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.envs import DrivingEnv
from symphony.errors import ConfigError
from symphony.recipes import train
from symphony.simulation import SceneDataset
from symphony.simulation.calibration import calibrated_threshold, logged_totals


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs") / "store"
    with StoreWriter(folder) as writer:
        for seed, steps in enumerate((12, 9, 10)):
            writer.append(crossing(4, seed=seed, steps=steps))
            writer.append(straight_road(4, seed=seed, steps=steps))
    return folder


@pytest.fixture(scope="module")
def run(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tiny("bc_ts_h", store, tmp_path_factory.mktemp("run") / "ts"))


def dataset(agent: Agent, store: Path, interactive: int = 2) -> SceneDataset:
    return SceneDataset(SegmentStore(store), interactive, agent.dynamics, routes=True)


def test_totals_of_the_log_are_those_of_its_states(run: Path, store: Path) -> None:
    agent = load_agent(str(run))
    assert agent.discriminator is not None
    (item,), data = [0], dataset(agent, store)
    scenes = data.scenes([item])
    env = DrivingEnv(scenes, agent.dynamics, agent.observation)
    state, _ = data.fitted([item], scenes)
    scores = []
    for step in range(1, int(scenes.last_step[0]) + 1):
        now = env.start(torch.tensor([0]))
        now = TensorDict({key: now.get(key) for key in (keys.SCENE, keys.STREAM, keys.VALID)}, [1])
        now.set(keys.STEP, torch.tensor([[step]])).set(keys.STATE, state[:, step])
        with torch.no_grad():
            seen = agent.discriminator(env.at(now.set(keys.GOAL, scenes.route_logged)))
        scores.append(seen.get(keys.SCORE)[0])
    each = torch.stack(scores)
    found = logged_totals(agent, data, SearchConfig(prune_every=3), batch=1)
    wanted = [each[first : first + 3].amax(0).sum() for first in range(0, len(each), 3)]
    torch.testing.assert_close(found[: len(wanted)], torch.stack(wanted), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("interactive", [1, 2])
def test_longer_periods_are_as_bad_as_their_worst_part(run: Path, store: Path, interactive: int) -> None:
    agent = load_agent(str(run))
    data = dataset(agent, store, interactive)
    short, long = (logged_totals(agent, data, SearchConfig(prune_every=n)) for n in (1, 100))
    assert len(long) == len(data)
    assert len(short) == int((SegmentStore(store).num_steps - 1).sum())
    if interactive == 1:
        assert long.max() == pytest.approx(float(short.max()), abs=1e-5)
    else:
        assert long.max() >= short.max() - 1e-5
    torch.testing.assert_close(
        logged_totals(agent, data, SearchConfig(), batch=2).sort().values,
        logged_totals(agent, data, SearchConfig(), batch=16).sort().values,
        atol=1e-5,
        rtol=1e-4,
    )


def test_the_threshold_lets_its_quantile_of_the_log_pass(run: Path, store: Path) -> None:
    agent = load_agent(str(run))
    data, search = dataset(agent, store), SearchConfig()
    totals = logged_totals(agent, data, search)
    for quantile in (0.1, 0.5, 0.9):
        threshold = calibrated_threshold(agent, data, search, quantile)
        share = float((totals <= threshold).double().mean())
        assert share == pytest.approx(quantile, abs=1.5 / len(totals))
    for wrong in (0.0, 1.0, 2.0):
        with pytest.raises(ConfigError, match="quantile"):
            calibrated_threshold(agent, data, search, wrong)
    plain = Agent("plain", agent.policy, agent.spec, agent.goals)
    with pytest.raises(ConfigError, match="no discriminator"):
        logged_totals(plain, data, search)


def test_an_evaluation_says_which_threshold_was_found(
    run: Path, store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "numbers.json"
    common = ["evaluate", str(run), "--data", str(store), "--rollouts", "2", "--no-keep", "--json", str(file)]
    calibrated = ["--calibrate", str(store), "--quantile", "0.8"]
    assert main([*common, "--rule", "replace", "--goals", "branch", *calibrated]) == 0
    record: dict[str, Any] = json.loads(file.read_text())
    agent = load_agent(str(run))
    wanted = calibrated_threshold(agent, dataset(agent, store), agent.search, 0.8)
    assert record["config"]["threshold"] == pytest.approx(wanted, abs=6e-4)
    shares = [record[f"goals_kept_{turn}"] for turn in ("left", "straight", "right")]
    assert sum(shares) == pytest.approx(100)
    assert 0 <= record["goals_turn_variation"] <= 1
    assert 1 <= record["goals_founders"] <= 2
    printed = capsys.readouterr()
    assert f"threshold {record['config']['threshold']:g}" in printed.err
    assert "stand at the end" in printed.out
    assert "first branches left" in printed.out.replace("\n", " ")
    assert main([*common, *calibrated, "--rule", "best"]) == 1
    assert main([*common, *calibrated, "--rule", "replace", "--threshold", "1"]) == 1
