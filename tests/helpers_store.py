"""Filling and comparing segment stores."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from helpers_segments import beginning, random_segment
from symphony.data.builtin import builtin_store
from symphony.data.segment import RunSegment, content_hash
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter


def fill(path: Path, found: list[RunSegment], *, append: bool = False) -> SegmentStore:
    with StoreWriter(path, append=append) as writer:
        for segment in found:
            writer.append(segment)
    return SegmentStore(path)


def brief(path: Path, rows: Iterable[int], steps: int = 26, split: Any = "test") -> Path:
    """A store of the first steps of built-in run segments, five seconds of each."""
    found = SegmentStore(builtin_store(split))
    return fill(path, [beginning(found[row], steps) for row in rows]).path


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
