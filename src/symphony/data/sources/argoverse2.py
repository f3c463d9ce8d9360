"""Reader of the Argoverse 2 motion-forecasting dataset: a scenario in Parquet with its map in JSON beside it.

How the format maps onto :class:`~symphony.data.segment.RunSegment`:

- One file, ``scenario_<ID>.parquet``, is one segment; ``segment_id`` is the scenario id. The map is
  ``log_map_archive_<ID>.json`` in the same folder. The format names no log: scenarios with equal maps are windows
  of one drive and form a group, named after the map's SHA-256.
- Steps run from 0 to the last at which any track is present (the test split ends after the history). The time
  step is the span of the timestamps divided by their number less one: the format has no times of single steps.
  ``current_step`` is the last observed step, 49 in the dataset's 5 s of history at 10 Hz.
- The ego is the recording vehicle, track ``AV``, which gets the id :data:`EGO_ID`. Agents are in order of id. The
  focal track is the agent of interest; focal and scored tracks are for prediction, in that order.
- The format has **no box sizes**: each object type gets its entry in :data:`NOMINAL_SIZES`.
- Tracks have no height, so z is 0 throughout, and the map's is dropped. Coordinates are taken relative to the
  ego's first position, rounded to metres.
- A lane's line is the file's ``centerline`` or, where it has none, the middle of its bounds; bike lanes are lanes
  of type ``BIKE_LANE``, among the others. There are no speed limits and no traffic lights. Neighbours are those
  of the same direction only. Maps are cropped to the scene: references to lanes beyond are left out, and the edge
  of the crop is no road boundary, which stays open there. Painted lane bounds and crossings are marks.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.bounds import MAX_STEPS, check_counts
from symphony.data.segment import AgentType, Bools, RunSegment
from symphony.data.sources.argoverse2_map import CityMap, read_map, road_map
from symphony.data.sources.base import Item, Reader, read_whole, to_float32
from symphony.data.sources.lines import Doubles
from symphony.errors import ConfigError, DataError

EGO_ID = -1
"""Agent id of the recording vehicle, whose track is called ``AV``; all others are numbers from 0."""

NOMINAL_SIZES: dict[str, tuple[AgentType, tuple[float, float, float]]] = {
    "vehicle": (AgentType.VEHICLE, (4.6, 1.9, 1.7)),
    "bus": (AgentType.VEHICLE, (12.0, 2.6, 3.2)),
    "motorcyclist": (AgentType.VEHICLE, (2.1, 0.8, 1.6)),
    "cyclist": (AgentType.CYCLIST, (1.8, 0.7, 1.7)),
    "pedestrian": (AgentType.PEDESTRIAN, (0.7, 0.7, 1.7)),
    "riderless_bicycle": (AgentType.OTHER, (1.7, 0.5, 1.1)),
    "static": (AgentType.OTHER, (0.8, 0.8, 1.0)),
    "background": (AgentType.OTHER, (0.8, 0.8, 1.0)),
    "construction": (AgentType.OTHER, (0.6, 0.6, 1.0)),
    "unknown": (AgentType.OTHER, (0.8, 0.8, 1.0)),
}
"""Object type of the format -> agent type and (length, width, height) in metres."""

MAX_ROWS = 500_000
"""States of a scenario; the dataset's have some thousand."""
MAX_TEXT = 64
"""Characters of an id."""
MAX_BYTES = 256 << 20
"""Of the columns, decompressed."""

_TEXT, _FLAG, _INTEGER, _NUMBER = "text", "true or false", "an integer", "a number"
_COLUMNS = {
    "scenario_id": _TEXT,
    "focal_track_id": _TEXT,
    "start_timestamp": _NUMBER,
    "end_timestamp": _NUMBER,
    "num_timestamps": _INTEGER,
    "track_id": _TEXT,
    "object_type": _TEXT,
    "object_category": _INTEGER,
    "timestep": _INTEGER,
    "observed": _FLAG,
    "position_x": _NUMBER,
    "position_y": _NUMBER,
    "heading": _NUMBER,
    "velocity_x": _NUMBER,
    "velocity_y": _NUMBER,
}
_STATE = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
_SCORED, _FOCAL = 2, 3

