"""The Gymnasium environment: what its checker wants, and that it is the driving environment."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers_segments import along, crossing, hide, make_road, make_segment, straight_road
from helpers_store import fill
from symphony import keys
from symphony.agents import load_agent
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.envs.driving import DrivingEnv
from symphony.envs.dynamics import Bicycle, displacement_inverse
from symphony.envs.observation import ObservationConfig
from symphony.envs.scene import scene
from symphony.errors import ConfigError, DataError
from symphony.learning.demonstrations import SceneDataset
from symphony.planners.interface import Pose
from symphony.saved.saving import save_simulation

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra 'gym'")

NAME = "symphony.gym:symphony/Driving-v0"
SMALL = ObservationConfig(num_objects=4, num_points=8)
WITH_ROUTE = ObservationConfig(num_objects=4, num_points=8, route=True)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    late = hide(straight_road(3, seed=5), 0, slice(0, 2))
    fill(tmp_path / "store", [late, crossing(4, steps=9), straight_road(4, steps=9)])
    return tmp_path / "store"


@pytest.mark.parametrize(("action", "observation"), [("discrete", WITH_ROUTE), ("continuous", SMALL)])
def test_gymnasiums_checker_is_content(store, action, observation):
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make(NAME, data=store, action=action, observation=observation)
    check_env(env.unwrapped, skip_render_check=True)


def test_it_is_the_driving_environment(store):
    env = gymnasium.make(NAME, data=str(store), observation=SMALL, ends_on=())
    seen, info = env.reset(seed=1, options={"segment": "crossing-0"})
    segment = SegmentStore(store)[1]
    other = DrivingEnv(scene(segment, [segment.ego]), Bicycle(), SMALL)
    now = other.start(torch.tensor(0))
    rng, truncated = np.random.default_rng(0), False
    while not truncated:
        for name, value in now.get(("agents", "observation")).items():
            np.testing.assert_array_equal(seen[name], value[0].numpy())
        np.testing.assert_array_equal(info["state"], now.get(keys.STATE)[0].numpy())
        assert info["collision"] == bool(now.get(keys.COLLISION))
        action = int(rng.integers(env.action_space.n))
        seen, reward, terminated, truncated, info = env.step(action)
        after = other.step(now.set(keys.ACTION, torch.tensor([action]))).get("next")
        assert reward == float(after.get(keys.REWARD))
        assert not terminated
        now = after.exclude(keys.REWARD)
    assert info["step"] == segment.num_steps - 1
    assert info["segment"] == "crossing-0"


def test_it_sees_what_a_planner_sees(store, tmp_path):
    """The record is the same where a planner drives as it did."""
    env = gymnasium.make(NAME, data=store, observation=SMALL, ends_on=()).unwrapped
    env.reset(options={"segment": "crossing-0"})
    mine, states, told = [], [], []
    for action in np.random.default_rng(0).integers(env.action_space.n, size=8):
        mine.append(env.seen())
        states.append(env.step(int(action))[-1]["state"].tolist())

    def follows(seen):
        told.append(seen)
        return Pose(*states[seen.step])

    agent = load_agent("playback")
    data = SceneDataset(SegmentStore(store), 1, agent.dynamics, [1], routes=True)
    (saved,) = save_simulation(tmp_path / "sim", agent, data, EvaluateConfig(rollouts=1), planner=follows)
    np.testing.assert_allclose(saved.state[0, 1:, 0], states, atol=1e-4)
    assert len(mine) == len(told) == saved.steps
    for one, other in zip(mine, told, strict=True):
        same(dataclasses.asdict(one) | {"seed": 0}, dataclasses.asdict(other) | {"seed": 0})


def test_the_way_of_one_that_crosses_its_own_path_goes_straight_on(tmp_path):
    """A loop to the left of 20 m radius that crosses the street it came from."""
    angle, street = np.linspace(-np.pi / 2, np.pi, 47), np.arange(0, 101, 2.0)
    circle = np.stack([100 + 20 * np.cos(angle), 20 + 20 * np.sin(angle)], -1)
    off = np.stack([np.full(110, 80.0), np.arange(20, -200, -2.0)], -1)
    lanes = [np.stack([street, 0 * street], -1), circle, off]
    place, heading = along(np.concatenate([lanes[0], circle[1:], off[1:]]), 60 + 0.8 * np.arange(200))
    forward = np.stack([np.cos(heading), np.sin(heading)], -1)
    place += 0.4 * forward[:, ::-1] * [-1, 1]
    road = make_road(lanes, successors=[(0, 1), (1, 2)])
    fill(tmp_path / "loop", [make_segment(road, place[None], heading[None], 4 * forward[None])])
    env = gymnasium.make(NAME, data=tmp_path / "loop", action="continuous", ends_on=()).unwrapped
    env.reset(options={"segment": 0})
    for there in np.concatenate([place, heading[:, None], np.full((200, 1), 4.0)], -1)[1:-1]:
        now = env._now.get(keys.STATE)[:1]
        env.step(displacement_inverse(now, torch.tensor(there[None], dtype=torch.float32))[0].numpy() / 8.0)
        seen = env.seen()
        way = seen.route[1] - seen.route[0]
        assert np.cos(np.arctan2(*way[::-1]) - seen.ego.heading) > 0.8


def same(one, other):
    """Records, tuples and arrays of the same numbers."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        one, other = tuple(one.values()), tuple(other.values())
    if isinstance(one, tuple):
        assert len(one) == len(other)
        for mine, theirs in zip(one, other, strict=True):
            same(mine, theirs)
    elif np.asarray(one).dtype.kind == "f":
        np.testing.assert_allclose(one, other, atol=0.02)
    else:
        np.testing.assert_array_equal(one, other)


