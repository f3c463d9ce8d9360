from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_sources import FAR, read_error, read_one, womd_scenario
from symphony.data.odd import NO_LINE, NO_SIZE, WILD
from symphony.data.segment import AgentType, LaneType, MarkType, RunSegment
from symphony.data.sources import get_reader, readers, womd_pb2
from symphony.data.sources.tfrecord import write_records
from symphony.errors import ConfigError, DataError

MPS = 0.44704


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "made.tfrecord-00000-of-00001"


def convert(path: Path, scenario: womd_pb2.Scenario) -> RunSegment:
    write_records(path, [scenario.SerializeToString()])
    return read_one("womd", path)


def refuse(path: Path, scenario: womd_pb2.Scenario) -> DataError:
    write_records(path, [scenario.SerializeToString()])
    return read_error("womd", path)


def test_readers_are_found_by_name() -> None:
    assert readers() == ("argoverse2", "commonroad", "interaction", "scenarionet", "womd")
    for name in readers():
        if name != "argoverse2" or importlib.util.find_spec("pyarrow"):
            assert get_reader(name).name == name
    with pytest.raises(ConfigError, match="did you mean 'womd'"):
        get_reader("wmod")
    with pytest.raises(ConfigError, match="known: argoverse2, commonroad, interaction, scenarionet, womd"):
        get_reader("?")
    with pytest.raises(ConfigError, match="'egoes'"):
        get_reader("commonroad", egoes="all")


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
    np.testing.assert_array_equal(segment.predict, [0])
    np.testing.assert_array_equal(segment.interest, [0, 1])


def test_invalid_states_are_zero_whatever_they_hold(path: Path) -> None:
    scenario = womd_scenario()
    hidden = scenario.tracks[0].states[3]
    hidden.valid, hidden.center_x, hidden.heading, hidden.velocity_x = False, np.nan, np.inf, 1e30
    segment = convert(path, scenario)
    np.testing.assert_array_equal(segment.valid[0], [True, True, True, False, True])
    assert not segment.position[0, 3].any()
    assert segment.heading[0, 3] == 0
    assert not segment.velocity[0, 3].any()


def test_sizes_come_from_the_current_step_or_else_the_median(path: Path) -> None:
    scenario = womd_scenario(tracks=3, steps=5)
    for step, length in enumerate([4.0, 9.0, 5.0, 6.0, 90.0]):
        for track in scenario.tracks[:2]:
            track.states[step].length = length
    scenario.tracks[1].states[1].valid = False
    segment = convert(path, scenario)
    assert segment.size[0, 0] == 9.0
    assert segment.size[1, 0] == 5.5


def test_tracks_never_seen_are_left_out_and_indices_follow(path: Path) -> None:
    scenario = womd_scenario(tracks=4)
    for state in scenario.tracks[1].states:
        state.valid = False
    scenario.tracks_to_predict.add(track_index=1)
    scenario.tracks_to_predict.add(track_index=2)
    segment = convert(path, scenario)
    np.testing.assert_array_equal(segment.agent_id, [100, 102, 103])
    assert segment.ego == 2
    np.testing.assert_array_equal(segment.predict, [0, 1])
    np.testing.assert_array_equal(segment.interest, [0])


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
    np.testing.assert_array_equal(
        road.mark_type, [MarkType.ROAD_LINE, MarkType.CROSSWALK, MarkType.STOP_SIGN]
    )
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
    np.testing.assert_allclose(
        segment.signal_point[0] + segment.origin, [FAR[0] + 49, FAR[1], FAR[2]], atol=1e-3
    )
    np.testing.assert_array_equal(segment.signal_point[1], segment.road.lanes[3][0])


def test_lanes_without_points_and_edges_of_one_go_with_all_that_refers_to_them(path: Path) -> None:
    scenario = womd_scenario()
    lane = next(feature for feature in scenario.map_features if feature.id == 11)
    del lane.lane.polyline[:]
    edge = next(feature for feature in scenario.map_features if feature.id == 30)
    del edge.road_edge.polyline[1:]
    segment = convert(path, scenario)
    np.testing.assert_array_equal(segment.road.lane_id, [10, 20, 21])
    np.testing.assert_array_equal(segment.road.successors, [[1, 2]])
    np.testing.assert_array_equal(segment.road.left_neighbors, [[0, 1]])
    np.testing.assert_array_equal(segment.road.right_neighbors, [[1, 0]])
    assert len(segment.road.boundary) == 0
    assert len(segment.signal_lane) == 0


@pytest.mark.parametrize("rate", [10, 15, 30, 60])
def test_the_time_step_is_that_of_the_whole_log(path: Path, rate: int) -> None:
    """Rounded to milliseconds, steps of 1/30 s would take a hundredth off the time."""
    scenario = womd_scenario(steps=91)
    jitter = np.random.default_rng(0).uniform(-2e-5, 2e-5, 91)
    scenario.timestamps_seconds[:] = (np.arange(91) / rate + jitter).tolist()
    write_records(path, [scenario.SerializeToString()])
    dt = read_one("womd", path).dt
    assert dt == (0.1 if rate == 10 else pytest.approx(1 / rate, rel=1e-4))