Columns = dict[str, NDArray[Any]]


class Argoverse2Reader(Reader):
    """Reads Argoverse 2 motion-forecasting scenarios.

    Raises:
        ConfigError: pyarrow is not installed.
    """

    name = "argoverse2"
    patterns = ("scenario_*.parquet",)

    def __init__(self) -> None:
        if importlib.util.find_spec("pyarrow") is None:
            raise ConfigError(
                "pyarrow is not installed; it comes with the extra: pip install 'symphony-traffic[argoverse2]'"
            )

    def companions(self, path: Path) -> tuple[Path, ...]:
        """The map."""
        return (map_path(path),)

    def _read(self, path: Path) -> Iterator[Item]:
        columns = read_columns(read_whole(path))
        name = _constant(columns, "scenario_id")
        try:
            yield self._segment(columns, name, path)
        except DataError as error:
            raise error.at(segment=name) from error

    def _segment(self, columns: Columns, name: str, path: Path) -> RunSegment:
        if path.name != f"scenario_{name}.parquet":
            # The map is found by the file's name: it must not be another scenario's.
            raise DataError(f"the file must be named scenario_{name}.parquet", field="scenario_id")
        tracks = _tracks(columns)
        city = read_map(map_path(path))
        # Absurd numbers may overflow on the way: the result is not finite, which validation reports.
        with np.errstate(over="ignore", invalid="ignore"):
            segment = _assemble(columns, tracks, city, name, path.name)
        return segment.replace(group=hashlib.sha256(map_path(path).read_bytes()).hexdigest()[:16])


def map_path(path: Path) -> Path:
    """Where the map of a scenario file is."""
    return path.with_name(f"log_map_archive_{path.stem.removeprefix('scenario_')}.json")


def read_columns(data: bytes) -> Columns:
    """The columns the reader needs, as arrays [N].

    Raises:
        DataError: the file is no Parquet, too large, a column is missing, of another type, or has gaps.
    """
    import pyarrow as pa  # noqa: PLC0415 - an optional extra
    from pyarrow import parquet  # noqa: PLC0415

    if not data:
        raise DataError("the file is empty")
    try:
        schema = parquet.read_schema(pa.BufferReader(data))
        missing = [name for name in _COLUMNS if name not in schema.names]
        if missing:
            raise DataError("the column is missing", field=missing[0])
        for name, kind in _COLUMNS.items():
            if pa.types.is_nested(schema.field(name).type):
                raise DataError(f"expected {kind}, is {schema.field(name).type}", field=name)
        # Text stays a dictionary: a long one that all rows share must not become a copy for each.
        texts = [name for name, kind in _COLUMNS.items() if kind == _TEXT]
        source = pa.BufferReader(data)
        file = parquet.ParquetFile(source, read_dictionary=texts, page_checksum_verification=True)
        _check_size(file)
        table = file.read(columns=list(_COLUMNS), use_threads=False)
        table.validate(full=True)
        return {name: _column(pa, table[name], name, kind) for name, kind in _COLUMNS.items()}
    # Its decoders raise much besides their own exceptions (which include ValueError and MemoryError).
    except (pa.ArrowException, OSError, ValueError, MemoryError, OverflowError) as error:
        raise DataError(f"not a readable Parquet file: {str(error)[:200]}") from error


def _check_size(file: Any) -> None:
    """Refuse what would take gigabytes once it is read."""
    metadata = file.metadata
    if metadata.num_rows > MAX_ROWS:
        raise DataError(f"{metadata.num_rows} rows, at most {MAX_ROWS} are read")
    size = 0
    for k in range(metadata.num_row_groups):
        # Opening the columns raises where their descriptions are damaged; asking for those ends the process.
        next(file.iter_batches(1, [k], [name for name in _COLUMNS if name in file.schema_arrow.names]), None)
        group = metadata.row_group(k)
        paths = [metadata.schema.column(j).path for j in range(group.num_columns)]
        chunks = [group.column(j) for j, path in enumerate(paths) if path in _COLUMNS]
        size += sum(chunk.total_uncompressed_size for chunk in chunks)
    if size > MAX_BYTES:
        raise DataError(f"{size} bytes in its columns, at most {MAX_BYTES} are read")


