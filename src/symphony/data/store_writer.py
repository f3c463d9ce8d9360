"""Write stores of run segments."""

from __future__ import annotations

import json
import operator
import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from symphony.data import store_format as layout
from symphony.data.segment import RunSegment, content_hash, validate
from symphony.data.store import GOAL, GROUP, TWICE, SegmentStore
from symphony.data.store_format import MAPS, SEGMENTS, Table
from symphony.errors import DataError
from symphony.files import Lock, naming, write_json


class StoreWriter(AbstractContextManager["StoreWriter"]):
    """Adds segments to a store, one at a time; each is stored once :meth:`append` returns.

    Its folder is created, or must be empty unless an existing store is continued (``append``): then what a writer
    that died left unfinished is cut off. A :class:`DataError` says if the folder holds something else, is damaged, of
    another version, or being written: there is one writer at a time.
    """

    def __init__(self, path: str | Path, *, append: bool = False) -> None:
        self.path = Path(path).absolute()
        fresh = not (self.path / layout.HEADER).exists()
        if fresh and not _is_blank(self.path):
            raise DataError("not empty and not a segment store: refusing to write into it", file=self.path)
        if not fresh and not append:
            raise DataError("already a segment store (append to it, or choose another)", file=self.path)
        self.path.mkdir(parents=True, exist_ok=True)
        self._lock: Lock | None = layout.lock(self.path)
        try:
            if not (self.path / layout.HEADER).exists():
                _create(self.path)
            store = SegmentStore(self.path)
            self._ids = {name: k for k, name in enumerate(store.ids)}
            self._roads = {key: k for k, key in enumerate(store.map_hashes)}
            self._maps = _TableWriter(self.path, MAPS, store._maps)
            self._segments = _TableWriter(self.path, SEGMENTS, store._segments)
        except BaseException:
            self._lock.close()
            raise

    def __len__(self) -> int:
        return self._segments.state[0]

    def has(self, segment_id: str) -> bool:
        """Return whether a segment of that name is in the store."""
        return segment_id in self._ids

    def index_of(self, segment_id: str) -> int:
        """Return the index of a segment that is in the store."""
        return self._ids[segment_id]

    def append(self, segment: RunSegment, *, tags: Mapping[str, Any] | None = None) -> int:
        """Add one segment and return its index; a :class:`DataError` if it breaks the schema or its name is taken.

        Tags are anything JSON can hold, given back by :meth:`SegmentStore.tags`; not under the names ``group`` and
        ``_goal``, where the segment's are kept.
        """
        segment = _plain(validate(segment))
        if wrong := {GROUP, GOAL} & (tags or {}).keys():
            raise DataError(f"{min(wrong)!r} cannot name a tag", segment=segment.segment_id, field="tags")
        # Not a column of its own: older stores and releases have none.
        known = segment.group not in {"", segment.segment_id}
        noted = {**(tags or {}), **({GROUP: segment.group} if known else {})}
        noted |= {} if segment.goal is None else {GOAL: segment.goal}
        values = {c.name: getattr(segment, c.name) for c in SEGMENTS.columns if c.name != "tags"}
        values["tags"] = json.dumps(noted, ensure_ascii=False) if noted else ""
        for name in ("segment_id", "source", "file", "tags"):
            values[name] = np.frombuffer(values[name].encode(), np.uint8)
        scalars = {n: getattr(segment, n) for n in ("ego", "current_step", "dt", "origin")}
        scalars["steps"] = segment.num_steps

        def road() -> dict[str, Any]:
            return {column.name: operator.attrgetter(column.name)(segment.road) for column in MAPS.columns}

        digest, road_digest = (bytes.fromhex(content_hash(each)) for each in (segment, segment.road))
        return self._write(segment.segment_id, values, scalars, digest, road_digest, road)

    def copy(self, store: SegmentStore, index: int) -> int:
        """Add a segment of another store, tags included; many times faster than reading and appending it. Returns its
        index, or raises a :class:`DataError` where one of that name is there already.
        """
        record, values = store.raw(SEGMENTS, index)
        map_record, road = store.raw(MAPS, int(record["map"]))
        digest = map_record["hash"].tobytes()
        # Segments of other stores will share it.
        if digest not in self._roads and content_hash(store.road(int(record["map"]))) != digest.hex():
            raise DataError("a map does not match its hash: the store was damaged", file=store.path)
        scalars = {name: record[name] for name, *_ in SEGMENTS.scalars}
        return self._write(store.ids[index], values, scalars, record["hash"].tobytes(), digest, lambda: road)

    def _write(
        self,
        name: str,
        values: Mapping[str, Any],
        scalars: Mapping[str, Any],
        digest: bytes,
        road_digest: bytes,
        road: Callable[[], dict[str, Any]],
    ) -> int:
        if self._lock is None:
            raise ValueError("the writer is closed")
        if self.has(name):
            file = bytes(values["file"]).decode(errors="replace") or None
            raise DataError(TWICE, file=file, segment=name, field="segment_id")
        if road_digest not in self._roads:
            self._roads[road_digest] = self._maps.append(road(), road_digest, {})
        number = self._segments.append(values, digest, {**scalars, "map": self._roads[road_digest]})
        self._ids[name] = number
        return number

    def write_report(self, report: Mapping[str, Any]) -> None:
        """Replace the conversion report kept with the store; its values are what JSON can hold."""
        write_json(self.path / layout.REPORT, report)

    def close(self) -> None:
        """Flush everything to disk and let the next writer in."""
        if self._lock is not None:
            self._maps.close()
            self._segments.close()
            self._lock.close()
            self._lock = None

    def __exit__(self, *error: object) -> None:
        self.close()


