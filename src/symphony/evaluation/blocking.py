"""Who blocks traffic: stands in a lane, for no reason that can be seen.

Metres, radians, seconds. Legend: A agents, U states of a rollout, M evaluated agents, Q lights.
"""

from __future__ import annotations

import math

import numpy as np
import shapely
from torch import from_numpy

from symphony.data.segment import RunSegment, SignalState
from symphony.evaluation.contacts import Bools, Indices, Reals
from symphony.geometry import levels_apart
from symphony.metrics.kinds import STANDING
from symphony.roadgraph import LaneGraph, lane_of
from symphony.saved.world import World

SECONDS = 3.0
"""For which an agent must stand on a free road to block it."""
FREE = 15.0
"""Metres ahead of the front that nobody is in and no light that is not green."""
CROSSING = 25.0
"""Metres within which others that move across are given way to."""
ASIDE = 0.5
"""Metres beside its box that an agent wants to be free."""
_PASSED = 5.0
"""Metres that the front may be past a stop point and still wait for its light."""
_LANE = 2.5


def blocking(world: World, evaluated: Indices, segment: RunSegment, graph: LaneGraph, start: int) -> Bools:
    """[M, U] when evaluated agents block traffic.

    That is, they stand (:data:`symphony.metrics.kinds.STANDING`) in a lane that goes on, for :data:`SECONDS` or more,
    while nobody is in their way ahead or crosses it, no light ahead is other than green, and the log, where it has
    the agent, moves.

    Args:
        world: everyone.
        evaluated: [M] rows of A.
        segment: map, lights and log.
        graph: the lanes.
        start: step of the log at which the first state lies.
    """
    steps = world.valid.shape[1]
    within = slice(start, start + steps)
    logged = np.linalg.norm(segment.velocity[evaluated, within].astype(np.float64), axis=-1) <= STANDING
    excused = logged & segment.valid[evaluated, within]
    stands = world.valid[evaluated] & (np.abs(world.speed[evaluated]) <= STANDING) & ~excused
    found, (who, step) = np.zeros(stands.shape, bool), _long(stands, segment.dt).nonzero()
    if not len(who):
        return found
    row = evaluated[who]
    free = _in_lane(world, row, step, graph) & _nobody_ahead(world, row, step)
    free &= _green(world, row, step, segment, start)
    found[who[free], step[free]] = True
    return _long(found, segment.dt)


def _long(flags: Bools, dt: float) -> Bools:
    """Flags [M, U] that stay for :data:`SECONDS` at least."""
    least = math.ceil(SECONDS / dt - 1e-6) + 1
    if flags.shape[1] < least:
        return np.zeros_like(flags)
    whole = np.lib.stride_tricks.sliding_window_view(flags, least, axis=1).all(-1)
    padded = np.pad(whole, ((0, 0), (least - 1, least - 1)))
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, least, axis=1).any(-1))


def _seen_from(world: World, row: Indices, step: Indices, points: Reals) -> tuple[Reals, Reals]:
    """How far points [E, K, 2] are ahead of agents' fronts, and to their left [E, K]."""
    heading = world.heading[row, step][:, None]
    x, y = np.moveaxis(points - world.position[row, step][:, None], -1, 0)
    cos, sin = np.cos(heading), np.sin(heading)
    return cos * x + sin * y - 0.5 * world.size[row, :1], cos * y - sin * x


def _nobody_ahead(world: World, row: Indices, step: Indices) -> Bools:
    ahead, left = _seen_from(world, row, step, world.position[:, step].swapaxes(0, 1))
    turn = (world.heading[:, step] - world.heading[row, step]).T
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    along, across = (
        0.5 * (one * world.size[:, 0] + two * world.size[:, 1]) for one, two in ((cos, sin), (sin, cos))
    )
    there = world.valid[:, step].T & (row[:, None] != np.arange(len(world.size)))
    if world.height is not None:
        level = from_numpy(world.height[:, step].swapaxes(0, 1))
        there &= ~levels_apart(level, from_numpy(world.height[row, step])[:, None]).numpy()
    near = (ahead + along > 0) & (ahead - along < FREE)
    wide = 0.5 * world.size[row, 1][:, None] + ASIDE
    in_the_way = near & (np.abs(left) - across < wide)
    moves = np.abs(world.speed[:, step].T) > STANDING
    crossing = moves & (sin > math.sin(math.pi / 4)) & (np.hypot(ahead, left) < CROSSING) & (ahead > -along)
    return ~(there & (in_the_way | crossing)).any(1)


def _green(world: World, row: Indices, step: Indices, segment: RunSegment, start: int) -> Bools:
    points = segment.signal_point[:, :2].astype(np.float64)
    ahead, left = _seen_from(world, row, step, np.broadcast_to(points, (len(row), *points.shape)))
    near = (ahead > -_PASSED) & (ahead < FREE) & (np.abs(left) < _LANE)
    state = segment.signal_state[:, np.minimum(start + step, segment.num_steps - 1)].T
    green = (state == SignalState.GO) | (state == SignalState.ARROW_GO)
    return ~(near & ~green).any(1)


def _in_lane(world: World, row: Indices, step: Indices, graph: LaneGraph) -> Bools:
    """Whether agents are in lanes that go on for a while."""
    position = world.position[row, step]
    lane = lane_of(graph, position, world.heading[row, step])
    found, inside = lane >= 0, np.flatnonzero(lane >= 0)
    lines = graph.index.geometry[np.searchsorted(graph.usable_lanes, lane[inside])]
    left = graph.length[lane[inside]] - shapely.line_locate_point(lines, shapely.points(position[inside]))
    follows = np.array([len(after) > 0 for after in graph.successors], bool)
    found[inside] = follows[lane[inside]] | (left > FREE)
    return found
