"""The inputs of a policy beside the paper's: where others are along its route, gaps, lights."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers_runs import tiny, weights
from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony.agents import load_agent
from symphony.config import AgentConfig, MGAILConfig, PerturbConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, DrivingEnv
from symphony.envs.objects import Observers
from symphony.envs.observation import OBJECT_FEATURES, SELF_FEATURES, ObservationConfig, observed_lights
from symphony.envs.routes import ALONG_FEATURES, POINTS, ROUTE_FEATURES, SPACING, RouteWindow, along_route
from symphony.envs.scene import LIGHT_COLUMN, Tables, collate
from symphony.learning import SceneDataset
from symphony.recipes import train


def scene(seed: int, others: int = 6) -> tuple[Any, ...]:
    """One agent on a winding route, some others around it, in double precision."""
    rng = torch.Generator().manual_seed(seed)
    turn = 0.1 * torch.randn(POINTS, generator=rng, dtype=torch.float64).cumsum(0)
    step = SPACING * torch.stack([turn.cos(), turn.sin()], -1)
    points = (step.cumsum(0) - step[:1])[None, None]
    # Not at the route's beginning, so that there is something behind.
    own = torch.cat([points[0, 0, 8], turn[8:9], 20 * torch.rand(2, generator=rng, dtype=torch.float64)])
    place = 4 * torch.randn(others, 2, generator=rng, dtype=torch.float64)
    place += points[0, 0, :: POINTS // others][:others]
    motion = 10 * torch.randn(others, 3, generator=rng, dtype=torch.float64)
    size = torch.tensor([4.5, 2.0], dtype=torch.float64)
    route = RouteWindow(points, torch.ones(1, 1, POINTS, dtype=torch.bool), torch.tensor([[8]]))
    state = torch.cat([place, motion], -1)
    return own[None, None], size[None, None], state[None, None], size.expand(1, 1, others, 2), route


@given(seed=st.integers(0, 10_000), faster=st.floats(0, 80))
def test_all_numbers_are_bounded_at_any_speed(seed: int, faster: float) -> None:
    own, size, others, *rest = scene(seed)
    others = others.clone()
    others[..., 3:] *= faster
    found = along_route(own, size, others, *rest)
    assert found.shape[-1] == ALONG_FEATURES
    assert found.abs().max() <= 1
    assert found.isfinite().all()


def test_on_a_straight_route_it_is_what_can_be_computed_by_hand() -> None:
    points = torch.stack([SPACING * torch.arange(POINTS).double(), torch.zeros(POINTS).double()], -1)
    own = torch.tensor([[[10.0, 0.5, 0.0, 10.0, 0.0]]], dtype=torch.float64)
    others = torch.tensor(
        [
            [30.0, 0.0, 0.0, 4.0, 0.0],  # a slower one ahead
            [4.0, -3.5, 0.0, 12.0, 0.0],  # a faster one behind on the right
            [11.0, 3.0, 0.0, 10.0, 0.0],  # side by side
            [40.0, 25.0, 0.0, 0.0, 0.0],  # too far away from the route
            [-20.0, 0.0, 0.0, 0.0, 0.0],  # before its beginning
        ],
        dtype=torch.float64,
    )
    size = torch.tensor([4.0, 2.0], dtype=torch.float64)
    exists = torch.ones(1, 1, POINTS, dtype=torch.bool)
    route = RouteWindow(points[None, None], exists, torch.tensor([[3]]))
    found = along_route(own, size[None, None], others[None, None], size.expand(1, 1, 5, 2), route)[0, 0]
    gap, left, faster = (20.0 - 4.0, -6.0 + 4.0, 0.0), (0.0, -3.5, 3.0), (-6.0, 2.0, 0.0)
    brake = 36.0 / (2 * 16.0)
    for k in range(3):
        expected = [
            1.0, math.tanh(gap[k] / 3), math.tanh(gap[k] / 12), math.tanh(gap[k] / 50),
            math.tanh(left[k] / 1.5), math.tanh(left[k] / 6), math.tanh((abs(left[k]) - 2.0) / 0.5),
            math.tanh(faster[k] / 2), math.tanh(faster[k] / 8), brake / (brake + 2) if k == 0 else 0.0,
            0.0 if k == 1 else 1.0,
        ]  # fmt: skip
        assert found[k].tolist() == pytest.approx(expected, abs=1e-6), k
    assert (found[3:] == 0).all()


def test_beyond_the_end_of_the_route_and_without_one_nothing_is_said() -> None:
    own, size, others, sizes, route = scene(3)
    for count, own_place in ((0, 0), (4, 2)):  # of four points the agent is past the last
        exists = torch.arange(POINTS)[None, None] < count
        seen = RouteWindow(route.points, exists, torch.tensor([[own_place]]))
        assert (along_route(own, size, others, sizes, seen) == 0).all()


@pytest.mark.parametrize("method", ["bc", "mgail_h"])
def test_a_recipe_learns_with_all_of_it(method: str, tmp_path: Path) -> None:
    agent = AgentConfig(num_points=12, num_lights=2, features="gaps", accelerations=9, hidden=8)
    mgail = MGAILConfig(regression=2, head_start=1, rollouts=2, expert_weight=0.1, react=True)
    perturb = PerturbConfig(share=0.5, begin=1)
    fill(tmp_path / "store", [straight_road(4, steps=6), crossing(4, steps=6)])
    config = tiny(method, tmp_path / "store", tmp_path / "run", agent=agent, mgail=mgail, perturb=perturb)
    train(config)
    agent_of = load_agent(str(tmp_path / "run"))
    assert agent_of.spec is not None
    assert agent_of.spec.agent == agent
    learned = weights(tmp_path / "run")
    assert all(value.isfinite().all() for value in learned.values())
    # The first layer of the policy's objects takes the further features.
    first = next(value for name, value in learned.items() if "groups.0" in name and value.ndim == 2)
    along = ALONG_FEATURES if agent_of.spec.goals else 0
    assert first.shape[1] == OBJECT_FEATURES + along + 3 * 4
    # And that of its own features the route.
    own = next(value for name, value in learned.items() if "own.0" in name and value.ndim == 2)
    route = ROUTE_FEATURES if agent_of.spec.goals else 0
    assert own.shape[1] == SELF_FEATURES + route


@pytest.fixture(scope="module")
def data() -> SceneDataset:
    return SceneDataset(SegmentStore(builtin_store("train")), 2, Bicycle(), routes=True)


EVERYTHING = ObservationConfig(16, 64, 3, route=True, along=True, gaps=True, foresight=(0.5, 1.0))


def test_lights_seen_are_the_nearest_of_all(data: SceneDataset) -> None:
    items = list(islice((i for i in range(len(data)) if data.scene(i).light.shape[2] > 3), 3))
    scenes = data.scenes(items)
    rng = torch.Generator().manual_seed(0)
    origin = 30.0 * torch.randn(len(items), 2, 2, generator=rng)
    state = torch.cat([origin, torch.randn(len(items), 2, 3, generator=rng)], -1)
    row, none = torch.arange(len(items)), torch.zeros(len(items), 2)
    heading, speed = state[..., 2], state[..., 3]
    who = Observers(row, torch.zeros_like(row), none.long(), state, origin, None, origin, heading, speed)
    found, mask = observed_lights(Tables(scenes, EVERYTHING), who)
    # All points at once, of which those of lights are told by their state.
    wide = replace(EVERYTHING, num_lights=scenes.point.shape[1])
    everything, known = observed_lights(Tables(scenes, wide), who)
    assert mask.all()
    for b in range(len(items)):
        lights = scenes.point[b][(scenes.point_light[b] >= 0) & scenes.point_valid[b]]
        for n in range(2):
            away = (lights - origin[b, n]).norm(dim=-1).sort().values
            seen = found[b, n, :, :2].norm(dim=-1).sort().values * EVERYTHING.distance_scale
            torch.testing.assert_close(seen, away[:3])
            assert known[b, n].sum() == len(lights)
            # Each shows exactly one state.
            assert (everything[b, n][known[b, n]][:, LIGHT_COLUMN:].sum(-1) == 1).all()


def test_a_batch_changes_nothing_of_what_is_seen(data: SceneDataset) -> None:
    items = [0, 1, 2]
    together = DrivingEnv(data.scenes(items), Bicycle(), EVERYTHING)
    seen = together.with_goals(together.start(torch.arange(3))).get(("agents", "observation"))
    assert set(seen.keys()) >= {"along", "gap", "gap_ahead", "lights", "route"}
    for k, item in enumerate(items):
        alone = DrivingEnv(collate([data.scene(item)]), Bicycle(), EVERYTHING)
        one = alone.with_goals(alone.start(torch.tensor([0]))).get(("agents", "observation"))
        for name in ("along", "gap", "gap_ahead", "lights", "lights_mask", "route"):
            torch.testing.assert_close(seen.get(name)[k], one.get(name)[0], msg=name)
