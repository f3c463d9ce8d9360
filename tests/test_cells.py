"""Looking things up in the cells of a map gives what looking at everything gives; roads above each other."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import helpers_oracle as oracle
from helpers_saved import played
from helpers_segments import LANE_WIDTH, crossing, hide, make_road, make_segment, straight_road
from helpers_store import fill
from symphony import keys
from symphony.config import EvaluateConfig
from symphony.data import levels
from symphony.data.builtin import builtin_store
from symphony.data.levels import Levels, agent_heights
from symphony.data.segment import RunSegment, validate
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv, ObservationConfig, SceneBatch, collate, observation, scene
from symphony.envs.flags import collision_flags, offroad_flags, road_distance
from symphony.envs.objects import Objects, Observers, objects_at, rollout_heights
from symphony.envs.observation import nearest_points, observed_points
from symphony.envs.scene import PointType, Tables
from symphony.evaluation import evaluate
from symphony.evaluation.contacts import contacts
from symphony.geometry import LEVEL, NO_BOUNDARY, levels_apart
from symphony.geometry.cells import PointCells
from symphony.geometry.nearest import nearest, smallest
from symphony.render.plots import draw_hit, saved_clip
from symphony.render.style import new_figure
from symphony.saved.rollouts import world_of
from test_geometry import closed, segments, star

FEW = ObservationConfig(num_objects=4, num_points=60)


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lists of points are made at the first query."""
    monkeypatch.setattr(observation, "REPAID", 1)


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    """Maps of several sizes, made and recorded, one without lights and one without a boundary."""
    store = SegmentStore(builtin_store("train"))
    bare = scene(straight_road(4))
    bare = bare.replace(**{name: getattr(bare, name)[:, :0] for name in _EDGES})
    given = [scene(s) for s in (straight_road(), crossing(6), *(store[k] for k in (0, 9, 21)))]
    given.append(bare)
    return collate(given)


_EDGES = ("edge_start", "edge_end", "edge_valid", "edge_previous", "edge_following")