def _column(pa: Any, column: Any, name: str, kind: str) -> NDArray[Any]:
    types = pa.types
    if kind == _TEXT:
        return _text(pa, column, name)
    if types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    fits = {
        _FLAG: types.is_boolean(column.type),
        _INTEGER: types.is_integer(column.type),
        _NUMBER: types.is_floating(column.type) or types.is_integer(column.type),
    }
    if not fits[kind]:
        raise DataError(f"expected {kind}, is {column.type}", field=name)
    _check_full(column, name)
    return column.cast({_FLAG: pa.bool_(), _INTEGER: pa.int64(), _NUMBER: pa.float64()}[kind]).to_numpy()


def _check_full(column: Any, name: str) -> None:
    if column.null_count:
        raise DataError(f"{column.null_count} of {len(column)} values are missing", field=name)
    if not len(column):
        raise DataError("the file has no rows", field=name)


def _text(pa: Any, column: Any, name: str) -> NDArray[np.str_]:
    """Text of at most :data:`MAX_TEXT` characters, by way of the few that differ."""
    if not pa.types.is_dictionary(column.type):
        column = column.dictionary_encode()
    kind = column.type.value_type
    if not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        raise DataError(f"expected {_TEXT}, is {kind}", field=name)
    _check_full(column, name)
    whole = column.unify_dictionaries().combine_chunks()
    whole = whole.chunk(0) if isinstance(whole, pa.ChunkedArray) else whole
    values = whole.dictionary.to_pylist()
    if None in values:
        raise DataError("values are missing", field=name)
    if max(map(len, values)) > MAX_TEXT:
        raise DataError(f"a text of more than {MAX_TEXT} characters", field=name)
    return np.array(values, np.str_)[whole.indices.to_numpy()]


def _constant(columns: Columns, name: str) -> Any:
    """The value all rows share."""
    values = columns[name]
    if (values != values[0]).any():
        raise DataError("differs between the rows", field=name)
    return values[0].item()


@dataclass(frozen=True)
class _Tracks:
    """Tracks in order of id, in city coordinates.

    Attributes:
        name: [A] as in the file; id [A] int64, -1 for the ego.
        kind: [A] object type; category [A].
        state: [A, T, 5] x, y, heading, velocity; 0 where not valid.
        valid: [A, T].
        current: the last observed step.
    """

    name: NDArray[np.str_]
    agent_id: NDArray[np.int64]
    kind: NDArray[np.str_]
    category: NDArray[np.int64]
    state: Doubles
    valid: Bools
    current: int


def _tracks(columns: Columns) -> _Tracks:
    names, first, inverse = np.unique(columns["track_id"], return_index=True, return_inverse=True)
    ids = np.array([_agent_id(name) for name in names.tolist()], np.int64)
    order = np.argsort(ids, kind="stable")
    row = np.argsort(order)[inverse]
    for name in ("object_type", "object_category"):
        wrong = np.flatnonzero(columns[name] != columns[name][first][inverse])
        if len(wrong):
            raise DataError(f"track {columns['track_id'][wrong[0]]} has more than one", field=name)
    category = columns["object_category"][first][order]
    if not np.isin(category, range(_FOCAL + 1)).all():
        raise DataError(f"unknown value, expected 0 … {_FOCAL}", field="object_category")
    step, steps = _steps(columns, len(names))
    state = np.stack([columns[name] for name in _STATE], axis=-1)
    _check_states(columns, state, row * steps + step)
    table = np.zeros((len(names), steps, len(_STATE)))
    valid = np.zeros((len(names), steps), np.bool_)
    table[row, step], valid[row, step] = state, True
    if not columns["observed"].any():
        raise DataError("no step is observed", field="observed")
    return _Tracks(
        name=names[order],
        agent_id=ids[order],
        kind=columns["object_type"][first][order],
        category=category,
        state=table,
        valid=valid,
        current=int(step[columns["observed"]].max()),
    )


