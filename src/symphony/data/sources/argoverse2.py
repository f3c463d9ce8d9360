"""Reader of the Argoverse 2 motion-forecasting dataset: a scenario in Parquet with its map in JSON beside it.

- ``segment_id`` is the scenario id. The map is ``log_map_archive_<ID>.json`` in the same folder. The format names no
  log: scenarios with equal maps are windows of one drive and form a group, named after the map's SHA-256.
- Steps run from 0 to the last at which any track is present (the test split ends after the history). The time step
  is the span of the timestamps divided by their number less one. ``current_step`` is the last observed step.
- The ego is the recording vehicle, track ``AV``, which gets the id :data:`EGO_ID`. Agents are in order of id. The
  focal track is the agent of interest; focal and scored tracks are for prediction, in that order.
- The format has **no box sizes** (see :data:`NOMINAL_SIZES`) and no heights. Of the ego it has the rear axle (see
  :func:`.base.from_rear_axle`). Coordinates are relative to the ego's first position, rounded to metres.
- A lane's line is the file's ``centerline`` or, where it has none, the middle of its bounds. Neighbours are those of
  the same direction only. Maps are cropped: references to lanes beyond are left out, and the edge of the crop is no
  road boundary. Painted lane bounds and crossings are marks.
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

from symphony.data import segment as schema
from symphony.data.segment import MAX_STEPS, AgentType, Bools, LaneType, MarkType, RoadMap, RunSegment
from symphony.data.sources import base, lines
from symphony.data.sources.base import Doubles, Item, Reader, T, located, motion, read_whole, readable, refuse
from symphony.data.sources.lines import Lane
from symphony.errors import ConfigError, DataError

EGO_ID = -1  # agent id of the recording vehicle, whose track is called AV; all others are numbers from 0

NOMINAL_SIZES: dict[str, tuple[AgentType, tuple[float, float, float]]] = {
    "vehicle": (AgentType.VEHICLE, (4.6, 1.9, 1.7)),
    "bus": (AgentType.VEHICLE, (12.0, 2.6, 3.2)),
    "motorcyclist": (AgentType.VEHICLE, (2.1, 0.8, 1.6)),
    "cyclist": (AgentType.CYCLIST, (1.8, 0.7, 1.7)),
    "pedestrian": (AgentType.PEDESTRIAN, (0.7, 0.7, 1.7)),
    "riderless_bicycle": (AgentType.OTHER, (1.7, 0.5, 1.1)),
    "construction": (AgentType.OTHER, (0.6, 0.6, 1.0)),
    **dict.fromkeys(("static", "background", "unknown"), (AgentType.OTHER, (0.8, 0.8, 1.0))),
}
"""Object type of the format -> agent type and (length, width, height) in metres."""

NO_LANE = "a lane left out that can't be read"
NO_AREA = "a drivable area left out that can't be read"
NO_CROSSING = "a crossing left out that can't be read"
NO_TYPE = "an agent of a type that is not known"

MAX_ROWS = 500_000  # states of a scenario; the dataset's have some thousand
MAX_TEXT = 64  # characters of an id
MAX_BYTES = 256 << 20  # bytes of the columns, decompressed
TILE = 10.0
"""Metres: maps are cut along the axes at whole multiples of it (30 in the files examined)."""
CUT_TOLERANCE = 0.011  # metres by which an edge may miss such a line: coordinates are kept to the centimetre

_TEXTS = ("scenario_id", "focal_track_id", "track_id", "object_type")
_STATE = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
_COLUMNS = {
    **dict.fromkeys(_TEXTS, "string"),
    **dict.fromkeys(("start_timestamp", "end_timestamp", *_STATE), "float64"),
    **dict.fromkeys(("num_timestamps", "object_category", "timestep"), "int64"),
    "observed": "bool",
}
_SCORED, _FOCAL = 2, 3
_LANE_TYPES = dict.fromkeys(("VEHICLE", "BUS"), LaneType.SURFACE_STREET) | {"BIKE": LaneType.BIKE_LANE}

Columns = dict[str, NDArray[Any]]


class Argoverse2Reader(Reader):
    """Reads Argoverse 2 motion-forecasting scenarios.

    Raises a :class:`ConfigError` where pyarrow is not installed.
    """

    name = "argoverse2"
    patterns = ("scenario_*.parquet",)

    def __init__(self) -> None:
        if importlib.util.find_spec("pyarrow") is None:
            extra = "pip install 'symphony-traffic[argoverse2]'"
            raise ConfigError(f"pyarrow is not installed; it comes with the extra: {extra}")

    def companions(self, path: Path) -> tuple[Path, ...]:
        """Return the map."""
        return (map_path(path),)

    def _read(self, path: Path) -> Iterator[Item]:
        columns = read_columns(read_whole(path))
        name = _constant(columns, "scenario_id")
        with located(segment=name):
            if path.name != f"scenario_{name}.parquet":
                # The map is found by the file's name: it must not be another scenario's.
                raise DataError(f"the file must be named scenario_{name}.parquet", field="scenario_id")
            yield _segment(columns, name, path)


def map_path(path: Path) -> Path:
    """Return where the map of a scenario file is."""
    return path.with_name(f"log_map_archive_{path.stem.removeprefix('scenario_')}.json")


def read_columns(data: bytes) -> Columns:
    """Return the columns the reader needs, as arrays [N].

    A :class:`DataError` says if the file is not Parquet or too large, or a column is missing, odd or has gaps.
    """
    import pyarrow as pa  # noqa: PLC0415 - an optional extra
    from pyarrow import parquet  # noqa: PLC0415

    try:
        head = parquet.read_schema(pa.BufferReader(data))
        for name, kind in _COLUMNS.items():
            refuse(name not in head.names, "the column is missing", name)
            found = head.field(name).type
            refuse(pa.types.is_nested(found), f"expected {kind}, is {found}", name)
        # Text stays a dictionary: a long one that all rows share must not become a copy for each.
        source = pa.BufferReader(data)
        file = parquet.ParquetFile(source, read_dictionary=list(_TEXTS), page_checksum_verification=True)
        _check_size(file)
        table = file.read(columns=list(_COLUMNS), use_threads=False)
        table.validate(full=True)
        return {name: _column(pa, table[name], name) for name in _COLUMNS}
    # Its decoders raise much besides their own exceptions (which include ValueError and MemoryError).
    except (pa.ArrowException, OSError, ValueError, MemoryError, OverflowError) as error:
        raise DataError(f"not a readable Parquet file: {str(error)[:200]}") from error


def _check_size(file: Any) -> None:
    """Refuse what would take gigabytes once it is read."""
    metadata = file.metadata
    refuse(metadata.num_rows > MAX_ROWS, f"{metadata.num_rows} rows, at most {MAX_ROWS} are read")
    size = 0
    for k in range(metadata.num_row_groups):
        # Opening the columns raises where their descriptions are damaged; asking for those ends the process.
        next(file.iter_batches(1, [k], list(_COLUMNS)), None)
        group = metadata.row_group(k)
        paths = [metadata.schema.column(j).path for j in range(group.num_columns)]
        chunks = [group.column(j) for j, path in enumerate(paths) if path in _COLUMNS]
        size += sum(chunk.total_uncompressed_size for chunk in chunks)
    refuse(size > MAX_BYTES, f"{size} bytes in its columns, at most {MAX_BYTES} are read")


def _column(pa: Any, column: Any, name: str) -> NDArray[Any]:
    missing = column.null_count
    refuse(missing or not len(column), f"{missing} of {len(column)} values are missing", name)
    try:
        # What Arrow would convert, such as a text to a number or a number to a text, is another column.
        kind, of = getattr(column.type, "value_type", column.type), pa.types
        others = {"string": of.is_string(kind) or of.is_large_string(kind), "bool": of.is_boolean(kind)}
        fits = others.get(_COLUMNS[name], of.is_integer(kind) or of.is_floating(kind))
        refuse(not fits, f"expected {_COLUMNS[name]}, is {column.type}", name)
        if name not in _TEXTS:
            return column.cast(_COLUMNS[name]).to_numpy()
        coded = column if pa.types.is_dictionary(column.type) else column.dictionary_encode()
        coded = coded.unify_dictionaries().combine_chunks()
        coded = coded.chunk(0) if isinstance(coded, pa.ChunkedArray) else coded
        values = coded.dictionary.cast("string").to_pylist()
    except pa.ArrowException as error:
        raise DataError(f"expected {_COLUMNS[name]}, is {column.type}", field=name) from error
    refuse(None in values, "values are missing", name)
    refuse(max(map(len, values)) > MAX_TEXT, f"a text of more than {MAX_TEXT} characters", name)
    return np.array(values, np.str_)[coded.indices.to_numpy()]


def _constant(columns: Columns, name: str) -> Any:
    """Return the value all rows share."""
    values = columns[name]
    refuse((values != values[0]).any(), "differs between the rows", name)
    return values[0].item()


def _segment(columns: Columns, name: str, path: Path) -> RunSegment:
    names, first, inverse = np.unique(columns["track_id"], return_index=True, return_inverse=True)
    ids = np.array([_agent_id(name) for name in names.tolist()], np.int64)
    order = np.argsort(ids, kind="stable")
    row = np.argsort(order)[inverse]
    for field in ("object_type", "object_category"):
        mixed = columns["track_id"][columns[field] != columns[field][first][inverse]]
        refuse(len(mixed), f"track {mixed[:1]} has more than one", field)
    step, count = columns["timestep"], _constant(columns, "num_timestamps")
    refuse(not 2 <= count <= MAX_STEPS, f"{count} steps, expected 2 … {MAX_STEPS}", "num_timestamps")
    refuse(step.min() < 0 or step.max() >= count, f"a step that is not one of the {count}", "timestep")
    steps = int(step.max()) + 1
    schema.check_counts(len(names), steps, "track_id")
    states, counts = np.unique(row * steps + step, return_counts=True)
    twice = [f"{names[order][k // steps]} at step {k % steps}" for k in states[counts > 1].tolist()]
    refuse(twice, f"two states of track {twice[:1]}", "timestep")
    refuse(not columns["observed"].any(), "no step is observed", "observed")
    refuse(ids[order[0]] != EGO_ID, "has no track 'AV', the recording vehicle", "track_id")
    focal = np.flatnonzero(names[order] == _constant(columns, "focal_track_id"))
    refuse(not len(focal), "names no track of the file", "focal_track_id")
    state, valid = np.zeros((len(names), steps, len(_STATE))), np.zeros((len(names), steps), np.bool_)
    state[row, step], valid[row, step] = np.stack([columns[name] for name in _STATE], axis=-1), True
    dt, origin = _time_step(columns), np.round(state[0, np.argmax(valid[0]), :2])
    state[0] = base.from_rear_axle(state[0], range(len(_STATE)), valid[0], dt)
    kinds = columns["object_type"][first][order].tolist()
    types, sizes = zip(*(NOMINAL_SIZES.get(kind, NOMINAL_SIZES["unknown"]) for kind in kinds), strict=True)
    unknown = [f"{kind[:40]!r}" for kind in kinds if kind not in NOMINAL_SIZES]
    category = columns["object_category"][first][order]
    predict = [np.flatnonzero(category == which) for which in (_FOCAL, _SCORED)]
    road, odd, group = _read_map(map_path(path), origin)
    return RunSegment(
        segment_id=name,
        source=Argoverse2Reader.name,
        dt=dt,
        ego=0,
        agent_id=ids[order],
        agent_type=np.array(types, np.uint8),
        size=np.array(sizes, np.float32),
        **motion(state[..., :2] - origin, state[..., 2], state[..., 3:5], valid),
        origin=np.array([*origin, 0.0]),
        road=road,
        **lines.lights({}, steps, origin),
        current_step=int(step[columns["observed"]].max()),
        interest=focal.astype(np.int32),
        predict=np.concatenate(predict).astype(np.int32),
        file=path.name,
        group=group,
        odd=odd | ({NO_TYPE: unknown[0]} if unknown else {}),
    )


def _agent_id(name: str) -> int:
    number = name.isascii() and name.isdecimal() and len(name) <= 18
    refuse(not number and name != "AV", f"{name[:40]!r} is neither 'AV' nor a number", "track_id")
    return int(name) if number else EGO_ID


def _time_step(columns: Columns) -> float:
    """Return the seconds per step to the millisecond; the format's times are nanoseconds."""
    start, end = _constant(columns, "start_timestamp"), _constant(columns, "end_timestamp")
    dt = (end - start) * 1e-9 / (_constant(columns, "num_timestamps") - 1)
    even = dt > 0 and abs(round(dt, 3) - dt) <= 0.01 * dt
    refuse(not even, f"{dt:g} s per step: not a positive number of milliseconds", "end_timestamp")
    return round(dt, 3)


