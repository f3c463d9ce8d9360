"""Missing links between lanes that continue each other on the ground."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.data.segment import LaneType, RoadMap

REACH, TURN = 1.5, np.deg2rad(30)  # metres in space and radians within which a lane goes on from another
SAME = 0.1  # metres within which two places are one
STEP = 1e-3  # metres below which two neighbouring points of a lane have no direction
TAG = "joined_gaps"  # of a stored segment: how many links were added to its map


def joined(road: RoadMap) -> tuple[RoadMap, int]:
    """Return a map with links across the gaps that its source has left between lanes, and how many were added.

    A lane goes on into another where its end lies within :data:`REACH` and :data:`TURN` of the other's start, nearer
    to that than to the other's end and nearer than its own start does, and either both or none are for bicycles. Only
    ends without a successor are joined, to the nearest such starts, and starts without a predecessor, to an end
    within :data:`SAME`: no branch is invented where lanes are linked. Lanes of a single point stay as they are.
    """
    first, last, inward, outward, known = _ends(road)
    # Shapely's index is flat; heights are compared below. [E] pairs of an end's lane and a start's.
    tree = shapely.STRtree(shapely.points(first[:, :2]))
    end, start = tree.query(shapely.points(last[:, :2]), predicate="dwithin", distance=REACH)
    gap = np.linalg.norm(first[start] - last[end], axis=1)
    bicycle = road.lane_type == LaneType.BIKE_LANE
    straight = (outward[end] * inward[start]).sum(1) >= np.cos(TURN)
    ahead = gap < np.minimum(*(np.linalg.norm(p[start] - p[end], axis=1) for p in (first, last)))
    good = (gap <= REACH) & straight & ahead & known[end] & known[start] & (bicycle[end] == bicycle[start])
    end, start, gap = end[good], start[good], gap[good]
    count = len(road.lanes)
    open_end, open_start = np.ones(count, np.bool_), np.ones(count, np.bool_)
    open_end[road.successors[:, 0]] = False
    open_start[road.successors[:, 1]] = False
    nearest = np.full(count, np.inf)
    np.minimum.at(nearest, end, gap)
    new = (open_end[end] & (gap <= nearest[end] + SAME)) | (open_start[start] & (gap <= SAME))
    # A lane is linked to another once, whatever the distance of the ends.
    links = end.astype(np.int64) * count + start
    new &= ~np.isin(links, road.successors[:, 0].astype(np.int64) * count + road.successors[:, 1])
    if not new.any():
        return road, 0
    added = np.stack([end[new], start[new]], axis=1).astype(np.int32)
    added = added[np.lexsort(added.T[::-1])]
    return dataclasses.replace(road, successors=np.concatenate([road.successors, added])), len(added)


def _ends(road: RoadMap) -> tuple[NDArray[Any], ...]:
    """Return first and last point of each lane [L, 3], unit direction there [L, 2] on the ground, if any [L]."""
    points, offsets = road.lanes.points.astype(np.float64), road.lanes.offsets
    step = np.diff(points[:, :2], axis=0)
    length = np.hypot(*step.T)
    owner = road.lanes.line_index
    moves = np.flatnonzero((owner[1:] == owner[:-1]) & (length > STEP))
    lanes = np.arange(len(road.lanes))
    known = np.isin(lanes, owner[moves])
    unit: Any = np.append(step, np.zeros((1, 2)), axis=0) / np.append(np.maximum(length, STEP), 1.0)[:, None]
    left = np.searchsorted(owner[moves], lanes, side="left")
    right = np.searchsorted(owner[moves], lanes, side="right") - 1
    padded = np.append(moves, len(step))  # lanes without a direction look past the end, at zeros
    inward, outward = unit[padded[np.where(known, left, -1)]], unit[padded[np.where(known, right, -1)]]
    return points[offsets[:-1]], points[offsets[1:] - 1], inward, outward, known
