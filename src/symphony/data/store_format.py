"""Layout of the segment store on disk, and the append-only tables it is made of.

A store is a directory::

    store.json      format name, version and column layout
    segments.idx    one fixed-size record per segment; a segment exists once its record is complete
    maps.idx        one fixed-size record per distinct map
    columns/*.bin   raw little-endian arrays, the rows of all segments (or maps) one after the other
    report.json     what the conversion skipped, and why
    store.lock      held by the writer

Columns that have one row per agent, say, share an *axis*; a record holds the first row and the number of rows
on each axis. Nothing is padded.
"""

from __future__ import annotations

import json
import mmap
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from symphony import files
from symphony.data.bounds import MAX_AGENTS, MAX_POINTS, MAX_STEPS
from symphony.errors import DataError
from symphony.files import locating

FORMAT = "symphony segment store"
VERSION = 1
HEADER, LOCK, REPORT, COLUMNS = "store.json", "store.lock", "report.json", "columns"
PARTIAL = ".partial"
"""What a store's name is followed by while a conversion into it is not finished."""


@dataclass(frozen=True)
class Column:
    """One array field: rows along ``axis``, each of shape ``tail`` and little-endian ``dtype``."""

    name: str
    axis: str
    dtype: str
    tail: tuple[int, ...] = ()

    @property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return int(np.dtype(self.dtype).itemsize * np.prod(self.tail, dtype=int))


@dataclass(frozen=True)
class Table:
    """Columns plus an index of fixed-size records.

    Attributes:
        name: stem of the index file.
        columns: the array fields.
        scalars: (name, dtype, shape) of what a record holds besides the extents and the content hash.
    """

    name: str
    columns: tuple[Column, ...]
    scalars: tuple[tuple[str, str, tuple[int, ...]], ...] = ()

    @cached_property
    def axes(self) -> dict[str, int]:
        """Place of each axis in ``begin`` and ``count`` of a record."""
        names = dict.fromkeys(column.axis for column in self.columns)
        return {name: k for k, name in enumerate(names)}

    @cached_property
    def record(self) -> np.dtype[Any]:
        """Layout of one index record."""
        axes = len(self.axes)
        fields = [("begin", "<i8", (axes,)), ("count", "<i8", (axes,)), ("hash", "u1", (32,))]
        return np.dtype([*fields, *self.scalars])

    def index_path(self, folder: Path) -> Path:
        """Where the index lies."""
        return folder / f"{self.name}.idx"

    def column_path(self, folder: Path, column: Column) -> Path:
        """Where a column lies."""
        return folder / COLUMNS / f"{column.name}.bin"

    def layout(self) -> dict[str, Any]:
        """JSON description, compared when a store is opened."""
        return {
            "record_bytes": self.record.itemsize,
            "columns": {c.name: [c.axis, c.dtype, list(c.tail)] for c in self.columns},
        }


SEGMENTS = Table(
    "segments",
    (
        Column("agent_id", "agents", "<i8"),
        Column("agent_type", "agents", "|u1"),
        Column("size", "agents", "<f4", (3,)),
        Column("position", "states", "<f4", (3,)),
        Column("heading", "states", "<f4"),
        Column("velocity", "states", "<f4", (2,)),
        Column("valid", "states", "|b1"),
        Column("signal_lane", "signals", "<i4"),
        Column("signal_point", "signals", "<f4", (3,)),
        Column("signal_state", "signal_states", "|u1"),
        Column("interest", "interest", "<i4"),
        Column("predict", "predict", "<i4"),
        Column("segment_id", "segment_id", "|u1"),
        Column("source", "source", "|u1"),
        Column("file", "file", "|u1"),
        Column("tags", "tags", "|u1"),
    ),
    (
        ("map", "<i8", ()),
        ("steps", "<i8", ()),
        ("ego", "<i8", ()),
        ("current_step", "<i8", ()),
        ("dt", "<f8", ()),
        ("origin", "<f8", (3,)),
    ),
)

