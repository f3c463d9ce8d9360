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
- The format has **no box sizes**: each object type gets its entry in :data:`NOMINAL_SIZES`, those not in there that
  of ``unknown``.
- Tracks have no height, so z is 0 throughout, and the map's is dropped. Coordinates are taken relative to the
  ego's first position, rounded to metres.
- A lane's line is the file's ``centerline`` or, where it has none, the middle of its bounds; bike lanes are lanes
  of type ``BIKE_LANE``, among the others. There are no speed limits and no traffic lights. Neighbours are those
  of the same direction only. Maps are cropped to the scene: references to lanes beyond are left out, and the edge
  of the crop is no road boundary, which stays open there. Painted lane bounds and crossings are marks.
- Lanes, areas and crossings that can't be read are left out, and noted.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.bounds import MAX_POINTS, MAX_STEPS, check_counts
from symphony.data.segment import AgentType, LaneType, MarkType, RoadMap, RunSegment
from symphony.data.sources.base import Item, Reader, read_whole, readable, to_float32
from symphony.data.sources.lines import (
    Doubles,
    Lane,
    drivable_rings,
    lights,
    matched,
    median_width,
    painted,
    road_map,
    stretches,
)
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

NO_LANE = "a lane left out that can't be read"
NO_AREA = "a drivable area left out that can't be read"
NO_CROSSING = "a crossing left out that can't be read"
NO_TYPE = "an agent of a type that is not known"

MAX_ROWS = 500_000
"""States of a scenario; the dataset's have some thousand."""
MAX_TEXT = 64
"""Characters of an id."""
MAX_BYTES = 256 << 20
"""Bytes of the columns, decompressed."""
MAX_COORDINATE = 1e8
"""Larger magnitudes are no metres of a city."""
TILE = 10.0
"""Metres: maps are cut along the axes at whole multiples of it (30 in the files that were looked at)."""
CUT_TOLERANCE = 0.011
"""Metres by which an edge may miss such a line: coordinates are kept to the centimetre."""

_TEXT, _FLAG, _INTEGER, _NUMBER = "text", "true or false", "an integer", "a number"
_STATE = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
_COLUMNS = {
    **dict.fromkeys(("scenario_id", "focal_track_id", "track_id", "object_type"), _TEXT),
    **dict.fromkeys(("start_timestamp", "end_timestamp", *_STATE), _NUMBER),
    **dict.fromkeys(("num_timestamps", "object_category", "timestep"), _INTEGER),
    "observed": _FLAG,
}
_SCORED, _FOCAL = 2, 3
_LANE_TYPES = {
    "VEHICLE": LaneType.SURFACE_STREET,
    "BUS": LaneType.SURFACE_STREET,
    "BIKE": LaneType.BIKE_LANE,
}

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
            if path.name != f"scenario_{name}.parquet":
                # The map is found by the file's name: it must not be another scenario's.
                raise DataError(f"the file must be named scenario_{name}.parquet", field="scenario_id")
            # Absurd numbers may overflow on the way: the result is not finite, which validation reports.
            with np.errstate(over="ignore", invalid="ignore"):
                yield _segment(columns, name, path)
        except DataError as error:
            raise error.at(segment=name) from error


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

    try:
        schema = parquet.read_schema(pa.BufferReader(data))
        for name, kind in _COLUMNS.items():
            if name not in schema.names:
                raise DataError("the column is missing", field=name)
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
    if column.null_count:
        raise DataError(f"{column.null_count} of {len(column)} values are missing", field=name)
    if not len(column):
        raise DataError("the file has no rows", field=name)
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
    return column.cast({_FLAG: pa.bool_(), _INTEGER: pa.int64(), _NUMBER: pa.float64()}[kind]).to_numpy()


