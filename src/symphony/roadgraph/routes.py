"""Feasible routes: the ways a vehicle can take along lanes, and the one it took (section III of the paper)."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from symphony.geometry.polylines import stations_along, to_pieces
from symphony.roadgraph import paths
from symphony.roadgraph.graph import LaneGraph, Reals, turn_between

HORIZON = 240.0  # metres ahead up to which routes take every branch: 10 s at 20 m/s and a margin
LIMIT = 200  # most routes a vehicle gets
MAX_LANES = 500  # most lanes of a route

CHANGE_METRES, CHANGE_SECONDS = 20.0, 3.0
"""Metres, or seconds at the vehicle's speed, that a change of lanes takes, whichever is longer."""
CHANGE_TURN = np.radians(25.0)
"""Largest angle between two lanes where one changes, and what a change may turn more within 3 m than the lanes do."""
CHANGE_WIDTH = 7.0  # metres between the centre lines of two lanes beside each other, at most
SAME = 1.0  # metres within which two routes are one
_TIE, _SHORTEST = 1e-3, 0.01
_SLACK = 30.0  # metres of a route beyond 1.5 times the way driven that are compared with it
_RETURN_METRES, _RETURN_WIDTH = 25.0, 6.0
"""Metres farther along, and metres of distance, at which a line counts as passing a place twice."""


class Route(NamedTuple):
    """Lanes in driving order, with at most one change of lanes."""

    lanes: tuple[int, ...]  # each a successor of the one before, but for the one that the change leads to
    change: int = 0  # place in ``lanes`` of the lane that the change leads to; 0 for none
    begins: float = 0.0  # metres along the lane before that one at which the change begins
    beside: float = 0.0  # metres along the lane it leads to of the place beside that


Path = tuple[float, Route]  # how far a route reaches ahead of the vehicle, in metres, and the route


def routes(
    graph: LaneGraph,
    starts: Sequence[tuple[int, float]],
    *,
    horizon: float = HORIZON,
    onward: float = 0.0,
    limit: int = LIMIT,
) -> list[Route]:
    """Return lane sequences that follow every branch until they reach the horizon or the lanes end.

    Routes without a lane change come first, by start and then by lane index; those with one change follow as far as
    the limit allows. A change is offered where it first becomes possible: on the lane of the start, and where a
    neighbour begins beside the route (a turn pocket). If there are more routes than the limit, the nearest branches
    are all kept, and beyond them routes go on along the straightest lane.

    Starts are pairs (lane, metres from its start at which the vehicle is). Every branch is followed within the
    horizon, metres ahead of the vehicle; ``onward`` metres past it routes go on along the straightest lane.
    """
    if limit < 1:
        raise ValueError(f"limit must be at least 1, is {limit}")
    seeds = [(float(graph.length[lane]) - along, Route((lane,))) for lane, along in starts]
    rank = {lane: k for k, (lane, _) in reversed(list(enumerate(starts)))}

    def order(path: Path) -> tuple[Any, ...]:
        return rank[path[1].lanes[0]], path[1]

    plain = sorted(_complete(graph, seeds, horizon, limit), key=order)
    changed: list[Path] = []
    if len(plain) < limit:
        offered = _changes(graph, [route for _, route in plain], dict(starts), horizon)
        changed = sorted(_complete(graph, offered, horizon, limit), key=order)[: limit - len(plain)]
    return [_onward(graph, reach, route, horizon + onward) for reach, route in plain + changed]


def _complete(graph: LaneGraph, seeds: Sequence[Path], horizon: float, limit: int) -> list[Path]:
    """Extend each path to the horizon; nearest choices first, so that the limit cuts only the farthest. Very short
    lanes in a circle would never get there: a path ends after :data:`MAX_LANES`.
    """
    frontier = sorted(set(seeds))[:limit]
    heapq.heapify(frontier)
    done: list[Path] = []
    while frontier:
        reach, route = heapq.heappop(frontier)
        after = graph.successors[route.lanes[-1]]
        if reach >= horizon or not after or len(route.lanes) >= MAX_LANES:
            done.append((reach, route))
            continue
        if len(done) + len(frontier) + len(after) > limit:
            after = (_straightest(graph, after),)
        for lane in after:
            longer = route._replace(lanes=(*route.lanes, lane))
            heapq.heappush(frontier, (reach + float(graph.length[lane]), longer))
    return done


def _onward(graph: LaneGraph, reach: float, route: Route, until: float) -> Route:
    """Return a route that goes on along the straightest lanes until it reaches ``until``."""
    lanes = list(route.lanes)
    while reach < until and graph.successors[lanes[-1]] and len(lanes) < MAX_LANES:
        lanes.append(_straightest(graph, graph.successors[lanes[-1]]))
        reach += float(graph.length[lanes[-1]])
    return route._replace(lanes=tuple(lanes))


