"""Which branching regions a trajectory visits: the raw material of the curvature JSD (section V of the paper)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.geometry.nearest import spans
from symphony.roadgraph.graph import Bools, Indices, LaneGraph, Reals, turn_between

REACH = 2.0
"""Metres from a region's centre line, or from its entry point, within which a trajectory is on it."""
APART = 0.5
"""Metres by which every alternative must be farther away before a region counts as chosen."""
TURN = math.pi / 4
"""Largest angle between a vehicle on a region and the region."""


def visited_regions(
    graph: LaneGraph, position: NDArray[Any], heading: NDArray[Any], valid: NDArray[np.bool_]
) -> Bools:
    """Which branching regions each trajectory took.

    A trajectory comes to a choice where the path between two consecutive valid states passes the first point of
    one of its regions, or where the first valid state is on one of them already. From there until it comes to the
    same choice again (in a roundabout), the last state that is clearly on one region decides. A state is on a
    region if it lies within 2 m of the centre line with a compatible heading, and clearly so if every alternative
    is at least half a metre farther away. So of the alternatives of one choice each pass takes at most one.

    Args:
        graph: the lane graph.
        position: [..., T, 2] metres.
        heading: [..., T] radians.
        valid: [..., T].

    Returns:
        [..., R], in the order of ``graph.regions``.

    Raises:
        ValueError: for a valid state that is not finite.
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
    # Rollouts that share a history, and whoever stands, come to a place many times: it is looked up once.
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
    """Average curvatures, 1/m, of all regions visited by any of the trajectories, one entry per visit.

    Shapes as in :func:`visited_regions`.
    """
    visited = visited_regions(graph, position, heading, valid)
    return graph.regions.curvature[np.nonzero(visited)[-1]]


def _states_on(
    graph: LaneGraph, begins: Bools, points: Reals, headings: Reals, first: Indices, place: Indices
) -> tuple[Indices, Indices, Indices]:
    """States clearly on a region, ascending, those regions, and pairs [K, 2] (choice, first state on it).

    Args:
        graph: the lane graph.
        begins: [n] whether a trajectory begins with the state.
        points: [n, 2] metres.
        headings: [n] radians.
        first: [places] a state at each of the distinct places.
        place: [n] number of the place of each state.
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
    """Pairs [K, 2] of a choice and the last state before the entry point of one of its regions is passed."""
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
    """What was found at distinct places, for all states at them.

    Args:
        found: [K] numbers of places, ascending.
        place: [n] of each state.
        count: places.

    Returns:
        States, ascending, and the numbers in ``found`` of what was found where they are, ascending for each.
    """
    each = np.bincount(found, minlength=count)
    number, first = each[place], (each.cumsum() - each)[place]
    state = np.repeat(np.arange(len(place)), number)
    return state, spans(first, number)


def _new_passes(events: Indices, begins: Bools) -> tuple[Indices, Indices]:
    """Choices and first states of the passes, in order; events at consecutive states are one pass."""
    parent, state = np.unique(events, axis=0).T
    follows = (parent[1:] == parent[:-1]) & (state[1:] == state[:-1] + 1) & ~begins[state[1:]]
    new = np.ones(len(parent), dtype=bool)
    new[1:] = ~follows
    return parent[new], state[new]