def _read_map(path: Path, origin: Doubles) -> tuple[RoadMap, dict[str, str], str]:
    """Return the map relative to an origin [2], what was left out, and the start of its file's SHA-256."""
    refuse(not path.exists(), "the scenario's map is missing", file=path)
    with located(file=path):
        data = read_whole(path)
        try:
            root = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise DataError(f"not well-formed JSON: {error}") from error
        return *_road(root, origin), hashlib.sha256(data).hexdigest()[:16]


def _road(root: Any, origin: Doubles) -> tuple[RoadMap, dict[str, str]]:
    odd: dict[str, str] = {}

    def each(name: str, read: Callable[[Any], T], kind: str) -> Iterator[T]:
        with located(field=name):
            nodes = root[name].items()
        for key, node in nodes:
            yield from readable(kind, odd, read, node, field=f"{name} {key}")

    lanes: dict[int, Lane] = {}
    bounds: list[Doubles] = []
    points = 0
    for lane, marked in each("lane_segments", _lane, NO_LANE):
        points += len(lane.line)
        refuse(points > schema.MAX_POINTS, f"more than {schema.MAX_POINTS} points", "lane_segments")
        if len(lane.line):
            refuse(lane.name in lanes, "two of one id", f"lane_segments {lane.name}")
            lanes[lane.name] = lane
            bounds += marked
    areas = list(each("drivable_areas", _outline, NO_AREA))
    crossings = list(each("pedestrian_crossings", _crossing, NO_CROSSING))
    for found, name in ((areas, "drivable_areas"), (lanes, "lane_segments")):
        refuse(not found, f"has none that can be read {list(odd.values())[:1]}", name)
    rings = lines.drivable_rings(areas, field="drivable_areas")
    marks = lines.painted(bounds) + [(ring, MarkType.CROSSWALK) for ring in crossings]
    boundary = [line for ring in rings for line in lines.stretches(ring, ~_is_cut(ring))]
    return lines.road_map([_same_way(lane, lanes) for lane in lanes.values()], origin, boundary, marks), odd


