"""The Argoverse 2 reader: what becomes of tracks and map, and that whatever is wrong is named."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers_argoverse2 import (
    FAR,
    NAME,
    Columns,
    city,
    finished,
    lane,
    needs_pyarrow,
    points,
    scenario,
    track,
    write,
)
from helpers_sources import off_road, read_error, read_one
from symphony.cli import main
from symphony.data.convert import convert
from symphony.data.odd import WILD
from symphony.data.segment import AgentType, LaneType, MarkType, RunSegment, content_hash
from symphony.data.sources import get_reader
from symphony.data.sources.argoverse2 import EGO_ID, NOMINAL_SIZES, map_path
from symphony.data.sources.lines import stretches
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError
from symphony.evaluation import evaluate

pa = needs_pyarrow
IN_FOLDER = settings(
    deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def links(segment: RunSegment, found: NDArray[Any]) -> set[tuple[int, int]]:
    """Pairs of lane ids."""
    return {(int(a), int(b)) for a, b in segment.road.lane_id[found]}


# Tracks


def test_tracks(tmp_path: Path) -> None:
    segment = read_one("argoverse2", write(tmp_path))
    assert (segment.segment_id, segment.source, segment.file) == (
        NAME,
        "argoverse2",
        f"scenario_{NAME}.parquet",
    )
    assert (segment.dt, segment.num_steps, segment.current_step, segment.ego) == (0.1, 20, 7, 0)
    assert segment.agent_id.tolist() == [EGO_ID, 7, 8, 9, 101, 102]
    np.testing.assert_array_equal(segment.origin, [*np.round(FAR + np.array([15, 0])), 0])
    expected = 15 + FAR[0] - segment.origin[0] + np.arange(20)
    np.testing.assert_allclose(segment.position[0, :, 0], expected, atol=1e-6)
    np.testing.assert_allclose(segment.position[0, :, 1], FAR[1] - segment.origin[1], atol=1e-6)
    np.testing.assert_array_equal(segment.velocity[4], [[8, 0]] * 20)
    np.testing.assert_allclose(segment.heading[5], np.pi)
    assert np.flatnonzero(segment.valid[1]).tolist() == list(range(2, 18))
    assert segment.valid.sum(axis=1).tolist() == [20, 16, 20, 2, 20, 20]
    assert not segment.position[1, [0, 1, 18, 19]].any()
    assert not segment.position[..., 2].any()
    # The focal track, and then the scored one.
    assert segment.interest.tolist() == [5]
    assert segment.predict.tolist() == [5, 4]


def test_the_order_of_rows_does_not_matter(tmp_path: Path) -> None:
    columns = scenario()
    order = np.random.default_rng(0).permutation(len(columns["timestep"]))
    shuffled = {name: [values[k] for k in order] for name, values in columns.items()}
    first = read_one("argoverse2", write(tmp_path, columns))
    assert content_hash(read_one("argoverse2", write(tmp_path, shuffled))) == content_hash(first)


@pytest.mark.parametrize("kind", sorted(NOMINAL_SIZES))
def test_sizes_are_nominal(kind: str, tmp_path: Path) -> None:
    columns = scenario()
    columns["object_type"] = [kind if t == "9" else k for t, k in zip(*track_types(columns), strict=True)]
    segment = read_one("argoverse2", write(tmp_path, columns))
    agent_type, size = NOMINAL_SIZES[kind]
    assert segment.agent_type[3] == agent_type
    np.testing.assert_array_equal(segment.size[3], np.float32(size))
    assert segment.agent_type.tolist()[:3] == [AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST]


def track_types(columns: Columns) -> tuple[list[str], list[str]]:
    return columns["track_id"], columns["object_type"]


def test_a_scenario_without_its_future(tmp_path: Path) -> None:
    """As in the test split: the number of time stamps stays, the rows end."""
    whole = scenario()
    keep = [k for k, observed in enumerate(whole["observed"]) if observed]
    columns = {name: [values[k] for k in keep] for name, values in whole.items()}
    segment = read_one("argoverse2", write(tmp_path, columns))
    assert (segment.num_steps, segment.current_step, segment.dt) == (8, 7, 0.1)


def test_columns_of_other_widths_say_the_same(tmp_path: Path) -> None:
    expected = content_hash(read_one("argoverse2", write(tmp_path)))
    types = {
        "track_id": pa.large_string(),
        "object_type": pa.dictionary(pa.int8(), pa.string()),
        "timestep": pa.uint16(),
        "object_category": pa.int8(),
        "start_timestamp": pa.float64(),
    }
    assert content_hash(read_one("argoverse2", write(tmp_path, types=types))) == expected


def test_precision_far_from_the_origin(tmp_path: Path) -> None:
    """Nothing depends on where in the city the scenario lies."""
    columns, map_ = scenario(), city()
    near = read_one("argoverse2", write(tmp_path, columns, map_))
    columns["position_x"] = [x + 300_000 for x in columns["position_x"]]
    moved = json.loads(json.dumps(map_), object_hook=lambda d: d | {"x": d["x"] + 3e5} if "x" in d else d)
    far = read_one("argoverse2", write(tmp_path, columns, moved))
    np.testing.assert_allclose(near.position, far.position, atol=1e-6)
    for name in ("lanes", "boundary", "marks"):
        lines = getattr(near.road, name), getattr(far.road, name)
        np.testing.assert_allclose(lines[0].points, lines[1].points, atol=1e-6)


# Map


def test_lane_graph(tmp_path: Path) -> None:
    segment = read_one("argoverse2", write(tmp_path))
    road = segment.road
    assert road.lane_id.tolist() == [10, 11, 20, 21, 30, 40]
    # From either end; lane 12 lies beyond the map.
    assert links(segment, road.successors) == {(10, 11), (20, 21)}
    # The file's left neighbour of 20 comes towards it; 99 is not there.
    assert links(segment, road.left_neighbors) == {(10, 20), (11, 21)}
    assert links(segment, road.right_neighbors) == {(20, 10), (21, 11)}
    assert road.lane_type.tolist() == [LaneType.SURFACE_STREET] * 5 + [LaneType.BIKE_LANE]
    np.testing.assert_allclose(road.lane_width, [3.6] * 5 + [1.5], rtol=1e-6)
    assert np.isnan(road.speed_limit).all()
    origin = FAR - segment.origin[:2]
    np.testing.assert_allclose(road.lanes[4][:, :2] - origin, [[120, 7.2], [60, 7.2], [0, 7.2]], atol=1e-4)
    assert not road.lanes.points[:, 2].any()


@pytest.mark.parametrize("center", ["absent", "empty"])
def test_a_missing_centre_line_is_the_middle_of_the_bounds(center: str, tmp_path: Path) -> None:
    map_ = city()
    for node in map_["lane_segments"].values():
        node.pop("centerline")
        if center == "empty":
            node["centerline"] = []
    expected = read_one("argoverse2", write(tmp_path)).road
    road = read_one("argoverse2", write(tmp_path, map_=map_)).road
    for k in range(len(expected.lanes)):
        line = shapely.LineString(road.lanes[k])
        assert line.hausdorff_distance(shapely.LineString(expected.lanes[k])) < 1e-4
        np.testing.assert_allclose(road.lanes[k][[0, -1]], expected.lanes[k][[0, -1]], atol=1e-4)


def test_lanes_without_any_line_are_left_out(tmp_path: Path) -> None:
    map_ = city()
    map_["lane_segments"]["11"] |= {"centerline": [], "left_lane_boundary": points([(60, 0)])}
    road = read_one("argoverse2", write(tmp_path, map_=map_)).road
    assert road.lane_id.tolist() == [10, 20, 21, 30, 40]
    assert len(road.successors) == 1


def test_marks(tmp_path: Path) -> None:
    segment = read_one("argoverse2", write(tmp_path))
    road = segment.road
    # The dashes between 10 and 20 are in the file twice, with another number of points on either side.
    assert road.mark_type.tolist() == [MarkType.ROAD_LINE] * 3 + [MarkType.CROSSWALK]
    map_ = city()
    left = map_["lane_segments"]["10"]["left_lane_boundary"]
    for shared in (left, left[::-1]):
        map_["lane_segments"]["20"]["right_lane_boundary"] = shared
        found = read_one("argoverse2", write(tmp_path, map_=map_)).road
        assert found.mark_type.tolist() == [MarkType.ROAD_LINE] * 2 + [MarkType.CROSSWALK]


@pytest.mark.parametrize("turned", [False, True])
def test_a_crossing_is_a_simple_ring(turned: bool, tmp_path: Path) -> None:
    map_ = city()
    if turned:
        map_["pedestrian_crossings"]["5"]["edge2"].reverse()
    ring = read_one("argoverse2", write(tmp_path, map_=map_)).road.marks[3][:, :2]
    np.testing.assert_array_equal(ring[0], ring[-1])
    assert shapely.Polygon(ring).is_valid
    assert shapely.Polygon(ring).area == pytest.approx(4 * 13.5, rel=1e-4)


def test_the_boundary_is_open_where_the_map_is_cut(tmp_path: Path) -> None:
    segment = read_one("argoverse2", write(tmp_path))
    lines = [segment.road.boundary[k][:, :2] + segment.origin[:2] - FAR for k in range(2)]
    assert len(segment.road.boundary) == 2
    lines.sort(key=lambda line: line[0, 1])
    np.testing.assert_allclose(lines[0][[0, -1]], [[0, -4], [120, -4]], atol=1e-3)
    np.testing.assert_allclose(lines[1][[0, -1]], [[120, 9.5], [0, 9.5]], atol=1e-3)
    # Traffic on the road, and beyond its two ends, is not off it; what is beside it is.
    spots = np.array([[-15, 0], [1, 0], [60, 3], [119, 9], [140, 7]]) + FAR - segment.origin[:2]
    assert (off_road(segment.road, spots) < 0).all()
    beside = np.array([[10, -5], [70, 11], [110, -30]]) + FAR - segment.origin[:2]
    assert (off_road(segment.road, beside) > 0).all()


def test_a_closed_area_stays_a_ring(tmp_path: Path) -> None:
    """Where no edge lies on a tile's, the rings are whole: outer counter-clockwise, holes clockwise."""
    map_ = city()
    ring = [(3, -4.1), (117, -4.1), (117, 9.6), (3, 9.6), (3, -4.1)]
    hole = [(51, 11), (69, 11), (69, 13), (51, 13)]
    frame = shapely.Polygon(ring).union(shapely.box(41, 9, 79, 15)).difference(shapely.Polygon(hole))
    halves = [
        frame.intersection(shapely.box(0, -5, 60, 20)),
        frame.intersection(shapely.box(60, -5, 130, 20)),
    ]
    map_["drivable_areas"] = {
        str(k): {"id": k, "area_boundary": points(half.exterior.coords)} for k, half in enumerate(halves)
    }
    road = read_one("argoverse2", write(tmp_path, map_=map_)).road
    rings = [shapely.LinearRing(road.boundary[k][:, :2]) for k in range(len(road.boundary))]
    assert [ring.is_ccw for ring in rings] == [True, False]
    assert all((road.boundary[k][0] == road.boundary[k][-1]).all() for k in range(2))
    assert shapely.Polygon(rings[0], [rings[1]]).area == pytest.approx(frame.area, rel=1e-3)


