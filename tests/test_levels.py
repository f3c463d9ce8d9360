"""Roads above each other: who is on another level is not met, not seen and bounds nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers_saved import played
from helpers_segments import LANE_WIDTH, crossing, make_road, make_segment, straight_road
from helpers_store import fill
from symphony import keys
from symphony.config import EvaluateConfig
from symphony.data import levels
from symphony.data.levels import Levels, agent_heights
from symphony.data.segment import RunSegment, validate
from symphony.envs import DrivingEnv, ObservationConfig, collate, scene
from symphony.envs.flags import road_distance
from symphony.envs.objects import rollout_heights
from symphony.envs.observation import nearest_points
from symphony.envs.scene import PointType, Tables
from symphony.evaluation import evaluate
from symphony.geometry import LEVEL, levels_apart
from symphony.saved.rollouts import world_of

HIGH = 6.0
STEPS = 41
SEEN = ObservationConfig(num_objects=8, num_points=400, num_lights=0, clearance=True, foresight=(1.0,))


def line(axis: int, across: float, height: float, back: bool = False) -> NDArray[Any]:
    """A straight line along x (0) or y (1), 200 m long, at a height."""
    along = np.arange(-100, 101, 4.0)[:: -1 if back else 1]
    points = np.full((len(along), 3), float(height))
    points[:, axis], points[:, 1 - axis] = along, across
    return points


def overpass(height: float = HIGH, slope: float = 0.0, turn: float = 0.0) -> RunSegment:
    """A road along x, and one along y that crosses it at a height; a car on each, both at the crossing at 4 s.

    All climbs along x, and the world is turned.
    """
    half = LANE_WIDTH / 2
    lanes = [line(0, 0, 0), line(1, 0, height)]
    boundary = [
        line(0, -half, 0), line(0, half, 0, back=True), line(1, half, height),
        line(1, -half, height, back=True),
    ]  # fmt: skip
    speed, time = 10.0, 0.2 * np.arange(STEPS)
    position = np.zeros((3, STEPS, 3))
    position[0, :, 0] = position[1, :, 1] = speed * (time - 4)
    position[2, :, 0] = speed * (time - 4) - 15  # follows the first
    position[1, :, 2] = height
    heading = np.zeros((3, STEPS))
    heading[1] = np.pi / 2
    velocity = np.stack([speed * np.cos(heading), speed * np.sin(heading)], -1)

    def lifted(points: NDArray[Any]) -> NDArray[Any]:
        c, s = np.cos(turn), np.sin(turn)
        x, y, z = np.moveaxis(points, -1, 0)
        return np.stack([c * x - s * y, s * x + c * y, z + slope * x], -1)

    road = make_road([lifted(each) for each in lanes], boundary=[lifted(each) for each in boundary])
    made = make_segment(
        road, lifted(position) + np.array([0, 0, 0.8]), heading + turn,
        lifted(np.pad(velocity, ((0, 0), (0, 0), (0, 1))))[..., :2], segment_id=f"overpass-{height:g}",
    )  # fmt: skip
    return validate(made)


def drive(segment: RunSegment, *others: RunSegment) -> tuple[DrivingEnv, Any]:
    """An environment with the segment's first scene in it, and its agents where they cross at 4 s."""
    env = DrivingEnv(collate([scene(s, [0, 1]) for s in (segment, *others)]), observation=SEEN)
    start = env.start(torch.tensor([0]))
    # Where both are in the middle of the crossing.
    state = start.get(keys.STATE).clone()
    state[0, :, :2] = torch.from_numpy(segment.position[[0, 1], 20, :2])
    start.set(keys.STATE, state)
    start.set(keys.STEP, torch.full_like(start.get(keys.STEP), 20))
    return env, env.at(start)