MAPS = Table(
    "maps",
    (
        Column("lanes.points", "lanes.points", "<f4", (3,)),
        Column("lanes.offsets", "lanes.offsets", "<i8"),
        Column("lane_id", "lanes", "<i8"),
        Column("lane_type", "lanes", "|u1"),
        Column("speed_limit", "lanes", "<f4"),
        Column("lane_width", "lanes", "<f4"),
        Column("successors", "successors", "<i4", (2,)),
        Column("left_neighbors", "left_neighbors", "<i4", (2,)),
        Column("right_neighbors", "right_neighbors", "<i4", (2,)),
        Column("boundary.points", "boundary.points", "<f4", (3,)),
        Column("boundary.offsets", "boundary.offsets", "<i8"),
        Column("marks.points", "marks.points", "<f4", (3,)),
        Column("marks.offsets", "marks.offsets", "<i8"),
        Column("mark_type", "marks", "|u1"),
    ),
)

TABLES = (SEGMENTS, MAPS)


def header() -> dict[str, Any]:
    """What ``store.json`` holds."""
    return {"format": FORMAT, "version": VERSION, **{table.name: table.layout() for table in TABLES}}


def check_header(folder: Path) -> None:
    """Refuse what is not a store of this version, with a :class:`DataError`."""
    path = folder / HEADER
    if not folder.name:
        raise DataError("not a segment store: it has no name of its own", file=folder)
    if not path.is_file():
        message = "no such directory" if not folder.exists() else "not a directory"
        message = f"not a segment store: it has no {HEADER}" if folder.is_dir() else message
        if folder.with_name(folder.name + PARTIAL).is_dir():
            message += "; there is an unfinished conversion to that name: its command goes on with it"
        raise DataError(message, file=folder)
    found = read_json(path)
    if found.get("format") != FORMAT:
        raise DataError(f"not a segment store: format is {found.get('format')!r}", file=path, field="format")
    if found.get("version") != VERSION:
        message = f"store version {found.get('version')!r}; this release reads version {VERSION}"
        raise DataError(message, file=path, field="version")
    if found != header():
        raise DataError("describes other columns than this version of the format has", file=path)


def read_json(path: Path) -> dict[str, Any]:
    """Parse a JSON object; a :class:`DataError` if it can't be read, or is none."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"cannot be read as JSON: {error}", file=path) from error
    if not isinstance(found, dict):
        raise DataError("cannot be read as JSON: not an object", file=path)
    return found


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Replace a JSON file in one step, so that no reader sees half of it."""
    draft = path.with_name(path.name + ".tmp")
    with locating(path):
        with draft.open("w", encoding="utf-8") as file:
            json.dump(value, file, indent=1, ensure_ascii=False, default=str)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)


