"""A real WOMD record, compared with an independent summary of the same file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_sources import read_one
from symphony.data.segment import AgentType, MarkType, RunSegment
from symphony.data.sources import womd_pb2
from symphony.data.sources.tfrecord import read_records

MPS = 0.44704


@pytest.fixture(scope="module")
def sample(samples: Path) -> Path:
    return samples / "womd" / "motion_data_one_scenario.tfrecord"


@pytest.fixture(scope="module")
def summary(samples: Path) -> dict[str, Any]:
    path = samples.parent / "wosac" / "scenario_637f20cafde22ff8.json"
    if not path.is_file():
        pytest.skip(f"no summary at {path}")
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def record(sample: Path) -> womd_pb2.Scenario:
    (payload,) = read_records(sample)
    assert isinstance(payload, bytes)
    return womd_pb2.Scenario.FromString(payload)


@pytest.fixture(scope="module")
def real(sample: Path) -> RunSegment:
    return read_one("womd", sample)


STATE = ("center_x", "center_y", "center_z", "heading", "velocity_x", "velocity_y")


@pytest.mark.samples
def test_record_header(record: womd_pb2.Scenario, summary: dict[str, Any]) -> None:
    for name in ("scenario_id", "current_time_index", "sdc_track_index"):
        assert getattr(record, name) == summary[name]
    np.testing.assert_allclose(record.timestamps_seconds, summary["timestamps_seconds"], atol=1e-9)
    predict = [(p.track_index, p.difficulty) for p in record.tracks_to_predict]
    assert predict == [(p["track_index"], p["difficulty"]) for p in summary["tracks_to_predict"]]
    assert list(record.objects_of_interest) == summary["objects_of_interest"]


@pytest.mark.samples
def test_record_tracks(record: womd_pb2.Scenario, summary: dict[str, Any]) -> None:
    assert len(record.tracks) == len(summary["tracks"]) == 83
    for track, expected in zip(record.tracks, summary["tracks"], strict=True):
        assert (track.id, track.object_type) == (expected["id"], expected["object_type"])
        assert len(track.states) == expected["n_states"]
        valid = [step for step, state in enumerate(track.states) if state.valid]
        assert len(valid) == expected["n_valid"]
        assert (valid[0], valid[-1]) == (expected["first_valid"], expected["last_valid"])
        for name in STATE:
            total = sum(getattr(track.states[step], name) for step in valid)
            assert total == pytest.approx(expected["sum_valid"][name], rel=1e-9, abs=1e-6)
        current = track.states[record.current_time_index]
        for name, value in expected["state_at_current"].items():
            assert getattr(current, name) == pytest.approx(value, abs=1e-9)


@pytest.mark.samples
def test_record_map(record: womd_pb2.Scenario, summary: dict[str, Any]) -> None:
    assert len(record.map_features) == len(summary["map_features"])
    for feature, expected in zip(record.map_features, summary["map_features"], strict=True):
        kind = feature.WhichOneof("feature_data")
        assert (feature.id, kind) == (expected["id"], expected["kind"])
        body = getattr(feature, kind)
        if kind == "stop_sign":
            assert list(body.lane) == expected["lane_ids"]
            assert [body.position.x, body.position.y, body.position.z] == expected["position"]
            continue
        line = body.polyline if kind in {"lane", "road_line", "road_edge"} else body.polygon
        points = np.array([(p.x, p.y, p.z) for p in line])
        assert len(points) == expected["n_points"]
        np.testing.assert_allclose(points[0], expected["first"], rtol=1e-12)
        np.testing.assert_allclose(points[-1], expected["last"], rtol=1e-12)
        np.testing.assert_allclose(points.sum(axis=0), expected["sum_xyz"], rtol=1e-12)
        for name in ("edge", "line", "lane"):
            if f"{name}_type_value" in expected:
                assert body.type == expected[f"{name}_type_value"]
        if kind == "lane":
            check_lane(body, expected)


def check_lane(lane: womd_pb2.LaneCenter, expected: dict[str, Any]) -> None:
    for name in ("speed_limit_mph", "interpolating"):
        assert getattr(lane, name) == pytest.approx(expected[name])
    for name in ("entry_lanes", "exit_lanes"):
        assert list(getattr(lane, name)) == expected[name]
    numbers = (
        "feature_id",
        "self_start_index",
        "self_end_index",
        "neighbor_start_index",
        "neighbor_end_index",
    )
    for side in ("left", "right"):
        near = getattr(lane, f"{side}_neighbors")
        for found, other in zip(near, expected[f"{side}_neighbors"], strict=True):
            assert [getattr(found, name) for name in numbers] == [other[name] for name in numbers]
            check_boundaries(found.boundaries, other["boundaries"])
        check_boundaries(getattr(lane, f"{side}_boundaries"), expected[f"{side}_boundaries"])


def check_boundaries(found: Any, expected: list[dict[str, Any]]) -> None:
    names = ("lane_start_index", "lane_end_index", "boundary_feature_id")
    assert [[getattr(b, n) for n in names] for b in found] == [[b[n] for n in names] for b in expected]
    assert [b.boundary_type for b in found] == [b["boundary_type_value"] for b in expected]


@pytest.mark.samples
def test_record_lights(record: womd_pb2.Scenario, summary: dict[str, Any]) -> None:
    assert sum(len(now.lane_states) for now in record.dynamic_map_states) == summary["n_lane_states_total"]
    for now, expected in zip(record.dynamic_map_states, summary["dynamic_map_states"], strict=True):
        found = [
            {
                "lane": s.lane,
                "state": s.state,
                "stop_point": [s.stop_point.x, s.stop_point.y, s.stop_point.z],
            }
            for s in now.lane_states
        ]
        assert found == expected


@pytest.mark.samples
def test_segment_tracks(real: RunSegment, summary: dict[str, Any]) -> None:
    tracks = summary["tracks"]
    assert real.position.shape == (83, 91, 3)
    assert (real.segment_id, real.dt, real.current_step, real.ego) == ("637f20cafde22ff8", 0.1, 10, 82)
    np.testing.assert_array_equal(real.agent_id, [track["id"] for track in tracks])
    assert np.bincount(real.agent_type).tolist() == [0, 70, 10, 3]
    np.testing.assert_array_equal(real.valid.sum(axis=1), [track["n_valid"] for track in tracks])
    np.testing.assert_array_equal(real.predict, [72, 43, 42])
    assert len(real.interest) == 0
    logged = np.where(real.valid[..., None], real.position + real.origin, 0).sum(axis=1)
    for k, track in enumerate(tracks):
        sums, now = track["sum_valid"], track["state_at_current"]
        np.testing.assert_allclose(logged[k], [sums[f"center_{axis}"] for axis in "xyz"], atol=91 * 2e-5)
        assert real.heading[k].sum(dtype=float) == pytest.approx(sums["heading"], abs=1e-3)
        velocity = real.velocity[k].sum(axis=0, dtype=float)
        np.testing.assert_allclose(velocity, [sums["velocity_x"], sums["velocity_y"]], atol=1e-3)
        if now["valid"]:
            np.testing.assert_allclose(real.size[k], [now["length"], now["width"], now["height"]], rtol=1e-6)


@pytest.mark.samples
def test_segment_map(real: RunSegment, summary: dict[str, Any]) -> None:
    road = real.road
    features = {kind: [] for kind in summary["n_map_features_by_type"]}
    for feature in summary["map_features"]:
        features[feature["kind"]].append(feature)
    lanes = features["lane"]
    assert len(lanes) == 199
    np.testing.assert_array_equal(road.lane_id, [lane["id"] for lane in lanes])
    np.testing.assert_array_equal(road.lane_type, [lane["lane_type_value"] for lane in lanes])
    np.testing.assert_allclose(
        road.speed_limit, [lane["speed_limit_mph"] * MPS or np.nan for lane in lanes], rtol=1e-6
    )
    index = {lane["id"]: k for k, lane in enumerate(lanes)}

    def links(pick: Any) -> set[tuple[int, int]]:
        return {(k, index[i]) for k, lane in enumerate(lanes) for i in pick(lane) if i in index}

    assert set(map(tuple, road.successors.tolist())) == links(lambda lane: lane["exit_lanes"])
    entries = links(lambda lane: lane["entry_lanes"])
    assert {(b, a) for a, b in road.successors.tolist()} == entries
    assert (np.bincount(road.successors[:, 0]) > 1).sum() == 20
    for side, found in (("left", road.left_neighbors), ("right", road.right_neighbors)):
        near = links(lambda lane, side=side: [n["feature_id"] for n in lane[f"{side}_neighbors"]])
        assert set(map(tuple, found.tolist())) == near
    for lines, expected in ((road.lanes, lanes), (road.boundary, features["road_edge"])):
        np.testing.assert_array_equal(np.diff(lines.offsets), [line["n_points"] for line in expected])
        for k, line in enumerate(expected):
            np.testing.assert_allclose(lines[k][0] + real.origin, line["first"], atol=2e-5)
            length = np.hypot(*np.diff(lines[k][:, :2].astype(float), axis=0).T).sum()
            assert length == pytest.approx(line["length_xy"], abs=2e-3)
    kinds = [MarkType.ROAD_LINE, MarkType.CROSSWALK, MarkType.SPEED_BUMP, MarkType.STOP_SIGN]
    assert [int((road.mark_type == kind).sum()) for kind in kinds] == [59, 4, 3, 8]


@pytest.mark.samples
def test_segment_lights(real: RunSegment, summary: dict[str, Any]) -> None:
    rows = {lane: k for k, lane in enumerate(real.road.lane_id[real.signal_lane].tolist())}
    assert len(rows) == 12
    expected = np.zeros((12, 91), np.uint8)
    for step, now in enumerate(summary["dynamic_map_states"]):
        for light in now:
            expected[rows[light["lane"]], step] = light["state"]
            stop = real.signal_point[rows[light["lane"]]] + real.origin
            np.testing.assert_allclose(stop, light["stop_point"], atol=1e-4)
    np.testing.assert_array_equal(real.signal_state, expected)


@pytest.mark.samples
def test_traffic_drives_on_the_left_of_the_boundary(real: RunSegment) -> None:
    import shapely

    edges = [shapely.LineString(real.road.boundary[k][:, :2]) for k in range(len(real.road.boundary))]
    speed = np.hypot(*np.moveaxis(real.velocity, -1, 0))
    fast = real.valid & (speed > 3) & (real.agent_type == AgentType.VEHICLE)[:, None]
    sides = []
    for x, y in real.position[fast][::20, :2].astype(float):
        spot = shapely.Point(x, y)
        edge = min(edges, key=spot.distance)
        if spot.distance(edge) < 8:
            along = edge.project(spot)
            a, b = edge.interpolate(max(along - 0.5, 0)), edge.interpolate(along + 0.5)
            sides.append((b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x) > 0)
    assert len(sides) > 50
    assert np.mean(sides) > 0.97
