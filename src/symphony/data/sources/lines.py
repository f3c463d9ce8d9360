"""Lanes, boundaries and lights as the readers of maps share them, and their plane geometry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.polygon import orient

from symphony.data.segment import Bools, MarkType, Polylines, RoadMap
from symphony.data.sources.base import Doubles, pairs, refuse, to_float32
from symphony.errors import DataError

Links = NDArray[np.int32]  # [E, 2] lane indices (from, to)
Codes = NDArray[np.uint8]  # members of an enumeration of the schema
Mark = tuple[Doubles, MarkType]  # its points, and what it is
Lights = dict[int, tuple[Doubles, Any]]  # lane -> (stop point [2 or 3], states [T])
MAX_EDGES, MAX_NEAR, MAX_CROSSINGS, MAX_KNOTS = 500_000, 2_000_000, 50_000, 500
"""Edges of outlines, pairs of them whose boxes overlap, pairs that cross, and pairs of one outline that do: the time
and memory of a union grow with them, with the last by a power. Maps of 7 000 edges had 1 500 crossings."""
PROBES = 200
MAX_BOUND, SPACING = 10_000.0, 2.0  # metres of a lane's bound, at most; between points of a centre line
CUT = 0.3  # metres by which a ring may miss the cut it was closed along
SLIT = 0.1  # metres by which neighbouring areas may miss each other on either side and still bound no slit


@dataclass(frozen=True)
class Lane:
    """A lane in the coordinates and by the ids of its source; unknown values are NaN."""

    name: Any
    line: Doubles  # [P, 2 or 3] centre line in the direction of travel
    kind: int  # its LaneType
    width: float = np.nan  # metres
    speed_limit: float = np.nan  # m/s
    successors: Iterable[Any] = ()  # names of lanes that traffic flows into
    predecessors: Iterable[Any] = ()  # names of lanes that traffic comes from
    left: Iterable[Any] = ()  # names of the neighbours on the left that a lane change may reach
    right: Iterable[Any] = ()


def named(lanes: Sequence[Lane], field: str) -> list[tuple[int, int]]:
    """Return (lane, lane it names in a field) by index; names of lanes that are not there are left out."""
    index = {lane.name: k for k, lane in enumerate(lanes)}
    return [(k, index[ref]) for k, lane in enumerate(lanes) for ref in getattr(lane, field) if ref in index]


def flow(lanes: Sequence[Lane]) -> Links:
    """Return which lanes lead to which, as either of the two tells."""
    return pairs(named(lanes, "successors") + [(b, a) for a, b in named(lanes, "predecessors")])


def road_map(
    lanes: Sequence[Lane],
    origin: Doubles,
    boundary: Sequence[Doubles],
    marks: Sequence[Mark],
    *,
    links: Links | None = None,
    beside: tuple[Links, Links] | None = None,
    ids: Sequence[int] | None = None,
) -> RoadMap:
    """Return the map relative to an origin [2 or 3]; z is 0 where lines have none.

    The boundary's lines have the drivable side on their left. By default ``links`` (successors) and ``beside`` (left
    and right neighbours) are what the lanes say, and ``ids`` their names, which are numbers.
    """

    def local(lines: Iterable[Doubles]) -> Polylines:
        return Polylines.of([to_float32(line - origin[: line.shape[1]]) for line in lines])

    left, right = beside or (pairs(named(lanes, "left")), pairs(named(lanes, "right")))
    widths = np.array([lane.width for lane in lanes], np.float64)
    return RoadMap(
        lanes=local(lane.line for lane in lanes),
        lane_id=np.array([lane.name for lane in lanes] if ids is None else ids, np.int64),
        lane_type=np.array([lane.kind for lane in lanes], np.uint8),
        speed_limit=to_float32(np.array([lane.speed_limit for lane in lanes], np.float64)),
        lane_width=to_float32(np.where(widths > 0, widths, np.nan)),
        successors=flow(lanes) if links is None else links,
        left_neighbors=left,
        right_neighbors=right,
        boundary=local(boundary),
        marks=local(line for line, _ in marks),
        mark_type=np.array([kind for _, kind in marks], np.uint8),
    )


def lights(found: Lights, steps: int, origin: Doubles) -> dict[str, Any]:
    """Return the fields of a run segment for lights."""
    points = np.array([point - origin for point, _ in found.values()]).reshape(-1, len(origin))
    return {
        "signal_lane": np.array(list(found), np.int32),
        "signal_point": to_float32(np.pad(points, ((0, 0), (0, 3 - len(origin))))),
        "signal_state": np.array([states for _, states in found.values()], np.uint8).reshape(-1, steps),
    }


def painted(bounds: Iterable[Doubles]) -> list[Mark]:
    """Return painted bounds of lanes as marks; one that two lanes share, in either direction, counts once."""
    found: dict[bytes, Doubles] = {}
    for bound in bounds:
        if len(bound) and bound[::-1].tobytes() not in found:
            found.setdefault(bound.tobytes(), bound)
    return [(bound, MarkType.ROAD_LINE) for bound in found.values()]


def evenly(line: Doubles, count: int) -> Doubles:
    """Return [count, 2] points at equal arc length along a line [P, 2]."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    where = np.linspace(0, along[-1], count)
    return np.stack([np.interp(where, along, line[:, k]) for k in range(2)], axis=-1)


