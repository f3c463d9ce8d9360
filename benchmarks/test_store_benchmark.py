"""Measure how fast the store writes, opens and reads, and what a segment takes on disk.

``pytest benchmarks/test_store_benchmark.py`` (a map of its own per segment is the worst case: real logs without
shared maps; a shared map is the built-in generator's case).
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from helpers_segments import random_segment
from symphony.data.segment import Polylines, RunSegment
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter

SEGMENTS = 100


def scenario_size(shared_map: bool) -> list[RunSegment]:
    """Return 80 agents over 9 s at 5 Hz on 200 lanes with 12 000 map points: an ordinary WOMD scenario."""
    rng = np.random.default_rng(0)
    base = random_segment("base", agents=80, steps=46, lanes=200, lights=12, marks=4)

    def lines(count: int, points: int) -> Polylines:
        return Polylines.of(list(rng.normal(0, 50, (count, points, 3)).astype(np.float32)))

    road = dataclasses.replace(
        base.road,
        lanes=lines(200, 40),
        boundary=lines(40, 50),
        marks=lines(50, 40),
        mark_type=np.ones(50, np.uint8),
    )
    found = []
    for k in range(SEGMENTS):
        position = base.position + np.float32(k)
        own = dataclasses.replace(road, lane_id=road.lane_id if shared_map else road.lane_id + k)
        found.append(base.replace(segment_id=f"s{k}", position=position, road=own))
    return found


def write(path: Path, segments: list[RunSegment]) -> None:
    with StoreWriter(path) as writer:
        for segment in segments:
            writer.append(segment)


@pytest.fixture(scope="module", params=[False, True], ids=["own maps", "shared map"])
def filled(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    segments = scenario_size(request.param)
    path = tmp_path_factory.mktemp("store") / "store"
    write(path, segments)
    return path, segments


def test_write(benchmark: Any, filled: Any, tmp_path: Path) -> None:
    _, segments = filled
    names = (tmp_path / str(k) for k in itertools.count())
    benchmark.pedantic(write, setup=lambda: ((next(names), segments), {}), rounds=5)
    size = SegmentStore(next(tmp_path.iterdir())).summary()["bytes"]
    benchmark.extra_info["segments_per_s"] = round(SEGMENTS / benchmark.stats["median"])
    benchmark.extra_info["bytes_per_segment"] = size // SEGMENTS


def test_random_access(benchmark: Any, filled: Any) -> None:
    """Read a segment's views, without touching its data."""
    store = SegmentStore(filled[0])
    order = np.random.default_rng(0).permutation(SEGMENTS).tolist()
    benchmark(lambda: [store[i] for i in order])
    benchmark.extra_info["segments_per_s"] = round(SEGMENTS / benchmark.stats["median"])


def test_read_everything(benchmark: Any, filled: Any) -> None:
    """Copy out every byte of agents and map (from the page cache)."""
    store = SegmentStore(filled[0])

    def copy() -> float:
        total = 0.0
        for segment in store:
            total += float(segment.position.sum() + segment.velocity.sum() + segment.heading.sum())
            total += float(segment.road.lanes.points.sum() + segment.road.boundary.points.sum())
        return total

    benchmark(copy)
    benchmark.extra_info["segments_per_s"] = round(SEGMENTS / benchmark.stats["median"])


def test_open(benchmark: Any, filled: Any) -> None:
    benchmark(SegmentStore, filled[0])


def test_checksum(benchmark: Any, filled: Any) -> None:
    benchmark(lambda: SegmentStore(filled[0]).checksum())