@given(keep=st.lists(st.booleans(), min_size=3, max_size=12))
def test_stretches_hold_exactly_the_edges_kept(keep: list[bool]) -> None:
    count = len(keep)
    angle = np.arange(count + 1) % count * (2 * np.pi / count)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    found = stretches(ring, np.array(keep))
    edges = [(tuple(a), tuple(b)) for line in found for a, b in pairwise(line)]
    expected = [(tuple(ring[k]), tuple(ring[k + 1])) for k in range(count) if keep[k]]
    assert sorted(edges) == sorted(expected)
    # No two of them could be one.
    starts, ends = [tuple(line[0]) for line in found], [tuple(line[-1]) for line in found]
    assert all(keep) or not set(starts) & set(ends)


# Bad input


def test_a_missing_pyarrow_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"symphony-traffic\[argoverse2\]"):
        get_reader("argoverse2")


@IN_FOLDER
@given(data=st.data())
def test_either_file_cut_anywhere(data: st.DataObject, tmp_path: Path) -> None:
    path = write(tmp_path)
    part = data.draw(st.sampled_from([path, map_path(path)]))
    whole = part.read_bytes()
    part.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    error = read_error("argoverse2", path)
    assert error.file == part
    assert (error.segment is None) == (part == path)


def test_a_missing_map(tmp_path: Path) -> None:
    path = write(tmp_path)
    map_path(path).unlink()
    error = read_error("argoverse2", path)
    assert (error.file, error.segment, error.message) == (
        map_path(path),
        NAME,
        "the scenario's map is missing",
    )


