"""Maps of ScenarioNet scenarios: named features with a polyline, a polygon or a position."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.data.resample import wrap
from symphony.data.segment import LaneType, MarkType, RoadMap
from symphony.data.sources.base import pairs, to_float32
from symphony.data.sources.lines import Doubles, cut_ends, drivable_rings, opened, polylines
from symphony.data.sources.safe_pickle import Array
from symphony.errors import DataError

MAX_COORDINATE = 1e8
"""Larger magnitudes are no metres of a city."""
MEETS = 0.5
"""Metres within which a lane's end meets another's start."""
TURN = np.deg2rad(60)
"""Largest angle between the two there."""
HALF_WIDTH = 1.75
"""Metres on either side of a centre line that are drivable where the map has no area."""
MAX_WIDTH = 20.0
"""Metres on either side of a line in which the edge of its area is looked for."""
BESIDE = (2.0, 5.5)
"""Metres between the centre lines of neighbours."""

_LANES = {
    "LANE_SURFACE_STREET": LaneType.SURFACE_STREET,
    "LANE_SURFACE_UNSTRUCTURE": LaneType.SURFACE_STREET,
    "LANE_UNKNOWN": LaneType.UNDEFINED,
    "LANE_FREEWAY": LaneType.FREEWAY,
    "LANE_BIKE_LANE": LaneType.BIKE_LANE,
}
_AREAS = {
    "CROSSWALK": MarkType.CROSSWALK,
    "SPEED_BUMP": MarkType.SPEED_BUMP,
    "DRIVEWAY": MarkType.DRIVEWAY,
}
_NO_LIMITS = frozenset({"nuscenes", "av2"})
"""Datasets without speed limits: ScenarioNet writes 100 km/h for connectors, and 85 mph for all lanes."""


@dataclass(frozen=True)
class Lane:
    """One lane; its line [P, 2 or 3], its outline [P, 2] where there is one, what the source says about it."""

    name: str
    line: Doubles
    area: Doubles | None
    kind: LaneType
    speed_limit: float
    exits: tuple[str, ...] | None
    left: tuple[str, ...]
    right: tuple[str, ...]


@dataclass(frozen=True)
class Features:
    """The map in the source's coordinates.

    Attributes:
        lanes: those with a line; a road's lane k is ``lanes[k]``.
        edges: road edges, drivable side on the left.
        outlines: closed rings around the drivable areas, in any direction.
        marks: lines and their types.
    """

    lanes: tuple[Lane, ...]
    edges: tuple[Doubles, ...]
    outlines: tuple[Doubles, ...]
    marks: tuple[tuple[Doubles, MarkType], ...]


def read_features(features: Mapping[Any, Any], dataset: str) -> Features:
    """Sort the features of a scenario; those of unknown types are left out.

    Raises:
        DataError: there are no lanes, or a feature can't be read; names it.
    """
    lanes: list[Lane] = []
    edges: list[Doubles] = []
    outlines: list[Doubles] = []
    pieces: list[Doubles] = []
    marks: list[tuple[Doubles, MarkType]] = []
    for key, value in features.items():
        field = f"map_features {str(key)[:60]}"
        node = mapping(value, field)
        kind = str(node.get("type"))
        line = points(node.get("polyline", ()), f"{field}: polyline")
        if dataset == "nuscenes":
            line = line[:, :2]  # the third number is a heading
        area = points(node.get("polygon", ()), f"{field}: polygon")
        if kind in _LANES and len(line):
            lanes.append(_lane(str(key), node, line, area, dataset))
        elif kind.startswith("ROAD_EDGE") and len(line) > 1:
            edges.append(line)
        elif kind in _AREAS and len(area if len(area) else line) > 2:
            ring = area if len(area) else line
            marks.append((np.concatenate([ring, ring[:1]]), _AREAS[kind]))
        elif kind == "STOP_SIGN":
            place = points([node.get("position", ())], f"{field}: position")
            marks.append((place, MarkType.STOP_SIGN))
        elif str(key).startswith("boundary_") and len(line) > 1:
            closed = len(line) > 3 and bool((np.abs(line[0] - line[-1]) < 0.01).all())
            (outlines if closed else pieces).append(line[:, :2])
        elif kind.startswith("ROAD_LINE") and len(line) > 1:
            marks.append((line, MarkType.ROAD_LINE))
    if not lanes:
        raise DataError("has no lanes", field="map_features")
    if pieces:
        # Long rings were cut up (Argoverse 2): without them, the islands that are whole would be all the road.
        marks += [(line, MarkType.ROAD_LINE) for line in outlines + pieces]
        outlines = []
    return Features(tuple(lanes), tuple(edges), tuple(outlines), tuple(marks))


def _lane(name: str, node: Mapping[Any, Any], line: Doubles, area: Doubles, dataset: str) -> Lane:
    limit = node.get("speed_limit_kmh")
    known = isinstance(limit, int | float) and 0 < limit < 300 and dataset not in _NO_LIMITS
    exits = node.get("exit_lanes")
    # Of nuPlan, ScenarioNet names all lanes of a road, in an order that need not be theirs.
    beside = dataset != "nuplan"
    return Lane(
        name=name,
        line=line,
        area=area[:, :2] if len(area) > 2 else None,
        kind=_LANES[str(node["type"])],
        speed_limit=float(limit) / 3.6 if known and limit is not None else np.nan,
        exits=None if exits is None else _references(exits),
        left=_references(node.get("left_neighbor", ())) if beside else (),
        right=_references(node.get("right_neighbor", ())) if beside else (),
    )


def _references(values: Any) -> tuple[str, ...]:
    if isinstance(values, Array):
        values = values.value.ravel().tolist()
    if not isinstance(values, list | tuple):
        return ()
    return tuple(str(v.get("feature_id")) if isinstance(v, dict) else str(v) for v in values)


def road_map(features: Features, origin: Doubles) -> RoadMap:
    """The map relative to an origin [3].

    Raises:
        DataError: no area can be formed.
    """
    lanes = features.lanes
    index = {lane.name: k for k, lane in enumerate(lanes)}
    links = successors(lanes, index)
    left, right = neighbors(lanes, index)
    widths = np.array([_width(lane) for lane in lanes])
    edges = features.edges or opened(_rings(features), _cuts(lanes, links))
    return RoadMap(
        lanes=polylines([lane.line - origin[: lane.line.shape[1]] for lane in lanes], np.zeros(1)),
        lane_id=np.arange(len(lanes), dtype=np.int64),
        lane_type=np.array([lane.kind for lane in lanes], np.uint8),
        speed_limit=to_float32(np.array([lane.speed_limit for lane in lanes])),
        lane_width=to_float32(np.where(widths > 0, widths, np.nan)),
        successors=links,
        left_neighbors=left,
        right_neighbors=right,
        boundary=polylines([edge - origin[: edge.shape[1]] for edge in edges], np.zeros(1)),
        marks=polylines([line - origin[: line.shape[1]] for line, _ in features.marks], np.zeros(1)),
        mark_type=np.array([kind for _, kind in features.marks], np.uint8),
    )


def successors(lanes: tuple[Lane, ...], index: Mapping[str, int]) -> NDArray[np.int32]:
    """[E, 2] lane indices (from, to): as the source says or, where it says nothing, where an end meets a start.

    A lane that begins within :data:`MEETS` of another's end, and turns off by less than :data:`TURN`, succeeds it.
    """
    if any(lane.exits is not None for lane in lanes):
        found = [(k, index[ref]) for k, lane in enumerate(lanes) for ref in lane.exits or () if ref in index]
        return pairs([(a, b) for a, b in found if a != b])
    starts, ends = (shapely.points(np.array([lane.line[row, :2] for lane in lanes])) for row in (0, -1))
    before, after = shapely.STRtree(starts).query(ends, predicate="dwithin", distance=MEETS)
    out, into = (np.array([_course(lane.line, row) for lane in lanes]) for row in (-1, 0))
    good = (np.abs(wrap(into[after] - out[before])) < TURN) & (before != after)
    return pairs(list(zip(before[good].tolist(), after[good].tolist(), strict=True)))


def _course(line: Doubles, row: int) -> float:
    """Direction of the first or last piece; NaN, which is near no angle, of a single point."""
    step = np.diff(line[:, :2], axis=0)
    step = step[np.hypot(*step.T) > 1e-6]
    return float(np.arctan2(*step[row][::-1])) if len(step) else np.nan


def neighbors(
    lanes: tuple[Lane, ...], index: Mapping[str, int]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Left and right neighbours [E, 2]: as the source says or, where it says nothing, lanes that lie side by side.

    Of two such lanes the areas touch, and at the middle of the shorter one their lines are :data:`BESIDE` apart and
    run the same way.
    """
    if any(lane.left or lane.right for lane in lanes):
        left, right = (
            [(k, index[ref]) for k, lane in enumerate(lanes) for ref in getattr(lane, side) if ref in index]
            for side in ("left", "right")
        )
        return pairs(left), pairs(right)
    with_area = [k for k, lane in enumerate(lanes) if lane.area is not None and len(lane.line) > 1]
    areas = shapely.make_valid(np.array([shapely.Polygon(lanes[k].area) for k in with_area]))
    one, two = shapely.STRtree(areas).query(areas, predicate="dwithin", distance=0.2)
    found: list[tuple[int, int]] = []
    for a, b in zip(one.tolist(), two.tolist(), strict=True):
        if a < b and (side := _side(lanes[with_area[a]].line, lanes[with_area[b]].line)):
            found.append((with_area[a], with_area[b]) if side > 0 else (with_area[b], with_area[a]))
    return pairs(found), pairs([(b, a) for a, b in found])