def test_the_ego_is_driven_and_reaches_what_it_hits(store):
    """Full displacement to the side leaves the road and ends the episode."""
    env = gymnasium.make(NAME, data=store, action="continuous", observation=SMALL)
    _, start = env.reset(seed=0, options={"segment": 2})
    step = np.array([0.25, -1.0], np.float32)
    _, reward, terminated, truncated, info = env.step(step)
    assert info["driven"] == pytest.approx(float(np.hypot(0.25, 1.0)) * 40 * 0.2, rel=1e-4)
    moved = info["state"][:2] - start["state"][:2]
    np.testing.assert_allclose(moved, [0.25 * 8, -8], atol=1e-4)
    assert (reward, terminated, truncated, info["offroad"]) == (-1.0, True, False, True)


def test_segments_are_drawn_by_seed_and_only_those_with_an_ego(store):
    def drawn(seed: int) -> list[str]:
        env = gymnasium.make(NAME, data=store, observation=SMALL)
        return [env.reset(seed=seed if k == 0 else None)[1]["segment"] for k in range(8)]

    assert drawn(3) == drawn(3)
    assert set(drawn(3) + drawn(4)) == {"crossing-0", "straight-0"}
    env = gymnasium.make(NAME, data=store, observation=SMALL, duration=1)
    with pytest.raises(DataError, match="not seen at the first step"):
        env.reset(options={"segment": "straight-5"})
    with pytest.raises(DataError, match="no such segment"):
        env.reset(options={"segment": "nowhere"})
    for seconds, steps in ((1, 5), (0.01, 1)):
        env = gymnasium.make(NAME, data=store, observation=SMALL, duration=seconds)
        env.reset(options={"segment": 1})
        ends = [env.step(env.action_space.n // 2)[3] for _ in range(steps)]
        assert ends == [False] * (steps - 1) + [True]
        assert env.unwrapped.seen().step == steps


def test_the_extra_is_named_where_it_is_missing():
    code = "import sys; sys.modules['gymnasium'] = None; import symphony.gym"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "symphony-traffic[gym]" in done.stderr


def test_a_reward_of_ones_own_and_continuous_actions_cut_to_the_space(store):
    def speed(before: Any, after: Any) -> Any:
        return after.get(keys.STATE)[..., 3]

    env = gymnasium.make(NAME, data=store, action="continuous", reward=speed, ends_on=()).unwrapped
    found = []
    for ahead in (1.0, 5.0):
        env.reset(options={"segment": 1})
        _, reward, *_, info = env.step(np.array([ahead, 0.0], np.float32))
        assert reward == info["state"][3]
        found.append(info["state"])
    np.testing.assert_array_equal(*found)
    for action in ((np.nan, 0.0), (0.0, np.inf), (1.0,)):
        with pytest.raises(ConfigError, match="two finite numbers"):
            env.step(np.array(action, np.float32))


def test_actions_segments_and_arguments_that_are_none(store):
    fill(store.parent / "empty", [])
    wrong = {"discrete or continuous": {"action": "jump"}, "must not be negative": {"duration": -1.0}}
    wrong |= {"no run segments": {"data": store.parent / "empty"}}
    for message, given in wrong.items():
        with pytest.raises((ConfigError, DataError), match=message):
            gymnasium.make(NAME, **{"data": store, **given})
    env = gymnasium.make(NAME, data=store, observation=SMALL).unwrapped
    env.reset(options={"segment": 1})
    for number, message in ((-1, "holds 3 segments"), (3, "holds 3 segments"), (1.5, "an id or a number")):
        with pytest.raises((ConfigError, DataError), match=message):
            env.reset(options={"segment": number})
    for action in (-1, env.action_space.n, 1.5, np.nan, np.array([1]), "1"):
        with pytest.raises(ConfigError, match="is not one of"):
            env.step(action)


def test_torchrl_makes_it_by_its_name(store):
    from torchrl.envs import GymEnv

    import symphony.gym  # noqa: F401

    env = GymEnv("symphony/Driving-v0", data=str(store), observation=SMALL, ends_on=())
    assert env.rollout(3)["next", "own"].shape == (3, 4)