def _text(pa: Any, column: Any, name: str) -> NDArray[np.str_]:
    """Text of at most :data:`MAX_TEXT` characters, by way of the few that differ."""
    if not pa.types.is_dictionary(column.type):
        column = column.dictionary_encode()
    kind = column.type.value_type
    if not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        raise DataError(f"expected {_TEXT}, is {kind}", field=name)
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


def _segment(columns: Columns, name: str, path: Path) -> RunSegment:
    names, first, inverse = np.unique(columns["track_id"], return_index=True, return_inverse=True)
    ids = np.array([_agent_id(name) for name in names.tolist()], np.int64)
    order = np.argsort(ids, kind="stable")
    row = np.argsort(order)[inverse]
    for field in ("object_type", "object_category"):
        wrong = np.flatnonzero(columns[field] != columns[field][first][inverse])
        if len(wrong):
            raise DataError(f"track {columns['track_id'][wrong[0]]} has more than one", field=field)
    step, count = columns["timestep"], _constant(columns, "num_timestamps")
    if not 2 <= count <= MAX_STEPS:
        raise DataError(f"{count} steps, expected 2 … {MAX_STEPS}", field="num_timestamps")
    outside = step[(step < 0) | (step >= count)]
    if len(outside):
        raise DataError(f"{outside[0]} is outside the {count} steps", field="timestep")
    steps = int(step.max()) + 1
    check_counts(len(names), steps, "track_id")
    _, place, counts = np.unique(row * steps + step, return_index=True, return_counts=True)
    if (counts > 1).any():
        twice = place[counts > 1][0]
        message = f"track {columns['track_id'][twice]} has two states at step {step[twice]}"
        raise DataError(message, field="timestep")
    if not columns["observed"].any():
        raise DataError("no step is observed", field="observed")
    if ids[order[0]] != EGO_ID:
        raise DataError("has no track 'AV', the recording vehicle", field="track_id")
    focal = np.flatnonzero(names[order] == _constant(columns, "focal_track_id"))
    if not len(focal):
        raise DataError("names no track of the file", field="focal_track_id")
    state, valid = np.zeros((len(names), steps, len(_STATE))), np.zeros((len(names), steps), np.bool_)
    state[row, step], valid[row, step] = np.stack([columns[name] for name in _STATE], axis=-1), True
    origin = np.round(state[0, np.argmax(valid[0]), :2])
    position = np.where(valid[..., None], state[..., :2] - origin, 0.0)
    kinds = columns["object_type"][first][order].tolist()
    types, sizes = zip(*(NOMINAL_SIZES.get(kind, NOMINAL_SIZES["unknown"]) for kind in kinds), strict=True)
    unknown = [f"{kind[:40]!r}" for kind in kinds if kind not in NOMINAL_SIZES]
    category = columns["object_category"][first][order]
    predict = [np.flatnonzero(category == which) for which in (_FOCAL, _SCORED)]
    road, odd, group = _read_map(map_path(path), origin)
    return RunSegment(
        segment_id=name,
        source=Argoverse2Reader.name,
        dt=_time_step(columns),
        ego=0,
        agent_id=ids[order],
        agent_type=np.array(types, np.uint8),
        size=np.array(sizes, np.float32),
        position=to_float32(np.pad(position, ((0, 0), (0, 0), (0, 1)))),
        heading=to_float32(state[..., 2]),
        velocity=to_float32(state[..., 3:5]),
        valid=valid,
        road=road,
        **lights({}, steps, origin),
        origin=np.array([*origin, 0.0]),
        current_step=int(step[columns["observed"]].max()),
        interest=focal.astype(np.int32),
        predict=np.concatenate(predict).astype(np.int32),
        file=path.name,
        group=group,
        odd=odd | ({NO_TYPE: unknown[0]} if unknown else {}),
    )


def _agent_id(name: str) -> int:
    if name == "AV":
        return EGO_ID
    if not (name.isascii() and name.isdecimal() and len(name) <= 18):
        raise DataError(f"{name[:40]!r} is neither 'AV' nor a number", field="track_id")
    return int(name)


