"""Lists that are kept with a store's maps: what is found is what would be found without."""

from __future__ import annotations

import copy
import hashlib
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_runs import tiny
from helpers_segments import crossing, straight_road
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import ObservationConfig, SceneBatch, collate, points, scene
from symphony.envs.map_lists import MapLists
from symphony.envs.points import nearest_points
from symphony.envs.road import road_distance
from symphony.envs.scene import PointType
from symphony.envs.tables import Tables
from symphony.errors import DataError
from symphony.geometry.cell_lists import Frame, JoinedLists, is_packed, packed
from symphony.geometry.cells import EdgeCells, PointCells
from symphony.geometry.edges import Edges
from symphony.geometry.spans import spans
from symphony.recipes import train
from symphony.simulation import SceneDataset
from symphony.simulation.kept import LISTS_VERSION, KeptLists

CONFIG = ObservationConfig(num_points=60)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A copy of the built-in store, without what was kept with it."""
    kept = shutil.ignore_patterns("experts", "lists")
    return Path(shutil.copytree(builtin_store("train"), tmp_path / "s", ignore=kept))


def files(store: Path) -> list[Path]:
    return sorted((store / "lists").glob("*.npz"))


def with_lists(one: SceneBatch, count: int = 60) -> SceneBatch:
    return MapLists.of(one, count).beside(one)


def lanes(scenes: SceneBatch) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows of scenes [M] and positions [M, 1, 2]: all points of lanes."""
    row, point = (scenes.point_valid & (scenes.point_type == PointType.LANE)).nonzero(as_tuple=True)
    return row, scenes.point[row, point][:, None]


@given(st.lists(st.tuples(st.integers(-50, 50), st.integers(0, 7)), max_size=20))
def test_spans_are_ranges_one_after_the_other(given_spans: list[tuple[int, int]]) -> None:
    begin, length = np.array(given_spans, np.int64).reshape(-1, 2).T
    expected = [n for b, k in given_spans for n in range(b, b + k)]
    assert spans(begin, length).tolist() == expected
    assert spans(0, length).tolist() == [n for _, k in given_spans for n in range(k)]


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(1, 5), st.integers(0, 9), st.integers(1, 40))
def test_lists_that_were_packed_and_joined_are_the_same(seed: int, maps: int, most: int, total: int) -> None:
    rng = np.random.default_rng(seed)
    given_lists, whole, wanted = [], [], 3
    for _ in range(maps):
        lists = [
            np.flatnonzero(rng.random(total) < 0.6) if total > 1 else np.zeros(1, np.int64)
            for _ in range(rng.integers(0, most + 1))
        ]
        lists = [items if len(items) else np.array([0]) for items in lists]
        cell = np.sort(rng.permutation(30)[: len(lists)])
        sign = rng.integers(-1, 2, len(lists)).astype(np.int8)
        frame = Frame(*(np.array([float(v)]) for v in (*rng.integers(-99, 99, 2), 8, 5, 6)))
        count = np.array([len(items) for items in lists], np.int64)
        items = np.concatenate([np.zeros(0, np.int64), *lists])
        one = packed(frame, cell, count, items, sign, total=total, wanted=wanted)
        assert is_packed(one, total)
        assert not is_packed(one, total + 1)
        assert not is_packed(one[:-1], total)
        whole.append(one)
        given_lists.append((frame, cell, lists, sign))
    rows = np.zeros((maps, max(map(len, whole)) + 2), np.int32)
    for row, one in zip(rows, whole, strict=True):
        row[: len(one)] = one
    beside = rng.integers(0, 4, maps)
    joined = JoinedLists(rows, total + beside, total=total + 5, wanted=wanted)
    assert joined.some.tolist() == [len(cell) > 0 for _, cell, _, _ in given_lists]
    order = rng.permutation(len(joined.cell))
    if len(order) == 0:
        return
    count, items = joined.lists(order)
    found = dict(zip(order.tolist(), np.split(items, count.cumsum()[:-1]), strict=True))
    place = 0
    for b, (frame, cell, lists, sign) in enumerate(given_lists):
        for k, expected in enumerate(lists):
            assert joined.scene[place] == b
            assert joined.cell[place] == cell[k]
            assert joined.sign[place] == sign[k]
            more = np.arange(total, total + beside[b])
            assert found[place].tolist() == (np.concatenate([expected, more]) + b * (total + 5)).tolist()
            place += 1
        if len(cell):
            assert [column[b] for column in joined.frame] == [column[0] for column in frame]
    assert place == len(order)
    assert not JoinedLists(rows, total + beside, total=total + 5, wanted=wanted + 1).some.any()