def _side(one: Doubles, two: Doubles) -> int:
    """1 if the second line runs along on the left of the first, -1 on its right, else 0."""
    lines = [shapely.LineString(line[:, :2]) for line in (one, two)]
    short, long = sorted(lines, key=lambda line: line.length)
    if short.length < 1:
        return 0
    half = short.length / 2
    spot = short.interpolate(half)
    there = long.project(spot)
    if not BESIDE[0] <= spot.distance(long) <= BESIDE[1] or not 0.5 < there < long.length - 0.5:
        return 0
    pieces = [
        np.array([line.interpolate(at + d).coords[0] for d in (-0.5, 0.5)])
        for line, at in ((short, half), (long, there))
    ]
    along, onward = (piece[1] - piece[0] for piece in pieces)
    across = pieces[1].mean(axis=0) - pieces[0].mean(axis=0)
    if along @ onward < np.cos(TURN / 2) * np.hypot(*along) * np.hypot(*onward):
        return 0
    turn = 1 if along[0] * across[1] - along[1] * across[0] > 0 else -1
    return turn if short is lines[0] else -turn


def _width(lane: Lane) -> float:
    """Of the area across the middle of the line; NaN where there is no area there."""
    if lane.area is None or len(lane.line) < 2:
        return np.nan
    line = shapely.LineString(lane.line[:, :2])
    half = line.length / 2
    if half < 0.1:
        return np.nan
    before, middle, after = (np.array(line.interpolate(half + d).coords[0]) for d in (-0.1, 0, 0.1))
    along = (after - before) / np.hypot(*(after - before))
    aside = MAX_WIDTH * np.array([-along[1], along[0]])
    area = shapely.make_valid(shapely.Polygon(lane.area))
    parts = shapely.get_parts(area.intersection(shapely.LineString([middle - aside, middle + aside])))
    here = [part.length for part in parts if part.distance(shapely.Point(middle)) < 0.1]
    return float(max(here, default=np.nan))


