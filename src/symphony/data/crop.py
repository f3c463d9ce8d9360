"""Cutting a run segment down to what is near its ego: some sources give a whole district with every scene."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.data.segment import Polylines, RoadMap, RunSegment, validate
from symphony.data.subset import with_agents, with_lanes
from symphony.errors import ConfigError

MARGIN = 10.0
"""Metres beside the lanes that are kept within which the boundary is kept, too."""


def crop(segment: RunSegment, radius: float) -> RunSegment:
    """What comes within a distance of the ego's logged path.

    Lanes are kept whole, with their links and lights; of the boundary and the marks the pieces that are near enough,
    or beside a lane that is kept. Where lanes go on beyond, the boundary stays open. Agents are kept whole if they
    are near enough at some step.

    Args:
        segment: a valid segment.
        radius: metres.

    Raises:
        ConfigError: the radius is not positive.
        DataError: no lane is near enough.
    """
    if not (np.isfinite(radius) and radius > 0):
        raise ConfigError(f"radius must be positive, is {radius}")
    path = segment.position[segment.ego, segment.valid[segment.ego], :2].astype(np.float64)
    near = _geometry(path).buffer(radius)
    shapely.prepare(near)
    spots = segment.position[..., :2].astype(np.float64)
    close = shapely.contains_xy(near, spots[..., 0], spots[..., 1]) & segment.valid
    agents = close.any(axis=1)
    agents[segment.ego] = True
    road, lanes = _road(segment.road, near)
    return validate(with_agents(with_lanes(segment.replace(road=road), lanes), agents))


def _geometry(points: NDArray[Any]) -> Any:
    return shapely.LineString(points) if len(points) > 1 else shapely.Point(points[0])


def _road(road: RoadMap, near: Any) -> tuple[RoadMap, NDArray[np.bool_]]:
    """(the map with boundary and marks cut, which of its lanes [L] are kept)."""
    shapes = [_geometry(road.lanes[k][:, :2].astype(np.float64)) for k in range(len(road.lanes))]
    kept = shapely.intersects(near, np.array(shapes, object))
    lanes = [shape.buffer(MARGIN) for shape, keep in zip(shapes, kept, strict=True) if keep]
    beside = shapely.union_all([near, *lanes])
    shapely.prepare(beside)

    marks = [_pieces(road.marks[k], beside) for k in range(len(road.marks))]
    return dataclasses.replace(
        road,
        boundary=Polylines.of(
            [p for k in range(len(road.boundary)) for p in _pieces(road.boundary[k], beside)]
        ),
        marks=Polylines.of([piece for pieces in marks for piece in pieces]),
        mark_type=np.repeat(road.mark_type, [len(pieces) for pieces in marks]),
    ), kept


def _pieces(line: NDArray[np.float32], area: Any) -> list[NDArray[np.float32]]:
    """Stretches of a line [P, 3] of edges that touch an area, each uncut, in their order."""
    points = line[:, :2].astype(np.float64)
    if len(line) == 1:
        return [line] if shapely.intersects_xy(area, *points[0]) else []
    keep = shapely.intersects(area, shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1)))
    change = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(np.int8)))
    return [line[a : b + 1] for a, b in pairwise(change.tolist()) if keep[a]]
