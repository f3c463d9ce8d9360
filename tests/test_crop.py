"""Cropping: what is near stays as it is, what is far goes, and nothing points at what is gone."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers_scenarionet import scenario, track, write
from helpers_segments import crossing, straight_road
from helpers_sources import off_road
from symphony.data.convert import convert
from symphony.data.segment import Polylines, content_hash, validate
from symphony.data.selection import road_points
from symphony.data.store import SegmentStore
from symphony.data.subset import crop
from symphony.errors import ConfigError


def test_all_of_a_small_segment_stays() -> None:
    for segment in (crossing(), straight_road(5)):
        assert content_hash(crop(segment, 5000)) == content_hash(segment)


@given(st.floats(5, 400), st.integers(0, 20))
def test_what_stays_is_what_it_was(radius: float, seed: int) -> None:
    segment = crossing(seed=seed)
    found = validate(crop(segment, radius))
    rows = np.flatnonzero(np.isin(segment.agent_id, found.agent_id))
    for name in ("agent_id", "agent_type", "size", "position", "heading", "velocity", "valid"):
        np.testing.assert_array_equal(getattr(found, name), getattr(segment, name)[rows])
    assert found.agent_id[found.ego] == segment.agent_id[segment.ego]
    path = segment.position[segment.ego, segment.valid[segment.ego], :2]
    for a in range(segment.num_agents):
        spots = segment.position[a, segment.valid[a], :2]
        away = np.hypot(*(spots[:, None] - path).transpose(2, 0, 1)).min() if len(spots) else np.inf
        # The path has corners, its ends are round: both to the same millimetre.
        if a in rows:
            assert away < radius + 1
        else:
            assert away > radius - 1
    for old, new, name in ((segment.road, found.road, n) for n in ("successors", "left_neighbors")):
        kept = {
            (a, b) for a, b in old.lane_id[getattr(old, name)].tolist() if {a, b} <= set(new.lane_id.tolist())
        }
        assert {(a, b) for a, b in new.lane_id[getattr(new, name)].tolist()} == kept
    light = dict(zip(segment.road.lane_id[segment.signal_lane], segment.signal_state.tolist(), strict=True))
    for lane, states in zip(found.road.lane_id[found.signal_lane], found.signal_state.tolist(), strict=True):
        assert light[lane] == states


def test_the_boundary_near_the_ego_is_as_it_was() -> None:
    segment = crossing()
    lines = [segment.road.boundary[k] for k in range(len(segment.road.boundary))]
    far = [np.float32([(400 + 2 * k, 300, 0) for k in range(50)])]
    whole = dataclasses.replace(segment.road, boundary=Polylines.of([*lines[:2], *far, *lines[2:], *far]))
    found = crop(segment.replace(road=whole), 30)
    assert len(found.road.boundary) == len(lines)
    assert road_points(found) < road_points(segment.replace(road=whole))
    path = segment.position[segment.ego, :, :2]
    spots = np.concatenate([path + shift for shift in ((0, 0), (3, 0), (-3, 0), (0, 6), (0, -6))])
    np.testing.assert_allclose(off_road(found.road, spots), off_road(segment.road, spots), atol=1e-4)


def test_a_conversion_crops(tmp_path: Path) -> None:
    tree = scenario()
    tree["tracks"]["far"] = track(0, 30, 5)
    file = write(tmp_path, tree)
    convert("scenarionet", [file], tmp_path / "all", interactive=1)
    report = convert("scenarionet", [file], tmp_path / "near", interactive=1, radius=9)
    assert report.settings["radius"] == 9
    whole, near = SegmentStore(tmp_path / "all")[0], SegmentStore(tmp_path / "near")[0]
    # The ego drives 24 m along the first lane: the last one, from 60 m on, is gone.
    assert (len(whole.road.lanes), len(near.road.lanes)) == (4, 2)
    assert (near.num_agents, whole.num_agents) == (4, 5)
    with pytest.raises(ConfigError, match="radius must be between"):
        convert("scenarionet", [file], tmp_path / "no", radius=0)
