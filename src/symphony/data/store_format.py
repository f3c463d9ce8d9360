"""Layout of the segment store on disk.

A store is a directory::

    store.json      format name, version and column layout
    segments.idx    one fixed-size record per segment; a segment exists once its record is complete
    maps.idx        one fixed-size record per distinct map
    columns/*.bin   raw little-endian arrays, the rows of all segments (or maps) one after the other
    report.json     what the conversion skipped, and why
    store.lock      held by the writer

Columns with one row per agent, say, share an *axis*; records hold first row and number of each. Nothing is padded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.errors import DataError
from symphony.files import Lock, read_object

FORMAT = "symphony segment store"
VERSION = 1
HEADER, LOCK, REPORT, COLUMNS = "store.json", "store.lock", "report.json", "columns"
PARTIAL = ".partial"  # what a store's name is followed by while a conversion into it is not finished


class Column(NamedTuple):
    """One array field: rows along ``axis``, each of shape ``tail`` and little-endian ``dtype``."""

    name: str
    axis: str
    dtype: str
    tail: tuple[int, ...] = ()

    @property
    def row(self) -> np.dtype[Any]:
        """Type of one row."""
        return np.dtype((self.dtype, self.tail))

    def path(self, folder: Path) -> Path:
        """Return where it lies in a store."""
        return folder / COLUMNS / f"{self.name}.bin"


@dataclass(frozen=True)
class Table:
    """Columns, and an index of fixed-size records: extents, content hash and scalars (name, dtype, shape)."""

    name: str
    columns: tuple[Column, ...]
    scalars: tuple[tuple[str, str, tuple[int, ...]], ...] = ()

    @cached_property
    def axes(self) -> dict[str, int]:
        """Place of each axis in ``begin`` and ``count`` of a record."""
        return {name: k for k, name in enumerate(dict.fromkeys(column.axis for column in self.columns))}

    @cached_property
    def record(self) -> np.dtype[Any]:
        """Layout of one index record."""
        axes = (len(self.axes),)
        extents = ("begin", "<i8", axes), ("count", "<i8", axes)
        return np.dtype([*extents, ("hash", "u1", (32,)), *self.scalars])

    def index_path(self, folder: Path) -> Path:
        """Return where the index lies."""
        return folder / f"{self.name}.idx"

    def ends(self, records: NDArray[Any]) -> NDArray[np.int64]:
        """Return [axes] the rows in use on each axis."""
        if len(records) == 0:
            return np.zeros(len(self.axes), np.int64)
        return np.asarray(records[-1]["begin"] + records[-1]["count"], np.int64)


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
        *(Column(name, name, "|u1") for name in ("segment_id", "source", "file", "tags")),
    ),
    (*((n, "<i8", ()) for n in ("map", "steps", "ego", "current_step")), ("dt", "<f8", ()), ("origin", "<f8", (3,))),
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
        *(Column(name, name, "<i4", (2,)) for name in ("successors", "left_neighbors", "right_neighbors")),
        Column("boundary.points", "boundary.points", "<f4", (3,)),
        Column("boundary.offsets", "boundary.offsets", "<i8"),
        Column("marks.points", "marks.points", "<f4", (3,)),
        Column("marks.offsets", "marks.offsets", "<i8"),
        Column("mark_type", "marks", "|u1"),
    ),
)
TABLES = (SEGMENTS, MAPS)


def header() -> dict[str, Any]:
    """Return what ``store.json`` holds."""
    layout = {
        table.name: {
            "record_bytes": table.record.itemsize,
            "columns": {c.name: [c.axis, c.dtype, list(c.tail)] for c in table.columns},
        }
        for table in TABLES
    }
    return {"format": FORMAT, "version": VERSION, **layout}


def check_header(folder: Path) -> None:
    """Refuse what is not a store of this version, with a :class:`DataError`."""
    path = folder / HEADER
    if not path.is_file():
        message = f"not a segment store: it has no {HEADER}" if folder.exists() else "no such directory"
        if folder.name and folder.with_name(folder.name + PARTIAL).is_dir():
            message += "; there is an unfinished conversion to that name: its command continues it"
        raise DataError(message, file=folder)
    found = read_object(path)
    if found != header():
        kind = f"{found.get('format')!r} of version {found.get('version')!r}"
        message = f"is {kind}; this release reads a {FORMAT} of version {VERSION}"
        raise DataError(f"{message}, with its own columns", file=path)


def lock(folder: Path) -> Lock:
    """Keep other writers out of a folder until this is closed; a :class:`DataError` if there is one."""
    return Lock(folder / LOCK)
