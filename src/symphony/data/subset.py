"""A run segment without some of its agents or lanes, or cut down to what is near its ego."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.data.segment import STATES, Bools, Polylines, RunSegment, validate

MARGIN = 10.0
"""Metres beside the lanes that are kept within which the boundary is kept, too."""


def with_agents(segment: RunSegment, kept: Bools) -> RunSegment:
    """The agents that a mask [A] keeps, the ego among them, everything that refers to them renumbered."""
    return segment.replace(
        ego=int(kept[: segment.ego].sum()),
        **{name: getattr(segment, name)[kept] for name in ("agent_id", "agent_type", "size", *STATES)},
        interest=_renumbered(segment.interest[kept[segment.interest]], kept),
        predict=_renumbered(segment.predict[kept[segment.predict]], kept),
    )


def with_lanes(segment: RunSegment, kept: Bools) -> RunSegment:
    """The lanes that a mask [L] keeps, with the links between them and their lights."""
    road, lights = segment.road, kept[segment.signal_lane]
    pairs = {name: getattr(road, name) for name in ("successors", "left_neighbors", "right_neighbors")}
    names = ("lane_id", "lane_type", "speed_limit", "lane_width")
    fields: dict[str, Any] = {name: getattr(road, name)[kept] for name in names}
    fields |= {name: _renumbered(pair[kept[pair].all(axis=1)], kept) for name, pair in pairs.items()}
    return segment.replace(
        road=dataclasses.replace(road, lanes=lines_of(road.lanes, kept), **fields),
        signal_lane=_renumbered(segment.signal_lane[lights], kept),
        signal_point=segment.signal_point[lights],
        signal_state=segment.signal_state[lights],
    )


def lines_of(lines: Polylines, kept: Bools) -> Polylines:
    """The lines that a mask [K] keeps."""
    return Polylines.of([lines[k] for k in np.flatnonzero(kept).tolist()])


def _renumbered(index: NDArray[Any], kept: Bools) -> NDArray[np.int32]:
    return (np.cumsum(kept) - 1).astype(np.int32)[index]


def crop(segment: RunSegment, radius: float) -> RunSegment:
    """Keep what comes within a radius in metres of the ego's logged path: some sources give a whole district.

    Lanes are kept whole, with their links and lights; of the boundary and the marks the pieces that are near enough,
    or beside a lane that is kept. Where lanes go on beyond, the boundary stays open. Agents are kept whole if they
    are near enough at some step. Raises a :class:`DataError` if no lane is near enough.
    """
    road = segment.road
    near = _shape(segment.position[segment.ego, segment.valid[segment.ego]]).buffer(radius)
    shapely.prepare(near)
    spots = segment.position[..., :2].astype(np.float64)
    agents = (shapely.contains_xy(near, spots[..., 0], spots[..., 1]) & segment.valid).any(axis=1)
    agents[segment.ego] = True
    shapes = [_shape(road.lanes[k]) for k in range(len(road.lanes))]
    kept = shapely.intersects(near, np.array(shapes, object))
    lanes = [shape.buffer(MARGIN) for shape, keep in zip(shapes, kept, strict=True) if keep]
    beside = shapely.union_all([near, *lanes])
    shapely.prepare(beside)
    edges, marks = ([_pieces(ls[k], beside) for k in range(len(ls))] for ls in (road.boundary, road.marks))
    road = dataclasses.replace(
        road,
        boundary=Polylines.of([piece for pieces in edges for piece in pieces]),
        marks=Polylines.of([piece for pieces in marks for piece in pieces]),
        mark_type=np.repeat(road.mark_type, [len(pieces) for pieces in marks]),
    )
    return validate(with_agents(with_lanes(segment.replace(road=road), kept), agents))


def _shape(points: NDArray[Any]) -> Any:
    flat = points[:, :2].astype(np.float64)
    return shapely.LineString(flat) if len(flat) > 1 else shapely.Point(flat[0])


def _pieces(line: NDArray[np.float32], area: Any) -> list[NDArray[np.float32]]:
    """Stretches of a line [P, 3] of edges that touch an area, each uncut, in their order."""
    points = line[:, :2].astype(np.float64)
    if len(line) == 1:
        return [line] if shapely.intersects_xy(area, *points[0]) else []
    keep = shapely.intersects(area, shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1)))
    change = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(np.int8)))
    return [line[a : b + 1] for a, b in pairwise(change.tolist()) if keep[a]]