def _same_way(lane: Lane, lanes: dict[int, Lane]) -> Lane:
    """Return a lane with the neighbours of its direction: the format also names the oncoming lane."""
    chord = lane.line[-1] - lane.line[0]
    left, right = (
        [ref for ref in refs if ref in lanes and chord @ (lanes[ref].line[-1] - lanes[ref].line[0]) > 0]
        for refs in (lane.left, lane.right)
    )
    return replace(lane, left=left, right=right)


def _lane(node: dict[str, Any]) -> tuple[Lane, list[Doubles]]:
    """Return a lane (without points where it has no line) and its painted bounds."""
    left, right = (_points(node[f"{side}_lane_boundary"]) for side in ("left", "right"))
    center, width = _points(node.get("centerline") or []), np.nan
    if min(len(left), len(right)) >= 2:
        even = lines.matched(left, right, "lane_segments")
        width = lines.median_width(*even)
        center = center if len(center) else np.mean(even, axis=0)
    beside = [[node[f"{side}_neighbor_id"]] for side in ("left", "right")]
    refs = [node["successors"], node["predecessors"], *(found if found != [None] else [] for found in beside)]
    links = [[_id(ref) for ref in found] for found in refs]
    marks = [node[f"{side}_lane_mark_type"] not in ("NONE", "UNKNOWN") for side in ("left", "right")]
    marked = [line for line, mark in zip((left, right), marks, strict=True) if mark]
    return Lane(_id(node["id"]), center, _LANE_TYPES[node["lane_type"]], width, np.nan, *links), marked


