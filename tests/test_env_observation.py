"""What is asked for is observed and nothing else; simulation does not depend on it."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from helpers_segments import crossing, straight_road
from symphony import keys
from symphony.envs import (
    Bicycle,
    ConstantVelocity,
    Displacement,
    DrivingEnv,
    ObservationConfig,
    collate,
    scene,
)
from symphony.envs.observation import observe_states
from symphony.roadgraph import LaneGraph

NOTHING = ObservationConfig.nothing()
EVERYTHING = ObservationConfig(num_objects=4, num_points=60, clearance=True, foresight=(0.5, 1.0))
KEYS = {"own", "objects", "objects_mask", "points", "points_mask", "gap", "gap_ahead", "road"}


def make_env(config: ObservationConfig, dynamics: Any = None) -> DrivingEnv:
    return DrivingEnv(collate([scene(s, [0, 1]) for s in (straight_road(), crossing())]), dynamics, config)


@pytest.mark.parametrize(
    ("config", "missing"),
    [
        (EVERYTHING, set()),
        (ObservationConfig(num_objects=0, num_points=0), KEYS - {"own"}),
        (ObservationConfig(num_objects=0, num_points=7), KEYS - {"own", "points", "points_mask"}),
        (ObservationConfig(3, 0), KEYS - {"own", "objects", "objects_mask"}),
        (ObservationConfig(0, 0, clearance=True, foresight=(1.0,)), KEYS - {"own", "road"}),
        (NOTHING, KEYS),
    ],
)
@pytest.mark.parametrize("shape", [(), (2, 3)])
def test_there_are_entries_for_what_is_asked_for(
    config: ObservationConfig, missing: set[str], shape: tuple[int, ...]
) -> None:
    env = make_env(config)
    start = env.reset(TensorDict(batch_size=shape))
    check_env_specs(env, tensordict=start)
    agents = start["agents"]
    seen = set(agents["observation"].keys()) if "observation" in agents.keys() else set()  # noqa: SIM118
    assert seen == KEYS - missing
    assert ("observation" in agents.keys()) == bool(seen)  # noqa: SIM118


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_what_is_observed_changes_no_state_and_no_flag(dynamics: Any) -> None:
    envs = [make_env(config, dynamics) for config in (EVERYTHING, NOTHING, ObservationConfig(0, 3))]
    now = [env.start(torch.tensor([0, 1, 1]), torch.arange(3)) for env in envs]
    rng, flags = torch.Generator().manual_seed(0), torch.zeros(())
    for _ in range(25):
        action = (
            torch.randint(147, (3, 2), generator=rng)
            if dynamics.discrete
            else torch.rand(3, 2, 2, generator=rng) * torch.tensor([3.0, 0.3])
        )
        now = [env.step(td.set(keys.ACTION, action))["next"] for env, td in zip(envs, now, strict=True)]
        for other in now[1:]:
            for key in (keys.STATE, keys.COLLISION, keys.OFFROAD, keys.REWARD, "done"):
                assert torch.equal(now[0][key], other[key])
        flags = flags + now[0][keys.REWARD].sum()
    assert flags < 0


def test_states_can_be_observed_without_an_environment() -> None:
    logs = [crossing(4, seed=1, steps=9), straight_road(4, steps=9)]
    scenes = collate([scene(log, [0, 1], LaneGraph(log.road)) for log in logs])
    config = replace(EVERYTHING, num_objects=3, num_points=12, route=True)
    env = DrivingEnv(scenes, None, config)
    now = env.start(torch.tensor([0, 1, 1]), goal=torch.tensor([[0, -1], [0, 0], [1, 0]]))
    for _ in range(3):
        now = env.step(now.set(keys.ACTION, torch.full((3, 2), 90)))["next"]
    row, step = now[keys.SCENE].squeeze(-1), now[keys.STEP].squeeze(-1)
    state, valid, goal, come = (now[key] for key in (keys.STATE, keys.VALID, keys.GOAL, keys.PROGRESS))
    seen, _ = observe_states(scenes, row, step, state, valid, config, goal=goal, progress=come)
    assert now[keys.ROUTE].any()
    for name, value in now["agents", "observation"].items():
        assert torch.equal(seen[name], value), name


def test_constant_velocity_needs_no_observation() -> None:
    env = make_env(NOTHING)
    policy, now = ConstantVelocity(env.dynamics), env.start(torch.tensor([0]))
    for _ in range(50):
        now = env.step(policy(now))["next"]
    truth = torch.from_numpy(straight_road().position[:2, 50, :2])
    torch.testing.assert_close(now[keys.STATE][0, :, :2], truth, atol=0.01, rtol=0)


def test_tables_follow_the_scenes() -> None:
    one, two = make_env(EVERYTHING), make_env(EVERYTHING)
    two.scenes = collate([scene(crossing(5), [0, 1]), scene(straight_road(3), [0, 1])])
    fresh = DrivingEnv(two.scenes, None, EVERYTHING)
    one.start(torch.tensor([0, 1]))
    one.scenes = two.scenes
    for env in (one, two):
        assert (env.start(torch.tensor([0, 1])) == fresh.start(torch.tensor([0, 1]))).all()


@pytest.mark.filterwarnings("ignore:The method <bound method TensorDictBase.__deepcopy__")
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])  # noqa: S301 - our own
def test_copies_simulate_the_same(copied: Any) -> None:
    env = make_env(EVERYTHING)
    start = env.start(torch.tensor([0, 1])).set(keys.ACTION, torch.full((2, 2), 80))
    after = env.step(start.clone())["next"]
    twin = copied(env)
    assert (twin.step(start.clone())["next"] == after).all()
    kept = [made._kept() for made in (env, twin)]
    assert kept[0] is not kept[1]
    assert kept[1].scenes is twin.scenes


def test_agents_see_their_size_their_speed_and_that_the_log_ends() -> None:
    short, long = straight_road(steps=4), crossing(steps=6)
    scenes = collate([scene(short, [0, 1]), scene(long, [0, 1])])
    env = DrivingEnv(scenes, Bicycle(), ObservationConfig(num_objects=0, num_points=0))
    state, told = env.start(torch.arange(2)), []
    for _ in range(6):
        own = state["agents", "observation", "own"]
        told.append(own[:, 0, 3].tolist())
        scales = env.observation.speed_scale, env.observation.size_scale
        torch.testing.assert_close(own[..., 0] * scales[0], state[keys.STATE][..., 3])
        torch.testing.assert_close(own[..., 1:3] * scales[1], scenes.box_size[:, :2])
        state.set(keys.ACTION, torch.full((2, 2), env.dynamics.num_actions // 2))
        state = env.step(state)["next"]
    # With three and five steps to take; what goes on after its end is told so, too.
    assert told == [[k >= 3, k >= 5] for k in range(6)]


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_place_that_is_not_finite_spoils_what_is_seen_from_there_alone(wrong: float) -> None:
    """And NumPy does not warn of it."""
    env = make_env(ObservationConfig(num_objects=0, num_points=5))
    state = env.start(torch.tensor([0, 1]))
    good = env.at(state)[keys.POINTS]
    state[keys.STATE][1, 0, 0] = wrong
    found = env.at(state)[keys.POINTS]
    assert not found[1, 0].isfinite().all()
    assert torch.equal(found[0], good[0])
    assert torch.equal(found[1, 1], good[1, 1])