def _time_step(columns: Columns) -> float:
    """Seconds per step to the millisecond; the format's times are nanoseconds."""
    start, end = _constant(columns, "start_timestamp"), _constant(columns, "end_timestamp")
    dt = (end - start) * 1e-9 / (_constant(columns, "num_timestamps") - 1)
    if not (dt > 0 and abs(round(dt, 3) - dt) <= 0.01 * dt):
        raise DataError(f"{dt:g} s per step: not a positive number of milliseconds", field="end_timestamp")
    return round(dt, 3)


def _read_map(path: Path, origin: Doubles) -> tuple[RoadMap, dict[str, str], str]:
    """The map relative to an origin [2], what was left out, and the start of the SHA-256 of its file."""
    try:
        data = read_whole(path)
        try:
            root = _table(json.loads(data), "the file")
        except (ValueError, RecursionError) as error:
            raise DataError(f"not well-formed JSON: {error}") from error
        return *_road(root, origin), hashlib.sha256(data).hexdigest()[:16]
    except FileNotFoundError:
        raise DataError("the scenario's map is missing", file=path) from None
    except DataError as error:
        raise error.at(file=path) from error


def _road(root: dict[str, Any], origin: Doubles) -> tuple[RoadMap, dict[str, str]]:
    odd: dict[str, str] = {}
    points = 0

    def each(name: str, read: Callable[[Any, str], Any], kind: str) -> Iterator[Any]:
        for key, node in _table(_get(root, name, ""), name).items():
            field = f"{name} {key}"
            yield from readable(kind, odd, lambda n, f: read(_table(n, f), f), node, field)

    lanes: dict[int, Lane] = {}
    bounds: list[Doubles] = []
    for lane, marked, count in each("lane_segments", _lane, NO_LANE):
        points += count
        if points > MAX_POINTS:
            raise DataError(f"more than {MAX_POINTS} points", field="lane_segments")
        if len(lane.line):
            lanes.setdefault(lane.name, lane)
            bounds += marked
    areas = list(each("drivable_areas", _outline, NO_AREA))
    crossings = list(each("pedestrian_crossings", _crossing, NO_CROSSING))
    for found, name in ((areas, "drivable_areas"), (lanes, "lane_segments")):
        if not found:
            missing = next(iter(odd.values()), "")
            raise DataError(f"has none that can be read{missing and ': '}{missing}", field=name)
    rings = drivable_rings(areas, field="drivable_areas")
    marks = [(line, MarkType.ROAD_LINE) for line in painted(bounds)]
    marks += [(ring, MarkType.CROSSWALK) for ring in crossings]
    boundary = [line for ring in rings for line in stretches(ring, ~_is_cut(ring))]
    return road_map([_same_way(lane, lanes) for lane in lanes.values()], origin, boundary, marks), odd


def _same_way(lane: Lane, lanes: dict[int, Lane]) -> Lane:
    """A lane with the neighbours of its direction: the format also names the oncoming lane."""
    chord = lane.line[-1] - lane.line[0]
    left, right = (
        [ref for ref in refs if ref in lanes and chord @ (lanes[ref].line[-1] - lanes[ref].line[0]) > 0]
        for refs in (lane.left, lane.right)
    )
    return replace(lane, left=left, right=right)


