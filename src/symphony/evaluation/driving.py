"""How single rollouts drive: red lights, wrong way, progress, comfort, distance to the log.

Metres, radians, seconds. Legend: A agents, U states, T = U - 1 steps, M evaluated agents, Q lights.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely

from symphony.data.segment import RunSegment, SignalState
from symphony.evaluation.contacts import Bools, Indices, Reals
from symphony.evaluation.fault import Lights, lane_widths
from symphony.geometry.stations import stations_along
from symphony.metrics.kinds import STANDING
from symphony.roadgraph import LaneGraph
from symphony.roadgraph.routes import ends_inside
from symphony.saved.rollouts import SavedRollouts
from symphony.saved.world import World

RED = (SignalState.STOP, SignalState.ARROW_STOP)
SAME_WAY = math.pi / 2
"""Largest angle between an agent and its lane."""
WRONG_WAY = 2 * math.pi / 3
"""Smallest angle between an agent and a lane that it drives the wrong way."""
IN_LANE = 2.0
"""Metres from a centre line within which an agent is in the lane."""
PAST_END = 5.0
"""Metres from the end of a route beyond which an agent has gone on."""
_FOLLOWED = 3.0
"""Metres from a centre line, on average, within which a path follows the lane."""


def red_lights(world: World, evaluated: Indices, segment: RunSegment, start: int) -> Lights:
    """Red lights that the evaluated agents [M] of one rollout ran.

    An agent runs a light if its front crosses the stop point in the direction of the lane, within the lane's width,
    while the light is red (a plain or arrow stop, not a flashing one), and it follows that lane: of the lanes whose
    lights it crosses at once the one that its path is nearest to, before the stop point where that lies at the end
    of the lane, behind it elsewhere.

    Args:
        world: everyone.
        evaluated: [M] rows of A.
        segment: the lights, with their states in all steps of the log.
        start: step of the log at which the first state lies.
    """
    lanes = [segment.road.lanes[int(lane)][:, :2].astype(np.float64) for lane in segment.signal_lane]
    usable = np.array([len(np.unique(line, axis=0)) > 1 for line in lanes], bool)
    if not usable.any():
        return Lights(*(np.zeros(0, np.int64) for _ in range(3)))
    stop = segment.signal_point[:, :2].astype(np.float64)
    lines = [shapely.LineString(line) if ok else None for line, ok in zip(lanes, usable, strict=True)]
    direction = np.stack([_direction(line, point) for line, point in zip(lines, stop, strict=True)])
    heading = world.heading[evaluated]
    forward = np.stack([np.cos(heading), np.sin(heading)], -1)
    front = world.position[evaluated] + 0.5 * world.size[evaluated, 0, None, None] * forward
    # [M, U, Q] how far each front is past each stop point, and beside it.
    away = front[:, :, None] - stop
    along = (away * direction).sum(-1)
    across = away[..., 1] * direction[:, 0] - away[..., 0] * direction[:, 1]
    beside = np.abs(across[:, 1:]) <= 0.5 * lane_widths(segment.road)[segment.signal_lane]
    passing = (along[:, :-1] < 0) & (along[:, 1:] >= 0) & (along[:, 1:] < 15) & beside & usable
    same = (forward[:, 1:, None] * direction).sum(-1) > math.cos(SAME_WAY)
    passing &= same & (world.valid[evaluated, 1:] & world.valid[evaluated, :-1])[..., None]
    who, step = passing.any(-1).nonzero()
    found = []
    # There are few crossings.
    for m, t in zip(who.tolist(), step.tolist(), strict=True):
        light = _followed(world, int(evaluated[m]), t + 1, passing[m, t].nonzero()[0], lines, stop)
        # One that changes just then is not held against the agent.
        if light >= 0 and np.isin(segment.signal_state[light, start + t : start + t + 2], RED).all():
            found.append((int(evaluated[m]), t + 1, light))
    return Lights(*np.array(found, np.int64).reshape(-1, 3).T)


def _direction(line: shapely.LineString | None, point: Reals) -> Reals:
    """Unit vector of a lane where it is nearest to a point."""
    if line is None:
        return np.zeros(2)
    at = min(line.project(shapely.Point(point)), line.length - min(1.0, line.length))
    ends = [np.asarray(line.interpolate(s).coords[0]) for s in (at, at + min(1.0, line.length))]
    return (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])


def _followed(
    world: World, agent: int, step: int, lights: Indices, lines: list[shapely.LineString | None], stop: Reals
) -> int:
    """Which of the lights is that of the lane an agent follows past a stop point; -1 for none."""
    path, valid = world.position[agent], world.valid[agent]
    best, least = -1, _FOLLOWED
    for light in lights.tolist():
        line = lines[light]
        assert line is not None  # noqa: S101 - only usable lanes are passed
        at_end = line.project(shapely.Point(stop[light])) > 0.5 * line.length
        part = slice(0, step) if at_end else slice(step, None)
        points = path[part][valid[part]]
        driven = np.linalg.norm(points - stop[light], axis=-1)
        points = points[driven <= line.length]
        if len(points):
            distance = float(shapely.distance(line, shapely.points(points)).mean())
            best, least = (light, distance) if distance < least else (best, least)
    return best


def wrong_way(world: World, evaluated: Indices, graph: LaneGraph) -> Bools:
    """[M, U] whether an evaluated agent drives in a lane that leads the other way, and in none that leads its way."""
    seen = world.valid[evaluated] & (np.abs(world.speed[evaluated]) > STANDING)
    position, heading = world.position[evaluated][seen], world.heading[evaluated][seen]
    near = graph.index.near(position, IN_LANE)
    turn = np.abs((near.heading - heading[near.point] + np.pi) % (2 * np.pi) - np.pi)
    wrong, right = np.zeros((2, len(position)), bool)
    wrong[near.point[turn > WRONG_WAY]] = True
    right[near.point[turn < SAME_WAY]] = True
    out = np.zeros(seen.shape, bool)
    out[seen] = wrong & ~right
    return out


class Progress(NamedTuple):
    """Metres [K, M] that evaluated agents got on in all, that they did while the log has them, and the log itself.

    The first two are NaN where an agent went on beyond a route that ends inside the map.
    """

    driven: Reals
    compared: Reals
    logged: Reals


def progress(saved: SavedRollouts, evaluated: Indices) -> Progress:
    """How far evaluated agents (numbers [M] of the driven ones) got on.

    It is measured along the route that an agent follows, and beyond its end along the path of the log, where the log
    goes on from there. A route that passes a place twice is followed in order
    (:func:`symphony.geometry.stations.stations_along`). For an agent that goes on where both end but the map does not
    it is NaN. Without a route it is the length of the agent's path.
    """
    rows, within = saved.agents[evaluated], slice(saved.start, saved.last + 1)
    there = saved.there[..., evaluated].swapaxes(1, 2)
    path = saved.state[:, :, evaluated, :2].swapaxes(1, 2).astype(np.float64)
    log = saved.segment.position[rows, within, :2].astype(np.float64)
    seen = saved.segment.valid[rows, within]
    goal = saved.goal[:, evaluated]
    both = there & seen
    driven, compared = _length(path, there), _length(path, both)
    logged = np.broadcast_to(_length(log, seen), goal.shape).copy()
    counts = np.diff(saved.routes.offsets)
    has = np.append(counts > 1, False)[goal]
    if not has.any():
        return Progress(driven, compared, logged)
    # Agents have routes of their own, so a route is that of one agent.
    number = np.broadcast_to(np.arange(len(evaluated)), goal.shape)
    pairs = dict(zip(goal[has].tolist(), number[has].tolist(), strict=True))
    whole = {
        route: _with_log(saved.routes[route][:, :2].astype(np.float64), log[agent], seen[agent])
        for route, agent in pairs.items()
    }
    most = max(map(len, whole.values()))
    along = {route: np.pad(line, ((0, most - len(line)), (0, 0)), "edge") for route, line in whole.items()}
    lines = np.stack([along[route] for route in goal[has].tolist()])
    places = stations_along(lines, path[has], there[has])
    driven[has], compared[has] = _advance(places, there[has]), _advance(places, both[has])
    who = list(pairs.values())
    of_log = stations_along(np.stack(list(along.values())), log[who], seen[who])
    advance = dict(zip(whole, _advance(of_log, seen[who]).tolist(), strict=True))
    logged[has] = [advance[route] for route in goal[has].tolist()]
    # Whoever is farther from the end than a vehicle is long has gone on from it.
    past = np.linalg.norm(path[has] - lines[:, -1:], axis=-1) > PAST_END
    past &= places >= np.linalg.norm(np.diff(lines, axis=1), axis=-1).sum(-1)[:, None] - 1e-3
    beyond = np.flatnonzero((past & there[has]).any(1))
    if len(beyond):
        graph = LaneGraph(saved.segment.road)
        open_end = {route: ends_inside(graph, line) for route, line in whole.items()}
        undefined = [k for k in beyond.tolist() if open_end[int(goal[has][k])]]
        for part in (driven, compared):
            values = part[has]
            values[undefined] = np.nan
            part[has] = values
    return Progress(driven, compared, logged)


def _with_log(route: Reals, log: Reals, seen: Bools) -> Reals:
    """A route [P, 2], and from its end on the path of a log [U, 2] that goes on from there."""
    places = stations_along(route[None], log[None], seen[None])[0]
    length = np.linalg.norm(np.diff(route, axis=0), axis=-1).sum()
    passed = np.flatnonzero(seen & (places >= length - 1e-3))
    if not len(passed) or np.linalg.norm(log[passed[0]] - route[-1]) > PAST_END + _FOLLOWED:
        return route
    path = log[passed]
    moves = np.linalg.norm(np.diff(np.concatenate([route[-1:], path]), axis=0), axis=-1) > 0.1
    return np.concatenate([route, path[moves]])


def _length(path: Reals, valid: Bools) -> Reals:
    """[...] of paths [..., U, 2]."""
    strides = np.linalg.norm(np.diff(path, axis=-2), axis=-1)
    return np.where(valid[..., 1:] & valid[..., :-1], strides, 0).sum(-1)


def _advance(places: Reals, counted: Bools) -> Reals:
    """Metres [R] from the first to the last counted one of places along lines [R, U]."""
    row, last = np.arange(len(places)), counted.shape[1] - 1 - counted[:, ::-1].argmax(1)
    return np.where(counted.any(1), places[row, last] - places[row, counted.argmax(1)], 0.0)


class Comfort(NamedTuple):
    """Motion of evaluated agents [K, T, M]; NaN where it is not known: m/s^2, m/s^3, m/s^2."""

    acceleration: Reals
    jerk: Reals
    lateral: Reals


def comfort(saved: SavedRollouts, evaluated: Indices) -> Comfort:
    """Differences of speed, of acceleration, and speed times yaw rate, over one step each, not smoothed."""
    state, dt = saved.state[:, :, evaluated].astype(np.float64), saved.segment.dt
    state = np.where(saved.there[:, :, evaluated][..., None], state, np.nan)
    speed, heading = state[..., 3], state[..., 2]
    acceleration = np.diff(speed, axis=1) / dt
    turn = (np.diff(heading, axis=1) + np.pi) % (2 * np.pi) - np.pi
    jerk = np.diff(acceleration, axis=1, prepend=np.nan) / dt
    return Comfort(acceleration, jerk, 0.5 * (speed[:, 1:] + speed[:, :-1]) * turn / dt)


def log_distance(saved: SavedRollouts, evaluated: Indices) -> tuple[Reals, Indices]:
    """Metres from the log, summed over the steps at which there is one, and their number: both [K]."""
    rows, within = saved.agents[evaluated], slice(saved.start + 1, saved.last + 1)
    log = saved.segment.position[rows, within, :2].swapaxes(0, 1)
    both = saved.counted[:, :, evaluated] & saved.segment.valid[rows, within].T
    away = np.linalg.norm(saved.state[:, 1:, evaluated, :2].astype(np.float64) - log, axis=-1)
    return np.where(both, away, 0.0).sum((1, 2)), both.sum((1, 2))