def places(scenes: SceneBatch, count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows of scenes [M] and positions [M, count, 2]: on points, near them, anywhere, and far off every map."""
    rng = torch.Generator().manual_seed(seed)
    row = torch.arange(len(scenes)).repeat_interleave(5)
    pick = (torch.rand(len(row), count, generator=rng) * scenes.point_valid.sum(1)[row, None]).long()
    near = scenes.point[row[:, None], pick]
    spread = torch.tensor([0.0, 0.5, 5.0, 60.0, 2000.0])[torch.randint(5, (*pick.shape, 1), generator=rng)]
    return row, near + spread * torch.randn(near.shape, generator=rng)


@pytest.mark.parametrize("count", [1, 8, 60, 300, 5000])
def test_the_nearest_points_are_those_among_all(scenes: SceneBatch, count: int) -> None:
    row, where = places(scenes, 9)
    tables = Tables(scenes, replace(FEW, num_points=count))
    flat, mask = nearest_points(tables, row, where)
    total = scenes.point.shape[1]
    if count < total:
        cells = tables.point_cells
        assert (cells.begin >= 0).any() == bool((scenes.point_valid.sum(1) >= 3 * count).any())
        expected = oracle.nearest_points(scenes, row, where, count)
        exist = scenes.point_valid[row[:, None, None], expected]
        assert torch.equal(mask, exist)
        assert torch.equal(flat[mask], (expected + row[:, None, None] * total)[exist])
    else:
        assert torch.equal(mask.sum(-1), scenes.point_valid.sum(1)[row, None].expand(mask.shape[:2]))


def test_points_are_seen_as_by_the_plain_formula(scenes: SceneBatch) -> None:
    row, where = places(scenes, 3)
    rng = torch.Generator().manual_seed(1)
    pose = torch.cat([where, torch.randn(*where.shape[:2], 2, generator=rng) * 5], -1)
    step, tables = torch.randint(60, (len(row),), generator=rng), Tables(scenes, FEW)
    x, y, heading, speed = pose.clone().requires_grad_().unbind(-1)
    state = torch.stack([x, y, heading, speed * heading.cos(), speed * heading.sin()], -1)
    objects = Objects(state, torch.ones_like(x, dtype=torch.bool), state[..., :2])
    who = Observers.of(objects, row, step, torch.arange(3).expand(x.shape))
    found, mask = observed_points(tables, who)
    chosen = oracle.nearest_points(scenes, row, where, FEW.num_points)
    expected, exist = oracle.observed_points(scenes, row, step, chosen, pose, FEW)
    assert found.requires_grad
    assert torch.equal(mask, exist)
    torch.testing.assert_close(found.detach(), expected, atol=1e-6, rtol=1e-6)
    assert (expected[..., -9:].sum((-1, -2)) > 0).any()


def test_road_distances_and_flags_are_those_among_all_edges(scenes: SceneBatch) -> None:
    row, where = places(scenes, 40, seed=2)
    tables = Tables(scenes, FEW)
    expected = oracle.road_distance(scenes, row, where)
    distance = road_distance(scenes, row, where, tables)
    # Far from every edge float32 itself is coarser.
    torch.testing.assert_close(distance, expected, atol=1e-5, rtol=1e-6)
    flags, sure = offroad_flags(scenes, row, where, tables), expected.abs() > 1e-4
    assert torch.equal(flags[sure], (expected > 0)[sure])
    assert 0.2 < flags.float().mean() < 0.8
    assert (distance[row == len(scenes) - 1] == NO_BOUNDARY).all()
    visited = tables.edge_cells.begin >= 0
    assert 0.01 < visited.mean() < 0.5
    assert 0.3 < (tables.edge_cells.sign[:-1][visited] != 0).mean() < 1


@pytest.mark.parametrize("seed", range(4))
def test_acute_corners_have_the_side_that_the_distance_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rings = [np.array([[90.0, 90], [110, 91], [90, 92], [90, 90]])[:: rng.choice([-1, 1])]]  # acute first
    for centre in rng.uniform(-80, 80, (12, 2)):
        rings.append(closed(star(rng, 7, centre, 1, 20))[:: rng.choice([-1, 1])])
    edges = segments(rings, torch.float32)
    given = scene(straight_road()).replace(**dict(zip(_EDGES, edges, strict=True)))
    batch, row = collate([given]), torch.zeros(1, dtype=torch.int64)
    corner = edges[0][0].repeat(60, 1)
    where = (corner + 1.5 * torch.from_numpy(rng.normal(size=corner.shape)).float())[None]
    tables = Tables(batch, FEW)
    expected = oracle.road_distance(batch, row, where)
    sure, flags = expected.abs() > 1e-3, offroad_flags(batch, row, where, tables)
    assert torch.equal(flags[sure], (expected > 0)[sure])
    assert (tables.edge_cells.sign != 0).any()
    # Whoever is alone at a corner is on the same side of it.
    alone = [offroad_flags(batch, row, place, tables) for place in where[:, :300].split(1, 1)]
    assert torch.equal(torch.cat(alone, 1), flags[:, :300])


def answers(scenes: SceneBatch, tables: Tables, at: tuple[torch.Tensor, torch.Tensor]) -> list[torch.Tensor]:
    flat, _ = nearest_points(tables, *at)
    return [flat, *(ask(scenes, *at, tables) for ask in (road_distance, offroad_flags))]


def test_answers_stay_when_cells_get_their_lists_and_threads_ask_at_once(scenes, monkeypatch) -> None:
    monkeypatch.setattr(observation, "REPAID", 2)
    asked, tables, lists = [places(scenes, 6, seed=seed) for seed in range(12)], Tables(scenes, FEW), []
    first = [answers(scenes, Tables(scenes, FEW), at) for at in asked]
    for _ in range(3):
        assert all(map(torch.equal, answers(scenes, tables, asked[5]), first[5]))
        lists.append((tables.point_cells.begin >= 0).sum())
    assert lists[0] < lists[1] == lists[2]
    fresh = Tables(scenes, FEW)
    with ThreadPoolExecutor(6) as pool:
        for one, other in zip(pool.map(lambda at: answers(scenes, fresh, at), asked), first, strict=True):
            assert all(map(torch.equal, one, other))


def test_collisions_are_those_of_all_pairs() -> None:
    scenes = collate([scene(crossing(7), [0, 1, 2]), scene(straight_road(5), [0, 1, 2])])
    rng, row = torch.Generator().manual_seed(6), torch.arange(2).repeat(200)
    state = torch.randn(400, 3, 4, generator=rng) * torch.tensor([6.0, 6.0, 2.0, 3.0])
    state[..., :2] += scenes.log_state[row, 3, 2, :2][:, None]
    index, real = scenes.interactive[row], torch.rand(400, 3, generator=rng) < 0.9
    objects = objects_at(scenes, row, torch.full_like(row, 3), state, index, real)
    found, expected = collision_flags(objects, index), oracle.collisions(objects, index)
    assert torch.equal(found, expected)
    assert 0.1 < expected.float().mean() < 0.9
    # Far from the origin, and whatever those hold who are not there.
    moved = objects._replace(state=objects.state + torch.tensor([3e4, -2e4, 0.0, 0.0, 0.0]))
    expected = oracle.collisions(moved, index)
    gone = moved._replace(state=moved.state.masked_fill(~moved.valid[..., None], torch.nan))
    there = moved.valid.gather(1, index)
    assert torch.equal(collision_flags(gone, index) & there, expected & there)


@settings(max_examples=30)
@given(st.integers(1, 6), st.integers(1, 40), st.integers(1, 45), st.integers(0, 10**6), st.booleans())
def test_the_smallest_are_the_first_of_a_stable_sort(rows, width, count, seed, spoiled):
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 6, (rows, width)).astype(np.float32)
    values[values == 5] = np.inf
    if spoiled:
        values[rng.random(values.shape) < 0.2] = np.nan
    ordered = np.argsort(np.where(np.isnan(values), np.inf, values), axis=-1, kind="stable")
    expected = np.sort(ordered[:, :count], axis=-1)
    found = smallest(values, count).reshape(rows, -1) - np.arange(rows)[:, None] * width
    np.testing.assert_array_equal(found, expected)
    index, finite = nearest(torch.from_numpy(values), count)
    assert index.shape == finite.shape == (rows, count)
    deep = nearest(torch.from_numpy(values)[None, :, None], count)
    assert all(torch.equal(more[0, :, 0], one) for more, one in zip(deep, (index, finite), strict=True))
    known = np.isfinite(values[np.arange(rows)[:, None], expected])
    np.testing.assert_array_equal(finite[:, : expected.shape[1]], known)
    assert not finite[:, expected.shape[1] :].any()


def test_huge_maps_have_larger_cells() -> None:
    x, y = (np.array([[0.0, end, 5.0]], np.float32) for end in (9000.0, 7000.0))
    cells = PointCells(x, y, 1)
    assert len(cells.begin) <= 1 << 14
    assert cells.side[0] > 8
    where = np.array([8999.0]), np.array([6999.0])
    cell = cells.locate(np.array([0]), *where)
    assert cells.listed(np.array([0]), cell).all()
    assert cells.nearest_points(cell, *where).tolist() == [[1]]


HIGH, STEPS = 6.0, 41
SEEN = ObservationConfig(num_objects=8, num_points=400, num_lights=2, clearance=True, foresight=(1.0,))


def line(axis: int, across: float, height: float, back: bool = False) -> NDArray[Any]:
    """A straight line along x (0) or y (1), 200 m long, at a height."""
    along = np.arange(-100, 101, 4.0)[:: -1 if back else 1]
    points = np.full((len(along), 3), float(height))
    points[:, axis], points[:, 1 - axis] = along, across
    return points


def overpass(height: float = HIGH, slope: float = 0.0, turn: float = 0.0, ramp: float = 0.0) -> RunSegment:
    """A road along x, and one along y at a height; a car on each is at the crossing at 4 s.

    All climbs along x, and the bridge ends in ramps.
    """
    half, lanes = LANE_WIDTH / 2, [line(0, 0, 0), line(1, 0, height)]
    boundary = [
        line(0, -half, 0), line(0, half, 0, back=True), line(1, half, height), line(1, -half, height, back=True),
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
        return np.stack([c * x - s * y, s * x + c * y, z + slope * x - ramp * (abs(y) - 20).clip(0)], -1)

    road = make_road([lifted(each) for each in lanes], boundary=[lifted(each) for each in boundary])
    made = make_segment(
        road, lifted(position) + np.array([0, 0, 0.8]), heading + turn,
        lifted(np.pad(velocity, ((0, 0), (0, 0), (0, 1))))[..., :2], segment_id=f"overpass-{height:g}",
        signal_lane=np.arange(2, dtype=np.int32), signal_state=np.zeros((2, STEPS), np.uint8),
        signal_point=lifted(np.array([[9.0, 0, 0], [0, 9, height]])).astype(np.float32),
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
    # Where the log does not have an agent, as at zeros, does not tell how high it is.
    env, found = drive(hide(overpass(HIGH, slope, turn), 1, slice(1, 5)))
    assert not found.get(keys.COLLISION).any()
    assert not found.get(keys.OFFROAD).any()
    seen = found.get(("agents", "observation", "objects_mask"))
    assert seen[0].sum(-1).tolist() == [1, 0]  # the first sees who follows it, the second nobody
    assert found.get(keys.LIGHTS_MASK)[0].sum(-1).tolist() == [1, 1]
    for agent in (0, 1):
        # Only the two lines of its own road, both beside it.
        across = boundary_seen(env, found, agent)[:, 1]
        assert len(across) > 40
        np.testing.assert_allclose(np.abs(across), LANE_WIDTH / 2, atol=1e-3)
    road = found.get(("agents", "observation", "road"))[0]
    np.testing.assert_allclose(road[:, 0], -LANE_WIDTH / 2, atol=1e-3)


def test_at_one_height_all_of_it_counts() -> None:
    assert levels.LEVEL == LEVEL  # of data and of geometry
    for height in (0.0, LEVEL - 0.1):
        env, found = drive(overpass(height))
        assert found.get(keys.COLLISION)[0, :2].all()
        assert found.get(("agents", "observation", "objects_mask"))[0].sum(-1).tolist() == [2, 2]
        assert np.abs(boundary_seen(env, found, 0)[:, 1]).max() > 20
    flat = scene(overpass(0.0), [0, 1])
    for name in ("agent_height", "point_height", "edge_height"):
        assert getattr(flat, name).numel() == 0


@pytest.mark.parametrize("agent", ["playback", "constant_velocity"])
@pytest.mark.parametrize("ramp", [0.0, 0.07])
def test_an_evaluation_holds_to_it(agent: str, ramp: float, tmp_path: Path) -> None:
    """Of two segments, one with a bridge, half collide, and none are off the road but where both roads are one."""
    fill(tmp_path / "store", [overpass(0.0), overpass(HIGH, ramp=ramp)])
    how = EvaluateConfig(rollouts=2)
    rates = [evaluate(agent, tmp_path / "store", how, items=items).numbers() for items in ([0], [1], [0, 1])]
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
    assert float(expected[..., 0].std()) > 0.5
    for k in (0, 1):
        found = world_of(saved, k).height
        np.testing.assert_array_equal(found[[1, 0]], expected[0, k].transpose(0, 1))
        np.testing.assert_array_equal(found[2], agent_heights(segment)[4:, 2])
    assert world_of(played(overpass(0.0)), 0).height is None


def test_padded_slots_leave_everyone_as_high_as_they_are() -> None:
    """Agent 0 of the first scene plays back the log, up a slope."""
    scenes, found = [scene(overpass(HIGH, slope=0.03), [1]), scene(straight_road(3, steps=STEPS), [0, 1])], []
    for batch in (scenes[:1], scenes):
        env, first = DrivingEnv(collate(batch), observation=SEEN), torch.tensor([0])
        state = env.start(first)
        found.append(
            env.objects(first, first + STEPS - 1, state.get(keys.STATE), state.get(keys.VALID)).height[0, :3]
        )
    torch.testing.assert_close(*found)


def test_flat_scenes_beside_it_keep_every_number() -> None:
    flat = [straight_road(3, steps=STEPS), crossing(steps=STEPS)]
    alone = DrivingEnv(collate([scene(s, [0, 1]) for s in flat]), observation=SEEN)
    shapes: dict[str, list[int]] = {}  # of a flat batch before, with more of everything
    collate([scene(straight_road(40, steps=STEPS), [0, 1])], shapes=shapes)
    mixed = collate([scene(s, [0, 1]) for s in (*flat, overpass())], shapes=shapes)
    mixed = DrivingEnv(mixed, observation=SEEN)
    one, two = (env.start(torch.arange(2)) for env in (alone, mixed))
    for _ in range(5):
        for name in one.keys(True, True):
            assert torch.equal(one.get(name), two.get(name)), name
        one, two = (now.set(keys.ACTION, torch.full((2, 2), 3)) for now in (one, two))
        one, two = alone.step(one)["next"], mixed.step(two)["next"]


def test_cars_that_follow_each_other_up_a_ramp_are_never_apart() -> None:
    """A ramp from the lower road to the upper one: its number changes on the way."""
    ramp = np.stack([np.linspace(-60, 0, 31), np.full(31, 20.0), np.linspace(0, HIGH, 31)], -1)
    lower, upper = line(0, 20, 0)[:11], line(0, 20, HIGH)[25:]
    below = np.concatenate([line(1, 40, 0), line(1, -80, HIGH)])
    levels = Levels(np.concatenate([ramp, lower, upper, below, line(0, 0, 0), line(1, 0, HIGH)]))
    assert not levels.flat
    x = np.linspace(-60, 60, 121)
    found = levels.at(np.stack([x, np.full(121, 20.0), np.interp(x, [-60, 0], [0, HIGH])], -1))
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


def test_who_stands_above_is_not_drawn_as_hit() -> None:
    """The ego's log ends before the bridge; simulated, it drives on and is hit below by the driven agent 2."""
    full = overpass(HIGH)
    state = played(full, [0, 2]).state.copy()
    state[:, 18:, 1, 0] += 11
    there = np.ones((1, STEPS - 1, 2), bool)
    saved = played(hide(full, 0, slice(15, STEPS)), [0, 2], state=state, counted=there)
    saved.collision[0, 17:] = True
    (hits,) = contacts([world_of(saved, 0)], np.array([0, 2]))
    assert list(zip(hits.agent.tolist(), hits.other.tolist(), strict=True)) == [(0, 2), (2, 0)]
    assert draw_hit(new_figure(4, 4).add_subplot(), saved_clip(saved)) is None