def test_a_file_under_another_scenarios_name(tmp_path: Path) -> None:
    path = write(tmp_path, name="another")
    error = read_error("argoverse2", path)
    assert (error.field, error.segment) == ("scenario_id", NAME)
    assert f"scenario_{NAME}.parquet" in error.message


REQUIRED = [name for name in scenario() if name not in {"city", "map_id"}]


@pytest.mark.parametrize("name", REQUIRED)
def test_each_column_is_needed(name: str, tmp_path: Path) -> None:
    columns = scenario()
    good = columns.pop(name)
    error = read_error("argoverse2", write(tmp_path, columns))
    assert (error.field, error.message) == (name, "the column is missing")
    error = read_error("argoverse2", write(tmp_path, columns | {name: [*good[:-1], None]}))
    assert error.field == name
    assert "missing" in error.message
    other = [b"x"] * len(good)
    error = read_error("argoverse2", write(tmp_path, columns | {name: other}))
    assert error.field == name
    assert "binary" in error.message


def test_other_columns_are_not_needed(tmp_path: Path) -> None:
    expected = content_hash(read_one("argoverse2", write(tmp_path)))
    columns = {name: values for name, values in scenario().items() if name in REQUIRED}
    assert content_hash(read_one("argoverse2", write(tmp_path, columns))) == expected