def matched(left: Doubles, right: Doubles, field: str) -> tuple[Doubles, Doubles]:
    """Return both bounds of a lane with equally many points, evenly and at most :data:`SPACING` apart."""
    longest = max(np.hypot(*np.diff(line, axis=0).T).sum() for line in (left, right))
    refuse(not longest <= MAX_BOUND, f"a lane of {longest:.4g} m, at most {MAX_BOUND:g}", field)
    count = max(int(np.ceil(longest / SPACING)) + 1, 2)
    return evenly(left, count), evenly(right, count)


def median_width(left: Doubles, right: Doubles) -> float:
    """Return the metres between two bounds with equally many points."""
    return float(np.median(np.hypot(*(left - right).T)))


def drivable_rings(outlines: Sequence[Any], field: str = "lanelet") -> tuple[Doubles, ...]:
    """Return closed rings [P, 2] around the union of outlines, inside on the left; holes run the other way.

    Outlines are points [P, 2] or polygons. Slits and holes up to 2 * :data:`SLIT` wide are closed. A
    :class:`DataError` says of which ``field`` the union can't be formed, or would take too long.
    """
    shapes = [outline for outline in outlines if isinstance(outline, shapely.Polygon)]
    flat = [outline[:, :2] for outline in outlines if not isinstance(outline, shapely.Polygon)]
    _check_effort([*flat, *_rings(shapes)], field)
    try:
        # Shapely takes NaN and infinity on its way through outlines of no width for something to warn of.
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            areas = np.array([shapely.Polygon(each) for each in outlines], object)
            wider = shapely.union_all(shapely.make_valid(areas)).buffer(SLIT, join_style="mitre")
            closed = wider.buffer(-SLIT, join_style="mitre").simplify(0.01)
    except (shapely.errors.ShapelyError, ValueError) as error:
        raise DataError(f"the union of the areas can't be formed: {error}", field=field) from error
    parts = [part for part in shapely.get_parts(closed) if part.geom_type == "Polygon" and not part.is_empty]
    return tuple(_rings(orient(part, 1.0) for part in parts))


def _rings(polygons: Iterable[shapely.Polygon]) -> list[Doubles]:
    rings = (ring for polygon in polygons for ring in (polygon.exterior, *polygon.interiors))
    return [np.asarray(ring.coords)[:, :2] for ring in rings]


