"""Filling and comparing segment stores."""

from __future__ import annotations

from pathlib import Path

from helpers_segments import random_segment
from symphony.data.segment import RunSegment, content_hash
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter


def fill(path: Path, found: list[RunSegment], *, append: bool = False) -> SegmentStore:
    with StoreWriter(path, append=append) as writer:
        for segment in found:
            writer.append(segment)
    return SegmentStore(path)


def hashes(found: SegmentStore | list[RunSegment]) -> list[str]:
    return [content_hash(segment) for segment in found]


def unlike(count: int, start: int = 0) -> list[RunSegment]:
    """Segments that differ in every size."""
    return [
        random_segment(f"r{k}", seed=k, agents=1 + k % 4, steps=2 + k % 5, lights=k % 3, lanes=1 + k % 3)
        for k in range(start, start + count)
    ]


def files(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("*") if p.suffix in {".idx", ".bin"})