class _TableWriter:
    """Appends rows to the columns of a table, then the record that makes them count.

    Writes go straight to the operating system, in this order, so a process that dies at any moment leaves
    whole records and at most some bytes past the last one, which the next writer cuts off.
    """

    def __init__(self, folder: Path, table: Table, records: NDArray[Any]) -> None:
        self.table = table
        self.state = (len(records), table.ends(records))
        self._index: BinaryIO = table.index_path(folder).open("r+b", buffering=0)
        self._files = {c.name: c.path(folder).open("r+b", buffering=0) for c in table.columns}
        self._trim()

    def append(self, values: Mapping[str, NDArray[Any]], digest: bytes, scalars: Mapping[str, Any]) -> int:
        """Write rows of every column (leading dimensions are flattened) and a record; return its number."""
        record = np.zeros(1, self.table.record)
        counts = np.zeros(len(self.table.axes), np.int64)
        number, end = self.state
        for column in self.table.columns:
            axis, size = self.table.axes[column.axis], column.row.itemsize
            counts[axis] = values[column.name].nbytes // size
            _write_at(self._files[column.name], int(end[axis]) * size, values[column.name])
        record["begin"], record["count"] = end, counts
        record["hash"] = np.frombuffer(digest, np.uint8)
        for name, value in scalars.items():
            record[name] = value
        _write_at(self._index, number * self.table.record.itemsize, record)
        # One assignment: an interrupt must not find the count and the ends apart.
        self.state = (number + 1, end + counts)
        return number

    def _trim(self) -> None:
        """Cut off what lies past the last record."""
        number, end = self.state
        self._index.truncate(number * self.table.record.itemsize)
        for column in self.table.columns:
            self._files[column.name].truncate(int(end[self.table.axes[column.axis]]) * column.row.itemsize)

    def close(self) -> None:
        """Flush everything to disk, columns before the index, and write no more."""
        self._trim()
        for file in (*self._files.values(), self._index):
            with naming(Path(file.name)):
                os.fsync(file.fileno())
            file.close()


def _write_at(file: BinaryIO, offset: int, array: NDArray[Any]) -> None:
    data = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
    with naming(Path(file.name)):
        file.seek(offset)
        while data:
            data = data[file.write(data) :]


def _plain(segment: RunSegment) -> RunSegment:
    """Return Python scalars and text in place of NumPy's, which would enter the content hash."""
    texts = {name: str(getattr(segment, name)) for name in ("segment_id", "source", "file")}
    numbers = {"dt": float(segment.dt), "ego": int(segment.ego), "current_step": int(segment.current_step)}
    return segment.replace(**texts, **numbers)


def _is_blank(path: Path) -> bool:
    """Return whether nothing is there, or only the empty files of a writer that died before it had begun."""
    if not path.is_dir():
        return not path.exists()
    draft = f".{Path(layout.HEADER).stem}."
    return all(
        f.is_dir()
        or f.name == layout.LOCK
        or f.name.startswith(draft)
        or (f.suffix in {".idx", ".bin"} and not f.stat().st_size)
        for f in path.rglob("*")
    )


def _create(path: Path) -> None:
    """Create empty files first and the header last: with a header, a store is whole."""
    (path / layout.COLUMNS).mkdir(exist_ok=True)
    for table in layout.TABLES:
        for file in (table.index_path(path), *(c.path(path) for c in table.columns)):
            file.touch()
    write_json(path / layout.HEADER, layout.header())