def _lane(node: dict[str, Any], field: str) -> tuple[Lane, list[Doubles], int]:
    """A lane (without points where it has no line), its painted bounds, and how many points it has."""
    lane_id = _integer(_get(node, "id", field), f"{field}: id")
    kind = _get(node, "lane_type", field)
    if not isinstance(kind, str) or kind not in _LANE_TYPES:
        raise DataError(f"unknown value {str(kind)[:40]!r}", field=f"{field}: lane_type")
    left, right = (_points(node, f"{side}_lane_boundary", field) for side in ("left", "right"))
    center = _points(node, "centerline", field) if node.get("centerline") else np.zeros((0, 2))
    width = np.nan
    if min(len(left), len(right)) >= 2:
        even = matched(left, right, field)
        width = median_width(*even)
        center = center if len(center) else np.mean(even, axis=0)
    flow: dict[str, Any] = {
        name: [_integer(ref, f"{field}: {name}") for ref in _list(node, name, field)]
        for name in ("successors", "predecessors")
    }
    beside: dict[str, Any] = {}
    for side in ("left", "right"):
        ref = _get(node, f"{side}_neighbor_id", field)
        beside[side] = [] if ref is None else [_integer(ref, f"{field}: {side}_neighbor_id")]
    paint = [str(_get(node, f"{side}_lane_mark_type", field)) for side in ("left", "right")]
    marked = [
        line for line, mark in zip((left, right), paint, strict=True) if mark not in {"NONE", "UNKNOWN"}
    ]
    lane = Lane(lane_id, center, _LANE_TYPES[kind], width, **flow, **beside)
    return lane, marked, len(center) + len(left) + len(right)


def _outline(node: dict[str, Any], field: str) -> Doubles:
    outline = _points(node, "area_boundary", field)
    if len(outline) < 3:
        raise DataError(f"an area of {len(outline)} points", field=f"{field}: area_boundary")
    return outline


def _crossing(node: dict[str, Any], field: str) -> Doubles:
    """[P, 2] closed outline; the two long edges come in either direction."""
    first, second = (_points(node, name, field) for name in ("edge1", "edge2"))
    if min(len(first), len(second)) < 2:
        raise DataError("an edge of fewer than 2 points", field=field)
    same, turned = (np.hypot(*(first[[0, -1]] - ends).T).sum() for ends in (second[[0, -1]], second[[-1, 0]]))
    return np.concatenate([first, second[::-1] if same <= turned else second, first[:1]])


def _is_cut(ring: Doubles) -> NDArray[np.bool_]:
    """[P - 1] edges of a ring [P, 2] that bound the map and not the road.

    They lie on a line of constant x or y at a multiple of :data:`TILE`. Traffic goes on beyond them, so that as
    road boundary they would put all of it off the road.
    """
    line = np.round(ring / TILE) * TILE
    on = np.abs(ring - line) <= CUT_TOLERANCE
    return (on[:-1] & on[1:] & (line[:-1] == line[1:])).any(axis=1)


def _table(value: Any, field: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise DataError(f"expected a JSON object, is {type(value).__name__}", field=field)
    return value


def _get(node: dict[str, Any], name: str, field: str) -> Any:
    if name not in node:
        raise DataError("missing", field=f"{field}: {name}" if field else name)
    return node[name]


def _list(node: dict[str, Any], name: str, field: str) -> list[Any]:
    value = _get(node, name, field)
    if not isinstance(value, list):
        raise DataError(f"expected a list, is {type(value).__name__}", field=f"{field}: {name}")
    return value


def _integer(value: Any, field: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not -(2**63) <= value < 2**63:
        raise DataError(f"{str(value)[:40]!r} is not a 64-bit integer", field=field)
    return value


def _points(node: dict[str, Any], name: str, field: str) -> Doubles:
    """[P, 2] the x and y of a list of points."""
    value = _list(node, name, field)
    numbers: list[Any] = [point.get(axis) for point in value if isinstance(point, dict) for axis in "xy"]
    if len(numbers) != 2 * len(value) or not all(type(number) in {int, float} for number in numbers):
        raise DataError("a point without the numbers x and y", field=f"{field}: {name}")
    # Integers beyond the range of a double can't be converted at all.
    if not all(abs(number) <= MAX_COORDINATE for number in numbers):
        raise DataError("a coordinate that is not finite or absurdly large", field=f"{field}: {name}")
    return np.array(numbers, np.float64).reshape(-1, 2)
