"""Filling and comparing segment stores."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_segments import beginning, random_segment
from symphony.data.builtin import builtin_store
from symphony.data.segment import RunSegment, content_hash
from symphony.data.store import SegmentStore
from symphony.data.store_format import SEGMENTS
from symphony.data.store_writer import StoreWriter


def fill(path: Path, found: list[RunSegment], *, append: bool = False) -> SegmentStore:
    with StoreWriter(path, append=append) as writer:
        for segment in found:
            writer.append(segment)
    return SegmentStore(path)


def stored(make: Callable[[], list[RunSegment]], name="store", scope: Any = "module", opened=False) -> Any:
    """A fixture: the path of a store of some segments, or the store itself; by default made once for a module."""

    @pytest.fixture(scope=scope)
    def store(tmp_path_factory: pytest.TempPathFactory) -> Path | SegmentStore:
        found = fill(tmp_path_factory.mktemp("data") / name, make())
        return found if opened else found.path

    return store


def brief(path: Path, rows: Iterable[int], steps: int = 26, split: Any = "test") -> Path:
    """A store of the first steps of built-in run segments, five seconds of each."""
    found = SegmentStore(builtin_store(split))
    return fill(path, [beginning(found[row], steps) for row in rows]).path


def hashes(found: SegmentStore | list[RunSegment]) -> list[str]:
    return [content_hash(segment) for segment in found]


def rehash(path: Path) -> None:
    """Give what is in a store the hashes it has now, as who wants to deceive would."""
    store, index = SegmentStore(path), SEGMENTS.index_path(path)
    records = np.fromfile(index, SEGMENTS.record, len(store))
    for k in range(len(store)):
        records[k]["hash"] = np.frombuffer(bytes.fromhex(content_hash(store._read(k))), np.uint8)
    index.write_bytes(records.tobytes())


def unlike(count: int, start: int = 0) -> list[RunSegment]:
    """Segments that differ in every size."""
    return [
        random_segment(f"r{k}", seed=k, agents=1 + k % 4, steps=2 + k % 5, lights=k % 3, lanes=1 + k % 3)
        for k in range(start, start + count)
    ]


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a folder by their names in it."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def files(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("*") if p.suffix in {".idx", ".bin"})