def boundary_seen(env: DrivingEnv, found: Any, agent: int) -> NDArray[Any]:
    """Points [P, 2] of the boundary that an agent sees, in its frame in metres."""
    points = found.get(("agents", "observation", "points"))[0, agent]
    mask = found.get(("agents", "observation", "points_mask"))[0, agent]
    kind = points[..., 6 + PointType.BOUNDARY] > 0
    return (points[mask & kind][:, :2] * env.observation.distance_scale).numpy()


@settings(max_examples=10)
@given(st.floats(-0.03, 0.03), st.floats(-3, 3))
def test_an_overpass_is_another_world(slope: float, turn: float) -> None:
    env, found = drive(overpass(HIGH, slope, turn))
    assert not found.get(keys.COLLISION).any()
    assert not found.get(keys.OFFROAD).any()
    seen = found.get(("agents", "observation", "objects_mask"))
    assert seen[0].sum(-1).tolist() == [1, 0]  # the first sees who follows it, the second nobody
    for agent in (0, 1):
        # Only the two lines of its own road, both beside it.
        across = boundary_seen(env, found, agent)[:, 1]
        assert len(across) > 40
        np.testing.assert_allclose(np.abs(across), LANE_WIDTH / 2, atol=1e-3)
    road = found.get(("agents", "observation", "road"))[0]
    np.testing.assert_allclose(road[:, 0], -LANE_WIDTH / 2, atol=1e-3)


def test_data_and_geometry_agree_on_what_a_level_is() -> None:
    assert levels.LEVEL == LEVEL


def test_at_one_height_all_of_it_counts() -> None:
    for height in (0.0, LEVEL - 0.1):
        env, found = drive(overpass(height))
        assert found.get(keys.COLLISION)[0, :2].all()
        assert found.get(("agents", "observation", "objects_mask"))[0].sum(-1).tolist() == [2, 2]
        assert np.abs(boundary_seen(env, found, 0)[:, 1]).max() > 20
    flat = scene(overpass(0.0), [0, 1])
    for name in ("agent_height", "point_height", "edge_height"):
        assert getattr(flat, name).numel() == 0


@pytest.mark.parametrize("agent", ["playback", "constant_velocity"])
def test_an_evaluation_holds_to_it(agent: str, tmp_path: Path) -> None:
    """Of two segments, one with a bridge, half collide, and nobody is off the road but where both roads are one."""
    fill(tmp_path / "store", [overpass(0.0), overpass(HIGH)])
    rates = [
        evaluate(agent, tmp_path / "store", EvaluateConfig(rollouts=2), items=items).numbers()
        for items in ([0], [1], [0, 1])
    ]
    for name in ("collision_rate", "collision_rate_at_states", "collision_crossing"):
        assert [one[name] for one in rates] == [100.0, 0.0, 50.0]
    assert rates[0]["offroad_time"] > 0
    assert rates[1]["offroad_time"] == 0


def test_saved_rollouts_are_as_high_as_in_the_simulation() -> None:
    """Driven back along their logs, from a step later on."""
    segment = overpass(HIGH, slope=0.03)
    saved = played(segment, [1, 0], rollouts=2, start=4)
    saved = replace(saved, state=saved.state[:, :3:-1].copy(), counted=saved.counted[:, 4:])
    expected = rollout_heights(scene(segment, [1, 0]), torch.from_numpy(saved.state)[None])
    assert expected is not None
    assert float(expected[..., 0].std()) > 0.5
    for k in (0, 1):
        found = world_of(saved, k).height
        assert found is not None
        np.testing.assert_array_equal(found[[1, 0]], expected[0, k].transpose(0, 1))
        np.testing.assert_array_equal(found[2], agent_heights(segment)[4:, 2])
    assert world_of(played(overpass(0.0)), 0).height is None


def test_flat_scenes_beside_it_keep_every_number() -> None:
    flat = [straight_road(3, steps=STEPS), crossing(steps=STEPS)]
    alone = DrivingEnv(collate([scene(s, [0, 1]) for s in flat]), observation=SEEN)
    mixed = DrivingEnv(collate([scene(s, [0, 1]) for s in (*flat, overpass())]), observation=SEEN)
    one, two = (env.start(torch.arange(2)) for env in (alone, mixed))
    for _ in range(5):
        for name in one.keys(True, True):
            mine, theirs = one.get(name), two.get(name)
            assert torch.equal(mine, theirs), name
        action = torch.full((2, 2), 3)
        one, two = (
            env.step(now.set(keys.ACTION, action))["next"] for env, now in ((alone, one), (mixed, two))
        )


