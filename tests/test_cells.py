"""Looking things up in the cells of a map gives what looking at everything gives."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import helpers_oracle as oracle
from helpers_segments import crossing, straight_road
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import ObservationConfig, SceneBatch, collate, observation, scene
from symphony.envs.flags import collision_flags, offroad_flags, road_distance
from symphony.envs.objects import Objects, Observers, objects_at
from symphony.envs.observation import nearest_points, observed_points
from symphony.envs.scene import Tables
from symphony.geometry import NO_BOUNDARY, segments_of
from symphony.geometry.cells import PointCells
from symphony.geometry.nearest import nearest, smallest

FEW = ObservationConfig(num_objects=4, num_points=60)


@pytest.fixture
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


@pytest.mark.usefixtures("at_once")
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


@pytest.mark.usefixtures("at_once")
def test_points_are_seen_as_by_the_plain_formula(scenes: SceneBatch) -> None:
    row, where = places(scenes, 3)
    rng = torch.Generator().manual_seed(1)
    pose = torch.cat([where, torch.randn(*where.shape[:2], 2, generator=rng) * 5], -1)
    step = torch.randint(60, (len(row),), generator=rng)
    tables = Tables(scenes, FEW)
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


@pytest.mark.usefixtures("at_once")
def test_road_distances_and_flags_are_those_among_all_edges(scenes: SceneBatch) -> None:
    row, where = places(scenes, 40, seed=2)
    tables = Tables(scenes, FEW)
    expected = oracle.road_distance(scenes, row, where)
    distance = road_distance(scenes, row, where, tables)
    # Far from every edge float32 itself is coarser.
    torch.testing.assert_close(distance, expected, atol=1e-5, rtol=1e-6)
    flags = offroad_flags(scenes, row, where, tables)
    sure = expected.abs() > 1e-4
    assert torch.equal(flags[sure], (expected > 0)[sure])
    assert 0.2 < flags.float().mean() < 0.8
    assert (distance[row == len(scenes) - 1] == NO_BOUNDARY).all()
    visited = tables.edge_cells.begin >= 0
    assert 0.01 < visited.mean() < 0.5
    assert 0.3 < (tables.edge_cells.sign[:-1][visited] != 0).mean() < 1


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("seed", range(4))
def test_acute_corners_have_the_side_that_the_distance_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rings = [
        np.array([[90, 90], [110, 91], [90, 92], [90, 90]], float)[:: rng.choice([-1, 1])]
    ]  # the first edge's are acute
    for centre in rng.uniform(-80, 80, (12, 2)):
        angle = np.sort(rng.uniform(0, 2 * np.pi, 7)) + np.linspace(0, 0.1, 7)
        ring = centre + rng.uniform(1, 20, (7, 1)) * np.stack([np.cos(angle), np.sin(angle)], -1)
        rings.append(np.concatenate([ring, ring[:1]])[:: rng.choice([-1, 1])])
    start, end, previous, following = segments_of(np.concatenate(rings), np.cumsum([0, *map(len, rings)]))
    given = scene(straight_road())
    given = given.replace(
        edge_start=torch.from_numpy(start)[None].float(), edge_end=torch.from_numpy(end)[None].float(),
        edge_valid=torch.ones(1, len(start), dtype=torch.bool),
        edge_previous=torch.from_numpy(previous)[None], edge_following=torch.from_numpy(following)[None],
    )  # fmt: skip
    batch, row = collate([given]), torch.zeros(1, dtype=torch.int64)
    corner = torch.from_numpy(start).float().repeat(60, 1)
    where = (corner + 1.5 * torch.from_numpy(rng.normal(size=corner.shape)).float())[None]
    tables = Tables(batch, FEW)
    expected = oracle.road_distance(batch, row, where)
    sure = expected.abs() > 1e-3
    flags = offroad_flags(batch, row, where, tables)
    assert torch.equal(flags[sure], (expected > 0)[sure])
    assert (tables.edge_cells.sign != 0).any()
    # Whoever is alone at a corner is on the same side of it.
    alone = [offroad_flags(batch, row, place, tables) for place in where[:, :300].split(1, 1)]
    assert torch.equal(torch.cat(alone, 1), flags[:, :300])


@pytest.mark.usefixtures("at_once")
def test_padding_batch_and_order_change_nothing(scenes: SceneBatch) -> None:
    row, where = places(scenes, 6, seed=4)
    together = Tables(scenes, FEW)
    flat, _ = nearest_points(together, row, where)
    distance = road_distance(scenes, row, where, together)
    for b in (3, 0):
        valid, edges = scenes.point_valid[b].sum(), scenes.edge_valid[b].sum()
        fields = {n: getattr(scenes, n)[b : b + 1] for n in SceneBatch.__annotations__}
        for name in fields:
            limit = {"point": valid, "edge_": edges}.get(name[:5])
            if limit is not None:
                fields[name] = fields[name][:, :limit]
        lone = SceneBatch(**fields, batch_size=[1])
        mine = row == b
        zero = torch.zeros(int(mine.sum()), dtype=torch.int64)
        alone = Tables(lone, FEW)
        found, _ = nearest_points(alone, zero, where[mine].flip(1))
        assert torch.equal(found.flip(1), flat[mine] - b * scenes.point.shape[1])
        assert torch.equal(road_distance(lone, zero, where[mine].flip(1), alone).flip(1), distance[mine])


def test_answers_stay_when_cells_get_their_lists(scenes: SceneBatch) -> None:
    row, where = places(scenes, 6, seed=5)
    tables, seen, lists = Tables(scenes, FEW), [], []
    for _ in range(3):
        flat, _ = nearest_points(tables, row, where)
        lists.append((tables.point_cells.begin >= 0).sum())
        seen.append(
            (flat, road_distance(scenes, row, where, tables), offroad_flags(scenes, row, where, tables))
        )
    assert lists[0] < lists[1] == lists[2]
    for flat, distance, flag in seen[1:]:
        assert torch.equal(flat, seen[0][0])
        assert torch.equal(distance, seen[0][1])
        assert torch.equal(flag, seen[0][2])


def test_threads_that_ask_at_once_get_the_same(scenes: SceneBatch) -> None:
    tables, asked = Tables(scenes, FEW), [places(scenes, 6, seed=seed) for seed in range(12)]
    with ThreadPoolExecutor(6) as pool:
        found = list(
            pool.map(lambda at: (nearest_points(tables, *at), road_distance(scenes, *at, tables)), asked)
        )
    for at, ((flat, _), distance) in zip(asked, found, strict=True):
        alone = Tables(scenes, FEW)
        assert torch.equal(flat, nearest_points(alone, *at)[0])
        assert torch.equal(distance, road_distance(scenes, *at, alone))


def test_collisions_are_those_of_all_pairs() -> None:
    scenes = collate([scene(crossing(7), [0, 1, 2]), scene(straight_road(5), [0, 1, 2])])
    rng = torch.Generator().manual_seed(6)
    row = torch.arange(2).repeat(200)
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


@settings(max_examples=60)
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
