"""The WOMD reader, its files, and a real record compared with an independent summary of it."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_sources import FAR, read_error, read_one, womd_scenario, write_records
from symphony.data.odd import NO_LINE, NO_SIZE, WILD
from symphony.data.segment import AgentType, LaneType, MarkType, RunSegment
from symphony.data.sources import get_reader, readers
from symphony.data.sources.womd_pb2 import Scenario
from symphony.errors import ConfigError

MPS = 0.44704
Change = Callable[[Scenario], Any]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "made.tfrecord-00000-of-00001"


def convert(path: Path, scenario: Scenario) -> RunSegment:
    write_records(path, [scenario.SerializeToString()])
    return read_one("womd", path)


def test_readers_are_found_by_name() -> None:
    assert readers() == ("argoverse2", "commonroad", "interaction", "scenarionet", "womd")
    for name in readers():
        if name != "argoverse2" or importlib.util.find_spec("pyarrow"):
            assert get_reader(name).name == name
    for name, options, message in (
        ("wmod", {}, "did you mean 'womd'"),
        ("?", {}, "known: argoverse2, commonroad, interaction, scenarionet, womd"),
        ("commonroad", {"egoes": "all"}, "'egoes"),
        ("commonroad", {"egos": "most"}, "egos must be 'one' or 'all'"),
    ):
        with pytest.raises(ConfigError, match=message):
            get_reader(name, **options)


def test_tracks(path: Path) -> None:
    segment = convert(path, womd_scenario(tracks=3, steps=5))
    assert (segment.segment_id, segment.source, segment.file) == ("0123456789abcdef", "womd", path.name)
    assert (segment.dt, segment.num_steps, segment.current_step, segment.ego) == (0.1, 5, 1, 2)
    np.testing.assert_array_equal(segment.agent_id, [100, 101, 102])
    np.testing.assert_array_equal(segment.agent_type, [AgentType.VEHICLE] * 3)
    np.testing.assert_array_equal(segment.origin, np.round(FAR + np.array([10, 0, 0])))
    for k in range(3):
        x = FAR[0] - segment.origin[0] + 5 * k + (10 + k) * 0.1 * np.arange(5)
        np.testing.assert_allclose(segment.position[k, :, 0], x, atol=1e-5)
        np.testing.assert_allclose(segment.position[k, :, 1], 4 * (k % 2), atol=1e-5)
        np.testing.assert_allclose(segment.velocity[k], [[10 + k, 0.5]] * 5)
        np.testing.assert_allclose(segment.heading[k], 0.01 * k)
    np.testing.assert_allclose(segment.size, [[4.5, 2, 1.5], [5.5, 2, 1.5], [6.5, 2, 1.5]])
    assert (segment.predict.tolist(), segment.interest.tolist()) == ([0], [0, 1])


def test_what_is_not_valid_is_zero_and_tracks_never_seen_are_left_out(path: Path) -> None:
    scenario = womd_scenario(tracks=4)
    hidden = scenario.tracks[0].states[3]
    hidden.valid, hidden.center_x, hidden.heading, hidden.velocity_x = False, np.nan, np.inf, 1e30
    for state in scenario.tracks[1].states:
        state.valid = False
    scenario.tracks_to_predict.add(track_index=1)
    scenario.tracks_to_predict.add(track_index=2)
    # A size is that of the current step, or else the median.
    for step, length in enumerate([4.0, 9.0, 5.0, 6.0, 90.0]):
        scenario.tracks[0].states[step].length = scenario.tracks[2].states[step].length = length
    scenario.tracks[2].states[1].valid = False
    segment = convert(path, scenario)
    assert np.argwhere(~segment.valid).tolist() == [[0, 3], [1, 1]]
    for field in (segment.position, segment.heading, segment.velocity):
        assert not field[0, 3].any()
    assert segment.size[:2, 0].tolist() == [9.0, 5.5]
    np.testing.assert_array_equal(segment.agent_id, [100, 102, 103])
    assert (segment.ego, segment.predict.tolist(), segment.interest.tolist()) == (2, [0, 1], [0])


def test_road(path: Path) -> None:
    segment = convert(path, womd_scenario())
    road, shift = segment.road, FAR[:2] - segment.origin[:2]
    np.testing.assert_array_equal(road.lane_id, [10, 11, 20, 21])
    np.testing.assert_array_equal(road.successors, [[0, 1], [2, 3]])
    np.testing.assert_array_equal(road.left_neighbors, [[0, 2], [1, 3]])
    np.testing.assert_array_equal(road.right_neighbors, [[2, 0], [3, 1]])
    np.testing.assert_allclose(road.speed_limit, 25 * MPS)
    assert np.isnan(road.lane_width).all()
    np.testing.assert_array_equal(road.lane_type, [LaneType.SURFACE_STREET] * 4)
    np.testing.assert_allclose(road.lanes[1][:, :2] - shift, [[50, 0], [75, 0], [100, 0]], atol=1e-4)
    np.testing.assert_allclose(road.boundary[0][:, :2] - shift, [[0, -2], [100, -2]], atol=1e-4)
    assert road.mark_type.tolist() == [MarkType.ROAD_LINE, MarkType.CROSSWALK, MarkType.STOP_SIGN]
    np.testing.assert_array_equal(np.diff(road.marks.offsets), [3, 5, 1])
    np.testing.assert_array_equal(road.marks[1][0], road.marks[1][-1])


def test_lights(path: Path) -> None:
    scenario = womd_scenario(steps=5)
    extra = scenario.dynamic_map_states[2].lane_states
    extra.add(lane=999, state=4)
    extra.add(lane=21, state=5)
    segment = convert(path, scenario)
    np.testing.assert_array_equal(segment.signal_lane, [1, 3])
    np.testing.assert_array_equal(segment.signal_state, [[4, 4, 4, 6, 6], [0, 0, 5, 0, 0]])
    stop = segment.signal_point[0] + segment.origin
    np.testing.assert_allclose(stop, FAR + np.array([49, 0, 0]), atol=1e-3)
    np.testing.assert_array_equal(segment.signal_point[1], segment.road.lanes[3][0])


def test_lanes_without_points_and_edges_of_one_go_with_all_that_refers_to_them(path: Path) -> None:
    scenario = womd_scenario()
    features = {feature.id: feature for feature in scenario.map_features}
    del features[11].lane.polyline[:]
    del features[30].road_edge.polyline[1:]
    segment = convert(path, scenario)
    road = segment.road
    np.testing.assert_array_equal(road.lane_id, [10, 20, 21])
    links = [each.tolist() for each in (road.successors, road.left_neighbors, road.right_neighbors)]
    assert links == [[[1, 2]], [[0, 1]], [[1, 0]]]
    assert len(road.boundary) == len(segment.signal_lane) == 0


@pytest.mark.parametrize(("change", "field"), [
    (lambda s: s.ClearField("scenario_id"), "scenario_id"),
    (lambda s: s.timestamps_seconds.__setitem__(2, 0.9), "timestamps_seconds"),
    (lambda s: s.timestamps_seconds.__setitem__(2, np.nan), "timestamps_seconds"),
    (lambda s: s.ClearField("tracks"), "tracks"), (lambda s: s.tracks[0].states.pop(), "tracks.states"),
    (lambda s: setattr(s.tracks[1], "object_type", 9), "tracks.object_type"),
    (lambda s: setattr(s, "sdc_track_index", 3), "sdc_track_index"),
    (lambda s: [setattr(x, "valid", False) for x in s.tracks[2].states], "sdc_track_index"),
    (lambda s: setattr(s, "current_time_index", 5), "current_time_index"),
    (lambda s: s.tracks_to_predict.add(track_index=7), "tracks_to_predict"),
    (lambda s: s.dynamic_map_states.pop(), "dynamic_map_states"),
    (lambda s: setattr(s.dynamic_map_states[0].lane_states[0], "state", 260), "dynamic_map_states.state"),
    (lambda s: setattr(s.map_features[0].lane, "type", 4), "map_features.lane.type"),
    # What the schema forbids.
    (lambda s: setattr(s.tracks[1], "id", 100), "agent_id"),
    (lambda s: setattr(s, "scenario_id", "a/b"), "segment_id"),
    (lambda s: setattr(s.map_features[1], "id", 10), "road.lane_id"),
    (lambda s: setattr(s.map_features[0].lane, "speed_limit_mph", -5), "road.speed_limit"),
])  # fmt: skip
def test_what_is_forbidden_is_named(path: Path, change: Change, field: str) -> None:
    scenario = womd_scenario()
    change(scenario)
    write_records(path, [scenario.SerializeToString()])
    error = read_error("womd", path)
    assert (error.file, str(error.field).removeprefix("record 0, ")) == (path, field)
    assert error.segment == (scenario.scenario_id or None)


@pytest.mark.parametrize(("change", "kind"), [
    (lambda s: setattr(s.tracks[0].states[2], "center_x", np.nan), WILD),
    (lambda s: setattr(s.tracks[0].states[2], "center_y", 1e6), WILD),
    (lambda s: setattr(s.tracks[0].states[2], "heading", np.inf), WILD),
    (lambda s: setattr(s.tracks[0].states[1], "length", 0), NO_SIZE),
    (lambda s: setattr(s.map_features[0].lane.polyline[1], "z", np.nan), NO_LINE),
    (lambda s: setattr(s.map_features[4].road_edge.polyline[0], "x", np.inf), NO_LINE),
])  # fmt: skip
def test_single_odd_things_are_left_out(path: Path, change: Change, kind: str) -> None:
    scenario = womd_scenario()
    whole = convert(path, scenario)
    change(scenario)
    found = convert(path, scenario)
    assert list(found.odd) == [kind]
    lines = [len(each.road.lanes) + len(each.road.boundary) for each in (whole, found)]
    assert (lines[0] - lines[1], whole.num_agents - found.num_agents) == (kind == NO_LINE, kind == NO_SIZE)
    if kind == WILD:
        assert np.argwhere(~found.valid).tolist() == [[0, 2]]


@pytest.fixture(scope="module")
def summary(samples: Path) -> dict[str, Any]:
    path = samples.parent / "wosac" / "scenario_637f20cafde22ff8.json"
    if not path.is_file():
        pytest.skip(f"no summary at {path}")
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def real(samples: Path) -> RunSegment:
    return read_one("womd", samples / "womd" / "motion_data_one_scenario.tfrecord")


@pytest.mark.samples
def test_a_real_record(real: RunSegment, summary: dict[str, Any]) -> None:
    tracks, lanes = summary["tracks"], [f for f in summary["map_features"] if f["kind"] == "lane"]
    assert real.position.shape == (83, 91, 3)
    assert (real.segment_id, real.dt, real.current_step, real.ego) == ("637f20cafde22ff8", 0.1, 10, 82)
    np.testing.assert_array_equal(real.agent_id, [track["id"] for track in tracks])
    np.testing.assert_array_equal(real.valid.sum(axis=1), [track["n_valid"] for track in tracks])
    np.testing.assert_array_equal(real.predict, [72, 43, 42])
    logged = np.where(real.valid[..., None], real.position + real.origin, 0).sum(axis=1)
    for k, track in enumerate(tracks):
        sums, now = track["sum_valid"], track["state_at_current"]
        np.testing.assert_allclose(logged[k], [sums[f"center_{axis}"] for axis in "xyz"], atol=91 * 2e-5)
        assert real.heading[k].sum(dtype=float) == pytest.approx(sums["heading"], abs=1e-3)
        velocity = real.velocity[k].sum(axis=0, dtype=float)
        np.testing.assert_allclose(velocity, [sums["velocity_x"], sums["velocity_y"]], atol=1e-3)
        if now["valid"]:
            np.testing.assert_allclose(real.size[k], [now["length"], now["width"], now["height"]], rtol=1e-6)
    np.testing.assert_array_equal(real.road.lane_id, [lane["id"] for lane in lanes])
    np.testing.assert_array_equal(real.road.lane_type, [lane["lane_type_value"] for lane in lanes])
    limits = [lane["speed_limit_mph"] * MPS or np.nan for lane in lanes]
    np.testing.assert_allclose(real.road.speed_limit, limits, rtol=1e-6)
    index = {lane["id"]: k for k, lane in enumerate(lanes)}
    beside = ([[n["feature_id"] for n in lane[f"{side}_neighbors"]] for lane in lanes] for side in ("left", "right"))
    ways = ([lane[f"{way}_lanes"] for lane in lanes] for way in ("exit", "entry"))
    road, nexts = real.road, real.road.successors
    pairs = (nexts, nexts[:, ::-1], road.left_neighbors, road.right_neighbors)
    for found, named in zip(pairs, (*ways, *beside), strict=True):
        links = {(k, index[i]) for k, ids in enumerate(named) for i in ids if i in index}
        assert set(map(tuple, found.tolist())) == links
    edges = [feature for feature in summary["map_features"] if feature["kind"] == "road_edge"]
    for lines, expected in ((real.road.lanes, lanes), (real.road.boundary, edges)):
        np.testing.assert_array_equal(np.diff(lines.offsets), [line["n_points"] for line in expected])
        first = lines.points[lines.offsets[:-1]] + real.origin
        np.testing.assert_allclose(first, [line["first"] for line in expected], atol=2e-5)
    rows = {lane: k for k, lane in enumerate(real.road.lane_id[real.signal_lane].tolist())}
    states = np.zeros((12, 91), np.uint8)
    for step, lights in enumerate(summary["dynamic_map_states"]):
        for light in lights:
            states[rows[light["lane"]], step] = light["state"]
    np.testing.assert_array_equal(real.signal_state, states)