def put(name: str, value: Any, row: int | None = None) -> Callable[[Columns], None]:
    """Write a value into one row of a column, or all."""

    def change(columns: Columns) -> None:
        rows = range(len(columns[name])) if row is None else [row]
        for k in rows:
            columns[name][k] = value

    return change


def rename(name: str, to: str) -> Callable[[Columns], None]:
    def change(columns: Columns) -> None:
        columns["track_id"] = [to if track == name else track for track in columns["track_id"]]

    return change


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        (put("position_x", float("nan"), 3), "position_x", "first at track 102, step 3"),
        (put("heading", float("inf"), 5), "heading", "not finite"),
        (put("velocity_y", float("-inf"), 0), "velocity_y", "not finite"),
        (put("timestep", 4, 5), "timestep", "track 102 has two states at step 4"),
        (put("timestep", -1, 5), "timestep", "-1 is outside the 20 steps"),
        (put("timestep", 20, 5), "timestep", "20 is outside the 20 steps"),
        (put("num_timestamps", 1), "num_timestamps", "1 steps"),
        (put("num_timestamps", 10**12), "num_timestamps", "steps"),
        (put("num_timestamps", 21, 7), "num_timestamps", "differs"),
        (put("end_timestamp", 0.0), "end_timestamp", "per step"),
        (put("end_timestamp", 3.15986559459579e17 + 1e3), "end_timestamp", "per step"),
        (put("end_timestamp", float("nan")), "end_timestamp", ""),
        (put("start_timestamp", 3.0e17, 2), "start_timestamp", "differs"),
        (put("object_type", "tram"), "object_type", "unknown value 'tram'"),
        (put("object_type", "bus", 3), "object_type", "track 102 has more than one"),
        (put("object_category", 1, 25), "object_category", "track 101 has more than one"),
        (put("object_category", 4), "object_category", "expected 0 … 3"),
        (put("observed", False), "observed", "no step"),
        (put("focal_track_id", "555"), "focal_track_id", "no track"),
        (rename("AV", "300"), "track_id", "no track 'AV'"),
        (rename("7", "seven"), "track_id", "'seven' is neither"),
        (rename("7", "9" * 30), "track_id", "neither"),
        (rename("7", "0101"), "agent_id", "not unique"),
    ],
)
def test_bad_tracks(change: Callable[[Columns], None], field: str, message: str, tmp_path: Path) -> None:
    columns = scenario()
    change(columns)
    path = write(tmp_path, columns)
    error = read_error("argoverse2", path)
    assert (error.file, error.segment, error.field) == (path, NAME, field)
    assert message in error.message