def _outline(node: dict[str, Any]) -> Doubles:
    outline = _points(node["area_boundary"])
    refuse(len(outline) < 3, f"an area of {len(outline)} points")
    return outline


def _crossing(node: dict[str, Any]) -> Doubles:
    """Return [P, 2] closed outline; the two long edges come in either direction."""
    first, second = (_points(node[name]) for name in ("edge1", "edge2"))
    refuse(min(len(first), len(second)) < 2, "an edge of fewer than 2 points")
    same, turned = (np.hypot(*(first[[0, -1]] - ends).T).sum() for ends in (second[[0, -1]], second[[-1, 0]]))
    return np.concatenate([first, second[::-1] if same <= turned else second, first[:1]])


def _is_cut(ring: Doubles) -> Bools:
    """Return [P - 1] which edges of a ring [P, 2] bound the map and not the road.

    They lie on a line of constant x or y at a multiple of :data:`TILE`. Traffic goes on beyond them, so that as
    road boundary they would put all of it off the road.
    """
    line = np.round(ring / TILE) * TILE
    on = np.abs(ring - line) <= CUT_TOLERANCE
    return (on[:-1] & on[1:] & (line[:-1] == line[1:])).any(axis=1)


def _id(value: Any) -> int:
    refuse(type(value) is not int, f"{str(value)[:40]!r} is not an id")
    return int(np.int64(value))  # raises where it has more than 64 bits


def _points(points: list[Any]) -> Doubles:
    """Return [P, 2] the x and y of a list of points."""
    rows = [(point["x"], point["y"]) for point in points]
    wrong = type(points) is not list or any(type(n) not in {int, float} for row in rows for n in row)
    refuse(wrong, "not a list of points with the numbers x and y")
    found = np.array(rows, np.float64).reshape(len(rows), 2)
    return base.finite(found)