@pytest.mark.parametrize(
    ("change", "field", "message"),
    [
        (lambda s: s.ClearField("scenario_id"), "scenario_id", "missing"),
        (lambda s: s.ClearField("timestamps_seconds"), "timestamps_seconds", "at least 2"),
        (lambda s: s.timestamps_seconds.__setitem__(2, 0.9), "timestamps_seconds", "uneven"),
        (lambda s: s.timestamps_seconds.__setitem__(2, np.nan), "timestamps_seconds", "finite"),
        (lambda s: s.ClearField("tracks"), "tracks", "no agents"),
        (lambda s: s.tracks[0].states.pop(), "tracks.states", "track 100 has 4 states for 5 steps"),
        (lambda s: setattr(s.tracks[1], "object_type", 9), "tracks.object_type", "unknown value 9"),
        (lambda s: setattr(s, "sdc_track_index", 3), "sdc_track_index", "outside the 3"),
        (lambda s: setattr(s, "sdc_track_index", -1), "sdc_track_index", "outside the 3"),
        (lambda s: [setattr(x, "valid", False) for x in s.tracks[2].states], "sdc_track_index", "no step"),
        (lambda s: setattr(s, "current_time_index", 5), "current_time_index", "outside the 5"),
        (lambda s: s.tracks_to_predict.add(track_index=7), "tracks_to_predict", "outside the 3"),
        (lambda s: s.dynamic_map_states.pop(), "dynamic_map_states", "4 entries for 5 steps"),
        (
            lambda s: setattr(s.dynamic_map_states[0].lane_states[0], "state", 260),
            "dynamic_map_states.state",
            "unknown value 260",
        ),
        (lambda s: setattr(s.map_features[0].lane, "type", 4), "map_features.lane.type", "unknown value 4"),
    ],
)
def test_what_the_format_forbids_is_named(path: Path, change: Any, field: str, message: str) -> None:
    scenario = womd_scenario()
    name = scenario.scenario_id
    change(scenario)
    error = refuse(path, scenario)
    assert error.file == path
    assert error.segment == (None if field == "scenario_id" else name)
    assert error.field == f"record 0, {field}"
    assert message in error.message


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda s: setattr(s.tracks[2].states[0], "center_x", np.nan), "position"),
        (lambda s: setattr(s.tracks[1], "id", 100), "agent_id"),
        (lambda s: setattr(s, "scenario_id", "a/b"), "segment_id"),
        (lambda s: s.ClearField("map_features"), "road.lanes"),
        (lambda s: setattr(s.map_features[1], "id", 10), "road.lane_id"),
        (lambda s: setattr(s.map_features[0].lane, "speed_limit_mph", -5), "road.speed_limit"),
    ],
)
def test_what_the_schema_forbids_is_named(path: Path, change: Any, field: str) -> None:
    scenario = womd_scenario()
    change(scenario)
    error = refuse(path, scenario)
    assert (error.file, error.segment, error.field) == (path, scenario.scenario_id, field)


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda s: setattr(s.tracks[0].states[2], "center_x", np.nan), WILD),
        (lambda s: setattr(s.tracks[0].states[2], "center_y", 1e300), WILD),
        (lambda s: setattr(s.tracks[0].states[2], "center_y", 1e6), WILD),
        (lambda s: setattr(s.tracks[0].states[2], "heading", np.inf), WILD),
        (lambda s: setattr(s.tracks[0].states[2], "velocity_y", np.nan), WILD),
        (lambda s: setattr(s.tracks[0].states[1], "length", 0), NO_SIZE),
        (lambda s: setattr(s.tracks[0].states[1], "width", np.nan), NO_SIZE),
        (lambda s: setattr(s.map_features[0].lane.polyline[1], "z", np.nan), NO_LINE),
        (lambda s: setattr(s.map_features[4].road_edge.polyline[0], "x", np.inf), NO_LINE),
    ],
)
def test_single_odd_things_are_left_out(path: Path, change: Any, kind: str) -> None:
    scenario = womd_scenario()
    write_records(path, [scenario.SerializeToString()])
    whole = read_one("womd", path)
    change(scenario)
    write_records(path, [scenario.SerializeToString()])
    found = read_one("womd", path)
    assert list(found.odd) == [kind]
    lines = [len(lines) for lines in (whole.road.lanes, whole.road.boundary)]
    left = [len(lines) for lines in (found.road.lanes, found.road.boundary)]
    assert sum(lines) - sum(left) == (kind == NO_LINE)
    assert whole.num_agents - found.num_agents == (kind == NO_SIZE)
    if kind == WILD:
        assert whole.valid.sum() - found.valid.sum() == 1
        assert not found.valid[0, 2]


def test_a_name_that_is_no_text_is_refused(path: Path) -> None:
    payload = womd_scenario("abcdefgh").SerializeToString().replace(b"abcdefgh", b"abc\xb3efgh")
    write_records(path, [payload])
    error = read_error("womd", path)
    assert error.segment is None
    assert error.field is not None
    assert error.field.startswith("record 0")
