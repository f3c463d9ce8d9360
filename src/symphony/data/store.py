"""Many run segments in one directory: memory-mapped, without padding, append-only (see ``store_format``)."""

from __future__ import annotations

import hashlib
import json
import mmap
import operator
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, SupportsIndex, cast, overload

import numpy as np
from numpy.typing import NDArray

from symphony.data import segment as schema
from symphony.data.segment import Polylines, RoadMap, RunSegment, content_hash, validate
from symphony.data.store_format import MAPS, REPORT, SEGMENTS, Table, check_header
from symphony.errors import DataError
from symphony.files import read_object

TWICE = "a segment of this name is in the store already"
GROUP, GOAL, NETWORK = "group", "_goal", "network"
"""Tags under which a segment's group (also by the generator before there were groups) and its goal are kept."""


class SegmentStore(Sequence[RunSegment]):
    """Read access to a store: ``store[i]`` reads that segment only, as read-only views of the mapped files.

    Holds what was complete when it was opened. Pickles as its path, so each process maps the files itself. The first
    time a process reads a segment, its content and its map's are compared with the hash that was written with it,
    and checked against the schema. A :class:`DataError` says if it is not a store, of another version, or a file is
    missing, truncated or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).absolute()
        check_header(self.path)
        self._segments, self._maps = _read_indices(self.path)
        self._columns: dict[str, NDArray[Any]] = {}
        more = self._map_columns(SEGMENTS, self._segments)
        if self._map_columns(MAPS, self._maps) or more:
            counted = self.report.get("converted")
            if isinstance(counted, int) and counted > len(self):
                held = f"index holds {len(self)} segments, the report of their conversion {counted}"
                raise DataError(f"{held}: cut short", file=SEGMENTS.index_path(self.path))
        self._unseen = np.ones(len(self), np.bool_)

    def _map_columns(self, table: Table, records: NDArray[Any]) -> bool:
        """Map what each column must hold. Return if one has more: a writer works or died, or the index is cut."""
        used, more = table.ends(records), False
        for column in table.columns:
            path, rows = column.path(self.path), int(used[table.axes[column.axis]])
            need = rows * column.row.itemsize
            size = path.stat().st_size if path.is_file() else -1
            if size < need:
                raise DataError(f"column is truncated: {size} of {need} bytes", file=path, field=column.name)
            self._columns[column.name] = _mapped(path, column.row, rows)
            more |= size > need
        return more

    def __reduce__(self) -> tuple[Any, ...]:
        return SegmentStore, (str(self.path),)

    def __len__(self) -> int:
        return len(self._segments)

    def filled(self) -> SegmentStore:
        """Return the store itself; a :class:`DataError` if it holds no run segments."""
        if not len(self):
            raise DataError("the store holds no run segments", file=self.path)
        return self

    @overload
    def __getitem__(self, index: SupportsIndex) -> RunSegment: ...
    @overload
    def __getitem__(self, index: slice) -> list[RunSegment]: ...
    def __getitem__(self, index: SupportsIndex | slice) -> RunSegment | list[RunSegment]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        row = self._row(index)
        segment = self._read(row)
        if self._unseen[row]:
            self._check(row, segment)
            self._unseen[row] = False
        return segment

    def _read(self, row: int) -> RunSegment:
        record, parts = self.raw(SEGMENTS, row)
        agents, steps, lights = len(parts["agent_id"]), int(record["steps"]), len(parts["signal_lane"])
        for name in ("segment_id", "source", "file"):
            parts[name] = self._text(parts[name], row, name)
        tags = self._parsed(row, parts.pop("tags"))
        parts["group"] = _group(tags, parts["segment_id"])
        parts["goal"] = tags.get(GOAL)
        for name in ("position", "heading", "velocity", "valid"):
            parts[name] = parts[name].reshape(agents, steps, *parts[name].shape[1:])
        parts["signal_state"] = parts["signal_state"].reshape(lights, steps)
        return RunSegment(
            **parts,
            road=self.road(int(record["map"])),
            dt=float(record["dt"]),
            ego=int(record["ego"]),
            current_step=int(record["current_step"]),
            origin=record["origin"].copy(),
        )

    def _check(self, row: int, segment: RunSegment) -> None:
        try:
            if content_hash(segment) != self.content(row):
                raise DataError("content does not match its hash: the store was damaged")
            validate(segment)
        except DataError as error:  # which names the log it was read from
            name = segment.segment_id
            raise DataError(error.message, file=self.path, segment=name, field=error.field) from error

    def __iter__(self) -> Iterator[RunSegment]:
        return (self[i] for i in range(len(self)))

    def _row(self, index: SupportsIndex) -> int:
        i = operator.index(index)
        if not -len(self) <= i < len(self):
            raise IndexError(f"segment {i} of {len(self)}")
        return i % len(self)

    def raw(self, table: Table, number: int) -> tuple[Any, dict[str, Any]]:
        """Return the index record of a segment or map, and views of its rows of every column."""
        record = (self._segments if table is SEGMENTS else self._maps)[number]
        begin, count = record["begin"].tolist(), record["count"].tolist()
        rows = {}
        for column in table.columns:
            axis = table.axes[column.axis]
            rows[column.name] = self._columns[column.name][begin[axis] : begin[axis] + count[axis]]
        return record, rows

    def road(self, number: int) -> RoadMap:
        """Return one of the distinct maps (see :attr:`map_index`)."""
        if not 0 <= number < len(self._maps):
            raise IndexError(f"map {number} of {len(self._maps)}")
        _, parts = self.raw(MAPS, number)
        for name in ("lanes", "boundary", "marks"):
            parts[name] = Polylines(parts.pop(f"{name}.points"), parts.pop(f"{name}.offsets"))
        return RoadMap(**parts)

    def content(self, index: SupportsIndex) -> str:
        """Return the hash of a segment's content, its map included, as it was written."""
        return cast(str, self._segments["hash"][self._row(index)].tobytes().hex())

    @property
    def map_hashes(self) -> list[bytes]:
        """Hash of the content of each distinct map."""
        return [key.tobytes() for key in self._maps["hash"]]

    @property
    def map_index(self) -> NDArray[np.int64]:
        """The distinct map that each segment lies on [segments]."""
        return self._segments["map"]

    @property
    def num_steps(self) -> NDArray[np.int64]:
        """The number of logged steps of each segment [segments], the first included."""
        return self._segments["steps"].astype(np.int64)

    @property
    def num_agents(self) -> NDArray[np.int64]:
        """The number of agents of each segment [segments], whoever is there at some step."""
        return self._segments["count"][:, SEGMENTS.axes["agents"]].astype(np.int64)

    @property
    def time_steps(self) -> NDArray[np.float64]:
        """The seconds per step of each segment [segments]."""
        return self._segments["dt"].astype(np.float64)

    @cached_property
    def ids(self) -> list[str]:
        """Segment ids in order of insertion."""
        return self._texts("segment_id")

    @cached_property
    def sources(self) -> NDArray[np.str_]:
        """The :attr:`RunSegment.source` of each segment [segments]."""
        return np.array(self._texts("source"), np.str_)

    @cached_property
    def groups(self) -> NDArray[np.str_]:
        """The recording [segments] that each segment is part of: :attr:`RunSegment.group`. It is the segment's id
        where the store does not know; the simulated network for stores of earlier releases.
        """
        tags = (self._parsed(i, text) for i, text in enumerate(self._texts("tags")))
        return np.array([_group(*each) for each in zip(tags, self.ids, strict=True)], np.str_)

    def _texts(self, column: str) -> list[str]:
        axis, data = SEGMENTS.axes[column], self._columns[column].tobytes()
        ends = [0, *np.cumsum(self._segments["count"][:, axis]).tolist()]
        return [self._text(data[a:b], row, column) for row, (a, b) in enumerate(pairwise(ends))]

    def _text(self, data: Any, row: int, field: str) -> str:
        try:
            return bytes(data).decode()
        except UnicodeDecodeError as error:
            message, name = f"damaged: not UTF-8 ({error})", f"number {row}"
            raise DataError(message, file=self.path, segment=name, field=field) from error

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.ids)}

    def index_of(self, segment_id: str | int) -> int:
        """Return the index of a segment by its id or its number; a :class:`DataError` if there is none."""
        if isinstance(segment_id, int) and 0 <= segment_id < len(self):
            return segment_id
        if segment_id not in self._places:
            held = f"no such segment: the store holds {len(self)} segments, the first is number 0"
            raise DataError(held, file=self.path, segment=str(segment_id))
        return self._places[segment_id]

    def tags(self, index: SupportsIndex) -> dict[str, Any]:
        """Return what was given as ``tags`` when the segment was appended."""
        row = self._row(index)
        found = self._parsed(row, self.raw(SEGMENTS, row)[1]["tags"])
        return {name: value for name, value in found.items() if name not in (GROUP, GOAL)}

    def _parsed(self, row: int, tags: Any) -> dict[str, Any]:
        try:
            found = json.loads((tags if isinstance(tags, str) else self._text(tags, row, "tags")) or "{}")
            if not isinstance(found, dict):
                raise ValueError("not an object")
        except (ValueError, RecursionError) as error:
            name = self.ids[row]
            raise DataError(f"not JSON: {error}", file=self.path, segment=name, field="tags") from error
        return found

    @property
    def unfinished(self) -> str | None:
        """A message if its generation is under way or was interrupted: how many segments there are, of how many."""
        found = [self.report.get(name) for name in ("generation", "settings")]
        made, settings = (each if isinstance(each, dict) else {} for each in found)
        if made.get("complete") is not False:
            return None
        held = f"holds {len(self)} of {settings.get('segments', 'more')} segments: its generation is not finished"
        return f"{held}; give the same `symphony data generate` again"

    def checksum(self) -> str:
        """Return SHA-256 over the hashes in the index, sorted by segment id: the same for the same segments.

        A hash covers all of a segment and its map; not its tags, the order of insertion or the report. That the
        content still has these hashes is seen when it is read (or by :meth:`verify`).
        """
        order = sorted(range(len(self)), key=self.ids.__getitem__)
        return hashlib.sha256(self._segments["hash"][order].tobytes()).hexdigest()

    def verify(self, progress: Callable[[int, int], None] = lambda *_: None) -> None:
        """Read everything, and compare it with the hashes and the schema; the tags must be JSON. A :class:`DataError`
        names the first segment that has changed. ``progress`` gets done and total.
        """
        for number, key in enumerate(self.map_hashes):
            if content_hash(self.road(number)) != key.hex():
                message = f"map {number} does not match its hash: the store was damaged"
                raise DataError(message, file=self.path)
        for row, name in enumerate(self.ids):
            if self._places[name] != row:
                raise DataError("two segments of this name", file=self.path, segment=name, field="segment_id")
            self._check(row, self._read(row))
            self._unseen[row] = False
            progress(row + 1, len(self))

    @property
    def report(self) -> dict[str, Any]:
        """The conversion report (empty where none was written)."""
        path = self.path / REPORT
        return read_object(path) if path.exists() else {}

    def summary(self) -> dict[str, Any]:
        """Return counts and ranges over the whole store, as JSON can hold them; reads no agent or map data."""
        segments, maps = self._segments, self._maps
        steps, dt = segments["steps"], segments["dt"]
        lanes = maps["count"][:, MAPS.axes["lanes"]]
        axes = [MAPS.axes[f"{name}.points"] for name in ("lanes", "boundary", "marks")]
        points = maps["count"][:, axes].sum(axis=1)
        return {
            "segments": len(self),
            "agents": int(self.num_agents.sum()),
            "signals": int(segments["count"][:, SEGMENTS.axes["signals"]].sum()),
            "sources": dict(sorted(Counter(self.sources.tolist()).items())),
            "steps": _span(steps),
            "dt": _span(dt),
            "duration": _span((steps - 1) * dt),
            "maps": len(maps),
            "lanes": _span(lanes[segments["map"]]),
            "map_points": _span(points[segments["map"]]),
            "bytes": sum(file.stat().st_size for file in self.path.rglob("*") if file.is_file()),
        }


