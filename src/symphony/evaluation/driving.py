"""The driving in single rollouts: red lights, wrong way, blocking traffic, progress, comfort, distance to the log.

Metres, radians, seconds. Legend: A agents, U states, T = U - 1 steps, M evaluated agents, Q lights, E moments.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from torch import from_numpy

from symphony.data.levels import levels_of
from symphony.data.segment import GREEN, RED, RunSegment, SignalState, wrap
from symphony.geometry import levels_apart
from symphony.geometry.polylines import stations_along
from symphony.metrics.kinds import STANDING
from symphony.roadgraph import LaneGraph, lane_of
from symphony.roadgraph.graph import Near, line_strings, turn_between
from symphony.roadgraph.routes import ends_inside
from symphony.saved.rollouts import SavedRollouts, World

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]
Bools = NDArray[np.bool_]
Heights = NDArray[np.float32] | None
"""Height and level [..., 2] of places; None where the map has no levels, so that all are on one."""

SAME_WAY = math.pi / 2  # largest angle between an agent and its lane
WRONG_WAY = 2 * math.pi / 3  # smallest angle between an agent and a lane that it drives the wrong way
IN_LANE = 2.0  # metres from a centre line within which an agent is in the lane
PAST_END = 5.0  # metres from the end of a route beyond which an agent has gone on
SECONDS = 3.0  # for which an agent must stand on a free road to block it
FREE = 15.0  # metres ahead of the front without other agents and without a light other than green
CROSSING = 25.0  # metres within which others that move across are given way to
ASIDE = 0.5  # metres beside its box that an agent wants to be free, and that it may reach into a lane
_FOLLOWED = 3.0  # metres from a centre line, on average, within which a path follows the lane
_PASSED = 5.0  # metres that the front may be past a stop point and still wait for its light
_LANE = 2.5  # metres aside within which a light is that of an agent's lane


class Lanes:
    """The lanes of a run segment, and which of them are on the level of a place (see :mod:`symphony.data.levels`).
    ``graph`` says how they connect, ``width`` [L] how wide they are, in metres; nominal where the source does not.
    """

    def __init__(self, segment: RunSegment) -> None:
        self.segment, self.graph, self._levels = segment, LaneGraph(segment.road), levels_of(segment)
        self.width = segment.road.widths

    def near(self, position: Reals, reach: float, height: Heights) -> Near:
        """Return pairs of a position [n, 2] and a lane on its level at most ``reach`` metres away."""
        found = self.graph.index.near(position, reach)
        return found if height is None else found.only(self._kept(found, height))

    def lane_of(self, position: Reals, heading: Reals, height: Heights) -> Indices:
        """Return the lane on its level that each agent [n] is in, see :func:`symphony.roadgraph.lane_of`."""
        keep = None if height is None else lambda near: self._kept(near, height)
        return lane_of(self.graph, position, heading, keep=keep)

    @cached_property
    def lit(self) -> bool:
        """Whether any light of a lane that has a length is ever known."""
        state = self.segment.signal_state[self.graph.length[self.segment.signal_lane] > 0]
        return bool((state != SignalState.UNKNOWN).any())

    @cached_property
    def light_height(self) -> NDArray[np.float32]:
        """The height and level of the lights [Q, 2], taken from their lanes."""
        place = np.zeros((len(self.segment.signal_lane), 3))
        for light, lane in enumerate(self.segment.signal_lane.tolist()):
            line = self.segment.road.lanes[lane]
            away = np.linalg.norm(line[:, :2] - self.segment.signal_point[light, :2], axis=-1)
            place[light] = line[away.argmin()]
        return self._levels.at(place)

    def _kept(self, near: Near, height: NDArray[np.float32]) -> Bools:
        place = np.zeros((len(near.line), 3))
        for number in np.unique(near.line):
            mine = near.line == number
            line = self.segment.road.lanes[int(self.graph.usable_lanes[number])].astype(np.float64)
            arc = np.append(0, np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T)))
            place[mine] = np.stack([np.interp(near.along[mine], arc, part) for part in line.T], -1)
        return ~levels_apart(from_numpy(self._levels.at(place)), from_numpy(height[near.point])).numpy()


class Lights(NamedTuple):
    """Lights that were red when agents drove past, all [E]: row of A, state, light."""

    agent: Indices
    step: Indices
    light: Indices


def red_lights(world: World, evaluated: Indices, lanes: Lanes, start: int) -> Lights:
    """Return the red lights that the evaluated agents [M] of one rollout ran.

    An agent runs a light if its front crosses the stop point in the direction of the lane, within the lane's width
    and on its level, while the light is red (a plain or arrow stop, not a flashing one), and it follows that lane: of
    the lanes whose stop points it crosses side by side the one that its path is nearest to, before the stop point
    where that lies at the end of the lane, behind it elsewhere. ``start`` is the step of the log at the first state.
    """
    segment, graph = lanes.segment, lanes.graph
    known = np.flatnonzero(graph.length[segment.signal_lane] > 0)
    lane, stop = segment.signal_lane[known], segment.signal_point[known, :2].astype(np.float64)
    lines, length = line_strings([graph.lines[each] for each in lane]), graph.length[lane]
    along_lane = shapely.line_locate_point(lines, shapely.points(stop))
    begin = np.minimum(along_lane, np.maximum(length - 1.0, 0.0))
    ends = [shapely.get_coordinates(shapely.line_interpolate_point(lines, at)) for at in (begin, begin + 1.0)]
    direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0], axis=-1, keepdims=True)
    heading = world.heading[evaluated]
    forward = np.stack([np.cos(heading), np.sin(heading)], -1)
    front = world.position[evaluated] + 0.5 * world.size[evaluated, 0, None, None] * forward
    # [M, U, Q] how far each front is past each stop point, and beside it.
    away = front[:, :, None] - stop
    along = (away * direction).sum(-1)
    across = away[..., 1] * direction[:, 0] - away[..., 0] * direction[:, 1]
    passing = (along[:, :-1] < 0) & (along[:, 1:] >= 0) & (along[:, 1:] < max(15.0, 60.0 * segment.dt))
    # Straight from state to state, the front is where it crosses the line, not where the step ends.
    beside = np.abs(across[:, :-1] * along[:, 1:] - across[:, 1:] * along[:, :-1])
    passing &= beside <= 0.5 * lanes.width[lane] * np.diff(along, axis=1)
    passing &= (forward[:, 1:, None] * direction).sum(-1) > math.cos(SAME_WAY)
    passing &= (world.valid[evaluated, 1:] & world.valid[evaluated, :-1])[..., None]
    if world.height is not None:
        here, there = world.height[evaluated, 1:, None], lanes.light_height[known]
        passing &= ~levels_apart(from_numpy(here), from_numpy(there)).numpy()
    found = []
    # There are few crossings.
    for m, t in zip(*(part.tolist() for part in passing.any(-1).nonzero()), strict=True):
        best, least, agent = -1, math.inf, evaluated[m]
        # Where it was without a break, away from the stop point.
        gone = np.flatnonzero(~world.valid[agent])
        first, last = gone[gone <= t].max(initial=-1) + 1, gone[gone > t].min(initial=world.valid.shape[1])
        behind, ahead = world.position[agent, first : t + 1][::-1], world.position[agent, t + 1 : last]
        # Lanes that part here differ in direction, so that one front may cross their stop points in different steps.
        beside = np.linalg.norm(stop - stop[passing[m, t].argmax()], axis=-1) < _PASSED
        for light in (passing[m].any(0) & beside).nonzero()[0]:
            path = behind if along_lane[light] > 0.5 * length[light] else ahead
            way = shapely.linestrings(np.concatenate([path[:1], path]))  # which may have no length
            points = shapely.line_interpolate_point(way, np.arange(min(way.length, length[light]) + 1))
            off = shapely.distance(points, shapely.points(stop[light]))
            # It may come by here again. A step may be longer than the lane, and an agent, whose centre is before it.
            points, line = points[off <= max(length[light], off.min())], graph.lines[lane[light]]
            reach = 0.5 * world.size[agent, 0] + np.linalg.norm(stop[light] - line[0])
            before = line[:1] + reach * (line[0] - line[1]) / np.linalg.norm(line[0] - line[1])
            longer = shapely.linestrings(np.concatenate([before, line]))
            distance = float(shapely.distance(lines[light], points).mean())
            if distance < least and shapely.distance(longer, points).mean() < _FOLLOWED:
                best, least = int(light), distance
        # One that changes just then is not held against the agent.
        shown = segment.signal_state[known[best], start + t : start + t + 2]
        if best >= 0 and passing[m, t, best] and np.isin(shown, RED).all():
            found.append((int(agent), t + 1, int(known[best])))
    return Lights(*np.array(found, np.int64).reshape(-1, 3).T)


def wrong_way(world: World, evaluated: Indices, lanes: Lanes) -> Bools:
    """Return [M, U] whether an evaluated agent drives in a lane that leads the other way, and in none of its way."""
    seen = world.valid[evaluated] & (np.abs(world.speed[evaluated]) > STANDING)
    position, heading = world.position[evaluated][seen], world.heading[evaluated][seen]
    near = lanes.near(position, IN_LANE, None if world.height is None else world.height[evaluated][seen])
    turn = turn_between(near.heading, heading[near.point])
    wrong, right = np.zeros((2, len(position)), bool)
    wrong[near.point[turn > WRONG_WAY]] = True
    right[near.point[turn < SAME_WAY]] = True
    out = np.zeros(seen.shape, bool)
    out[seen] = wrong & ~right
    return out


def blocking(world: World, evaluated: Indices, lanes: Lanes, start: int) -> Bools:
    """Return [M, U] when evaluated agents block traffic: stand (:data:`symphony.metrics.kinds.STANDING`) in a lane
    that goes on, along or across it, for :data:`SECONDS` or more, while nobody is in their way ahead or crosses it,
    no light ahead is other than green, and the log, where it has the agent, moves. All this is on their level.
    """
    segment = lanes.segment
    within = slice(start, start + world.valid.shape[1])
    logged = np.linalg.norm(segment.velocity[evaluated, within].astype(np.float64), axis=-1) <= STANDING
    excused = logged & segment.valid[evaluated, within]
    excused[:, max(segment.log_steps - start, 0) :] = False
    stands = world.valid[evaluated] & (np.abs(world.speed[evaluated]) <= STANDING) & ~excused
    found, (who, step) = np.zeros(stands.shape, bool), _long(stands, segment.dt).nonzero()
    if not len(who):
        return found
    row = evaluated[who]
    height = None if world.height is None else world.height[row, step]
    free = _goes_on(lanes, world.position[row, step], world.heading[row, step], world.size[row], height)
    free &= _nobody_ahead(world, row, step, height) & _green(world, row, step, lanes, start, height)
    found[who[free], step[free]] = True
    return _long(found, segment.dt)


def half_across(turn: Reals, size: Reals) -> Reals:
    """Return half of the metres [...] that boxes [..., 2], turned from a line, take up across it."""
    return np.asarray(0.5 * (np.abs(np.stack([np.sin(turn), np.cos(turn)], -1)) * size).sum(-1))


def _long(flags: Bools, dt: float) -> Bools:
    least = math.ceil(SECONDS / dt - 1e-6) + 1
    if flags.shape[1] < least:
        return np.zeros_like(flags)
    whole = np.lib.stride_tricks.sliding_window_view(flags, least, axis=1).all(-1)
    padded = np.pad(whole, ((0, 0), (least - 1, least - 1)))
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, least, axis=1).any(-1))


def _seen_from(world: World, row: Indices, step: Indices, points: Reals) -> tuple[Reals, Reals]:
    """Return how far points [E, K, 2] are ahead of agents' fronts, and to their left [E, K]."""
    heading = world.heading[row, step][:, None]
    x, y = np.moveaxis(points - world.position[row, step][:, None], -1, 0)
    cos, sin = np.cos(heading), np.sin(heading)
    return cos * x + sin * y - 0.5 * world.size[row, :1], cos * y - sin * x


