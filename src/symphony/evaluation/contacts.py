"""Collisions of single rollouts: with whom, when and how; and how long until the next one.

Contacts are found between the states. Of each pair the first counts; whose fault it was is for
:mod:`symphony.evaluation.fault`.

Metres, radians, seconds. Legend: A agents, U states of a rollout, M evaluated agents, E contacts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from symphony.geometry import boxes_overlap, levels_apart, meeting_time, pose_at
from symphony.metrics import collision_kinds, meetings
from symphony.saved.world import World

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]
Bools = NDArray[np.bool_]

STILL = 0.05
"""Speed in m/s up to which an agent that is hit has stopped, so that nothing is its fault (as in nuPlan)."""
HORIZON = 5.0
"""Seconds ahead that a collision is looked for."""
_SLACK = 1e-3
_PAIRS = 1 << 20
"""Pairs of agents, times states, held at a time."""


class Contacts(NamedTuple):
    """The first contact of evaluated agents with each other agent, all [E], by time, then agent.

    Attributes:
        agent: row of A.
        other: row of A.
        step: the state after it, from 1.
        share: of the step before that state after which they first overlap, from 0 to 1.
        kind: :class:`symphony.metrics.CollisionKind`, from the agent's point of view.
        at_state: whether they overlap at any state, not only between two.
    """

    agent: Indices
    other: Indices
    step: Indices
    share: Reals
    kind: Indices
    at_state: Bools


def contacts(worlds: Sequence[World], evaluated: Indices) -> list[Contacts]:
    """Collisions of the evaluated agents [M] of rollouts of one segment, from their second states on; nobody meets
    others on another level.

    Args:
        worlds: everyone in each rollout.
        evaluated: [M] rows of A.
    """
    position, heading, valid = (
        torch.from_numpy(np.stack([getattr(world, name) for world in worlds]))
        for name in ("position", "heading", "valid")
    )
    size = torch.from_numpy(worlds[0].size).expand(len(worlds), -1, -1)
    subject = torch.from_numpy(evaluated).expand(len(worlds), -1)
    levels = [world.height for world in worlds if world.height is not None]
    height = torch.from_numpy(np.stack(levels)) if levels else None
    found = meetings(position, heading, size, valid, subject, height)
    parts = found.subject.numpy(), found.other.numpy(), found.step.numpy() + 1, found.share.numpy()
    each = [tuple(part[found.row.numpy() == k] for part in parts) for k in range(len(worlds))]
    return [_first(world, evaluated[who], *pair) for world, (who, *pair) in zip(worlds, each, strict=True)]


def _first(world: World, agent: Indices, other: Indices, step: Indices, share: Reals) -> Contacts:
    """Of each pair the first, in order of time."""
    if not len(agent):
        return Contacts(agent, other, step, share, agent, np.zeros(0, bool))
    one, two = (_boxes(world, row, step) for row in (agent, other))
    overlap = boxes_overlap(*one, *two).numpy()
    order = np.lexsort((other, agent, share, step))
    pair = (agent * len(world.size) + other)[order]
    _, first, number = np.unique(pair, return_index=True, return_inverse=True)
    at_state = np.bincount(number, overlap[order], len(first)) > 0
    turn = np.argsort(first)
    agent, other, step, share = (part[order[first[turn]]] for part in (agent, other, step, share))
    return Contacts(agent, other, step, share, _kinds(world, agent, other, step), at_state[turn])


def poses(
    world: World, row: Indices, other: Indices, step: Indices, share: Reals
) -> tuple[Reals, Reals, Reals]:
    """Position [E, 2], heading [E] and velocity [E, 2] of agents at contacts with others, between two states; after
    the step where one of the two was not there before.
    """
    seen = world.valid[row, step - 1] & world.valid[other, step - 1]
    times = np.stack([np.where(seen, step - 1, step), step], -1)
    center, heading, velocity = (
        torch.from_numpy(part[row[:, None], times])
        for part in (world.position, world.heading, world.velocity)
    )
    place, direction = pose_at(center, heading, torch.from_numpy(share))
    speed = velocity[:, 0] + torch.from_numpy(share)[:, None] * (velocity[:, 1] - velocity[:, 0])
    return place.numpy(), direction.numpy(), speed.numpy()


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


def time_to_collision(world: World, evaluated: Indices) -> Reals:
    """Seconds [M, U] until an evaluated agent would first overlap one that is not behind it, if both go on so.

    Everyone keeps velocity and heading, and nobody meets others on another level. Infinite if that is more than
    :data:`HORIZON` away, or the agent has stopped or is not there.
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
    if world.height is not None:
        level = torch.from_numpy(world.height)
        near &= ~levels_apart(level[evaluated, None], level[None]).numpy()
    # Boxes can only meet where the circles around them do, which are nearest to each other at this time.
    soonest = np.clip(-(x * u + y * v) / np.maximum(u * u + v * v, 1e-12), 0, HORIZON)
    reach = (radius[evaluated, None] + radius[None] + _SLACK)[..., None]
    near &= (x + soonest * u) ** 2 + (y + soonest * v) ** 2 <= reach * reach
    away, gain = np.stack([x[near], y[near]], -1), np.stack([u[near], v[near]], -1)
    who, other, step = near.nonzero()
    one = evaluated[who]
    parts = (
        away,
        gain,
        world.heading[one, step],
        world.size[one],
        world.heading[other, step],
        world.size[other],
    )
    found = meeting_time(*(torch.from_numpy(part) for part in parts)).numpy()
    best = np.full((len(evaluated), world.valid.shape[1]), math.inf)
    np.minimum.at(best, (who, step), found)
    return np.where(best <= HORIZON, best, math.inf)