def _group(tags: dict[str, Any], segment_id: str) -> str:
    return str(tags.get(GROUP) or tags.get(NETWORK) or segment_id)


def _span(values: NDArray[Any]) -> dict[str, float]:
    """Return the smallest, mean and largest value, to a microsecond; empty for no values."""
    if len(values) == 0:
        return {}
    return {"min": values.min().item(), "mean": round(float(values.mean()), 6), "max": values.max().item()}


def _read_indices(folder: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return records of the segments, and of the maps they lie on, memory-mapped. A :class:`DataError` says if an
    index is missing, cut short or contradicts itself.
    """
    segments = _read_index(folder, SEGMENTS, None)
    count, axes = segments["count"], SEGMENTS.axes
    agents, lights, steps = count[:, axes["agents"]], count[:, axes["signals"]], segments["steps"]
    # Limits first: a product of numbers out of range may wrap around to a right one.
    sound = (steps >= 2) & (steps <= schema.MAX_STEPS)
    sound &= (agents <= schema.MAX_AGENTS) & (lights <= schema.MAX_POINTS)
    sound &= count[:, axes["states"]] == agents * steps
    sound &= count[:, axes["signal_states"]] == lights * steps
    sound &= (segments["ego"] >= 0) & (segments["ego"] < agents) & (segments["map"] >= 0)
    _check_sound(sound, SEGMENTS, folder)
    # Maps no segment points at belong to an append that never finished.
    maps = _read_index(folder, MAPS, limit=int(segments["map"].max(initial=-1)) + 1)
    lines = {n: maps["count"][:, MAPS.axes[f"{n}.offsets"]] for n in ("lanes", "boundary", "marks")}
    sound = np.all([line >= 1 for line in lines.values()], axis=0)
    for name in ("lanes", "marks"):
        sound &= maps["count"][:, MAPS.axes[name]] == lines[name] - 1
    _check_sound(sound, MAPS, folder)
    return segments, maps


def _check_sound(sound: NDArray[np.bool_], table: Table, folder: Path) -> None:
    if not sound.all():
        message = f"record {int(np.argmin(sound))} contradicts itself: the file is damaged"
        raise DataError(message, file=table.index_path(folder))


def _read_index(folder: Path, table: Table, limit: int | None) -> NDArray[Any]:
    """Return the complete records of an index; a torn last record is not one. With a limit there must be as many."""
    path = table.index_path(folder)
    if not path.is_file():
        raise DataError("index file is missing", file=path)
    count = path.stat().st_size // table.record.itemsize
    if limit is not None and count < limit:
        raise DataError(f"index holds {count} records, {limit} are in use", file=path)
    records = _mapped(path, table.record, count if limit is None else limit)
    begin, rows = records["begin"], records["count"]
    chained = np.array_equal(begin[1:], begin[:-1] + rows[:-1]) and not begin[:1].any()
    # Sums that pass the largest integer wrap around, and would follow one another again.
    if not chained or (rows < 0).any() or (begin < 0).any():
        raise DataError("index records do not follow one another: the file is damaged", file=path)
    return records


def _mapped(path: Path, row: np.dtype[Any], rows: int) -> NDArray[Any]:
    """Return a read-only view of the start of a file (an empty file can't be mapped)."""
    if rows == 0:
        return np.zeros(0, row)
    # Not np.memmap, which asks the disk for every folder on the way to each file, and is slow to slice.
    with path.open("rb") as file:
        mapped = mmap.mmap(file.fileno(), rows * row.itemsize, access=mmap.ACCESS_READ)
    return np.frombuffer(mapped, row)
