"""Plane geometry that readers of lane bounds and drivable areas share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.polygon import orient

from symphony.data.segment import Polylines
from symphony.data.sources.base import to_float32
from symphony.errors import DataError

Doubles = NDArray[np.float64]

MAX_EDGES = 500_000
MAX_NEAR, MAX_CROSSINGS, MAX_KNOTS = 2_000_000, 50_000, 500
"""Edges of outlines, pairs of them whose boxes overlap, pairs that cross, and pairs of one outline that do: the time
and memory of a union grow with them, with the last by a power. Maps of 7 000 edges had 1 500 crossings, and outlines
one with themselves."""
PROBES = 200
SLIT = 0.1
"""Metres by which neighbouring areas may miss each other on either side and still bound no slit."""


def evenly(line: Doubles, count: int) -> Doubles:
    """[count, 2] points at equal arc length along a line [P, 2]."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    where = np.linspace(0, along[-1], count)
    return np.stack([np.interp(where, along, line[:, k]) for k in range(2)], axis=-1)


def drivable_rings(
    outlines: Sequence[Doubles | shapely.Polygon], field: str = "lanelet"
) -> tuple[Doubles, ...]:
    """Closed rings [P, 2] around the union of outlines or polygons, inside on the left; holes run the other way.

    Slits and holes up to 2 * :data:`SLIT` wide are closed.

    Raises:
        DataError: the union can't be formed, or would be beyond all measure; ``field`` says where the outlines
            come from.
    """
    _check_effort([ring for outline in outlines for ring in _rings_of(outline)], field)
    try:
        # Shapely takes NaN and infinity on its way through outlines of no width for something to warn of.
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            polygons = shapely.make_valid(
                np.array([shapely.Polygon(outline) for outline in outlines], object)
            )
            union = shapely.union_all(polygons)
            wider = union.buffer(SLIT, join_style="mitre")
            closed = wider.buffer(-SLIT, join_style="mitre").simplify(0.01)
    except (shapely.errors.ShapelyError, ValueError) as error:
        raise DataError(f"the union of the areas can't be formed: {error}", field=field) from error
    rings = []
    for part in shapely.get_parts(closed):
        if part.geom_type == "Polygon" and not part.is_empty:
            polygon = orient(part, 1.0)
            rings += [np.asarray(ring.coords)[:, :2] for ring in (polygon.exterior, *polygon.interiors)]
    return tuple(rings)


def _rings_of(outline: Doubles | shapely.Polygon) -> list[Doubles]:
    """An outline itself, or the rings [P, 2] of a polygon."""
    if isinstance(outline, shapely.Polygon):
        return [np.asarray(ring.coords)[:, :2] for ring in (outline.exterior, *outline.interiors)]
    return [outline[:, :2]]


def _check_effort(outlines: Sequence[Doubles], field: str) -> None:
    """Refuse outlines that are too many, or cross each other or themselves without end."""
    count = sum(map(len, outlines))
    if count == 0:
        return
    if count > MAX_EDGES:
        raise DataError(f"outlines of {count} points, at most {MAX_EDGES}", field=field)
    owner = np.repeat(np.arange(len(outlines)), [len(outline) for outline in outlines])
    first = np.concatenate(outlines)
    second = np.concatenate([np.roll(outline, -1, axis=0) for outline in outlines])
    edges = shapely.linestrings(np.stack([first, second], axis=1))
    tree = shapely.STRtree(edges)
    probes = edges[np.linspace(0, count - 1, PROBES).astype(np.int64)]
    near = tree.query(probes).shape[1] / PROBES * count
    if near > MAX_NEAR:
        raise DataError(f"outlines whose edges meet about {near:.2g} times", field=field)
    one, other = tree.query(edges, predicate="crosses")
    crossings, knots = len(one) // 2, int((owner[one] == owner[other]).sum()) // 2
    if crossings > MAX_CROSSINGS:
        raise DataError(f"outlines that cross {crossings} times, at most {MAX_CROSSINGS}", field=field)
    if knots > MAX_KNOTS:
        raise DataError(f"outlines that cross themselves {knots} times, at most {MAX_KNOTS}", field=field)


def stretches(ring: Doubles, keep: NDArray[np.bool_]) -> list[Doubles]:
    """What remains of a closed ring [P, 2] when only some of its P - 1 edges are kept, in the same direction."""
    if keep.all():
        return [ring]
    if not keep.any():
        return []
    # The ring is cut open at an edge that goes, so that no stretch runs past the end of the array.
    shift = int(np.argmin(keep)) + 1
    keep = np.roll(keep, -shift)
    points = np.roll(ring[:-1], -shift, axis=0)
    padded = np.concatenate([[False], keep, [False]])
    first, last = np.flatnonzero(~padded[:-1] & padded[1:]), np.flatnonzero(padded[:-1] & ~padded[1:])
    return [points[a : b + 1] for a, b in zip(first, last, strict=True)]


def polylines(lines: Sequence[Doubles], origin: Doubles) -> Polylines:
    """Lines [P, 2 or 3] relative to an origin [2 or 3]; z is 0 where they have none."""
    return Polylines.of([to_float32(line - origin) for line in lines])


CUT = 0.3
"""Metres by which a ring may miss the cut it was closed along."""


def cut_ends(bounds: Sequence[tuple[Doubles, Doubles]], links: NDArray[np.int32]) -> Doubles:
    """[N, 2, 2] the line across each lane's end or start where no other lane goes on: there a map was cut.

    Args:
        bounds: left and right bound [P, 2] of each lane, in the direction of travel.
        links: [E, 2] successors, lane indices (from, to).
    """
    goes, comes = set(links[:, 0].tolist()), set(links[:, 1].tolist())
    found = [(left[-1], right[-1]) for k, (left, right) in enumerate(bounds) if k not in goes]
    found += [(left[0], right[0]) for k, (left, right) in enumerate(bounds) if k not in comes]
    return np.array(found, np.float64).reshape(-1, 2, 2)


def opened(rings: Sequence[Doubles], cuts: Doubles) -> tuple[Doubles, ...]:
    """Closed rings [P, 2] without their edges along cuts [N, 2, 2], in the same direction.

    Traffic goes on beyond a cut, so that as road boundary it would put all of it off the road.
    """
    lines = shapely.linestrings(cuts) if len(cuts) else np.zeros(0, object)
    tree = shapely.STRtree(lines)
    found: list[Doubles] = []
    for ring in rings:
        near = tree.query(shapely.LineString(ring), predicate="dwithin", distance=CUT)
        found += stretches(*_marked(ring, cuts[near], lines[near])) if len(near) else [ring]
    return tuple(found)


def _marked(ring: Doubles, cuts: Doubles, lines: NDArray[np.object_]) -> tuple[Doubles, NDArray[np.bool_]]:
    """The ring with a vertex where each cut begins and ends, and which of its edges lie along none."""
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
    middle = shapely.points(points[:-1] + step / 2)
    across = cuts[:, 1] - cuts[:, 0]
    close = shapely.distance(middle[:, None], lines) <= CUT
    lengths = np.hypot(*step.T)[:, None] * np.hypot(*across.T)
    close &= np.abs(step @ across.T) >= 0.7 * lengths
    return points, ~close.any(axis=1)