def test_cars_that_follow_each_other_up_a_ramp_are_never_apart() -> None:
    """A ramp from the lower road to the upper one: its number changes on the way."""
    ramp = np.stack([np.linspace(-60, 0, 31), np.full(31, 20.0), np.linspace(0, HIGH, 31)], -1)
    lower, upper = line(0, 20, 0)[:11], line(0, 20, HIGH)[25:]
    below = np.concatenate([line(1, 40, 0), line(1, -80, HIGH)])
    levels = Levels(np.concatenate([ramp, lower, upper, below, line(0, 0, 0), line(1, 0, HIGH)]))
    assert not levels.flat
    place = np.stack(
        [
            np.linspace(-60, 60, 121),
            np.full(121, 20.0),
            np.interp(np.linspace(-60, 60, 121), [-60, 0], [0, HIGH]),
        ],
        -1,
    )
    found = levels.at(place)
    one, other = torch.from_numpy(found[1:]), torch.from_numpy(found[:-1])
    assert (one[:, 1] != other[:, 1]).any()
    assert not levels_apart(one, other).any()
    assert {1.0, 2.0} <= set(found[:, 1].tolist())


@pytest.mark.parametrize("count", [40, 4000])
def test_points_and_edges_are_those_of_ones_own_level(count: int) -> None:
    """Against all of them, one by one, and however many are seen."""
    segment = overpass()
    scenes = collate([scene(segment, [0, 1]), scene(straight_road(2), [0, 1])])
    tables = Tables(scenes, ObservationConfig(num_points=count))
    rng = np.random.default_rng(0)
    where = torch.from_numpy(rng.uniform(-60, 60, (20, 2, 2)).astype(np.float32))
    height = torch.tensor([[0.0, 1.0], [HIGH, 2.0]]).expand(20, 2, 2).contiguous()
    row = torch.zeros(20, dtype=torch.int64)
    flat, mask = nearest_points(tables, row, where, height)
    distance = road_distance(scenes, row, where, tables, height)
    for agent, z in enumerate((0.0, HIGH)):
        mine = torch.nonzero(scenes.point_height[0, :, 0] == z).flatten()
        mine = mine[scenes.point_valid[0, mine]]
        keep = scenes.edge_height[0, :, 0] == z
        alone = scenes.replace(edge_valid=scenes.edge_valid & keep, edge_height=scenes.edge_height[:, :0])
        expected = road_distance(alone, row, where[:, agent : agent + 1])
        torch.testing.assert_close(distance[:, agent], expected[:, 0])
        for k in range(20):
            seen = set(flat[k, agent][mask[k, agent]].tolist())
            away = (scenes.point[0, mine] - where[k, agent]).square().sum(-1)
            assert seen == set(mine[away.argsort(stable=True)[:count]].tolist())


def test_a_device_finds_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is done where nothing may wait for the device, on the CPU."""
    segments = overpass(), straight_road(3, steps=STEPS)
    found = drive(*segments)[1]
    for name in ("envs.flags", "envs.observation", "envs.driving", "geometry.nearest"):
        monkeypatch.setattr(f"symphony.{name}.on_host", lambda _: False)
    there = drive(*segments)[1]
    for flag in (keys.COLLISION, keys.OFFROAD, ("agents", "observation", "objects_mask")):
        assert torch.equal(found.get(flag), there.get(flag))
    for name in ("road", "points"):
        one, other = (each.get(("agents", "observation", name)) for each in (found, there))
        if name == "points":  # in any order
            one, other = one.sort(-2).values, other.sort(-2).values
        torch.testing.assert_close(one, other)