def _straightest(graph: LaneGraph, lanes: Sequence[int]) -> int:
    return min(lanes, key=lambda k: (abs(float(graph.curvature[k] * graph.length[k])), k))


def _changes(graph: LaneGraph, plain: Sequence[Route], along: dict[int, float], horizon: float) -> list[Path]:
    """Return the paths up to and including the lane that a change leads to."""
    found: dict[Route, float] = {}
    known: dict[tuple[int, int, float], tuple[float, float] | None] = {}
    for route in plain:
        first = along[route.lanes[0]]
        reach, offered = -first, set(along)
        for k, lane in enumerate(route.lanes):
            if reach >= horizon:
                break
            here: set[int] = set(along) if k == 0 else set()
            start = first if k == 0 else 0.0
            for other in {*graph.left[lane], *graph.right[lane]} - here:
                # Where the neighbour continues one that was offered already, the change came earlier; where it is a
                # branch of the route itself, it takes no change.
                if k and not offered.union(route.lanes[k - 1 : k]).isdisjoint(graph.predecessors[other]):
                    here.add(other)
                    continue
                if (lane, other, start) not in known:
                    known[lane, other, start] = _change_at(graph, lane, other, start)
                place = known[lane, other, start]
                if place is not None:
                    here.add(other)
                    path = Route((*route.lanes[: k + 1], other), k + 1, *place)
                    found[path] = reach + path.begins + float(graph.length[other]) - path.beside
            reach += float(graph.length[lane])
            offered = here
    return [(reach, path) for path, reach in found.items()]


def _change_at(graph: LaneGraph, lane: int, other: int, start: float) -> tuple[float, float] | None:
    """Return metres along two lanes at which a change begins, from ``start`` on; None if not side by side."""
    line, target = graph.lines[lane], graph.lines[other]
    begins = max(start, paths.beside(line, target[0])[0])
    if begins > graph.length[lane] - paths.CLOSE:
        return None
    point = paths.at(line, graph.arc[lane], np.array([begins]))[0]
    onto, away = paths.beside(target, point)
    if onto > graph.length[other] - paths.CLOSE or away > CHANGE_WIDTH:
        return None
    headings = []
    for number, place in ((lane, begins), (other, max(onto, 0.0))):
        row = min(int(np.searchsorted(graph.arc[number], place, side="right")), len(graph.arc[number]) - 1)
        headings.append(np.arctan2(*(graph.lines[number][row] - graph.lines[number][row - 1])[::-1]))
    if turn_between(np.array(headings[0]), np.array(headings[1])) > CHANGE_TURN:
        return None
    return begins, max(onto, 0.0)


def change_length(speed: float) -> float:
    """Return the metres that a change of lanes takes at a speed in m/s."""
    return max(CHANGE_METRES, CHANGE_SECONDS * abs(speed))


def route_line(
    graph: LaneGraph,
    route: Route,
    start: float = 0.0,
    speed: float = 0.0,
    changes: dict[Route, Reals | None] | None = None,
) -> Reals | None:
    """Return the line [P, 2] that a vehicle follows on a route, in the graph's points; None if nobody can drive it.

    It is the centre line of the lanes, each joined to the one before. A change is a
    :func:`~symphony.roadgraph.paths.blend` from the lane it leaves to the one beside it, :func:`change_length` long,
    or half of that where it is too sharp. Where that is too sharp as well, nobody can drive the route.

    The line begins ``start`` metres along the first lane, where the vehicle has a speed in m/s; a route with a change
    begins on the lane that is left. ``changes`` keeps lines up to the end of changes for routes with the same.
    """
    if not route.change:
        return paths.centre_line(graph, route.lanes, start)
    reach, end = change_length(speed) + paths.CHORD, route.change + 1
    beyond = float(graph.length[route.lanes[route.change]]) - route.beside
    while end < len(route.lanes) and beyond < reach:
        beyond += float(graph.length[route.lanes[end]])
        end += 1
    near = route._replace(lanes=route.lanes[:end])
    changes = {} if changes is None else changes
    if near not in changes:
        changes[near] = _changed(graph, near, start, speed)
    line = changes[near]
    if line is None:
        return None
    return np.concatenate([line, *(paths.followed(graph, *pair) for pair in pairwise(route.lanes[end - 1 :]))])


