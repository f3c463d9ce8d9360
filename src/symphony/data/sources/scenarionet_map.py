"""Maps of ScenarioNet scenarios: named features with a polyline, a polygon or a position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from symphony.data.resample import wrap
from symphony.data.segment import LaneType, MarkType, RoadMap
from symphony.data.sources.base import pairs
from symphony.data.sources.lines import (
    Doubles,
    Lane,
    Links,
    cut_ends,
    drivable_rings,
    named,
    opened,
    road_map,
)
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


def read_map(features: Mapping[Any, Any], dataset: str, origin: Doubles) -> tuple[RoadMap, list[Lane]]:
    """The map relative to an origin [3], and its lanes in the source's coordinates.

    Features of unknown types are left out.

    Raises:
        DataError: there are no lanes, or a feature can't be read; names it.
    """
    lanes: list[Lane] = []
    areas: list[Doubles | None] = []
    edges: list[Doubles] = []
    outlines: list[Doubles] = []
    pieces: list[Doubles] = []
    marks: list[tuple[Doubles, MarkType]] = []
    told = False
    for key, value in features.items():
        field = f"map_features {str(key)[:60]}"
        node = mapping(value, field)
        kind = str(node.get("type"))
        line = points(node.get("polyline", ()), f"{field}: polyline")
        if dataset == "nuscenes":
            line = line[:, :2]  # the third number is a heading
        area = points(node.get("polygon", ()), f"{field}: polygon")
        if kind in _LANES and len(line):
            told |= node.get("exit_lanes") is not None
            areas.append(area[:, :2] if len(area) > 2 else None)
            lanes.append(_lane(str(key), node, line, areas[-1], dataset))
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
    links = pairs([(a, b) for a, b in named(lanes, "successors") if a != b]) if told else successors(lanes)
    # As the source says or, where it says nothing, lanes that lie side by side.
    given = any(lane.left or lane.right for lane in lanes)
    beside = (pairs(named(lanes, "left")), pairs(named(lanes, "right"))) if given else neighbors(lanes, areas)
    edges = edges or list(opened(_rings(lanes, areas, outlines), _cuts(lanes, links)))
    numbers = range(len(lanes))
    return road_map(lanes, origin, edges, marks, links=links, beside=beside, ids=numbers), lanes


def _lane(name: str, node: Mapping[Any, Any], line: Doubles, area: Doubles | None, dataset: str) -> Lane:
    limit = node.get("speed_limit_kmh")
    known = isinstance(limit, int | float) and 0 < limit < 300 and dataset not in _NO_LIMITS
    # Of nuPlan, ScenarioNet names all lanes of a road, in an order that need not be theirs.
    left, right = (_references(node.get(f"{s}_neighbor", ())) for s in ("left", "right"))
    return Lane(
        name=name,
        line=line,
        kind=_LANES[str(node["type"])],
        width=_width(line, area),
        speed_limit=float(limit) / 3.6 if known and limit is not None else np.nan,
        successors=_references(node.get("exit_lanes")),
        left=left if dataset != "nuplan" else (),
        right=right if dataset != "nuplan" else (),
    )


def _references(values: Any) -> tuple[str, ...]:
    if isinstance(values, Array):
        values = values.value.ravel().tolist()
    if not isinstance(values, list | tuple):
        return ()
    return tuple(str(v.get("feature_id")) if isinstance(v, dict) else str(v) for v in values)


def successors(lanes: Sequence[Lane]) -> Links:
    """Which lanes go on where: one that begins within :data:`MEETS` of another's end, and turns off by less than
    :data:`TURN`, succeeds it."""
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


def neighbors(lanes: Sequence[Lane], areas: Sequence[Doubles | None]) -> tuple[Links, Links]:
    """Left and right neighbours: lanes that lie side by side.

    Of two such lanes the areas touch, and at the middle of the shorter one their lines are :data:`BESIDE` apart and
    run the same way.
    """
    flat = [k for k, area in enumerate(areas) if area is not None and len(lanes[k].line) > 1]
    shapes = shapely.make_valid(np.array([shapely.Polygon(areas[k]) for k in flat]))
    one, two = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=0.2)
    found: list[tuple[int, int]] = []
    for a, b in ((flat[i], flat[j]) for i, j in zip(one.tolist(), two.tolist(), strict=True) if i < j):
        side = _side(lanes[a].line, lanes[b].line)
        if side:
            found.append((a, b) if side > 0 else (b, a))
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


def _width(line: Doubles, outline: Doubles | None) -> float:
    """Metres of the area across the middle of the line; NaN where there is no area there."""
    if outline is None or len(line) < 2:
        return np.nan
    shape = shapely.LineString(line[:, :2])
    half = shape.length / 2
    if half < 0.1:
        return np.nan
    before, middle, after = (np.array(shape.interpolate(half + d).coords[0]) for d in (-0.1, 0, 0.1))
    along = (after - before) / np.hypot(*(after - before))
    aside = MAX_WIDTH * np.array([-along[1], along[0]])
    area = shapely.make_valid(shapely.Polygon(outline))
    parts = shapely.get_parts(area.intersection(shapely.LineString([middle - aside, middle + aside])))
    here = [part.length for part in parts if part.distance(shapely.Point(middle)) < 0.1]
    return float(max(here, default=np.nan))


def _rings(
    lanes: Sequence[Lane], areas: Sequence[Doubles | None], outlines: Sequence[Doubles]
) -> tuple[Doubles, ...]:
    """Around the outlined areas, where one inside another is a hole, and those of lanes.

    Without outlines, lanes that have no area are :data:`HALF_WIDTH` wide on either side.
    """
    try:
        area = shapely.Polygon()
        for outline in outlines:
            area = area.symmetric_difference(shapely.make_valid(shapely.Polygon(outline)))
        if not outlines:
            bare = [lane.line[:, :2] for lane, own in zip(lanes, areas, strict=True) if own is None]
            strips = [shapely.LineString(line).buffer(HALF_WIDTH) for line in bare if len(line) > 1]
            area = shapely.union_all(strips)
    except shapely.errors.ShapelyError as error:
        raise DataError(f"the union of the areas can't be formed: {error}", field="map_features") from error
    parts = [part for part in shapely.get_parts(area) if part.geom_type == "Polygon"]
    return drivable_rings([*(own for own in areas if own is not None), *parts], field="map_features")


def _cuts(lanes: Sequence[Lane], links: Links) -> Doubles:
    """Across the ends where no lane goes on, as wide as the lane and a little more."""
    bounds = []
    for lane in lanes:
        half = lane.width / 2 if lane.width > 0 else HALF_WIDTH
        sides = []
        for row in (0, -1):
            course = _course(lane.line, row)
            aside = (min(half, 4.0) + 1.0) * np.array([-np.sin(course), np.cos(course)])
            sides.append((lane.line[row, :2] + aside, lane.line[row, :2] - aside))
        bounds.append((np.array([sides[0][0], sides[1][0]]), np.array([sides[0][1], sides[1][1]])))
    cuts = cut_ends(bounds, links)
    return cuts[np.isfinite(cuts).all(axis=(1, 2))]


def mapping(value: Any, field: str) -> Mapping[Any, Any]:
    """A dictionary; a :class:`DataError` if it is none."""
    if not isinstance(value, dict):
        raise DataError(f"expected a dictionary, is {type(value).__name__}", field=field)
    return value


def points(value: Any, field: str) -> Doubles:
    """[P, 2 or 3] points, however they are written; a :class:`DataError` if they are none, or not finite."""
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
