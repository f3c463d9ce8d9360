"""The lane a vehicle is on, and the branching regions a trajectory visits (for the curvature JSD, section V)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.geometry.nearest import spans
from symphony.roadgraph.graph import Bools, Indices, LaneGraph, Near, Reals, turn_between

LATERAL = 3.0  # metres from a centre line within which a vehicle can be on a lane
LANE_TURN = math.pi / 3  # largest angle between a vehicle and its lane
MARGIN = 1.5
"""Metres by which a lane may be farther away than the nearest and is still one that a vehicle may be on."""
_TIE = 0.25  # metres by which distances must differ to decide between lanes before the heading does
_TURN_TIE = 1e-3


def lane_of(
    graph: LaneGraph,
    position: NDArray[Any],
    heading: NDArray[Any],
    *,
    tolerance: float = LATERAL,
    keep: Callable[[Near], Bools] | None = None,
) -> Indices:
    """Return the lane of each vehicle, -1 where there is none: the nearest centre line that points the same way, by
    :data:`LANE_TURN`; those within a quarter of a metre of the nearest are told apart by heading, then by index.

    Takes positions [..., 2] and headings [...], the largest distance from the centre line in metres, and a function
    of which pairs of a vehicle and a lane near it count, where not all do. Raises ValueError for a position or
    heading that is not finite; names the vehicle.
    """
    position = np.asarray(position, dtype=np.float64)
    wrong = np.argwhere(~(np.isfinite(position).all(-1) & np.isfinite(heading)))
    if len(wrong):
        raise ValueError(f"vehicle {wrong[0].tolist()}: a position or heading that is not finite")
    near, turn = _compatible(graph, position.reshape(-1, 2), np.reshape(heading, -1), tolerance)
    if keep is not None:
        near, turn = near.only(kept := keep(near)), turn[kept]
    return _nearest(graph, near, turn, position[..., 0].size).reshape(position.shape[:-1])


def starting_lanes(
    graph: LaneGraph, position: NDArray[Any], heading: float, *, tolerance: float = LATERAL
) -> list[tuple[int, float]]:
    """Return every lane one vehicle may be on: inside a junction, where lanes overlap, usually several.

    These are lanes within a tolerance in metres, at most :data:`MARGIN` metres farther away than the nearest one. Of
    a lane and its successor only the one that the vehicle is alongside is kept. The lane that :func:`lane_of` names
    comes first, then by distance. Pairs are (lane, metres from its start). A ValueError says what is not finite.
    """
    position = np.asarray(position, dtype=np.float64).reshape(1, 2)
    if not (np.isfinite(position).all() and np.isfinite(heading)):
        raise ValueError("a position or heading that is not finite")
    near, turn = _compatible(graph, position, np.array([heading]), tolerance)
    if len(near.line) == 0:
        return []
    best = int(_nearest(graph, near, turn, 1)[0])
    found = {
        int(graph.usable_lanes[k]): (float(distance), float(along))
        for k, distance, along in zip(near.line, near.distance, near.along, strict=True)
        if distance <= near.distance.min() + MARGIN or graph.usable_lanes[k] == best
    }
    past = {k for k in found if found[k][1] >= graph.length[k] - 1e-6}
    pairs = [(k, s) for k in found for s in graph.successors[k] if s in found.keys() - {k}]
    gone = {k for k, _ in pairs if k in past} | {s for k, s in pairs if k not in past and found[s][1] <= 1e-6}
    kept = sorted(found.keys() - gone, key=lambda k: (k != best, round(found[k][0], 3), k))
    return [(k, found[k][1]) for k in kept]


def _nearest(graph: LaneGraph, near: Near, turn: NDArray[np.float64], count: int) -> Indices:
    """Return the lane [count] of each point, see :func:`lane_of`, from lanes near to them and the angles to these."""
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
    keep = turn <= LANE_TURN
    return near.only(keep), turn[keep]


REACH = 2.0  # metres from a region's centre line, or from its entry point, within which a trajectory is on it
APART = 0.5  # metres by which every alternative must be farther away before a region counts as chosen
TURN = math.pi / 4  # largest angle between a vehicle on a region and the region


def visited_regions(
    graph: LaneGraph, position: NDArray[Any], heading: NDArray[Any], valid: NDArray[np.bool_]
) -> Bools:
    """Return which branching regions each trajectory took.

    A trajectory comes to a choice where the path between two consecutive valid states passes the first point of
    one of its regions, or where the first valid state is on one of them already. From there until it comes to the
    same choice again (in a roundabout), the last state that is clearly on one region decides. A state is on a
    region if it lies within 2 m of the centre line with a compatible heading, and clearly so if every alternative
    is at least half a metre farther away. So of the alternatives of one choice each pass takes at most one.

    Takes positions [..., T, 2] and headings [..., T]; returns [..., R], in the order of ``graph.regions``. Raises
    ValueError for a valid state that is not finite.
    """
    lead, steps = valid.shape[:-1], valid.shape[-1]
    count = math.prod(lead)
    valid = np.asarray(valid, dtype=bool).reshape(count, steps)
    row, _ = np.nonzero(valid)
    points = np.asarray(position, dtype=np.float64).reshape(count, steps, 2)[valid]
    headings = np.asarray(heading, dtype=np.float64).reshape(count, steps)[valid]
    if not (np.isfinite(points).all() and np.isfinite(headings).all()):
        raise ValueError("positions and headings of valid states must be finite")
    shape = count, len(graph.regions)
    if shape[1] == 0 or len(row) == 0:
        return np.zeros((*lead, shape[1]), dtype=bool)
    # From here on all trajectories are one list of valid states; later states have higher numbers.
    begins = np.concatenate(([True], row[1:] != row[:-1]))
    # Rollouts that share a history, and agents that stand, come to a place many times: it is looked up once.
    _, first, place = np.unique(points.view(np.complex128).ravel(), return_index=True, return_inverse=True)
    clear, region, starts = _states_on(graph, begins, points, headings, first, place)
    events = np.concatenate((starts, _passes(graph, row, points, headings, place)))
    parent, begin = _new_passes(events, begins)
    # Number states within each choice, so that one sorted search finds the pass that a state belongs to.
    key = parent * len(row) + begin
    chosen = graph.regions.parent[region]
    found = np.searchsorted(key, chosen * len(row) + clear, side="right") - 1
    after = np.flatnonzero(found >= 0)
    at = found[after]
    same = (parent[at] == chosen[after]) & (row[begin[at]] == row[clear[after]])
    last = np.full(len(key), -1, dtype=np.int64)
    np.maximum.at(last, at[same], after[same])  # states ascend
    last = last[last >= 0]
    result = np.zeros(shape, dtype=bool)
    result[row[clear[last]], region[last]] = True
    return result.reshape(*lead, shape[1])


def visited_curvatures(
    graph: LaneGraph, position: NDArray[Any], heading: NDArray[Any], valid: NDArray[np.bool_]
) -> Reals:
    """Return average curvatures, 1/m, of all regions visited by any of the trajectories, one entry per visit: a lane
    that is one of several choices counts once. Shapes as in :func:`visited_regions`.
    """
    visited = visited_regions(graph, position, heading, valid)
    row, region = np.nonzero(visited.reshape(math.prod(visited.shape[:-1]), -1 if visited.size else 0))
    _, first = np.unique(np.stack([row, graph.regions.lane[region]]), axis=1, return_index=True)
    return graph.regions.curvature[region[np.sort(first)]]


def _states_on(
    graph: LaneGraph, begins: Bools, points: Reals, headings: Reals, first: Indices, place: Indices
) -> tuple[Indices, Indices, Indices]:
    """Return states clearly on a region, ascending, those regions, and pairs [K, 2] (choice, first state on it).

    Takes whether a trajectory begins with a state [n], its point and heading, a state at each of the distinct places,
    and the number of the place of each state [n].
    """
    near = graph.region_index.near(points[first], REACH + APART)
    order = np.lexsort((near.line, near.distance, graph.regions.parent[near.line], near.point))
    point, pair = _repeated(near.point, place, len(first))
    order = order[pair]
    region, distance = near.line[order], near.distance[order]
    on = (turn_between(near.heading[order], headings[point]) <= TURN) & (distance < REACH)
    # Sorted by state, choice and distance, each region's nearest alternative comes right after it.
    parent = graph.regions.parent[region]
    same = (point[1:] == point[:-1]) & (parent[1:] == parent[:-1])
    clear = on.copy()
    clear[1:] &= ~same
    clear[:-1] &= ~same | (np.diff(distance) >= APART)
    inside = on & begins[point]
    return point[clear], region[clear], np.stack((parent[inside], point[inside]), axis=1)


def _passes(graph: LaneGraph, row: Indices, points: Reals, headings: Reals, place: Indices) -> Indices:
    """Return pairs [K, 2] of a choice and the last state before one of its regions' entry points is passed."""
    here = np.flatnonzero(row[1:] == row[:-1])
    start, end = points[here], points[here + 1]
    # From place to place, each way once.
    ways = place[here] * len(points) + place[here + 1]
    _, first, way = np.unique(ways, return_index=True, return_inverse=True)
    paths = shapely.linestrings(np.stack((start[first], end[first]), axis=1))
    path, region = graph.entry_tree.query(paths, predicate="dwithin", distance=REACH)
    path, pair = _repeated(path, way, len(first))
    region = region[pair]
    step = end[path] - start[path]
    away = graph.regions.entry[region] - start[path]
    # The heading is that of the end of the piece nearer to the entry point.
    late = 2 * (away * step).sum(-1) > (step**2).sum(-1)
    facing = headings[here[path] + late]
    passed = turn_between(graph.regions.entry_heading[region], facing) <= TURN
    return np.stack((graph.regions.parent[region[passed]], here[path[passed]]), axis=1)


def _repeated(found: Indices, place: Indices, count: int) -> tuple[Indices, Indices]:
    """Expand the findings at distinct places to all states at them.

    Takes numbers of places [K], ascending, that of each state [n] and how many places there are. Returns states,
    ascending, and the numbers in ``found`` of the findings where they are, ascending for each.
    """
    each = np.bincount(found, minlength=count)
    number, first = each[place], (each.cumsum() - each)[place]
    state = np.repeat(np.arange(len(place)), number)
    return state, spans(first, number)


def _new_passes(events: Indices, begins: Bools) -> tuple[Indices, Indices]:
    """Return choices and first states of the passes, in order; events at consecutive states are one pass."""
    parent, state = np.unique(events, axis=0).T
    follows = (parent[1:] == parent[:-1]) & (state[1:] == state[:-1] + 1) & ~begins[state[1:]]
    new = np.ones(len(parent), dtype=bool)
    new[1:] = ~follows
    return parent[new], state[new]
