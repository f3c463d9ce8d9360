"""Many run segments in one directory: memory-mapped, without padding, append-only (see ``store_format``)."""

from __future__ import annotations

import hashlib
import json
import operator
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, SupportsIndex, cast, overload

import numpy as np
from numpy.typing import NDArray

from symphony.data import store_format as layout
from symphony.data.segment import Polylines, RoadMap, RunSegment, content_hash, validate
from symphony.data.store_format import MAPS, SEGMENTS, decoded, read_ids, read_indices, rows
from symphony.errors import DataError

TWICE = "a segment of this name is in the store already"
GROUP, NETWORK = "group", "network"
"""Tags a segment's group is kept under: in this release, and by the generator before there were groups."""


class SegmentStore(Sequence[RunSegment]):
    """Read access to a store: ``store[i]`` reads that segment only, as read-only views of the mapped files.

    Holds what was complete when it was opened. Pickles as its path, so each process maps the files itself. The first
    time a process reads a segment, its content and its map's are compared with the hash that was written with it,
    and checked against the schema.

    Raises:
        DataError: not a store, of another version, or a file is missing, truncated or damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path).absolute()
        layout.check_header(self.path)
        self._segments, self._maps = read_indices(self.path)
        more = layout.check_columns(self.path, SEGMENTS, self._segments)
        if layout.check_columns(self.path, MAPS, self._maps) or more:
            layout.check_whole(self.path, len(self._segments))
        self._unseen = np.ones(len(self._segments), np.bool_)
        self._columns = layout.map_columns(self.path, SEGMENTS, self._segments)
        self._road_columns = layout.map_columns(self.path, MAPS, self._maps)

    def __reduce__(self) -> tuple[Any, ...]:
        return SegmentStore, (str(self.path),)

    def __len__(self) -> int:
        return len(self._segments)

    @overload
    def __getitem__(self, index: SupportsIndex) -> RunSegment: ...
    @overload
    def __getitem__(self, index: slice) -> list[RunSegment]: ...
    def __getitem__(self, index: SupportsIndex | slice) -> RunSegment | list[RunSegment]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        row = self._row(index)
        try:
            segment = self._read(row)
            if self._unseen[row]:
                self._check(row, segment)
                self._unseen[row] = False
        except DataError as error:
            raise error.at(file=self.path, segment=self._name(row)) from error
        return segment

    def _read(self, row: int) -> RunSegment:
        record = self._segments[row]
        parts = rows(SEGMENTS, self._columns, record)
        agents, steps, lights = len(parts["agent_id"]), int(record["steps"]), len(parts["signal_lane"])
        parts.pop("tags")
        for name in ("segment_id", "source", "file"):
            parts[name] = decoded(bytes(parts[name]), name)
        parts["group"] = group_of(self._tags(row), parts["segment_id"])
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
        if content_hash(segment) != self.content(row):
            raise DataError("content does not match its hash: the store was damaged", file=self.path)
        try:
            validate(segment)
        except DataError as error:  # names the log it was read from
            raise DataError(error.message, file=self.path, field=error.field) from error

    def _name(self, row: int) -> str:
        try:
            return self._text("segment_id", row)
        except DataError:
            return f"number {row}"

    def __iter__(self) -> Iterator[RunSegment]:
        return (self[i] for i in range(len(self)))

    def _row(self, index: SupportsIndex) -> int:
        i = operator.index(index)
        if not -len(self) <= i < len(self):
            raise IndexError(f"segment {i} of {len(self)}")
        return i % len(self)

    def road(self, number: int) -> RoadMap:
        """One of the distinct maps (see :attr:`map_index`)."""
        if not 0 <= number < len(self._maps):
            raise IndexError(f"map {number} of {len(self._maps)}")
        parts = rows(MAPS, self._road_columns, self._maps[number])
        for name in ("lanes", "boundary", "marks"):
            parts[name] = Polylines(parts.pop(f"{name}.points"), parts.pop(f"{name}.offsets"))
        return RoadMap(**parts)

    def content(self, index: SupportsIndex) -> str:
        """Hash of a segment's content, its map included, as it was written."""
        return cast(str, self._segments["hash"][self._row(index)].tobytes().hex())

    def raw(self, index: SupportsIndex) -> tuple[str, Any, dict[str, NDArray[Any]], Any]:
        """A segment as it is stored: id, index record, rows of every column, index record of its map."""
        record = self._segments[self._row(index)]
        values = rows(SEGMENTS, self._columns, record)
        return self._text("segment_id", self._row(index)), record, values, self._maps[int(record["map"])]

    def raw_road(self, number: int) -> dict[str, NDArray[Any]]:
        """Rows of every column of a map."""
        return rows(MAPS, self._road_columns, self._maps[number])

    @property
    def num_maps(self) -> int:
        """Number of distinct maps."""
        return len(self._maps)

    @property
    def map_index(self) -> NDArray[np.int64]:
        """[segments] which distinct map each segment lies on."""
        return self._segments["map"]

    @cached_property
    def ids(self) -> list[str]:
        """Segment ids in order of insertion."""
        return read_ids(self.path, self._segments)

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.ids)}

    def index_of(self, segment_id: str | int) -> int:
        """Index of a segment by its id, or by its number, which it is; a :class:`DataError` if there is none."""
        if isinstance(segment_id, int):
            if not 0 <= segment_id < len(self):
                held = f"the store holds {len(self)} segments, the first is number 0"
                raise DataError(held, file=self.path, segment=str(segment_id))
            return segment_id
        if segment_id not in self._places:
            raise DataError("no such segment in the store", file=self.path, segment=segment_id)
        return self._places[segment_id]

    def tags(self, index: SupportsIndex) -> dict[str, Any]:
        """What was given as ``tags`` when the segment was appended."""
        found = self._tags(self._row(index))
        return {name: value for name, value in found.items() if name != GROUP}

    def _tags(self, row: int) -> dict[str, Any]:
        try:
            found = json.loads(self._text("tags", row) or "{}")
        except (ValueError, RecursionError) as error:
            raise DataError(
                f"not JSON: {error}", file=self.path, segment=self._name(row), field="tags"
            ) from error
        if not isinstance(found, dict):
            raise DataError("not a JSON object", file=self.path, segment=self._name(row), field="tags")
        return found

    @cached_property
    def groups(self) -> NDArray[np.str_]:
        """[segments] the recording each segment is part of: :attr:`RunSegment.group`.

        Its own id where the store does not know; the simulated network where an earlier release generated it.
        """
        found = [group_of(self._tags(i), name) for i, name in enumerate(self.ids)]
        return np.array(found, np.str_)

    @cached_property
    def sources(self) -> NDArray[np.str_]:
        """[segments] :attr:`RunSegment.source` of each."""
        return np.array([self._text("source", i) for i in range(len(self))], np.str_)

    def _text(self, column: str, row: int) -> str:
        axis = SEGMENTS.axes[column]
        begin, count = (int(self._segments[row][key][axis]) for key in ("begin", "count"))
        try:
            return decoded(bytes(self._columns[column][begin : begin + count]), column)
        except DataError as error:
            name = f"number {row}" if column == "segment_id" else self._name(row)
            raise error.at(file=self.path, segment=name) from error

    @property
    def unfinished(self) -> str | None:
        """That its generation is still under way, or was interrupted: how many segments there are, of how many."""
        made = self.report.get("generation")
        if not isinstance(made, dict) or made.get("complete") is not False:
            return None
        settings = self.report.get("settings")
        wanted = settings.get("segments", "more") if isinstance(settings, dict) else "more"
        return (
            f"holds {len(self)} of {wanted} segments: its generation is not finished; give the same "
            "`symphony data generate` again"
        )

    def check_complete(self) -> None:
        """Refuse a store that is still being generated, or whose generation was interrupted."""
        if self.unfinished is not None:
            raise DataError(self.unfinished, file=self.path)

    def checksum(self) -> str:
        """SHA-256 over the hashes in the index, sorted by segment id: the same for the same segments.

        A hash covers all of a segment that :class:`~symphony.data.segment.RunSegment` holds, its map included; not
        its tags, the order of insertion or the report. That the content still has these hashes is seen when it is
        read (or by :meth:`verify`).
        """
        digest = hashlib.sha256()
        for i in sorted(range(len(self)), key=self.ids.__getitem__):
            digest.update(self._segments["hash"][i].tobytes())
        return digest.hexdigest()

    def verify(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Read everything, read before or not, and compare it with the hashes and the schema; the tags must be JSON.

        A :class:`DataError` names the first segment that is not what was written. ``progress`` is told how many are
        done, of how many.
        """
        for number, key in enumerate(self._maps["hash"]):
            if content_hash(cast(Any, self.road(number))) != key.tobytes().hex():
                message = f"map {number} does not match its hash: the store was damaged"
                raise DataError(message, file=self.path)
        seen: dict[str, int] = {}
        for row, name in enumerate(self.ids):
            if seen.setdefault(name, row) != row:
                raise DataError("two segments of this name", file=self.path, segment=name, field="segment_id")
            try:
                self._check(row, self._read(row))
            except DataError as error:
                raise error.at(file=self.path, segment=name) from error
            self.tags(row)
            self._unseen[row] = False
            if progress is not None:
                progress(row + 1, len(self))

    @property
    def num_steps(self) -> NDArray[np.int64]:
        """Logged steps of every segment, the first included."""
        return self._segments["steps"].astype(np.int64)

    @property
    def time_steps(self) -> NDArray[np.float64]:
        """Seconds per step of every segment."""
        return self._segments["dt"].astype(np.float64)

    @property
    def report(self) -> dict[str, Any]:
        """The conversion report (empty where none was written)."""
        path = self.path / layout.REPORT
        return layout.read_json(path) if path.exists() else {}

    def summary(self) -> dict[str, Any]:
        """Counts and ranges over the whole store, as JSON can hold them; reads no agent or map data."""
        segments, maps = self._segments, self._maps
        steps, dt = segments["steps"], segments["dt"]
        lanes = maps["count"][:, MAPS.axes["lanes"]]
        axes = [MAPS.axes[f"{name}.points"] for name in ("lanes", "boundary", "marks")]
        points = maps["count"][:, axes].sum(axis=1)
        return {
            "segments": len(self),
            "agents": int(segments["count"][:, SEGMENTS.axes["agents"]].sum()),
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


def _span(values: NDArray[Any]) -> dict[str, float]:
    """Smallest, mean and largest, to a microsecond; empty for no values."""
    if len(values) == 0:
        return {}
    return {"min": values.min().item(), "mean": round(float(values.mean()), 6), "max": values.max().item()}


def group_of(tags: Mapping[str, Any], segment_id: str) -> str:
    """The recording that a segment belongs to: as its tags say, else itself."""
    return str(tags.get(GROUP) or tags.get(NETWORK) or segment_id)
