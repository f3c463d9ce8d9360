"""The Argoverse 2 reader: what becomes of tracks and map, and that whatever is wrong is named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from helpers_argoverse2 import FAR, NAME, Columns, city, points, scenario, write
from helpers_sources import IN_FOLDER, off_road, read_error, read_one
from symphony.data.conformance import check_reader
from symphony.data.segment import AgentType, LaneType, MarkType
from symphony.data.sources import argoverse2, get_reader
from symphony.data.sources.argoverse2 import EGO_ID, NO_AREA, NO_CROSSING, NO_LANE, NO_TYPE, NOMINAL_SIZES
from symphony.data.sources.base import FROM_AXLE, from_rear_axle


def test_tracks(tmp_path: Path) -> None:
    segment = read_one("argoverse2", write(tmp_path))
    assert (segment.segment_id, segment.file) == (NAME, f"scenario_{NAME}.parquet")
    assert (segment.dt, segment.num_steps, segment.current_step, segment.ego) == (0.1, 20, 7, 0)
    assert segment.agent_id.tolist() == [EGO_ID, 7, 8, 9, 101, 102]
    np.testing.assert_array_equal(segment.origin, [*np.round(FAR + np.array([15, 0])), 0])
    place = segment.position[0] + segment.origin - [*FAR, 0] - [FROM_AXLE, 0, 0]
    np.testing.assert_allclose(place, np.stack([15 + np.arange(20), *np.zeros((2, 20))], -1), atol=1e-6)
    np.testing.assert_array_equal(segment.velocity[4], [[8, 0]] * 20)
    np.testing.assert_allclose(segment.heading[5], np.pi)
    assert segment.valid.sum(axis=1).tolist() == [20, 16, 20, 2, 20, 20]
    assert not segment.position[~segment.valid].any()
    kinds = ("vehicle", "pedestrian", "cyclist", "static", "vehicle", "vehicle")
    for k, kind in enumerate(kinds):
        assert segment.agent_type[k] == NOMINAL_SIZES[kind][0]
        np.testing.assert_array_equal(segment.size[k], np.float32(NOMINAL_SIZES[kind][1]))
    # The focal track, and then the scored one.
    assert (segment.interest.tolist(), segment.predict.tolist()) == ([5], [5, 4])
    assert check_reader(get_reader("argoverse2"), [write(tmp_path)]).segments == 1
    # As in the test split: the number of time stamps stays, the rows end; of a type that nobody knows.
    whole = scenario()
    columns = {name: values[: whole["observed"].index(False)] for name, values in whole.items()}
    put("object_type", "tram")(columns)
    columns |= dict.fromkeys(("track_id", "focal_track_id"), ["AV"] * 8)
    segment = read_one("argoverse2", write(tmp_path, columns))
    assert (segment.num_steps, segment.current_step, segment.dt) == (8, 7, 0.1)
    assert (segment.odd, segment.agent_type.tolist()) == ({NO_TYPE: "'tram'"}, [AgentType.OTHER])


@given(st.floats(-0.5, 0.5), st.floats(0, 15), st.floats(-3, 3))
def test_the_middle_of_a_recording_car_is_ahead_of_its_rear_axle(turn: float, speed: float, course: float) -> None:
    """On a circle of any radius, its velocity is that of the place it moves to."""
    angle = course + turn * 0.1 * np.arange(30)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    between = angle - 0.05 * turn  # half a step before
    axle = np.cumsum(0.1 * speed * np.stack([np.cos(between), np.sin(between)], axis=-1), axis=0)
    states = np.concatenate([axle, angle[:, None], speed * along], axis=-1)
    states[:, 2] = np.arctan2(*along.T[::-1])
    valid = np.arange(30) % 11 > 0
    found = from_rear_axle(states, range(5), valid, 0.1)
    np.testing.assert_array_equal(found[~valid], states[~valid])
    middle = axle + FROM_AXLE * along
    np.testing.assert_allclose(found[valid, :3], np.c_[middle, states[:, 2]][valid], atol=1e-9)
    moved = (middle[2:] - middle[:-2]) / 0.2
    np.testing.assert_allclose(found[1:-1, 3:][valid[1:-1]], moved[valid[1:-1]], atol=0.02)
    np.testing.assert_array_equal(from_rear_axle(states, range(5), np.arange(30) == 1, 0.1)[2:], states[2:])


def test_lane_graph(tmp_path: Path) -> None:
    segment = read_one("argoverse2", write(tmp_path))
    road = segment.road
    assert road.lane_id.tolist() == [10, 11, 20, 21, 30, 40]
    names = ("successors", "left_neighbors", "right_neighbors")
    links = [{tuple(pair) for pair in road.lane_id[getattr(road, name)].tolist()} for name in names]
    # From either end; lane 12 lies beyond the map. The file's left neighbour of 20 comes towards it; 99 is not there.
    assert links == [{(10, 11), (20, 21)}, {(10, 20), (11, 21)}, {(20, 10), (21, 11)}]
    assert road.lane_type.tolist() == [LaneType.SURFACE_STREET] * 5 + [LaneType.BIKE_LANE]
    np.testing.assert_allclose(road.lane_width, [3.6] * 5 + [1.5], rtol=1e-6)
    assert np.isnan(road.speed_limit).all()
    # The dashes between 10 and 20 are in the file twice, with another number of points on either side.
    assert road.mark_type.tolist() == [MarkType.ROAD_LINE] * 3 + [MarkType.CROSSWALK]
    line = road.lanes[4] + segment.origin - [*FAR, 0]
    np.testing.assert_allclose(line, [[120, 7.2, 0], [60, 7.2, 0], [0, 7.2, 0]], atol=1e-4)


def test_a_missing_centre_line_is_the_middle_of_the_bounds(tmp_path: Path) -> None:
    map_ = city()
    for k, node in enumerate(map_["lane_segments"].values()):
        if k % 2:
            node["centerline"] = []
        else:
            del node["centerline"]
    expected = read_one("argoverse2", write(tmp_path)).road.lanes
    lanes = read_one("argoverse2", write(tmp_path, map_=map_)).road.lanes
    for k in range(len(expected)):
        assert shapely.LineString(lanes[k]).hausdorff_distance(shapely.LineString(expected[k])) < 1e-4
        np.testing.assert_allclose(lanes[k][[0, -1]], expected[k][[0, -1]], atol=1e-4)


def test_the_boundary_is_open_where_the_map_is_cut(tmp_path: Path) -> None:
    segment = read_one("argoverse2", write(tmp_path))
    lines = sorted((line[[0, -1], :2] for line in map(segment.road.boundary.__getitem__, (0, 1))), key=np.max)
    shift = segment.origin[:2] - FAR
    ends = [[(0, -4), (120, -4)], [(120, 9.5), (0, 9.5)]]
    np.testing.assert_allclose(sorted((line + shift).tolist() for line in lines), ends, atol=1e-3)
    # Traffic on the road, and beyond its two ends, is not off it; what is beside it is.
    spots = np.array([(-15, 0), (1, 0), (60, 3), (119, 9), (140, 7), (10, -5), (70, 11), (110, -30)]) - shift
    assert (off_road(segment.road, spots) > 0).tolist() == [False] * 5 + [True] * 3


@IN_FOLDER
@given(data=st.data())
def test_either_file_cut_anywhere(data: st.DataObject, tmp_path: Path) -> None:
    path = write(tmp_path)
    part = data.draw(st.sampled_from([path, argoverse2.map_path(path)]))
    whole = part.read_bytes()
    part.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    error = read_error("argoverse2", path)
    assert error.file == part
    assert (error.segment is None) == (part == path)


def test_a_missing_map_and_a_file_under_another_scenarios_name(tmp_path: Path) -> None:
    path = write(tmp_path)
    argoverse2.map_path(path).unlink()
    error = read_error("argoverse2", path)
    assert (error.file, error.segment) == (argoverse2.map_path(path), NAME)
    error = read_error("argoverse2", write(tmp_path, name="another"))
    assert (error.field, error.segment) == ("scenario_id", NAME)


@pytest.mark.parametrize("name", [name for name in scenario() if name not in {"city", "map_id"}])
def test_each_column_is_needed(name: str, tmp_path: Path) -> None:
    columns = scenario()
    good = columns.pop(name)
    other = 1 if isinstance(good[0], str | bool) else True
    wrong = [[value] * len(good) for value in ([1.0], b"1", other)]
    for given_ in ({}, *({name: values} for values in ([*good[:-1], None], *wrong))):
        error = read_error("argoverse2", write(tmp_path, columns | given_))
        assert (error.field, error.file) == (name, tmp_path / f"scenario_{NAME}.parquet")


def put(name: str, value: Any, row: int | None = None) -> Callable[[Columns], None]:
    """Write a value into one row of a column, or all."""

    def change(columns: Columns) -> None:
        for k in range(len(columns[name])) if row is None else [row]:
            columns[name][k] = value

    return change


def rename(name: str, to: str) -> Callable[[Columns], None]:
    def change(columns: Columns) -> None:
        columns["track_id"] = [to if track == name else track for track in columns["track_id"]]

    return change


@pytest.mark.parametrize(("change", "field"), [
    (put("timestep", 4, 5), "timestep"),  # two states at one step
    (put("timestep", -1, 5), "timestep"), (put("num_timestamps", 10**12), "num_timestamps"),
    (put("num_timestamps", 21, 7), "num_timestamps"), (put("start_timestamp", 3.0e17, 2), "start_timestamp"),
    (put("end_timestamp", 3.15986559459579e17 + 1e3), "end_timestamp"), (put("observed", False), "observed"),
    (put("object_type", "bus", 3), "object_type"), (put("focal_track_id", "555"), "focal_track_id"),
    (rename("AV", "300"), "track_id"), (rename("7", "seven"), "track_id"), (rename("7", "0101"), "agent_id"),
])  # fmt: skip
def test_bad_tracks(change: Callable[[Columns], None], field: str, tmp_path: Path) -> None:
    columns = scenario()
    change(columns)
    path = write(tmp_path, columns)
    error = read_error("argoverse2", path)
    assert (error.file, error.segment, error.field) == (path, NAME, field)


LANE = ("lane_segments", "11")
LEFT = (*LANE, "left_lane_boundary")


def written_with(folder: Path, keys: tuple[str, ...], value: Any) -> Path:
    """A scenario whose map has another value under some keys, or with ``...`` none."""
    holder = map_ = city()
    for key in keys[:-1]:
        holder = holder[key]
    if value is ...:
        del holder[keys[-1]]
    else:
        holder[keys[-1]] = value
    return write(folder, map_=map_)


@pytest.mark.parametrize("name", ["lane_segments", "drivable_areas", "pedestrian_crossings"])
def test_maps_without_a_part(name: str, tmp_path: Path) -> None:
    for value in (..., [], *([{}] if name != "pedestrian_crossings" else [])):
        path = written_with(tmp_path, (name,), value)
        error = read_error("argoverse2", path)
        assert (error.file, error.segment, error.field) == (argoverse2.map_path(path), NAME, name)
    error = read_error("argoverse2", written_with(tmp_path, (*LANE, "id"), 20))
    assert "lane_segments 20: two of one id" in str(error)


@pytest.mark.parametrize(("keys", "value", "kind"), [
    (LANE, 3, NO_LANE), ((*LANE, "id"), True, NO_LANE), ((*LANE, "lane_type"), [], NO_LANE),
    ((*LANE, "successors"), ..., NO_LANE), ((*LANE, "predecessors"), [2**63], NO_LANE),
    (LEFT, [{"x": 1.0, "y": float("nan")}], NO_LANE), (LEFT, [{"x": 10**400, "y": 2}], NO_LANE),
    (LEFT, [{"x": "7", "y": 2}], NO_LANE), (LEFT, {}, NO_LANE),
    (("drivable_areas", "1", "area_boundary"), points([(0, 0), (1, 1)]), NO_AREA),
    (("pedestrian_crossings", "5", "edge2"), points([(0, 0)]), NO_CROSSING),
    (("drivable_areas", "\ud800"), {}, NO_AREA),
])  # fmt: skip
def test_unreadable_entries_go(keys: tuple[str, ...], value: Any, kind: str, tmp_path: Path) -> None:
    found = read_one("argoverse2", written_with(tmp_path, keys, value))
    assert list(found.odd) == [kind]
    written = keys[1].encode(errors="backslashreplace").decode()  # JSON may hold halves of letters
    assert found.odd[kind].startswith(f"{keys[0]} {written}")
    assert (11 in found.road.lane_id.tolist()) == (kind != NO_LANE)
