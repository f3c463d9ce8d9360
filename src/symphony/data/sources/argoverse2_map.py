"""Maps of Argoverse 2: the ``log_map_archive_<ID>.json`` beside each scenario."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.bounds import MAX_POINTS
from symphony.data.segment import LaneType, MarkType, RoadMap
from symphony.data.sources.base import pairs, read_whole, to_float32
from symphony.data.sources.lines import Doubles, drivable_rings, evenly, polylines, stretches
from symphony.errors import DataError

TILE = 10.0
"""Metres: maps are cut along the axes at whole multiples of it (30 in the files that were looked at)."""

CUT_TOLERANCE = 0.011
"""Metres by which an edge may miss such a line: coordinates are kept to the centimetre."""

MAX_COORDINATE = 1e8
"""Larger magnitudes are no metres of a city."""
MAX_BOUND = 5_000.0
"""Metres of one bound of a lane; scenarios are some 100 m wide."""

_LANE_TYPES = {
    "VEHICLE": LaneType.SURFACE_STREET,
    "BUS": LaneType.SURFACE_STREET,
    "BIKE": LaneType.BIKE_LANE,
}
_UNPAINTED = frozenset({"NONE", "UNKNOWN"})
_SPACING = 2.0


@dataclass(frozen=True)
class Lane:
    """One lane segment in city coordinates; lines [P, 2] in the direction of travel."""

    lane_id: int
    lane_type: LaneType
    left: Doubles
    right: Doubles
    center: Doubles
    painted: tuple[bool, bool]
    successors: tuple[int, ...]
    predecessors: tuple[int, ...]
    left_neighbor: int | None
    right_neighbor: int | None

    @property
    def width(self) -> float:
        """Median distance between the bounds, NaN where one is missing."""
        if min(len(self.left), len(self.right)) < 2:
            return np.nan
        left, right = _matched(self.left, self.right)
        return float(np.median(np.hypot(*(left - right).T)))


@dataclass(frozen=True)
class CityMap:
    """A map in city coordinates (float64), z dropped.

    Attributes:
        lanes: those with a line; a road's lane k is ``lanes[k]``.
        boundary: edge of the drivable area, drivable side on the left, open where the map was cut.
        crossings: closed outlines of the pedestrian crossings.
    """

    lanes: tuple[Lane, ...]
    boundary: tuple[Doubles, ...]
    crossings: tuple[Doubles, ...]


def read_map(path: Path) -> CityMap:
    """Read a map file.

    Raises:
        DataError: it is missing, is not JSON, or an entry can't be used; ``field`` names the entry.
    """
    try:
        return _city_map(_load(path))
    except FileNotFoundError:
        raise DataError("the scenario's map is missing", file=path) from None
    except OSError as error:
        raise DataError(f"can't be read: {error.strerror or error}", file=path) from error
    except DataError as error:
        raise error.at(file=path) from error


def _load(path: Path) -> dict[str, Any]:
    data = read_whole(path)
    if not data.strip():
        raise DataError("the file is empty")
    try:
        root = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DataError(f"not well-formed JSON: {error}") from error
    return _table(root, "the file")


def _city_map(root: dict[str, Any]) -> CityMap:
    found = {
        name: _table(_get(root, name, ""), name)
        for name in ("lane_segments", "drivable_areas", "pedestrian_crossings")
    }
    lanes, points = [], 0
    for key, node in found["lane_segments"].items():
        lanes.append(_lane(key, node))
        points += len(lanes[-1].center) + len(lanes[-1].left) + len(lanes[-1].right)
        if points > MAX_POINTS:
            raise DataError(f"more than {MAX_POINTS} points", field="lane_segments")
    areas = [_outline(key, node) for key, node in found["drivable_areas"].items()]
    if not areas:
        raise DataError("has no drivable areas", field="drivable_areas")
    if not any(len(lane.center) for lane in lanes):
        raise DataError("has no lanes", field="lane_segments")
    rings = drivable_rings(areas, field="drivable_areas")
    return CityMap(
        lanes=tuple(lane for lane in lanes if len(lane.center)),
        boundary=tuple(line for ring in rings for line in stretches(ring, ~_is_cut(ring))),
        crossings=tuple(_crossing(key, node) for key, node in found["pedestrian_crossings"].items()),
    )


def _lane(key: str, node: Any) -> Lane:
    field = f"lane_segments {key}"
    node = _table(node, field)
    lane_id = _integer(_get(node, "id", field), f"{field}: id")
    if str(lane_id) != key:
        raise DataError(f"is {lane_id} under the key {key[:40]!r}", field=f"{field}: id")
    kind = _get(node, "lane_type", field)
    if not isinstance(kind, str) or kind not in _LANE_TYPES:
        raise DataError(f"unknown value {str(kind)[:40]!r}", field=f"{field}: lane_type")
    left, right = (
        _points(_get(node, f"{side}_lane_boundary", field), f"{field}: {side}_lane_boundary")
        for side in ("left", "right")
    )
    center = _points(node.get("centerline") or [], f"{field}: centerline")
    if not len(center) and min(len(left), len(right)) >= 2:
        center = np.mean(_matched(left, right), axis=0)
    links = {name: _references(_get(node, name, field), f"{field}: {name}") for name in _LINKS}
    beside = {name: _get(node, name, field) for name in ("left_neighbor_id", "right_neighbor_id")}
    near = [None if ref is None else _integer(ref, f"{field}: {name}") for name, ref in beside.items()]
    return Lane(
        lane_id=lane_id,
        lane_type=_LANE_TYPES[kind],
        left=left,
        right=right,
        center=center,
        painted=(_is_painted(node, "left", field), _is_painted(node, "right", field)),
        successors=links["successors"],
        predecessors=links["predecessors"],
        left_neighbor=near[0],
        right_neighbor=near[1],
    )


_LINKS = ("successors", "predecessors")


def _is_painted(node: dict[str, Any], side: str, field: str) -> bool:
    name = f"{side}_lane_mark_type"
    mark = _get(node, name, field)
    if not isinstance(mark, str):
        raise DataError(f"{str(mark)[:40]!r} is no text", field=f"{field}: {name}")
    return mark not in _UNPAINTED


def _matched(left: Doubles, right: Doubles) -> tuple[Doubles, Doubles]:
    """Both bounds with as many points, evenly spaced."""
    longest = max(np.hypot(*np.diff(line, axis=0).T).sum() for line in (left, right))
    if not longest <= MAX_BOUND:
        raise DataError(f"a lane of {longest:.4g} m, at most {MAX_BOUND:g}", field="lane_segments")
    count = int(np.ceil(longest / _SPACING)) + 1
    return evenly(left, max(count, 2)), evenly(right, max(count, 2))


def _outline(key: str, node: Any) -> Doubles:
    field = f"drivable_areas {key}"
    outline = _points(_get(_table(node, field), "area_boundary", field), f"{field}: area_boundary")
    if len(outline) < 3:
        raise DataError(f"an area of {len(outline)} points", field=f"{field}: area_boundary")
    return outline


def _crossing(key: str, node: Any) -> Doubles:
    """[P, 2] closed outline; the two long edges come in either direction."""
    field = f"pedestrian_crossings {key}"
    node = _table(node, field)
    first, second = (_points(_get(node, name, field), f"{field}: {name}") for name in ("edge1", "edge2"))
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


def road_map(city: CityMap, origin: Doubles) -> RoadMap:
    """The map relative to an origin [2]; references to lanes beyond its edge are left out."""
    lanes = city.lanes
    index = {lane.lane_id: k for k, lane in enumerate(lanes)}
    flow = [(k, index[ref]) for k, lane in enumerate(lanes) for ref in lane.successors if ref in index]
    flow += [(index[ref], k) for k, lane in enumerate(lanes) for ref in lane.predecessors if ref in index]
    painted = _paint(lanes)
    widths = np.array([lane.width for lane in lanes])
    return RoadMap(
        lanes=polylines([lane.center for lane in lanes], origin),
        lane_id=np.array([lane.lane_id for lane in lanes], np.int64),
        lane_type=np.array([lane.lane_type for lane in lanes], np.uint8),
        speed_limit=np.full(len(lanes), np.nan, np.float32),
        lane_width=to_float32(np.where(widths > 0, widths, np.nan)),
        successors=pairs(flow),
        left_neighbors=_beside(lanes, [lane.left_neighbor for lane in lanes], index),
        right_neighbors=_beside(lanes, [lane.right_neighbor for lane in lanes], index),
        boundary=polylines(city.boundary, origin),
        marks=polylines([*painted, *city.crossings], origin),
        mark_type=np.array(
            [MarkType.ROAD_LINE] * len(painted) + [MarkType.CROSSWALK] * len(city.crossings), np.uint8
        ),
    )


def _beside(
    lanes: Sequence[Lane], neighbors: Sequence[int | None], index: dict[int, int]
) -> NDArray[np.int32]:
    """[E, 2] (lane, neighbour) of the same direction: the format also names the oncoming lane."""
    chord = np.array([lane.center[-1] - lane.center[0] for lane in lanes])
    found = [(k, index[ref]) for k, ref in enumerate(neighbors) if ref is not None and ref in index]
    return pairs([(a, b) for a, b in found if chord[a] @ chord[b] > 0])


def _paint(lanes: Sequence[Lane]) -> list[Doubles]:
    """Painted bounds; one that two lanes share, in either direction, counts once."""
    found: dict[bytes, Doubles] = {}
    for lane in lanes:
        for bound, painted in zip((lane.left, lane.right), lane.painted, strict=True):
            if painted and len(bound) and bound[::-1].tobytes() not in found:
                found.setdefault(bound.tobytes(), bound)
    return list(found.values())


def _table(value: Any, field: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise DataError(f"expected a JSON object, is {type(value).__name__}", field=field)
    return value


def _get(node: dict[str, Any], name: str, field: str) -> Any:
    if name not in node:
        raise DataError("missing", field=f"{field}: {name}" if field else name)
    return node[name]


def _integer(value: Any, field: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not -(2**63) <= value < 2**63:
        raise DataError(f"{str(value)[:40]!r} is not a 64-bit integer", field=field)
    return value


def _references(value: Any, field: str) -> tuple[int, ...]:
    if not isinstance(value, list):
        raise DataError(f"expected a list, is {type(value).__name__}", field=field)
    return tuple(_integer(ref, field) for ref in value)


def _points(value: Any, field: str) -> Doubles:
    """[P, 2] the x and y of a list of points."""
    if not isinstance(value, list):
        raise DataError(f"expected a list of points, is {type(value).__name__}", field=field)
    numbers: list[Any] = [point.get(axis) for point in value if isinstance(point, dict) for axis in "xy"]
    if len(numbers) != 2 * len(value) or not all(type(number) in {int, float} for number in numbers):
        raise DataError("a point without the numbers x and y", field=field)
    # Integers beyond the range of a double can't be converted at all.
    if not all(abs(number) <= MAX_COORDINATE for number in numbers):
        raise DataError("a coordinate that is not finite or absurdly large", field=field)
    return np.array(numbers, np.float64).reshape(-1, 2)
