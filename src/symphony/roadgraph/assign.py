"""Which lane a vehicle is on."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.roadgraph.graph import Bools, Indices, LaneGraph, Near, turn_between

LATERAL = 3.0
"""Metres from a centre line within which a vehicle can be on a lane."""
TURN = math.pi / 3
"""Largest angle between a vehicle and its lane."""
MARGIN = 1.5
"""Metres by which a lane may be farther away than the nearest and is still one that a vehicle may be on."""
_TIE = 0.25
"""Metres by which distances must differ to decide between lanes before the heading does."""
_TURN_TIE = 1e-3


def lane_of(
    graph: LaneGraph,
    position: NDArray[Any],
    heading: NDArray[Any],
    *,
    tolerance: float = LATERAL,
    keep: Callable[[Near], Bools] | None = None,
) -> Indices:
    """Lane of each vehicle, -1 where there is none.

    It is the nearest centre line that points the same way within :data:`TURN`. Lanes within a quarter of a metre of
    the nearest are told apart by heading, then by index.

    Args:
        graph: the lane graph.
        position: [..., 2] metres.
        heading: [...] radians.
        tolerance: largest distance from the centre line, metres.
        keep: which of some pairs of a vehicle and a lane near to it count, where not all do.

    Raises:
        ValueError: a position or heading that is not finite; names the vehicle.
    """
    position = np.asarray(position, dtype=np.float64)
    wrong = np.argwhere(~(np.isfinite(position).all(-1) & np.isfinite(heading)))
    if len(wrong):
        raise ValueError(f"vehicle {wrong[0].tolist()}: a position or heading that is not finite")
    near, turn = _compatible(graph, position.reshape(-1, 2), np.reshape(heading, -1), tolerance)
    if keep is not None:
        near, turn = near.only(kept := keep(near)), turn[kept]
    return _nearest(graph, near, turn, position[..., 0].size).reshape(position.shape[:-1])


def starting_lanes(graph: LaneGraph, position: NDArray[Any], heading: float) -> list[tuple[int, float]]:
    """Every lane one vehicle may be on: inside a junction, where lanes overlap, usually several.

    These are lanes at most :data:`MARGIN` metres farther away than the nearest one. Of a lane and its successor only
    the one that the vehicle is alongside is kept. The lane that :func:`lane_of` names comes first, then by distance.

    Returns:
        Pairs (lane, metres from the lane's start); empty if the vehicle is on no lane.

    Raises:
        ValueError: a position or heading that is not finite.
    """
    position = np.asarray(position, dtype=np.float64).reshape(1, 2)
    if not (np.isfinite(position).all() and np.isfinite(heading)):
        raise ValueError("a position or heading that is not finite")
    near, turn = _compatible(graph, position, np.array([heading]), LATERAL)
    if len(near.line) == 0:
        return []
    best = int(_nearest(graph, near, turn, 1)[0])
    found = {
        int(graph.usable_lanes[k]): (float(distance), float(along))
        for k, distance, along in zip(near.line, near.distance, near.along, strict=True)
        if distance <= near.distance.min() + MARGIN or graph.usable_lanes[k] == best
    }
    past = {k for k in found if found[k][1] >= graph.length[k] - 1e-6}
    gone = {k for k in past if any(s in found for s in graph.successors[k])}
    gone |= {
        s for k in found.keys() - past for s in graph.successors[k] if s in found and found[s][1] <= 1e-6
    }
    kept = sorted(found.keys() - gone, key=lambda k: (k != best, round(found[k][0], 3), k))
    return [(k, found[k][1]) for k in kept]


def _nearest(graph: LaneGraph, near: Near, turn: NDArray[np.float64], count: int) -> Indices:
    """[count] lane of each point, see :func:`lane_of`, from lanes near to them and the angles to these."""
    result = np.full(count, -1, dtype=np.int64)
    smallest = np.full(count, np.inf)
    np.minimum.at(smallest, near.point, near.distance)
    close = near.distance <= smallest[near.point] + _TIE
    order = np.lexsort((near.line, np.round(turn / _TURN_TIE), ~close, near.point))
    point, first = np.unique(near.point[order], return_index=True)
    result[point] = graph.usable_lanes[near.line[order][first]]
    return result


def _compatible(
    graph: LaneGraph, position: NDArray[Any], heading: NDArray[Any], tolerance: float
) -> tuple[Near, NDArray[np.float64]]:
    near = graph.index.near(position, tolerance)
    turn = turn_between(near.heading, np.asarray(heading, dtype=np.float64)[near.point])
    keep = turn <= TURN
    return near.only(keep), turn[keep]
