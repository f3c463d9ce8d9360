"""Overlaps in logs: found as shapely finds them, counted, told, and left out on request."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers_convert import FakeReader
from helpers_segments import hide, random_segment, straight_road
from symphony.data.convert import convert, info, merge
from symphony.data.overlaps import overlapping
from symphony.data.report import Report
from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import travel
from symphony.data.sources.base import Item
from symphony.data.store import SegmentStore
from symphony.geometry import LEVEL
from test_geometry import polygons


def crowded(seed: int) -> RunSegment:
    """Agents so near to each other that some overlap; absent ones may be where others are."""
    segment = random_segment(seed=seed, agents=7)
    gone = np.random.default_rng(seed).random(segment.valid.shape) < 0.3
    position = segment.position - np.float32(0.95) * segment.position[:, 2:3]
    return segment.replace(position=position, valid=segment.valid & ~gone)


@given(st.integers(0, 200))
def test_agrees_with_shapely(seed: int) -> None:
    segment = crowded(seed)
    drives = (segment.agent_type == AgentType.VEHICLE) & (travel(segment) > 2)
    sure, possible = set(), set()
    for step in range(segment.num_steps):
        there = np.flatnonzero(segment.valid[:, step])
        now = segment.position[:, step, :2], segment.heading[:, step], segment.size[:, :2]
        shapes = polygons(*map(torch.from_numpy, now))
        for i, a in enumerate(there.tolist()):
            for b in there[i + 1 :].tolist():
                bottom = segment.position[[a, b], step, 2] - segment.size[[a, b], 2] / 2
                if (drives[a] or drives[b]) and abs(float(np.diff(bottom)[0])) < LEVEL:
                    # Single precision decides about boxes that touch.
                    possible |= {(a, b)} if shapes[a].distance(shapes[b]) < 1e-4 else set()
                    sure |= {(a, b)} if shapes[a].intersection(shapes[b]).area > 1e-3 else set()
    found = {tuple(pair) for pair in overlapping(segment).tolist()}
    assert sure <= found <= possible


def overlapped(seed: int = 0) -> RunSegment:
    """Two cars of the first lane, of which one stands inside the other's path."""
    segment = straight_road(3, seed=seed, dt=0.1, steps=91, segment_id=f"bad-{seed}")
    position = segment.position.copy()
    position[2] = position[0, 30]
    velocity = segment.velocity.copy()
    velocity[2] = 0
    return segment.replace(position=position, velocity=velocity)


def test_who_counts() -> None:
    segment = overlapped()
    assert (overlapping(segment).tolist(), overlapping(straight_road(4)).tolist()) == ([[0, 2]], [])
    # Not where one of them is not there, and not where neither is a vehicle that moves.
    assert overlapping(hide(segment, 0, slice(15, 45))).tolist() == []
    types = segment.agent_type.copy()
    types[0] = AgentType.PEDESTRIAN
    assert overlapping(segment.replace(agent_type=types)).tolist() == []
    types[0], types[2] = AgentType.VEHICLE, AgentType.PEDESTRIAN
    assert overlapping(segment.replace(agent_type=types)).tolist() == [[0, 2]]


class Mixed(FakeReader):
    """Its crossings are segments with an overlap."""

    def _read(self, path: Path) -> Iterator[Item]:
        for item in super()._read(path):
            yield overlapped(int(item.segment_id[9:])) if item.segment_id.startswith("crossing") else item


def test_a_conversion_counts_and_tells(tmp_path: Path) -> None:
    for k, text in enumerate(("crossing 1\nstraight 2\nstraight 3", "straight 4\ncrossing 5")):
        (tmp_path / f"{k}.scene").write_text(text)
    report = convert(Mixed(), [tmp_path], tmp_path / "all", workers=2)
    assert (report.converted, report.overlaps) == (5, 2)
    assert "of 2 of 5 segments (40.0 %)" in report.warning
    store = SegmentStore(tmp_path / "all")
    tagged = {store.ids[i] for i in range(5) if store.tags(i).get("overlaps")}
    assert (tagged, info(tmp_path / "all")["overlaps"]) == ({"bad-1", "bad-5"}, 2)
    assert Report.from_json(json.loads(json.dumps(report.to_json()))) == report
    (tmp_path / "more.scene").write_text("straight 6\ncrossing 7")
    convert(Mixed(), [tmp_path / "more.scene"], tmp_path / "more", workers=2)
    merge([tmp_path / "all", tmp_path / "more"], tmp_path / "both")
    assert info(tmp_path / "both")["overlaps"] == 3
    without = convert(Mixed(), [tmp_path], tmp_path / "clean", exclude_overlaps=True, workers=2)
    assert (without.converted, without.overlaps, without.warning) == (4, 0, "")
    assert without.exclusions["overlaps"] == 3
    assert without.settings["exclude_overlaps"] is True
    assert ({skip.segment for skip in without.skipped}, without.problems) == ({"bad-1", "bad-5", "bad-7"}, {})