def _rings(features: Features) -> tuple[Doubles, ...]:
    """Around the outlined areas, where one inside another is a hole, and those of lanes.

    Without outlines, lanes that have no area are :data:`HALF_WIDTH` wide on either side.
    """
    shapes = [lane.area for lane in features.lanes if lane.area is not None]
    try:
        area = shapely.Polygon()
        for outline in features.outlines:
            area = area.symmetric_difference(shapely.make_valid(shapely.Polygon(outline)))
        if not features.outlines:
            bare = [lane.line[:, :2] for lane in features.lanes if lane.area is None and len(lane.line) > 1]
            area = shapely.union_all([shapely.LineString(line).buffer(HALF_WIDTH) for line in bare])
    except shapely.errors.ShapelyError as error:
        raise DataError(f"the union of the areas can't be formed: {error}", field="map_features") from error
    return drivable_rings([*shapes, *_holes_apart(area)], field="map_features")


def _holes_apart(area: Any) -> Iterable[Any]:
    """Parts of an area, holes kept."""
    return [part for part in shapely.get_parts(area) if part.geom_type == "Polygon"]


def _cuts(lanes: tuple[Lane, ...], links: NDArray[np.int32]) -> Doubles:
    """Across the ends where no lane goes on, as wide as the lane and a little more."""
    bounds = []
    for lane in lanes:
        half = _width(lane) / 2 if _width(lane) > 0 else HALF_WIDTH
        sides = []
        for row in (0, -1):
            course = _course(lane.line, row)
            aside = (min(half, 4.0) + 1.0) * np.array([-np.sin(course), np.cos(course)])
            sides.append((lane.line[row, :2] + aside, lane.line[row, :2] - aside))
        bounds.append((np.array([sides[0][0], sides[1][0]]), np.array([sides[0][1], sides[1][1]])))
    cuts = cut_ends(bounds, links)
    return cuts[np.isfinite(cuts).all(axis=(1, 2))]


def mapping(value: Any, field: str) -> Mapping[Any, Any]:
    """A dictionary.

    Raises:
        DataError: it is none.
    """
    if not isinstance(value, dict):
        raise DataError(f"expected a dictionary, is {type(value).__name__}", field=field)
    return value


def points(value: Any, field: str) -> Doubles:
    """[P, 2 or 3] points, however they are written.

    Raises:
        DataError: they are no points, or not finite.
    """
    if isinstance(value, Array):
        value = value.value
    elif isinstance(value, list | tuple):
        rows = [row.value.tolist() if isinstance(row, Array) else row for row in value]
        # Looked at one by one: lists in lists may be larger than any memory.
        for row in rows:
            if not isinstance(row, list | tuple) or len(row) not in {2, 3}:
                raise DataError("not a list of points", field=field)
            if not all(isinstance(number, int | float) for number in row):
                raise DataError("a point that is not of numbers", field=field)
        if len({len(row) for row in rows}) > 1:
            raise DataError("points of two and of three numbers", field=field)
        try:
            value = np.array(rows, np.float64)
        except OverflowError as error:
            raise DataError("a number out of range", field=field) from error
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise DataError(f"expected points, is {type(value).__name__}", field=field)
    if value.size == 0:
        return np.zeros((0, 2))
    if value.ndim != 2 or value.shape[1] not in {2, 3}:
        raise DataError(f"shape {value.shape}, expected [points, 2 or 3]", field=field)
    value = value.astype(np.float64)
    if not (np.abs(value) <= MAX_COORDINATE).all():
        raise DataError("a coordinate that is not finite or absurdly large", field=field)
    return value