def read_indices(folder: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """Records of the segments, and of the maps they lie on, memory-mapped.

    Raises:
        DataError: an index is missing or cut short, or a record contradicts itself or its neighbours.
    """
    segments = _read_index(folder, SEGMENTS, None)
    count, axes = segments["count"], SEGMENTS.axes
    agents, lights, steps = count[:, axes["agents"]], count[:, axes["signals"]], segments["steps"]
    # Limits first: a product of numbers out of range may wrap around to a right one.
    sound = (steps >= 2) & (steps <= MAX_STEPS) & (agents <= MAX_AGENTS) & (lights <= MAX_POINTS)
    sound &= (count[:, axes["states"]] == agents * steps) & (
        count[:, axes["signal_states"]] == lights * steps
    )
    sound &= (segments["ego"] >= 0) & (segments["ego"] < agents) & (segments["map"] >= 0)
    _check_sound(sound, SEGMENTS, folder)
    # Maps no segment points at belong to an append that never finished.
    maps = _read_index(folder, MAPS, limit=int(segments["map"].max(initial=-1)) + 1)
    lines = [maps["count"][:, MAPS.axes[f"{name}.offsets"]] for name in ("lanes", "boundary", "marks")]
    sound = np.all([line >= 1 for line in lines], axis=0)
    for name, line in (("lanes", lines[0]), ("marks", lines[2])):
        sound &= maps["count"][:, MAPS.axes[name]] == line - 1
    _check_sound(sound, MAPS, folder)
    return segments, maps


def _check_sound(sound: NDArray[np.bool_], table: Table, folder: Path) -> None:
    if not sound.all():
        message = f"record {int(np.argmin(sound))} contradicts itself: the file is damaged"
        raise DataError(message, file=table.index_path(folder))


def _read_index(folder: Path, table: Table, limit: int | None) -> NDArray[Any]:
    """The complete records of an index; a torn last record is not one. With a limit there must be as many."""
    path = table.index_path(folder)
    if not path.is_file():
        raise DataError("index file is missing", file=path)
    count = path.stat().st_size // table.record.itemsize
    if limit is not None and count < limit:
        raise DataError(f"index holds {count} records, {limit} are in use", file=path)
    records = _map(path, table.record, (count if limit is None else limit,))
    begin, rows = records["begin"], records["count"]
    chained = np.array_equal(begin[1:], begin[:-1] + rows[:-1]) and not begin[:1].any()
    # Sums that pass the largest integer wrap around, and would follow one another again.
    if not chained or (rows < 0).any() or (begin < 0).any():
        raise DataError("index records do not follow one another: the file is damaged", file=path)
    return records


def read_ids(folder: Path, segments: NDArray[Any]) -> list[str]:
    """Segment ids in the order of the records; a :class:`DataError` names the number of one that is no text."""
    axis = SEGMENTS.axes["segment_id"]
    data = (folder / COLUMNS / "segment_id.bin").read_bytes()
    found = []
    for begin, count in zip(
        segments["begin"][:, axis].tolist(), segments["count"][:, axis].tolist(), strict=True
    ):
        try:
            found.append(decoded(data[begin : begin + count], "segment_id"))
        except DataError as error:
            raise error.at(file=folder, segment=f"number {len(found)}") from error
    return found


def decoded(data: bytes, field: str) -> str:
    """Text of a field; a :class:`DataError` if it is not UTF-8."""
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"damaged: not UTF-8 ({error.reason})", field=field) from error


def rows(table: Table, columns: Mapping[str, NDArray[Any]], record: Any) -> dict[str, Any]:
    """Views of one record's rows of every column."""
    begin, count = record["begin"].tolist(), record["count"].tolist()
    found = {}
    for column in table.columns:
        axis = table.axes[column.axis]
        found[column.name] = columns[column.name][begin[axis] : begin[axis] + count[axis]]
    return found


def ends(records: NDArray[Any], table: Table) -> NDArray[np.int64]:
    """[axes] rows in use on each axis."""
    if len(records) == 0:
        return np.zeros(len(table.axes), np.int64)
    return np.asarray(records[-1]["begin"] + records[-1]["count"], np.int64)


def check_columns(folder: Path, table: Table, records: NDArray[Any]) -> bool:
    """See that every column holds what the index says; a :class:`DataError` locates the first that does not.

    Returns:
        Whether one holds more: a writer is at work or has died, or the index was cut short.
    """
    used, more = ends(records, table), False
    for column in table.columns:
        path = table.column_path(folder, column)
        if not path.is_file():
            raise DataError("column file is missing", file=path, field=column.name)
        size, need = path.stat().st_size, int(used[table.axes[column.axis]]) * column.row_bytes
        if size < need:
            raise DataError(f"column is truncated: {size} of {need} bytes", file=path, field=column.name)
        more |= size > need
    return more


def check_whole(folder: Path, segments: int) -> None:
    """See that the index holds as many segments as the report has counted, else raise a :class:`DataError`."""
    path = folder / REPORT
    counted = read_json(path).get("converted") if path.exists() else None
    if isinstance(counted, int) and counted > segments:
        message = (
            f"index holds {segments} segments, the report of their conversion {counted}: it was cut short"
        )
        raise DataError(message, file=SEGMENTS.index_path(folder))


