"""A real WOMD record, compared with an independent summary of the same file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_sources import read_one
from symphony.data.segment import MarkType, RunSegment

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
def real(sample: Path) -> RunSegment:
    return read_one("womd", sample)


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