@pytest.mark.parametrize(("name", "value"), [("position_y", 1e7), ("velocity_x", 1e300)])
def test_a_wild_state_is_left_out(name: str, value: float, tmp_path: Path) -> None:
    columns = scenario()
    whole = read_one("argoverse2", write(tmp_path, columns))
    put(name, value, 30)(columns)
    found = read_one("argoverse2", write(tmp_path, columns))
    assert list(found.odd) == [WILD]
    assert whole.valid.sum() - found.valid.sum() == 1


@pytest.mark.parametrize("name", ["a/b", "../up", ""])
def test_names_that_are_no_names(name: str, tmp_path: Path) -> None:
    columns = scenario() | {"scenario_id": [name] * len(scenario()["timestep"])}
    error = read_error("argoverse2", write(tmp_path, columns))
    assert error.field == "scenario_id"


def test_too_much_to_hold(tmp_path: Path) -> None:
    columns: Columns = {}
    for k in range(700):
        track(columns, str(k), "vehicle", range(1), (0, 0), 1.0)
    track(columns, "AV", "vehicle", range(9_000, 9_001), (0, 0), 1.0)
    error = read_error("argoverse2", write(tmp_path, finished(columns)))
    assert "6309701 states (agents times steps), at most" in error.message


def at(*keys: str) -> Callable[[Any], Any]:
    """The entry of a map under some keys, but the last."""

    def find(node: Any) -> Any:
        for key in keys[:-1]:
            node = node[key]
        return node

    return find


LANE = ("lane_segments", "11")
LEFT = (*LANE, "left_lane_boundary")
AREA = ("drivable_areas", "1", "area_boundary")
MISSING = object()