def _check_effort(outlines: Sequence[Doubles], field: str) -> None:
    """Refuse outlines that are too many, or cross each other or themselves too often."""
    count = sum(map(len, outlines))
    refuse(count > MAX_EDGES, f"outlines of {count} points, at most {MAX_EDGES}", field)
    if count == 0:
        return
    owner = np.repeat(np.arange(len(outlines)), [len(outline) for outline in outlines])
    ends = [np.concatenate([np.roll(outline, k, axis=0) for outline in outlines]) for k in (0, -1)]
    edges = shapely.linestrings(np.stack(ends, axis=1))
    tree = shapely.STRtree(edges)
    probes = edges[np.linspace(0, count - 1, PROBES).astype(np.int64)]
    near = tree.query(probes).shape[1] / PROBES * count
    refuse(near > MAX_NEAR, f"outlines whose edges meet about {near:.2g} times", field)
    one, other = tree.query(edges, predicate="crosses")
    crossings, knots = len(one) // 2, int((owner[one] == owner[other]).sum()) // 2
    many = crossings > MAX_CROSSINGS or knots > MAX_KNOTS
    refuse(many, f"outlines that cross {crossings} times, themselves {knots} times", field)


def stretches(ring: Doubles, keep: Bools) -> list[Doubles]:
    """Return what remains of a closed ring [P, 2] when only some of its P - 1 edges are kept, same direction."""
    if keep.all():
        return [ring]
    # The ring is cut open at an edge that goes, so that no stretch runs past the end of the array.
    shift = int(np.argmin(keep)) + 1
    points = np.roll(ring[:-1], -shift, axis=0)
    change = np.diff(np.pad(np.roll(keep, -shift), 1).astype(np.int8))
    first, last = np.flatnonzero(change > 0), np.flatnonzero(change < 0)
    return [points[a : b + 1] for a, b in zip(first, last, strict=True)]


def cut_ends(bounds: Sequence[tuple[Doubles, Doubles]], links: Links) -> Doubles:
    """Return [N, 2, 2] the line across each lane's end or start where no other lane goes on: there a map was cut.
    Takes left and right bound [P, 2] of each lane, in the direction of travel, and all the successors.
    """
    goes, comes = set(links[:, 0].tolist()), set(links[:, 1].tolist())
    found = [(left[-1], right[-1]) for k, (left, right) in enumerate(bounds) if k not in goes]
    found += [(left[0], right[0]) for k, (left, right) in enumerate(bounds) if k not in comes]
    return np.array(found, np.float64).reshape(-1, 2, 2)


def opened(rings: Sequence[Doubles], cuts: Doubles) -> list[Doubles]:
    """Return closed rings [P, 2] without their edges along cuts [N, 2, 2], in the same direction. Traffic goes on
    beyond a cut, so that as road boundary it would put all of it off the road.
    """
    lines = shapely.linestrings(cuts) if len(cuts) else np.zeros(0, object)
    tree = shapely.STRtree(lines)
    found: list[Doubles] = []
    for ring in rings:
        near = tree.query(shapely.LineString(ring), predicate="dwithin", distance=CUT)
        found += stretches(*_marked(ring, cuts[near], lines[near])) if len(near) else [ring]
    return found


def _marked(ring: Doubles, cuts: Doubles, lines: NDArray[np.object_]) -> tuple[Doubles, Bools]:
    """Return the ring with a vertex where each cut begins and ends, and which of its edges lie along none."""
    shape = shapely.LineString(ring)
    corners = shapely.points(cuts.reshape(-1, 2))
    corners = corners[shapely.distance(shape, corners) <= CUT]
    own = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ring, axis=0).T))])
    spots = np.sort(shapely.line_locate_point(shape, corners))
    spots = spots[np.diff(spots, prepend=-np.inf) > 1e-6]  # neighbouring cuts share their corners
    new = spots[np.abs(spots[:, None] - own).min(axis=1, initial=np.inf) > 1e-6]
    along = np.unique(np.concatenate([own, new]))
    points = np.stack([np.interp(along, own, ring[:, k]) for k in range(2)], axis=-1)
    step = np.diff(points, axis=0)
    across = cuts[:, 1] - cuts[:, 0]
    close = shapely.distance(shapely.points(points[:-1] + step / 2)[:, None], lines) <= CUT
    close &= np.abs(step @ across.T) >= 0.7 * np.hypot(*step.T)[:, None] * np.hypot(*across.T)
    return points, ~close.any(axis=1)