def _goes_on(lanes: Lanes, position: Reals, heading: Reals, size: Reals, height: Heights) -> Bools:
    """Return whether boxes [E] reach :data:`ASIDE` metres or more into lanes that go on for a while."""
    graph, found = lanes.graph, np.zeros(len(position), bool)
    near = lanes.near(position, 0.5 * size.max(initial=0) + 0.5 * lanes.width.max(initial=0), height)
    lane, turn = graph.usable_lanes[near.line], near.heading - heading[near.point]
    covered = half_across(turn, size[near.point])
    follows = np.array([len(after) > 0 for after in graph.successors], bool)
    goes_on = follows[lane] | (graph.length[lane] - near.along > FREE)
    found[near.point[goes_on & (near.distance < 0.5 * lanes.width[lane] + covered - ASIDE)]] = True
    return found


def _nobody_ahead(world: World, row: Indices, step: Indices, height: Heights) -> Bools:
    ahead, left = _seen_from(world, row, step, world.position[:, step].swapaxes(0, 1))
    turn = (world.heading[:, step] - world.heading[row, step]).T
    along, across = half_across(turn, world.size[:, ::-1]), half_across(turn, world.size)
    there = world.valid[:, step].T & (row[:, None] != np.arange(len(world.size)))
    if world.height is not None and height is not None:
        level = from_numpy(world.height[:, step].swapaxes(0, 1))
        there &= ~levels_apart(level, from_numpy(height)[:, None]).numpy()
    wide = 0.5 * world.size[row, 1][:, None] + ASIDE
    in_the_way = (ahead + along > 0) & (ahead - along < FREE) & (np.abs(left) - across < wide)
    moves = np.abs(world.speed[:, step].T) > STANDING
    moves &= np.abs(np.sin(turn)) > math.sin(math.pi / 4)
    crossing = moves & (np.hypot(ahead, left) < CROSSING) & (ahead > -along)
    return ~(there & (in_the_way | crossing)).any(1)


