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

SLIT = 0.1
"""Metres by which neighbouring areas may miss each other on either side and still bound no slit."""


def evenly(line: Doubles, count: int) -> Doubles:
    """[count, 2] points at equal arc length along a line [P, 2]."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    where = np.linspace(0, along[-1], count)
    return np.stack([np.interp(where, along, line[:, k]) for k in range(2)], axis=-1)


def drivable_rings(outlines: Sequence[Doubles], field: str = "lanelet") -> tuple[Doubles, ...]:
    """Closed rings [P, 2] around the union of outlines, the inside on the left; holes run the other way.

    Slits and holes up to 2 * :data:`SLIT` wide are closed.

    Raises:
        DataError: the union can't be formed; ``field`` says where the outlines come from.
    """
    try:
        polygons = shapely.make_valid(np.array([shapely.Polygon(outline) for outline in outlines]))
        union = shapely.union_all(polygons)
        closed = union.buffer(SLIT, join_style="mitre").buffer(-SLIT, join_style="mitre").simplify(0.01)
    except shapely.errors.ShapelyError as error:
        raise DataError(f"the union of the areas can't be formed: {error}", field=field) from error
    rings = []
    for part in shapely.get_parts(closed):
        if part.geom_type == "Polygon" and not part.is_empty:
            polygon = orient(part, 1.0)
            rings += [np.asarray(ring.coords)[:, :2] for ring in (polygon.exterior, *polygon.interiors)]
    return tuple(rings)


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