def _changed(graph: LaneGraph, route: Route, start: float, speed: float) -> Reals | None:
    """Return the line of a route with a change; None if nobody can drive it."""
    before, after = route.lanes[: route.change], route.lanes[route.change :]
    left, arc = graph.lines[before[-1]], graph.arc[before[-1]]
    point = paths.at(left, arc, np.array([route.begins]))[0]
    kept = paths.centre_line(graph, before, start)
    along = paths.arc_lengths(kept)
    kept = kept[along < along[-1] - (arc[-1] - route.begins) - 1e-3]
    target = paths.centre_line(graph, after, route.beside)
    along = paths.arc_lengths(target)
    for length in (change_length(speed), change_length(speed) / 2):
        if along[-1] < length:
            continue
        way = paths.blend(target, point, length)
        if all(paths.gentle(graph, lane) for lane in (before[-1], *after)):
            return np.concatenate([kept, way])
        part = np.concatenate([kept[-1:], way[paths.arc_lengths(way) <= length + paths.CHORD]])
        if paths.sharpest(part) <= paths.sharpest(target[along <= length + paths.CHORD]) + CHANGE_TURN:
            return np.concatenate([kept, way])
    return None


def route_lines(
    graph: LaneGraph,
    found: Sequence[Route],
    along: dict[int, float],
    *,
    spacing: float,
    length: float,
    speed: float = 0.0,
) -> tuple[list[Route], list[Reals]]:
    """Return the routes that can be driven, without those that are the same within :data:`SAME`, and their lines.

    Of several that are the same the first is kept. Lines begin ``along`` metres on the first lanes, end after a
    length in metres, and have points ``spacing`` metres apart; the last piece may be shorter.
    """
    kept: list[Route] = []
    lines: list[Reals] = []
    ends: dict[tuple[int, int, int], list[int]] = {}
    changes: dict[Route, Reals | None] = {}
    for route in found:
        line = route_line(graph, route, along[route.lanes[0]], speed, changes)
        if line is None:
            continue
        points = resampled(line, spacing, length)
        # Lines that are the same have last points in one cell, or in cells side by side.
        count, (x, y) = len(points), np.floor(points[-1] / SAME).astype(int).tolist()
        around = product((count - 1, count, count + 1), (x - 1, x, x + 1), (y - 1, y, y + 1))
        close = (lines[k] for cell in around for k in ends.get(cell, ()))
        # One may have a point more before its last.
        pairs = ((line, [*range(min(len(line), count) - 1), -1]) for line in close)
        if any(np.hypot(*(line[both] - points[both]).T).max() < SAME for line, both in pairs):
            continue
        ends.setdefault((count, x, y), []).append(len(lines))
        kept.append(route)
        lines.append(points)
    return kept, lines


def carried_on(graph: LaneGraph, line: Reals, length: float, speed: float = 0.0) -> Reals | None:
    """Return a line [P, 2] that ends beside lanes that go on, carried on up to a length in metres; None for others.

    Within the last :func:`change_length` of that lane it changes to the nearest of those, over at least
    :data:`CHANGE_METRES`, and follows the straightest lanes from there, again and again if they end beside others.
    """
    drops, found = list(graph.drops), None
    ends = np.array([graph.lines[lane][-1] for lane in drops]).reshape(-1, 2)
    for _ in range(MAX_LANES):
        arc, away = paths.arc_lengths(line), np.hypot(*(ends - line[-1]).T)
        if arc[-1] >= length or away.min(initial=np.inf) > SAME:
            break
        lane = drops[int(away.argmin())]
        within = min(float(graph.length[lane]), change_length(speed), float(arc[-1]))
        point = paths.at(line, arc, arc[-1:] - within)[0]
        places = {other: paths.beside(graph.lines[other], point) for other in graph.drops[lane]}
        other = min(places, key=lambda k: places[k][1])
        rest = float(graph.length[other]) - places[other][0]
        on = _onward(graph, rest, Route((other,)), length - float(arc[-1]) + within)
        target, reach = paths.centre_line(graph, on.lanes, places[other][0]), max(within, CHANGE_METRES)
        near = int(np.searchsorted(paths.arc_lengths(target), 1.5 * reach)) + 1  # it may come by here again
        with np.errstate(divide="ignore", invalid="ignore"):  # of a lane that doubles back; it is not followed
            way = np.concatenate([paths.blend(target[:near], point, reach), target[near:]])
        if places[other][1] > CHANGE_WIDTH or len(way) < 2 or not np.isfinite(way).all():
            break
        line = found = np.concatenate([line[arc < arc[-1] - within - 1e-3], way])
    return found