@pytest.mark.parametrize(
    ("keys", "value", "field"),
    [
        (("lane_segments",), MISSING, "lane_segments"),
        (("drivable_areas",), MISSING, "drivable_areas"),
        (("pedestrian_crossings",), MISSING, "pedestrian_crossings"),
        (("lane_segments",), [], "lane_segments"),
        (("lane_segments",), {}, "lane_segments"),
        (("drivable_areas",), {}, "drivable_areas"),
        (LANE, 3, "lane_segments 11"),
        ((*LANE, "id"), 12, "lane_segments 11: id"),
        ((*LANE, "id"), "11", "lane_segments 11: id"),
        ((*LANE, "lane_type"), "TRAM", "lane_segments 11: lane_type"),
        ((*LANE, "lane_type"), MISSING, "lane_segments 11: lane_type"),
        ((*LANE, "successors"), MISSING, "lane_segments 11: successors"),
        ((*LANE, "successors"), ["12"], "lane_segments 11: successors"),
        ((*LANE, "predecessors"), None, "lane_segments 11: predecessors"),
        ((*LANE, "predecessors"), [2**63], "lane_segments 11: predecessors"),
        ((*LANE, "left_neighbor_id"), True, "lane_segments 11: left_neighbor_id"),
        ((*LANE, "right_neighbor_id"), MISSING, "lane_segments 11: right_neighbor_id"),
        ((*LANE, "left_lane_mark_type"), 3, "lane_segments 11: left_lane_mark_type"),
        ((*LANE, "centerline"), 3, "lane_segments 11: centerline"),
        (LEFT, MISSING, "lane_segments 11: left_lane_boundary"),
        (LEFT, [{"x": 1.0}], "lane_segments 11: left_lane_boundary"),
        (LEFT, [{"x": 1.0, "y": float("nan")}], "lane_segments 11: left_lane_boundary"),
        (LEFT, [{"x": 1.0, "y": "2"}], "lane_segments 11: left_lane_boundary"),
        (LEFT, [{"x": True, "y": 2}], "lane_segments 11: left_lane_boundary"),
        (LEFT, [{"x": 10**400, "y": 2}], "lane_segments 11: left_lane_boundary"),
        (LEFT, [[1.0, 2.0]], "lane_segments 11: left_lane_boundary"),
        (AREA, points([(0, 0), (1, 1)]), "drivable_areas 1: area_boundary"),
        (AREA, MISSING, "drivable_areas 1: area_boundary"),
        (("pedestrian_crossings", "5", "edge2"), points([(0, 0)]), "pedestrian_crossings 5"),
    ],
)
def test_bad_maps(keys: tuple[str, ...], value: Any, field: str, tmp_path: Path) -> None:
    map_ = city()
    holder = at(*keys)(map_)
    if value is MISSING:
        del holder[keys[-1]]
    else:
        holder[keys[-1]] = value
    path = write(tmp_path, map_=map_)
    error = read_error("argoverse2", path)
    assert (error.file, error.segment, error.field) == (map_path(path), NAME, field)


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, "\xff", "NaN"])
def test_maps_that_are_none(text: str, tmp_path: Path) -> None:
    path = write(tmp_path)
    map_path(path).write_bytes(text.encode("latin-1"))
    error = read_error("argoverse2", path)
    assert (error.file, error.segment) == (map_path(path), NAME)


def test_a_lane_twice_under_two_keys(tmp_path: Path) -> None:
    map_ = city()
    map_["lane_segments"]["011"] = lane(11, 0, 60, 120)
    assert read_error("argoverse2", write(tmp_path, map_=map_)).field == "lane_segments 011: id"


# The command, and the real sample


def test_convert_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path)
    assert main(["data", "convert", "argoverse2", str(path), "--out", str(tmp_path / "store")]) == 0
    (segment,) = SegmentStore(tmp_path / "store")
    assert (segment.segment_id, segment.dt, segment.num_steps) == (NAME, 0.2, 10)
    # A folder is searched for scenarios, and a map alone is none.
    found = convert("argoverse2", [tmp_path], tmp_path / "again")
    assert (found.converted, found.files) == (1, 1)


@pytest.fixture(scope="module")
def sample(samples: Path) -> Path:
    (path,) = (samples / "argoverse2").glob("scenario_*.parquet")
    return path


@pytest.fixture(scope="module")
def real(sample: Path) -> RunSegment:
    return read_one("argoverse2", sample)


