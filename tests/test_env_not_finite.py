"""One agent whose numbers are not finite spoils nothing for others, and out-of-range questions have plain answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from helpers_segments import crossing, straight_road
from symphony import keys
from symphony.envs import Bicycle, Displacement, DrivingEnv, collate, scene
from symphony.envs import flags as module
from symphony.envs.flags import collision_flags
from symphony.envs.objects import Objects
from symphony.envs.observation import ObservationConfig
from symphony.errors import ConfigError
from symphony.geometry import box_gap, boxes_overlap, signed_distance
from symphony.roadgraph import LaneGraph

BAD = (math.nan, math.inf, -math.inf)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("who", [0, 3])
def test_others_still_collide(bad: float, who: int, monkeypatch: pytest.MonkeyPatch) -> None:
    state = torch.zeros(1, 4, 5)
    state[0, :, 0] = torch.tensor([0.0, 50, 51, 100])
    state[0, who, 0] = bad
    objects = Objects(
        state,
        torch.ones(1, 4, dtype=torch.bool),
        torch.tensor([4.0, 2.0]).expand(1, 4, 2),
    )
    index = torch.arange(4)[None]
    found = collision_flags(objects, index)
    assert found.tolist() == [[False, True, True, False]]
    monkeypatch.setattr(module, "on_host", lambda tensor: False)
    assert torch.equal(collision_flags(objects, index), found)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("part", ["x", "y", "heading"])
def test_no_box_touches_one_that_is_nowhere(bad: float, part: str) -> None:
    x, y, heading = (bad if part == name else 0.0 for name in ("x", "y", "heading"))
    size = torch.tensor([4.0, 2.0])
    here = torch.zeros(2), torch.tensor(0.0), size
    there = torch.tensor([x + 10.0, y]), torch.tensor(heading), size
    for pair in ((*here, *there), (*there, *here)):
        assert not (box_gap(*pair) <= 0.0)
        assert not box_gap(*pair).isfinite()
        assert not boxes_overlap(*pair)


def test_masked_objects_are_zero_and_pass_no_gradient() -> None:
    scenes = scene(straight_road(3, steps=11), [0, 1, 2])
    env = DrivingEnv(scenes, Displacement(), ObservationConfig(num_objects=4, num_points=10, gaps=True))
    action = torch.zeros(1, 3, 2)
    action[..., 0] = 1.0
    action[0, 0, 0] = math.nan
    action.requires_grad_()
    after = env.step(env.start(torch.tensor([0])).set(keys.ACTION, action))["next"]
    seen = after["agents", "observation"]
    hidden = ~seen["objects_mask"][0, 1:]
    assert hidden.any()
    assert (seen["objects"][0, 1:][hidden] == 0).all()
    assert (seen["gap"][0, 1:][hidden] == 0).all()
    (gradient,) = torch.autograd.grad(seen["objects"][0, 1:].sum(), action)
    assert gradient[0, 1:].isfinite().all()
    assert gradient[0, 1:].any()


@pytest.mark.parametrize("far", [1e6, 1e9, 1e30])
def test_a_position_far_away_moves_nobody_elses_edge(far: float) -> None:
    scenes = scene(crossing(3, steps=5), [0])
    edges = (
        scenes.edge_start,
        scenes.edge_end,
        scenes.edge_valid,
        scenes.edge_previous.long(),
        scenes.edge_following.long(),
    )
    points = scenes.log_state[:, 0, :, :2]
    alone = signed_distance(points, *edges)
    beside = signed_distance(torch.cat([points, torch.full((1, 1, 2), far)], 1), *edges)
    assert torch.equal(beside[:, :-1], alone)


def test_lights_keep_their_last_state_after_the_log_however_long_others_are() -> None:
    config = ObservationConfig(num_objects=2, num_points=300)
    short, long = scene(crossing(3, steps=5, seed=1), [0]), scene(crossing(3, steps=15, seed=2), [0])
    found = []
    for scenes in (short, collate([short, long])):
        env = DrivingEnv(scenes, observation=config)
        now = env.start(torch.tensor([0]))
        for _ in range(7):
            now = env.step(now.set(keys.ACTION, torch.full((1, 1), 73)))["next"]
        points, mask = (now["agents", "observation", name] for name in ("points", "points_mask"))
        found.append(points[mask])
    assert torch.equal(*found)


def test_a_route_that_is_not_there_is_none() -> None:
    segment = crossing(3, steps=9, seed=1)
    scenes = scene(segment, [0, 1], LaneGraph(segment.road))
    env = DrivingEnv(scenes, observation=ObservationConfig(num_objects=2, num_points=2, route=True))
    start, many = env.start(torch.tensor([0])), scenes.route_count.shape[2]
    for goal in (-1, many, many + 1):
        seen = env.with_goals(start, torch.tensor([[goal, 0]]))["agents", "observation", "route"]
        assert not seen[0, 0].any()
        assert seen[0, 1].any()


@pytest.mark.parametrize("count", [0, 1, 2, 6])
@pytest.mark.parametrize("name", ["num_acceleration", "num_steering"])
def test_a_grid_without_a_middle_is_refused(name: str, count: int) -> None:
    with pytest.raises(ConfigError, match=name):
        Bicycle(**{name: count})


def test_a_grid_has_an_action_that_does_nothing() -> None:
    for count in (3, 7, 21):
        grid = Bicycle(num_acceleration=count)
        acceleration, steering = (part.numpy() for part in grid.grid(torch.zeros(1)))
        assert np.flatnonzero((acceleration == 0) & (steering == 0)).tolist() == [grid.num_actions // 2]


@pytest.mark.parametrize("bad", BAD)
def test_an_action_that_is_not_finite_ends_the_episode_of_its_scene(bad: float) -> None:
    scenes = collate(
        [scene(straight_road(3, steps=11), [0, 1]), scene(straight_road(3, steps=11, seed=1), [0, 1])]
    )
    env = DrivingEnv(scenes, Displacement(), ObservationConfig.nothing())
    action = torch.zeros(2, 2, 2)
    action[..., 0] = 1.0
    action[1, 1, 0] = bad
    after = env.step(env.start(torch.tensor([0, 1])).set(keys.ACTION, action))["next"]
    assert after["terminated"].tolist() == after["done"].tolist() == [[False], [True]]
    assert after["truncated"].tolist() == [[False], [False]]
    assert after[keys.REWARD].squeeze(-1).tolist() == [[0, 0], [0, -1]]