def _agent_id(name: str) -> int:
    if name == "AV":
        return EGO_ID
    if not (name.isascii() and name.isdecimal() and len(name) <= 18):
        raise DataError(f"{name[:40]!r} is neither 'AV' nor a number", field="track_id")
    return int(name)


def _steps(columns: Columns, agents: int) -> tuple[NDArray[np.int64], int]:
    """(step [N] of each row, number of steps)."""
    step, count = columns["timestep"], _constant(columns, "num_timestamps")
    if not 2 <= count <= MAX_STEPS:
        raise DataError(f"{count} steps, expected 2 … {MAX_STEPS}", field="num_timestamps")
    outside = step[(step < 0) | (step >= count)]
    if len(outside):
        raise DataError(f"{outside[0]} is outside the {count} steps", field="timestep")
    steps = int(step.max()) + 1
    check_counts(agents, steps, "track_id")
    return step, steps


def _check_states(columns: Columns, state: Doubles, place: NDArray[np.int64]) -> None:
    bad = np.argwhere(~np.isfinite(state))
    if len(bad):
        where = f"track {columns['track_id'][bad[0, 0]]}, step {columns['timestep'][bad[0, 0]]}"
        raise DataError(f"{len(bad)} numbers that are not finite, first at {where}", field=_STATE[bad[0, 1]])
    _, first, counts = np.unique(place, return_index=True, return_counts=True)
    if (counts > 1).any():
        twice = first[counts > 1][0]
        message = f"track {columns['track_id'][twice]} has two states at step {columns['timestep'][twice]}"
        raise DataError(message, field="timestep")


def _time_step(columns: Columns) -> float:
    """Seconds per step to the millisecond; the format's times are nanoseconds."""
    start, end = _constant(columns, "start_timestamp"), _constant(columns, "end_timestamp")
    dt = (end - start) * 1e-9 / (_constant(columns, "num_timestamps") - 1)
    if not (dt > 0 and abs(round(dt, 3) - dt) <= 0.01 * dt):
        raise DataError(f"{dt:g} s per step: not a positive number of milliseconds", field="end_timestamp")
    return round(dt, 3)


def _assemble(columns: Columns, tracks: _Tracks, city: CityMap, name: str, file: str) -> RunSegment:
    dt = _time_step(columns)
    unknown = [kind for kind in tracks.kind.tolist() if kind not in NOMINAL_SIZES]
    if unknown:
        raise DataError(f"unknown value {unknown[0][:40]!r}", field="object_type")
    if tracks.agent_id[0] != EGO_ID:
        raise DataError("has no track 'AV', the recording vehicle", field="track_id")
    focal = np.flatnonzero(tracks.name == _constant(columns, "focal_track_id"))
    if not len(focal):
        raise DataError("names no track of the file", field="focal_track_id")
    origin = np.round(tracks.state[0, np.argmax(tracks.valid[0]), :2])
    position = np.where(tracks.valid[..., None], tracks.state[..., :2] - origin, 0.0)
    types, sizes = zip(*(NOMINAL_SIZES[kind] for kind in tracks.kind.tolist()), strict=True)
    predict = [np.flatnonzero(tracks.category == category) for category in (_FOCAL, _SCORED)]
    return RunSegment(
        segment_id=name,
        source=Argoverse2Reader.name,
        dt=dt,
        ego=0,
        agent_id=tracks.agent_id,
        agent_type=np.array(types, np.uint8),
        size=np.array(sizes, np.float32),
        position=to_float32(np.pad(position, ((0, 0), (0, 0), (0, 1)))),
        heading=to_float32(tracks.state[..., 2]),
        velocity=to_float32(tracks.state[..., 3:5]),
        valid=tracks.valid,
        road=road_map(city, origin),
        signal_lane=np.zeros(0, np.int32),
        signal_point=np.zeros((0, 3), np.float32),
        signal_state=np.zeros((0, tracks.valid.shape[1]), np.uint8),
        origin=np.array([*origin, 0.0]),
        current_step=tracks.current,
        interest=focal.astype(np.int32),
        predict=np.concatenate(predict).astype(np.int32),
        file=file,
    )