def test_on_lanes_nothing_is_left_to_list(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = [scene(s) for s in (straight_road(), crossing(6), SegmentStore(builtin_store("train"))[0])]
    plain, listed = collate(scenes), collate([with_lists(one) for one in scenes])
    row, where = lanes(plain)
    found = [
        nearest_points(Tables(plain, CONFIG), row, where),
        road_distance(plain, row, where, Tables(plain, CONFIG)),
    ]
    for kind in (PointCells, EdgeCells):
        monkeypatch.setattr(kind, "_made", None)
    others: list[int] = []
    monkeypatch.setattr(points, "_among_all", lambda flat, rest, *_: others.append(len(rest)))
    tables = Tables(listed, CONFIG)
    again = [nearest_points(tables, row, where), road_distance(listed, row, where, tables)]
    assert torch.equal(again[0][0], found[0][0])
    assert torch.equal(again[1], found[1])
    assert others == [0]
    # So many points that nobody listed them.
    more = Tables(listed, ObservationConfig(num_points=61))
    with pytest.raises(TypeError, match="not callable"):
        nearest_points(more, row, where)


def test_lights_are_found_beside_the_points_of_a_map() -> None:
    given_scene = scene(crossing(6))
    lights = (given_scene.point_type[0] == PointType.LIGHT).nonzero()[:, 0]
    assert len(lights)
    listed = with_lists(given_scene)
    row = torch.zeros(len(lights), dtype=torch.int64)
    flat, _ = nearest_points(Tables(listed, CONFIG), row, listed.point[0, lights][:, None])
    assert (flat[:, 0] == lights[:, None]).any(1).all()
    # Of the map they are not: other lights, the same lists.
    without = given_scene.replace(**{n: getattr(given_scene, n)[:, : lights[0]] for n in _POINTS})
    for one, other in zip(MapLists.of(without, 60), MapLists.of(given_scene, 60), strict=True):
        np.testing.assert_array_equal(one, other)


_POINTS = ("point", "point_direction", "point_type", "point_speed", "point_light", "point_valid")


def test_a_light_may_stand_beyond_the_map() -> None:
    """There a scene's own cells would lie elsewhere than those that were kept."""
    plain = scene(crossing(6))
    lights = plain.point_type[0] == PointType.LIGHT
    plain.point[0, lights] -= torch.tensor([300.0, 200.0])
    listed = with_lists(plain)
    row, where = lanes(plain)
    row, where = torch.cat([row, row]), torch.cat([where, where - torch.tensor([290.0, 200.0])])
    tables = [Tables(one, CONFIG) for one in (plain, listed)]
    assert tables[0].point_cells.x != tables[1].point_cells.x
    found = [nearest_points(one, row, where)[0] for one in tables]
    assert torch.equal(*found)
    assert lights[found[0]].any()


def test_those_of_another_map_are_refused() -> None:
    lists = MapLists.of(scene(straight_road()), 60)
    with pytest.raises(DataError, match=r"point_lists.*those of another map"):
        lists.beside(scene(crossing(6)))


def test_a_training_keeps_them_with_its_store(store: Path, tmp_path: Path) -> None:
    config = tiny("bc", store, tmp_path / "run", steps=2, segments=4)
    train(config)
    assert files(store)
    assert replace(config, device="cuda").scenes["num_points"] == 0, "a device makes no use of them"


def test_lists_are_made_once_for_each_map(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened, items = SegmentStore(store), list(range(12))
    maps = len(np.unique(opened.map_index[items]))
    assert 1 < maps < len(items)
    first = SceneDataset(opened, num_points=60).scenes(items)
    assert len(files(store)) == maps
    monkeypatch.setattr(MapLists, "of", None)
    data = SceneDataset(opened, num_points=60)
    for again in (data, copy.copy(data)):
        for name in ("point_lists", "edge_lists"):
            assert getattr(first, name).shape[1] > 0
            assert torch.equal(getattr(again.scenes(items), name), getattr(first, name))
    assert SceneDataset(opened).scenes(items).point_lists.shape[1] == 0


def test_scenes_on_one_map_share_its_lists(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = SceneDataset(SegmentStore(store)), KeptLists(builtin_store("train"), 60)
    maps = one.store.map_index
    pair = np.flatnonzero(maps == maps[5])[:2].tolist()
    assert len(pair) == 2
    first, second, third = (other.of(one.scene(i)) for i in (*pair, 0))
    assert first is second
    assert third is not first
    monkeypatch.setattr("symphony.simulation.kept.RECENT", 2)
    for i in range(12):
        other.of(one.scene(i))
    assert len(other._recent) == 2
    assert other.of(one.scene(pair[0])) is not first


def test_of_another_number_of_points_they_are_kept_apart(store: Path) -> None:
    for count in (60, 61):
        SceneDataset(SegmentStore(store), num_points=count).scene(0)
    assert len(files(store)) == 2


@pytest.mark.parametrize("damage", ["cut", "empty", "noise", "shorter", "other map", "other fields"])
def test_damaged_lists_are_made_anew(store: Path, damage: str) -> None:
    def made() -> SceneBatch:
        return SceneDataset(SegmentStore(store), num_points=60).scene(0)

    right = made()
    (file,) = files(store)
    content = file.read_bytes()
    with np.load(file) as opened:
        arrays = {name: opened[name] for name in opened.files}
    if damage == "shorter":
        np.savez(file, **{name: value[:-1] for name, value in arrays.items()})
    elif damage == "other map":
        np.savez(file, **MapLists.of(scene(straight_road()), 60)._asdict())
    elif damage == "other fields":
        np.savez(file, points=arrays["points"])
    else:
        file.write_bytes({"cut": content[: len(content) // 2], "empty": b"", "noise": b"x" * 500}[damage])
    again = made()
    assert torch.equal(again.point_lists, right.point_lists)
    assert torch.equal(again.edge_lists, right.edge_lists)
    with np.load(file) as opened:
        assert all(np.array_equal(opened[name], value) for name, value in arrays.items())


def test_a_changed_bit_is_noticed(store: Path) -> None:
    one = SceneDataset(SegmentStore(store)).scene(0)
    kept = KeptLists(store, 60)
    right = kept.of(one)
    (file,) = files(store)
    whole = file.read_bytes()
    for place in range(0, len(whole), len(whole) // 100):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        file.write_bytes(bytes(damaged))
        for found, expected in zip(KeptLists(store, 60).of(one), right, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_into_the_package_nothing_is_written() -> None:
    assert SceneDataset(SegmentStore(builtin_store("test")), num_points=60).scene(0).point_lists.shape[1] > 0
    assert not (builtin_store("test") / "lists").exists()


def test_states_drawn_with_and_without_lists_are_the_same(store: Path) -> None:
    drawn = [
        SceneDataset(SegmentStore(store), num_points=count).sample_states(
            range(8), 100, CONFIG, torch.Generator().manual_seed(0)
        )
        for count in (0, 60)
    ]
    assert (drawn[0] == drawn[1]).all()


def test_other_points_or_edges_have_other_lists(store: Path) -> None:
    one = SceneDataset(SegmentStore(store)).scene(0)
    kept = KeptLists(store, 60)
    kept.of(one)
    changes = {
        "point": one.point + 1,
        "point_type": one.point_type.clip(1),
        "edge_start": one.edge_start + 0.1,
        "edge_end": one.edge_end + 0.1,
        "edge_previous": one.edge_previous.clip(0),
        "edge_following": one.edge_following.clip(0),
    }
    for number, (name, value) in enumerate(changes.items()):
        kept.of(one.replace(**{name: value}))
        assert len(files(store)) == number + 2, name
    for name in ("log_state", "point_speed", "light"):
        kept.of(one.replace(**{name: getattr(one, name) + 1}))
    assert len(files(store)) == len(changes) + 1


def test_the_version_is_raised_when_lists_change() -> None:
    """If this fails, raise LISTS_VERSION and renew the digest: what stores kept is not what would be made now."""
    number = np.arange(400)
    line = np.stack([3 * number % 97, number + 5 * (number % 3)], -1).astype(np.float32)
    edges = Edges.of(line[:-1], line[1:], np.ones(399, bool), number[1:] - 2, np.append(number[1:-1], -1))
    digest = hashlib.sha256()
    for cells in (PointCells(*line.T.copy()[:, None], 60), EdgeCells(edges, np.ones((1, 399), bool))):
        digest.update(cells.packed(*line[::5].T.copy(), cells.total).tobytes())
    assert (LISTS_VERSION, digest.hexdigest()[:16]) == (1, "0df68a2cb7659879")