def _green(world: World, row: Indices, step: Indices, lanes: Lanes, start: int, height: Heights) -> Bools:
    segment = lanes.segment
    points = segment.signal_point[:, :2].astype(np.float64)
    ahead, left = _seen_from(world, row, step, np.broadcast_to(points, (len(row), *points.shape)))
    near = (ahead > -_PASSED) & (ahead < FREE) & (np.abs(left) < _LANE)
    if height is not None:
        near &= ~levels_apart(from_numpy(height[:, None]), from_numpy(lanes.light_height)).numpy()
    state = segment.signal_state[:, np.minimum(start + step, segment.num_steps - 1)].T
    return np.asarray(~(near & ~np.isin(state, GREEN)).any(1))


def progress(saved: SavedRollouts, evaluated: Indices, lanes: Lanes) -> tuple[Reals, Reals, Reals]:
    """Return the progress [K, M] in metres of evaluated agents: in all, while the log has them, and that of the log.

    They are measured along the route that an agent follows, and beyond its end along the path of the log, where the
    log goes on from there. A route that passes a place twice is followed in order
    (:func:`symphony.geometry.polylines.stations_along`). Without a route they are the length of the agent's path; of
    an agent that goes on where route and log end but the map does not the first two are NaN.
    """
    rows, within = saved.agents[evaluated], slice(saved.start, saved.last + 1)
    there = saved.there[..., evaluated].swapaxes(1, 2)
    path = saved.state[:, :, evaluated, :2].swapaxes(1, 2).astype(np.float64)
    log = saved.segment.position[rows, within, :2].astype(np.float64)
    seen = saved.logged(rows)
    goal = saved.goal[:, evaluated]
    left = (~there & (there.cumsum(-1) > 0)).cumsum(-1) > 0  # one that comes back is elsewhere, on purpose
    both = there & seen & ~left
    driven, compared = _length(path, there), _length(path, both)
    logged = np.broadcast_to(_length(log, seen), goal.shape).copy()
    has = np.append(np.diff(saved.routes.offsets) > 1, False)[goal]
    if not has.any():
        return driven, compared, logged
    # Agents have routes of their own, so a route is that of one agent.
    pairs = dict(zip(goal[has].tolist(), has.nonzero()[1].tolist(), strict=True))
    who, number = list(pairs.values()), {route: k for k, route in enumerate(pairs)}
    which = [number[route] for route in goal[has].tolist()]
    routes = [saved.routes[route][:, :2].astype(np.float64) for route in pairs]
    whole = [_with_log(route, log[agent], seen[agent]) for route, agent in zip(routes, who, strict=True)]
    most = max(map(len, whole))
    lines = np.stack([np.pad(line, ((0, most - len(line)), (0, 0)), "edge") for line in whole])
    places = stations_along(lines[which], path[has], there[has])
    # Stretch by stretch, for one that came back to where it had begun.
    stays = there[has][:, 1:] & there[has][:, :-1]
    driven[has], compared[has] = np.where(stays, np.diff(places, axis=1), 0.0).sum(1), _advance(places, both[has])
    logged[has] = _advance(stations_along(lines, log[who], seen[who]), seen[who])[which]
    # An agent that is farther from the end than a vehicle is long has gone on from it.
    past = np.linalg.norm(path[has] - lines[which][:, -1:], axis=-1) > PAST_END
    past &= places >= np.linalg.norm(np.diff(lines, axis=1), axis=-1).sum(-1)[which][:, None] - 1e-3
    beyond = np.zeros_like(has)
    beyond[has] = (past & there[has]).any(1)
    if beyond.any():
        beyond[has] &= np.array([ends_inside(lanes.graph, line) for line in whole])[which]
        driven[beyond] = compared[beyond] = np.nan
    return driven, compared, logged


