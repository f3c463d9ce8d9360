"""Feasible routes: the lane sequences a vehicle can follow, and the one it did (section III of the paper)."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.geometry.stations import stations_along
from symphony.roadgraph.assign import starting_lanes
from symphony.roadgraph.graph import LaneGraph
from symphony.roadgraph.lines import Reals, line_strings

Route = tuple[int, ...]
"""Lane indices in driving order."""

HORIZON = 240.0
"""Metres ahead that routes reach: 10 s at 20 m/s and a margin."""

LIMIT = 200
"""Most routes a vehicle gets."""

MAX_LANES = 500
"""Most lanes of a route."""

_AROUND = 10.0
"""Metres along a route around a vehicle within which its lanes are those that it is on."""
_TIE = 1e-3

Path = tuple[float, Route]
"""How far a route reaches ahead of the vehicle, in metres, and the route."""


def feasible_routes(
    graph: LaneGraph,
    position: NDArray[Any],
    heading: float,
    *,
    horizon: float = HORIZON,
    limit: int = LIMIT,
    lane_change: bool = True,
) -> list[Route]:
    """Routes of one vehicle from every lane it may be on; empty if it is on none.

    See :func:`routes` for the order and :func:`symphony.roadgraph.assign.starting_lanes` for the lanes.
    """
    starts = starting_lanes(graph, position, heading)
    return routes(graph, starts, horizon=horizon, limit=limit, lane_change=lane_change)


def routes(
    graph: LaneGraph,
    starts: Sequence[tuple[int, float]],
    *,
    horizon: float = HORIZON,
    limit: int = LIMIT,
    lane_change: bool = True,
) -> list[Route]:
    """Lane sequences that follow every branch until they reach the horizon or the lanes end.

    Routes without a lane change come first, by start and then by lane index; those with one change follow as far as
    the limit allows. A change is written as the neighbour in place of the lane it is left from, and is offered
    where it first becomes possible: on the lane of the start, and where a neighbour begins beside the route (a
    turn pocket). If there are more routes than the limit, the nearest branches are all kept, and beyond them
    routes go on along the straightest lane.

    Args:
        graph: the lane graph.
        starts: pairs (lane, metres from the lane's start at which the vehicle is).
        horizon: metres ahead of the vehicle.
        limit: most routes to return.
        lane_change: whether to add the routes with a change.

    Raises:
        ValueError: the limit is not positive.
    """
    if limit < 1:
        raise ValueError(f"limit must be at least 1, is {limit}")
    seeds: list[Path] = [(float(graph.length[lane]) - along, (lane,)) for lane, along in starts]
    rank = {route[0]: k for k, (_, route) in reversed(list(enumerate(seeds)))}
    plain = _complete(graph, seeds, horizon, limit)
    plain.sort(key=lambda route: (rank[route[0]], route))
    if not lane_change or len(plain) >= limit:
        return plain
    known = set(plain)
    changed = [
        route
        for route in _complete(graph, _changes(graph, plain, dict(starts), horizon), horizon, limit)
        if route not in known
    ]
    return plain + sorted(changed, key=lambda r: (rank.get(r[0], len(rank)), r))[: limit - len(plain)]


def _complete(graph: LaneGraph, seeds: Sequence[Path], horizon: float, limit: int) -> list[Route]:
    """Extend each path to the horizon; nearest choices first, so that the limit cuts only the farthest.

    Lanes of next to no length in a circle would never get there: a path ends after :data:`MAX_LANES`.
    """
    frontier = sorted(set(seeds))[:limit]
    heapq.heapify(frontier)
    done: list[Route] = []
    while frontier:
        reach, route = heapq.heappop(frontier)
        after = graph.successors[route[-1]]
        if reach >= horizon or not after or len(route) >= MAX_LANES:
            done.append(route)
            continue
        if len(done) + len(frontier) + len(after) > limit:
            after = (min(after, key=lambda k: (abs(_turn(graph, k)), k)),)
        for lane in after:
            heapq.heappush(frontier, (reach + float(graph.length[lane]), (*route, lane)))
    return list(dict.fromkeys(done))


def _turn(graph: LaneGraph, lane: int) -> float:
    return float(graph.curvature[lane] * graph.length[lane])


def _changes(graph: LaneGraph, plain: Sequence[Route], along: dict[int, float], horizon: float) -> list[Path]:
    """Paths up to and including the lane that a change leads to."""
    found: dict[Route, float] = {}
    for route in plain:
        reach = -along[route[0]]
        before: set[int] = set()
        for k, lane in enumerate(route):
            if reach >= horizon:
                break
            beside = {*graph.left[lane], *graph.right[lane]}
            reach += float(graph.length[lane])
            for other in beside:
                # Where the neighbour continues one that was already beside the route, the change came earlier;
                # where it is a branch of the route itself, it takes no change.
                reachable = before.union(route[k - 1 : k]).intersection(graph.predecessors[other])
                if not reachable:
                    found[(*route[:k], other)] = reach
            before = beside
    return [(reach, path) for path, reach in found.items()]


def route_errors(
    graph: LaneGraph,
    choices: Sequence[Route],
    trajectory: NDArray[Any],
    valid: NDArray[np.bool_],
    *,
    within: float = np.inf,
) -> Reals:
    """Mean distance [G] in metres of a trajectory's valid points [T, 2] to each route (NaN if there are none).

    Of a route that comes by twice only the pass counts that the trajectory is on: else one that goes around the block
    first would be as right as the direct one.

    Args:
        graph: the lane graph.
        choices: the routes.
        trajectory: [T, 2].
        valid: [T].
        within: metres; a route that is worse than the best by more may get infinity instead, which is faster.
    """
    path = np.asarray(trajectory, dtype=np.float64)[np.asarray(valid, dtype=bool)]
    points = shapely.points(path)
    if len(points) == 0:
        return np.full(len(choices), np.nan)
    lanes = sorted({lane for route in choices for lane in route})
    row = {lane: k for k, lane in enumerate(lanes)}
    distance = shapely.distance(line_strings([graph.lines[lane] for lane in lanes])[:, None], points[None])
    away = [distance[[row[lane] for lane in route]] for route in choices]
    errors = np.array([each.min(0).mean() for each in away])
    again = np.array([len(set(route)) < len(route) for route in choices])
    # With all passes counted the error is at most what it is with one.
    close = errors <= errors[~again].min(initial=np.inf) + within
    errors[again & ~close] = np.inf
    twice = np.flatnonzero(again & close).tolist()
    for k, on in zip(twice, _passed(graph, [choices[k] for k in twice], path), strict=True):
        errors[k] = np.where(on, away[k], np.inf).min(0).mean()
    return errors


def _passed(graph: LaneGraph, choices: Sequence[Route], path: Reals) -> list[NDArray[np.bool_]]:
    """[lanes, T] for each route which of its lanes are near the place along it to which a path [T, 2] has come."""
    if not choices:
        return []
    lines = [np.concatenate([graph.lines[lane] for lane in route]) for route in choices]
    # Shorter ones end with their last point again.
    most = max(len(line) for line in lines)
    padded = np.stack([np.concatenate([line, line[-1:].repeat(most - len(line), 0)]) for line in lines])
    shape = len(lines), *path.shape
    stations = stations_along(padded, np.broadcast_to(path, shape), np.ones(shape[:2], bool))
    found = []
    for route, line, station in zip(choices, lines, stations, strict=True):
        arc = np.concatenate([[0.0], np.linalg.norm(np.diff(line, axis=0), axis=-1).cumsum()])
        ends = np.cumsum([len(graph.lines[lane]) for lane in route])
        begin, end = arc[np.concatenate([[0], ends[:-1]])], arc[ends - 1]
        found.append((begin[:, None] <= station + _AROUND) & (end[:, None] >= station - _AROUND))
    return found


def ground_truth_routes(
    graph: LaneGraph, choices: Sequence[Route], trajectory: NDArray[Any], valid: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The feasible routes with the smallest displacement error to the logged trajectory (paper, section IV-B).

    The error is that of :func:`route_errors`. Routes whose errors are within a millimetre are equally right: those
    that part beyond the trajectory's end, and all of them where no step is valid. To take one of them by its place
    would bias what is learned of choices.

    Returns:
        [G] whether a route is one of them.

    Raises:
        ValueError: there are no routes.
    """
    if not choices:
        raise ValueError("no routes to choose from")
    errors = route_errors(graph, choices, trajectory, valid, within=_TIE)
    if np.isnan(errors).all():
        return np.ones(len(choices), np.bool_)
    return errors <= errors.min() + _TIE


def route_polyline(
    graph: LaneGraph, route: Route, *, spacing: float = 2.0, start: float = 0.0, length: float | None = None
) -> Reals:
    """Centre line of a route, resampled.

    Args:
        graph: the lane graph.
        route: lane indices.
        spacing: metres between points (the last piece may be shorter).
        start: metres from the first lane's start at which the polyline begins.
        length: metres after which it ends, if the route is longer.

    Returns:
        [K, 2] points, K >= 2 unless nothing of the route is left at ``start`` (then its last point, twice).

    Raises:
        ValueError: an empty route, or spacing that is not positive.
    """
    if not route or spacing <= 0:
        raise ValueError("a route polyline needs at least one lane and a positive spacing")
    points = np.concatenate([graph.lines[lane] for lane in route])
    step = np.hypot(*np.diff(points, axis=0).T)
    keep = np.concatenate(([True], step > 0))
    points, arc = points[keep], np.concatenate(([0.0], np.cumsum(step[step > 0])))
    begin = min(max(start, 0.0), arc[-1])
    end = arc[-1] if length is None else min(begin + length, arc[-1])
    places = np.append(np.arange(begin, end - 1e-6, spacing), end)
    if len(places) < 2:
        places = np.array([begin, end])
    return np.stack([np.interp(places, arc, points[:, axis]) for axis in (0, 1)], axis=-1)