def ends_inside(graph: LaneGraph, line: Reals) -> bool:
    """Return whether a line [P, 2] ends where the map goes on.

    That is more than 20 m within the convex hull of all lanes, or where a lane lies ahead of its end, at most 30 m
    away, 2.5 m aside and 30 degrees turned.
    """
    end, way = line[-1], line[-1] - line[-2]
    way = way / max(float(np.hypot(*way)), 1e-9)
    points, ways = graph.lane_points
    away = points - end
    along, aside = away @ way, np.abs(away[:, 0] * way[1] - away[:, 1] * way[0])
    if ((along > 1.0) & (along < 30.0) & (aside < 2.5) & (ways @ way > np.cos(np.radians(30.0)))).any():
        return True
    outline = shapely.MultiPoint(points).convex_hull
    return bool(shapely.distance(outline.boundary, shapely.Point(end)) > 20.0)


def resampled(line: Reals, spacing: float, length: float = np.inf) -> Reals:
    """Return points [Q, 2], Q >= 2, of a line ``spacing`` metres apart, up to a length; the last may be nearer, but
    not by so little that rounding decided the direction of its piece.
    """
    arc = paths.arc_lengths(line)
    end = min(length, arc[-1])
    places = np.append(np.arange(0.0, end - _SHORTEST, spacing), end)
    return paths.at(line, arc, places if len(places) > 1 else np.array([0.0, end]))


def route_errors(lines: Sequence[Reals], path: Float[NDArray[Any], "T 2"]) -> Float[NDArray[np.float64], " G"]:
    """Return the mean distance in metres of a driven path to each of the lines [P, 2] that may be followed.

    Only the part of a line that can have been reached counts. Of a line that comes by a place twice only the pass
    counts that the path is on: else one that goes around the block first would be as right as the direct one.

    Lines have the same number of metres between all points but the last two; the path has one place or more.
    """
    path = np.asarray(path, np.float64)
    driven = np.hypot(*np.diff(path, axis=0).T).sum()
    spacing = max(_TIE, *(float(np.hypot(*(line[1] - line[0]))) for line in lines))
    most = min(max(map(len, lines)), int((1.5 * driven + _SLACK) / spacing) + 2)
    # Shorter ones end with their last point again. Routes that part farther on are one here.
    different: dict[bytes, int] = {}
    number = [different.setdefault(line[:most].tobytes(), len(different)) for line in lines]
    padded = np.empty((len(different), most, 2))
    for row, line in zip(number, lines, strict=True):
        padded[row, : len(line)] = line[:most]
        padded[row, len(line) :] = line[-1]
    twice = _returns(padded, spacing)
    errors = np.empty(len(padded))
    for block in np.array_split(np.flatnonzero(~twice), max(1, len(padded) // 16)):
        way, start = np.diff(padded[block], axis=1), padded[block, None, :-1]
        length = np.hypot(way[..., 0], way[..., 1])
        direction = way / np.maximum(length, np.finfo(np.float64).tiny)[..., None]
        away = to_pieces(start, direction[:, None], length[:, None], path[None, :, None])[2]
        errors[block] = away.min(-1).mean(-1)
    if twice.any():
        same = np.broadcast_to(path, (int(twice.sum()), *path.shape))
        places = stations_along(padded[twice], same, np.ones(same.shape[:2], bool))
        pairs = zip(padded[twice], places, strict=True)
        on = [paths.at(line, paths.arc_lengths(line), place) for line, place in pairs]
        errors[twice] = np.linalg.norm(np.stack(on) - same, axis=-1).mean(-1)
    return errors[number]


def _returns(lines: Float[NDArray[np.float64], "R P 2"], spacing: float) -> Bool[NDArray[np.bool_], " R"]:
    """Return which lines come near a place that they were at before."""
    place = np.arange(lines.shape[1])
    later = place[None] - place[:, None] > _RETURN_METRES / spacing
    first, second = np.nonzero(later)
    away = lines[:, first] - lines[:, second]
    # Padding repeats the end of a line, and is no return to it.
    moves = (lines[:, second] != lines[:, second - 1]).any(-1)
    return ((np.hypot(away[..., 0], away[..., 1]) < _RETURN_WIDTH) & moves).any(-1)


def ground_truth_routes(
    lines: Sequence[Reals], trajectory: Float[NDArray[Any], "T 2"], valid: Bool[NDArray[np.bool_], " T"]
) -> Bool[NDArray[np.bool_], " G"]:
    """Return the feasible routes with the smallest displacement error to the logged trajectory (paper, III-B).

    The error is that of :func:`route_errors`. Routes whose errors are within a millimetre are equally right: those
    that diverge beyond the trajectory's end, and all of them where no step is valid. To take one of them by its place
    would bias what is learned about choices.

    Takes the lines of routes (:func:`route_lines`) and a trajectory. Raises ValueError where there are no routes.
    """
    if not lines:
        raise ValueError("no routes to choose from")
    path = np.asarray(trajectory)[np.asarray(valid, bool)]
    if len(path) == 0:
        return np.ones(len(lines), np.bool_)
    errors = route_errors(lines, path)
    return errors <= errors.min() + _TIE