def _with_log(route: Reals, log: Reals, seen: Bools) -> Reals:
    """Return a route [P, 2], and from its end on the path of a log [U, 2] that goes on from there."""
    places = stations_along(route[None], log[None], seen[None])[0]
    length = np.linalg.norm(np.diff(route, axis=0), axis=-1).sum()
    passed = np.flatnonzero(seen & (places >= length - 1e-3))
    if not len(passed) or np.linalg.norm(log[passed[0]] - route[-1]) > PAST_END + _FOLLOWED:
        return route
    path = log[passed]
    moves = np.linalg.norm(np.diff(np.concatenate([route[-1:], path]), axis=0), axis=-1) > 0.1
    return np.concatenate([route, path[moves]])


def _length(path: Reals, valid: Bools) -> Reals:
    strides = np.linalg.norm(np.diff(path, axis=-2), axis=-1)
    return np.where(valid[..., 1:] & valid[..., :-1], strides, 0).sum(-1)


def _advance(places: Reals, counted: Bools) -> Reals:
    """Return metres [R] from the first to the last counted one of places along lines [R, U]."""
    row, last = np.arange(len(places)), counted.shape[1] - 1 - counted[:, ::-1].argmax(1)
    return np.where(counted.any(1), places[row, last] - places[row, counted.argmax(1)], 0.0)