def _map(path: Path, dtype: Any, shape: tuple[int, ...]) -> NDArray[Any]:
    """A read-only view of the start of a file (an empty file can't be mapped)."""
    if 0 in shape:
        return np.zeros(shape, dtype)
    # Not np.memmap, which asks the disk for every folder on the way to each file, and is slow to slice.
    row = np.dtype((dtype, shape[1:]))
    with path.open("rb") as file:
        mapped = mmap.mmap(file.fileno(), shape[0] * row.itemsize, access=mmap.ACCESS_READ)
    return np.frombuffer(mapped, row)


def map_columns(folder: Path, table: Table, records: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Every column, [rows in use, *tail], memory-mapped."""
    used = ends(records, table)
    return {
        c.name: _map(table.column_path(folder, c), c.dtype, (int(used[table.axes[c.axis]]), *c.tail))
        for c in table.columns
    }


class TableWriter:
    """Appends rows to the columns of a table, then the record that makes them count.

    Writes go straight to the operating system, in this order, so a process that dies at any moment leaves
    whole records and at most some bytes past the last one, which the next writer cuts off.

    Args:
        folder: the store.
        table: what to append to.
        records: the records that count; anything past them is cut off.
    """

    def __init__(self, folder: Path, table: Table, records: NDArray[Any]) -> None:
        self.table = table
        self._state = (len(records), ends(records, table))
        self._index: BinaryIO = table.index_path(folder).open("r+b", buffering=0)
        self._files: dict[str, BinaryIO] = {
            c.name: table.column_path(folder, c).open("r+b", buffering=0) for c in table.columns
        }
        self.trim()

    def append(self, values: Mapping[str, NDArray[Any]], digest: bytes, **scalars: Any) -> int:
        """Write one record and return its number.

        Args:
            values: rows of every column; leading dimensions are flattened.
            digest: SHA-256 of the content.
            scalars: the table's scalars.
        """
        record = np.zeros(1, self.table.record)
        counts = np.full(len(self.table.axes), -1)
        for column in self.table.columns:
            array, axis = values[column.name], self.table.axes[column.axis]
            if array.dtype != np.dtype(column.dtype):
                message = f"dtype {array.dtype}, expected {np.dtype(column.dtype)}"
                raise DataError(message, field=column.name)
            size = array.size // int(np.prod(column.tail, dtype=int))
            if counts[axis] not in {-1, size}:
                raise DataError(f"{size} rows, expected {counts[axis]}", field=column.name)
            counts[axis] = size
        number, end = self._state
        for column in self.table.columns:
            begin = int(end[self.table.axes[column.axis]])
            _write_at(self._files[column.name], begin * column.row_bytes, values[column.name])
        record["begin"], record["count"] = end, counts
        record["hash"] = np.frombuffer(digest, np.uint8)
        for name, value in scalars.items():
            record[name] = value
        _write_at(self._index, number * self.table.record.itemsize, record)
        # One assignment: an interrupt must not find the count and the ends apart.
        self._state = (number + 1, end + counts)
        return number

    @property
    def count(self) -> int:
        """Records so far."""
        return self._state[0]

    def trim(self) -> None:
        """Cut off what lies past the last record."""
        number, end = self._state
        self._index.truncate(number * self.table.record.itemsize)
        for column in self.table.columns:
            self._files[column.name].truncate(int(end[self.table.axes[column.axis]]) * column.row_bytes)

    def sync(self) -> None:
        """Bring everything to the disk, columns before the index."""
        for file in (*self._files.values(), self._index):
            with locating(file.name):
                os.fsync(file.fileno())

    def close(self) -> None:
        """Bring everything to the disk, and write no more."""
        self.trim()
        self.sync()
        for file in (*self._files.values(), self._index):
            file.close()


def lock(folder: Path) -> files.Lock:
    """Keep other writers out of a folder until this is closed; a :class:`DataError` if one is in there."""
    return files.Lock(folder / LOCK)


def _write_at(file: BinaryIO, offset: int, array: NDArray[Any]) -> None:
    data = np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
    with locating(file.name):
        file.seek(offset)
        while data:
            data = data[file.write(data) :]