@pytest.mark.samples
def test_sample_tracks(real: RunSegment, sample: Path) -> None:
    from pyarrow import parquet

    rows = parquet.read_table(sample).to_pylist()
    assert (real.num_agents, real.num_steps, real.dt, real.current_step) == (58, 110, 0.1, 49)
    assert np.bincount(real.agent_type).tolist() == [0, 32, 12, 0, 14]
    assert (real.ego, real.agent_id[0]) == (0, EGO_ID)
    assert real.valid[0].all()
    assert real.agent_id[real.interest].tolist() == [138951]
    assert real.agent_id[real.predict].tolist() == [138951, 139344]
    assert int(real.valid.sum()) == len(rows) == 2434
    index = {agent: k for k, agent in enumerate(real.agent_id.tolist())}
    for row in rows[::7]:
        k, step = index[EGO_ID if row["track_id"] == "AV" else int(row["track_id"])], row["timestep"]
        assert real.valid[k, step]
        logged = [row["position_x"], row["position_y"], 0]
        np.testing.assert_allclose(real.position[k, step] + real.origin, logged, atol=2e-5)
        np.testing.assert_allclose(real.velocity[k, step], [row["velocity_x"], row["velocity_y"]], rtol=1e-6)
        assert real.heading[k, step] == np.float32(row["heading"])


@pytest.mark.samples
def test_sample_map(real: RunSegment, sample: Path) -> None:
    nodes = json.loads(map_path(sample).read_text())["lane_segments"]
    road = real.road
    assert road.lane_id.tolist() == [int(key) for key in nodes]
    assert len(nodes) == 71
    assert int((road.lane_type == LaneType.BIKE_LANE).sum()) == 37
    known = {(n["id"], other) for n in nodes.values() for other in n["successors"] if str(other) in nodes}
    assert links(real, road.successors) == known
    assert len(known) == 79
    assert {(b, a) for a, b in known} == {
        (n["id"], other) for n in nodes.values() for other in n["predecessors"] if str(other) in nodes
    }
    # 28 of the file's 35 left neighbours come the other way.
    assert links(real, road.left_neighbors) == {(b, a) for a, b in links(real, road.right_neighbors)}
    assert len(road.left_neighbors) == 7
    for k, node in enumerate(nodes.values()):
        line = [(p["x"], p["y"]) for p in node["centerline"]]
        np.testing.assert_allclose(road.lanes[k][:, :2] + real.origin[:2], line, atol=2e-5)
    assert 1 < road.lane_width.min() < road.lane_width.max() < 8
    ends = road.lanes.points[road.lanes.offsets[1:] - 1]
    gap = road.lanes.points[road.lanes.offsets[:-1]][road.successors[:, 1]] - ends[road.successors[:, 0]]
    assert np.abs(gap).max() < 0.5


@pytest.mark.samples
def test_sample_traffic_is_on_the_road(real: RunSegment, sample: Path) -> None:
    speed = np.hypot(*np.moveaxis(real.velocity, -1, 0))
    moving = real.valid & (real.agent_type == AgentType.VEHICLE)[:, None] & (speed > 2)
    spots = real.position[moving][:, :2]
    off = off_road(real.road, spots) > 0
    assert moving.sum() == 444
    # Measured: 4.3 %, all of it in a side street that the map does not reach.
    assert off.mean() < 0.05
    areas = json.loads(map_path(sample).read_text())["drivable_areas"].values()
    rings = [[(p["x"], p["y"]) for p in area["area_boundary"]] for area in areas]
    union = shapely.union_all([shapely.Polygon(ring) for ring in rings])
    inside = shapely.contains_xy(union, *(spots + real.origin[:2]).T)
    # A closed boundary would put a quarter of the traffic off the road: whatever is beyond the map's edge.
    assert (~inside).mean() == pytest.approx(0.2545, abs=1e-3)
    assert not off[inside].any()


@pytest.mark.samples
def test_sample_playback(sample: Path, tmp_path: Path) -> None:
    report = convert("argoverse2", [sample], tmp_path / "store")
    assert (report.converted, report.skipped) == (1, [])
    found = evaluate("playback", SegmentStore(tmp_path / "store")).numbers()
    assert [found[name] for name in ("ade", "collision_rate", "offroad_time")] == [0, 0, 0]