def comfort(saved: SavedRollouts, evaluated: Indices) -> tuple[Reals, Reals, Reals]:
    """Return acceleration, jerk and lateral acceleration of evaluated agents [K, T, M], NaN where it is not known.
    They are differences of speed and of acceleration, and speed times yaw rate, over one step each, not smoothed.
    """
    state, dt = saved.state[:, :, evaluated].astype(np.float64), saved.segment.dt
    state = np.where(saved.there[:, :, evaluated][..., None], state, np.nan)
    speed, heading = state[..., 3], state[..., 2]
    acceleration = np.diff(speed, axis=1) / dt
    turn = wrap(np.diff(heading, axis=1))
    jerk = np.diff(acceleration, axis=1, prepend=np.nan) / dt
    return acceleration, jerk, 0.5 * (speed[:, 1:] + speed[:, :-1]) * turn / dt


def log_distance(saved: SavedRollouts, evaluated: Indices) -> tuple[Reals, Indices]:
    """Return the metres from the log, summed over the steps at which there is one, and their number: both [K]."""
    rows, within = saved.agents[evaluated], slice(saved.start + 1, saved.last + 1)
    log = saved.segment.position[rows, within, :2].swapaxes(0, 1)
    both = saved.counted[:, :, evaluated] & saved.logged(rows)[:, 1:].T
    away = np.linalg.norm(saved.state[:, 1:, evaluated, :2].astype(np.float64) - log, axis=-1)
    return np.where(both, away, 0.0).sum((1, 2)), both.sum((1, 2))
