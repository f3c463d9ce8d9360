"""Write stores of run segments."""

from __future__ import annotations

import json
import operator
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from symphony.data import store_format as layout
from symphony.data.segment import RoadMap, RunSegment, content_hash, validate
from symphony.data.store import GROUP, TWICE, SegmentStore
from symphony.data.store_format import MAPS, SEGMENTS, TableWriter, decoded, read_ids, read_indices
from symphony.errors import DataError
from symphony.files import Lock


class StoreWriter:
    """Adds segments to a store, one at a time; each is on record once :meth:`append` returns.

    Opening for append cuts off what a writer that died left unfinished. Only one writer at a time.

    Args:
        path: the store's directory; created, or must be empty unless ``append``.
        append: continue an existing store (or start one).

    Raises:
        DataError: the directory holds something else, is damaged, of another version, or being written.
    """

    def __init__(self, path: str | Path, *, append: bool = False) -> None:
        self.path = Path(path).absolute()
        if self.path.exists() and not self.path.is_dir():
            raise DataError("not a directory", file=self.path)
        fresh = not (self.path / layout.HEADER).exists()
        if fresh and not _is_blank(self.path):
            raise DataError("not empty and not a segment store: refusing to write into it", file=self.path)
        if not fresh:
            layout.check_header(self.path)
            if not append:
                raise DataError("already a segment store (append to it, or choose another)", file=self.path)
        self.path.mkdir(parents=True, exist_ok=True)
        self._lock: Lock | None = layout.lock(self.path)
        try:
            self._open(fresh)
        except BaseException:
            self._lock.close()
            raise

    def _open(self, fresh: bool) -> None:
        if fresh:
            _create(self.path)
        segments, maps = read_indices(self.path)
        for table, records in ((SEGMENTS, segments), (MAPS, maps)):
            layout.check_columns(self.path, table, records)
        self._ids = {name: k for k, name in enumerate(read_ids(self.path, segments))}
        self._roads = {record.tobytes(): k for k, record in enumerate(maps["hash"])}
        self._maps = TableWriter(self.path, MAPS, maps)
        self._segments = TableWriter(self.path, SEGMENTS, segments)

    def __len__(self) -> int:
        return self._segments.count

    def has(self, segment_id: str) -> bool:
        """Whether a segment of that name is in the store."""
        return segment_id in self._ids

    def index_of(self, segment_id: str) -> int:
        """Index of a segment that is in the store."""
        return self._ids[segment_id]

    def append(self, segment: RunSegment, *, tags: Mapping[str, Any] | None = None) -> int:
        """Add one segment.

        Args:
            segment: validated here.
            tags: anything JSON can hold, given back by :meth:`SegmentStore.tags`; not under the name
                ``group``, where the segment's group is kept.

        Returns:
            Its index.

        Raises:
            DataError: the segment breaks the schema, or one of that name is there already.
        """
        self._check_open()
        segment = _plain(validate(segment))
        try:
            if self.has(segment.segment_id):
                raise DataError(TWICE, field="segment_id")
            return self._append(segment, _tags_text(segment, tags))
        except DataError as error:
            raise error.at(file=segment.file or None, segment=segment.segment_id) from error

    def _append(self, segment: RunSegment, tags: str) -> int:
        key = bytes.fromhex(content_hash(cast(Any, segment.road)))
        road = self._road(key, lambda: _road_values(segment.road))
        values = {c.name: getattr(segment, c.name) for c in SEGMENTS.columns if c.name != "tags"}
        for name in ("segment_id", "source", "file"):
            values[name] = np.frombuffer(values[name].encode(), np.uint8)
        number = self._segments.append(
            values | {"tags": np.frombuffer(tags.encode(), np.uint8)},
            bytes.fromhex(content_hash(segment)),
            map=road,
            steps=segment.num_steps,
            ego=segment.ego,
            current_step=segment.current_step,
            dt=segment.dt,
            origin=segment.origin,
        )
        self._ids[segment.segment_id] = number
        return number

    def _road(self, key: bytes, values: Callable[[], dict[str, NDArray[Any]]]) -> int:
        if key not in self._roads:
            self._roads[key] = self._maps.append(values(), key)
        return self._roads[key]

    def copy(self, store: SegmentStore, index: int) -> int:
        """Add a segment of another store, tags included; many times faster than reading and appending it.

        Returns its index, or raises a :class:`DataError` where one of that name is there already.
        """
        self._check_open()
        name, record, values, road = store.raw(index)
        if self.has(name):
            file = decoded(bytes(values["file"]), "file") or None
            raise DataError(TWICE, file=file, segment=name, field="segment_id")
        key = road["hash"].tobytes()
        scalars = {field: record[field] for field, *_ in SEGMENTS.scalars}
        scalars["map"] = self._road(key, lambda: store.raw_road(int(record["map"])))
        self._ids[name] = self._segments.append(values, record["hash"].tobytes(), **scalars)
        return self._ids[name]

    def _check_open(self) -> None:
        if self._lock is None:
            raise ValueError("the writer is closed")

    def write_report(self, report: Mapping[str, Any]) -> None:
        """Replace the conversion report kept with the store."""
        layout.write_json(self.path / layout.REPORT, report)

    def close(self) -> None:
        """Bring everything to the disk and let the next writer in."""
        if self._lock is not None:
            self._maps.close()
            self._segments.close()
            self._lock.close()
            self._lock = None

    def __enter__(self) -> StoreWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _plain(segment: RunSegment) -> RunSegment:
    """Python scalars and text in place of NumPy's, which would enter the content hash."""
    texts = {name: str(getattr(segment, name)) for name in ("segment_id", "source", "file")}
    numbers = {"dt": float(segment.dt), "ego": int(segment.ego), "current_step": int(segment.current_step)}
    return segment.replace(**texts, **numbers)


def _tags_text(segment: RunSegment, tags: Mapping[str, Any] | None) -> str:
    """JSON of the tags and the group, which has no column of its own: older stores and releases have none."""
    if tags and GROUP in tags:
        raise DataError(f"{GROUP!r} is no name for a tag", field="tags")
    known = segment.group not in {"", segment.segment_id}
    found = {**(tags or {}), **({GROUP: segment.group} if known else {})}
    return json.dumps(found, ensure_ascii=False) if found else ""


def _road_values(road: RoadMap) -> dict[str, NDArray[Any]]:
    return {column.name: operator.attrgetter(column.name)(road) for column in MAPS.columns}


def _is_blank(path: Path) -> bool:
    """Nothing there, or only the empty files of a writer that died before it had begun."""
    own = {layout.LOCK, f"{layout.HEADER}.tmp"}
    files = path.rglob("*") if path.is_dir() else ()
    return all(
        f.is_dir() or f.name in own or (f.suffix in {".idx", ".bin"} and not f.stat().st_size) for f in files
    )


def _create(path: Path) -> None:
    """Empty files first and the header last: with a header, a store is whole."""
    (path / layout.COLUMNS).mkdir(exist_ok=True)
    for table in layout.TABLES:
        for file in (table.index_path(path), *(table.column_path(path, c) for c in table.columns)):
            file.touch()
    layout.write_json(path / layout.HEADER, layout.header())
