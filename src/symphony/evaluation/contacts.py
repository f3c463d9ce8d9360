"""Collisions of single rollouts: with whom, how, and whose fault; and how long until the next one.

Whose fault follows the sense of nuPlan's metric of at-fault collisions (https://github.com/motional/nuplan-devkit):
an agent answers for what it drives into, not for being driven into. Of each pair the first contact counts.

Metres, radians, seconds. Legend: A agents, U states of a rollout, M evaluated agents, E contacts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely
import torch
from numpy.typing import NDArray

from symphony.data.segment import LaneType, RoadMap
from symphony.geometry import boxes_overlap
from symphony.metrics import CollisionKind, collision_kinds
from symphony.metrics.kinds import STANDING
from symphony.roadgraph import LaneGraph, lane_of
from symphony.simulation.world import World

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]
Bools = NDArray[np.bool_]

STILL = 0.05
"""Speed in m/s up to which an agent that is hit has stopped, so that nothing is its fault (as in nuPlan)."""
HORIZON = 5.0
"""Seconds ahead that a collision is looked for."""
NOMINAL_WIDTH = 3.6
"""Metres, of lanes whose width is not known."""
BIKE_WIDTH = 1.6
_EDGE = 0.1
"""Metres an agent may reach over the edge of its lane and still count as within it."""
_SLACK = 1e-3
_PAIRS = 1 << 20
"""Pairs of agents, times states, held at a time."""


class Contacts(NamedTuple):
    """The first contact of evaluated agents with each other agent, all [E], by step, then agent.

    Attributes:
        agent: row of A.
        other: row of A.
        step: state at which they first overlap, from 1.
        kind: :class:`CollisionKind`, from the agent's point of view.
        fault: whether the agent is at fault.
    """

    agent: Indices
    other: Indices
    step: Indices
    kind: Indices
    fault: Bools


def contacts(world: World, evaluated: Indices, graph: LaneGraph, road: RoadMap, offroad: Bools) -> Contacts:
    """Collisions of the evaluated agents [M] of one rollout.

    At fault is an agent that was moving at the contact and

    - hit one that stood (:data:`symphony.metrics.kinds.STANDING`), or
    - hit the one ahead of it, or any other with its front, or
    - was touched at its side while it reached out of its lane or was off the road, or
    - backed into another.

    It is not at fault when it had stopped, when it was hit from behind, or when it was touched at its side within
    its own lane.

    Args:
        world: everyone.
        evaluated: [M] rows of A.
        graph: the lanes.
        road: they are of.
        offroad: [A, U] whether an agent is off the road; read for evaluated agents only.
    """
    found = [_first_overlaps(world, part) for part in _blocks(world, evaluated)]
    agent, other, step = (np.concatenate(parts) for parts in zip(*found, strict=True))
    order = np.lexsort((other, agent, step))
    agent, other, step = agent[order], other[order], step[order]
    if not len(agent):
        return Contacts(agent, other, step, agent, np.zeros(0, bool))
    kind = _kinds(world, agent, other, step)
    speed, their_speed = world.speed[agent, step], np.linalg.norm(world.velocity[other, step], axis=-1)
    front = _front_hits(world, agent, other, step)
    reaching = _out_of_lane(world, agent, step, graph, road) | offroad[agent, step]
    backing = (kind == CollisionKind.OTHER) & (speed < -STILL)
    side = np.isin(kind, [CollisionKind.SIDESWIPE, CollisionKind.CROSSING, CollisionKind.ONCOMING]) & ~front
    from_behind = kind == CollisionKind.REAR_ENDED
    standing = (their_speed <= STANDING) & (~from_behind | (speed < 0))
    fault = (
        standing | (kind == CollisionKind.INTO_LEADER) | (front & ~from_behind) | (side & reaching) | backing
    )
    fault &= np.abs(speed) > STILL
    return Contacts(agent, other, step, kind, fault)


def _first_overlaps(world: World, evaluated: Indices) -> tuple[Indices, Indices, Indices]:
    """Agent, other and state [E] of the first overlap of each pair, from the second state on."""
    radius = 0.5 * np.linalg.norm(world.size, axis=-1)
    reach = radius[evaluated, None] + radius[None] + _SLACK
    valid, position = world.valid[:, 1:], world.position[:, 1:]
    x, y = _pairs(position[..., 0], evaluated), _pairs(position[..., 1], evaluated)
    near = x * x + y * y <= (reach**2)[..., None]
    near &= valid[evaluated, None] & valid[None] & (evaluated[:, None] != np.arange(len(radius)))[..., None]
    who, other, step = near.nonzero()
    agent = evaluated[who]
    one, two = (_boxes(world, row, step + 1) for row in (agent, other))
    hit = boxes_overlap(*one, *two).numpy()
    agent, other, step = agent[hit], other[hit], step[hit] + 1
    order = np.lexsort((other, agent, step))
    agent, other, step = agent[order], other[order], step[order]
    # The first of each pair in order of time.
    _, first = np.unique(agent * len(radius) + other, return_index=True)
    first.sort()
    return agent[first], other[first], step[first]


def _boxes(world: World, row: Indices, step: Indices) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    parts = world.position[row, step], world.heading[row, step], world.size[row]
    return torch.from_numpy(parts[0]), torch.from_numpy(parts[1]), torch.from_numpy(parts[2])


def _kinds(world: World, agent: Indices, other: Indices, step: Indices) -> Indices:
    """Kind [E] of each contact: every one is a scene of two agents and two states."""
    rows = np.stack([agent, other], 1)[:, :, None]
    times = np.stack([step - 1, step], 1)[:, None]
    heading, velocity, valid = (
        world.heading[rows, times],
        world.velocity[rows, times],
        world.valid[rows, times],
    )
    # A state in which only one of them is there is not read; both must be as at contact then.
    pose = np.concatenate([world.position[rows, times], heading[..., None], velocity], -1)
    speed = world.speed[rows, times]
    state = np.concatenate([pose[..., :3], speed[..., None]], -1)
    count = len(agent)
    found = collision_kinds(
        torch.ones(count, 1, 1, dtype=torch.bool),
        torch.from_numpy(state[:, :1]),
        torch.from_numpy(valid[:, :1]),
        torch.zeros(count, 1, dtype=torch.int64),
        torch.from_numpy(pose),
        torch.from_numpy(valid),
        torch.from_numpy(world.size[rows[..., 0]]),
    )
    return found.kind[:, 0].numpy()


def _front_hits(world: World, agent: Indices, other: Indices, step: Indices) -> Bools:
    """Whether the front bumper of the agent reaches into the other [E]."""
    center, heading, size = _boxes(world, agent, step)
    ahead = torch.stack([heading.cos(), heading.sin()], -1) * 0.5 * size[:, :1]
    bumper = torch.stack([torch.zeros_like(heading), size[:, 1]], -1)
    return boxes_overlap(center + ahead, heading, bumper, *_boxes(world, other, step)).numpy()


def _out_of_lane(world: World, agent: Indices, step: Indices, graph: LaneGraph, road: RoadMap) -> Bools:
    """Whether an agent reaches over the edge of the lane that it is in, or is in none [E]."""
    position, heading = world.position[agent, step], world.heading[agent, step]
    lane = lane_of(graph, position, heading)
    inside = lane >= 0
    away = np.full(len(lane), np.inf)
    lines = graph.index.geometry[np.searchsorted(graph.usable_lanes, lane[inside])]
    away[inside] = shapely.distance(lines, shapely.points(position[inside]))
    return away + 0.5 * world.size[agent, 1] > 0.5 * lane_widths(road)[lane] + _EDGE


def lane_widths(road: RoadMap) -> Reals:
    """[L] metres, nominal ones where the source has none."""
    nominal = np.where(road.lane_type == LaneType.BIKE_LANE, BIKE_WIDTH, NOMINAL_WIDTH)
    return np.where(np.isnan(road.lane_width), nominal, road.lane_width).astype(np.float64)


def time_to_collision(world: World, evaluated: Indices) -> Reals:
    """Seconds [M, U] until an evaluated agent would first overlap one that is not behind it, if both go on so.

    Everyone keeps velocity and heading. Infinite if that is more than :data:`HORIZON` away, or the agent has stopped
    or is not there.
    """
    return np.concatenate([_time_to_collision(world, part) for part in _blocks(world, evaluated)])


def _blocks(world: World, evaluated: Indices) -> list[Indices]:
    """Parts of the evaluated agents whose pairs with everyone fit into memory."""
    size = max(1, _PAIRS // max(world.valid.size, 1))
    return [evaluated[k : k + size] for k in range(0, max(len(evaluated), 1), size)]


def _pairs(values: Reals, evaluated: Indices) -> Reals:
    """[M, A, U] how much more everyone has than the evaluated agents; by component, which is many times faster."""
    return values[None] - values[evaluated, None]


def _time_to_collision(world: World, evaluated: Indices) -> Reals:
    radius = 0.5 * np.linalg.norm(world.size, axis=-1)
    x, y = _pairs(world.position[..., 0], evaluated), _pairs(world.position[..., 1], evaluated)
    u, v = _pairs(world.velocity[..., 0], evaluated), _pairs(world.velocity[..., 1], evaluated)
    heading = world.heading[evaluated, None]
    near = x * np.cos(heading) + y * np.sin(heading) > 0
    moving = np.linalg.norm(world.velocity[evaluated], axis=-1) > STILL
    near &= (moving & world.valid[evaluated])[:, None] & world.valid[None]
    near &= (evaluated[:, None] != np.arange(len(radius)))[..., None]
    # Boxes can only meet where the circles around them do, which are nearest to each other at this time.
    soonest = np.clip(-(x * u + y * v) / np.maximum(u * u + v * v, 1e-12), 0, HORIZON)
    reach = (radius[evaluated, None] + radius[None] + _SLACK)[..., None]
    near &= (x + soonest * u) ** 2 + (y + soonest * v) ** 2 <= reach * reach
    away, gain = np.stack([x[near], y[near]], -1), np.stack([u[near], v[near]], -1)
    who, other, step = near.nonzero()
    found = _meeting(away, gain, world, evaluated[who], other, step)
    best = np.full((len(evaluated), world.valid.shape[1]), math.inf)
    np.minimum.at(best, (who, step), found)
    return np.where(best <= HORIZON, best, math.inf)


def _meeting(away: Reals, gain: Reals, world: World, one: Indices, two: Indices, step: Indices) -> Reals:
    """When boxes that don't turn first overlap [E]: on each of the four face normals, from when to when their
    shadows do; the boxes do where all four do.
    """
    begin, end = np.zeros(len(one)), np.full(len(one), math.inf)
    first, second = world.heading[one, step], world.heading[two, step]
    turn = np.abs(np.cos(second - first)), np.abs(np.sin(second - first))
    for angle, mine, theirs in (
        (first, world.size[one], world.size[two]),
        (second, world.size[two], world.size[one]),
    ):
        axes = np.stack([np.cos(angle), np.sin(angle)], -1), np.stack([-np.sin(angle), np.cos(angle)], -1)
        for k, axis in enumerate(axes):
            # What the other box, turned, covers along this axis.
            cover = 0.5 * (mine[:, k] + turn[0] * theirs[:, k] + turn[1] * theirs[:, 1 - k])
            at, speed = (away * axis).sum(-1), (gain * axis).sum(-1)
            slow = np.abs(speed) < 1e-9
            rate = np.where(slow, 1.0, speed)
            low, high = np.sort(np.stack([(-cover - at) / rate, (cover - at) / rate]), 0)
            apart = slow & (np.abs(at) >= cover)
            low = np.where(slow, np.where(apart, math.inf, -math.inf), low)
            begin, end = np.maximum(begin, low), np.minimum(end, np.where(slow, math.inf, high))
    return np.where(begin < end, begin, math.inf)
