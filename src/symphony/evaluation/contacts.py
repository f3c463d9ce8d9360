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

from symphony.geometry import boxes_overlap, levels_apart, meeting_time
from symphony.metrics import meetings
from symphony.metrics.kinds import kind_of_contact
from symphony.saved.rollouts import World

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
        kind: :class:`symphony.metrics.CollisionKind`, from the agent's point of view, whoever the other is.
        at_state: whether they overlap at any state, not only between two.
    """

    agent: Indices
    other: Indices
    step: Indices
    share: Reals
    kind: Indices
    at_state: Bools


def contacts(worlds: Sequence[World], evaluated: Indices) -> list[Contacts]:
    """Collisions of evaluated agents in each of some rollouts of one segment, from their second states on.

    Nobody meets others on another level.

    Args:
        worlds: everyone in each rollout.
        evaluated: [M] rows of A.
    """

    def stacked(name: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([getattr(world, name) for world in worlds]))

    found = meetings(
        stacked("position"),
        stacked("heading"),
        stacked("size"),
        stacked("valid"),
        torch.from_numpy(evaluated).expand(len(worlds), -1),
        None if worlds[0].height is None else stacked("height"),
    )
    parts = evaluated[found.subject.numpy()], found.other.numpy(), found.step.numpy() + 1, found.share.numpy()
    return [
        _first(world, *(part[found.row.numpy() == number] for part in parts))
        for number, world in enumerate(worlds)
    ]


def _first(world: World, agent: Indices, other: Indices, step: Indices, share: Reals) -> Contacts:
    """Of the contacts of each pair the first, in order of time."""
    boxes = (
        torch.from_numpy(part)
        for row in (agent, other)
        for part in (world.position[row, step], world.heading[row, step], world.size[row])
    )
    overlap = boxes_overlap(*boxes).numpy()
    order = np.lexsort((other, agent, share, step))
    pair = (agent * len(world.size) + other)[order]
    _, first, number = np.unique(pair, return_index=True, return_inverse=True)
    at_state = np.bincount(number, overlap[order], len(first)) > 0
    turn = np.argsort(first)
    agent, other, step, share = (part[order[first[turn]]] for part in (agent, other, step, share))
    kind = kind_of_contact(
        pose_ends(world, agent, other, step),
        pose_ends(world, other, agent, step),
        torch.from_numpy(share),
        *(torch.from_numpy(world.size[row]) for row in (agent, other)),
    )
    return Contacts(agent, other, step, share, kind.numpy(), at_state[turn])


def pose_ends(world: World, row: Indices, other: Indices, step: Indices) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses [E, 5] (x, y, heading, velocity x, velocity y) of agents before and after the step of a contact.

    Where one of the two was not there before the step, both are those after it.
    """
    seen = world.valid[row, step - 1] & world.valid[other, step - 1]
    before, after = (
        torch.from_numpy(
            np.concatenate(
                [world.position[row, at], world.heading[row, at, None], world.velocity[row, at]], -1
            )
        )
        for at in (np.where(seen, step - 1, step), step)
    )
    return before, after


def time_to_collision(world: World, evaluated: Indices) -> Reals:
    """Seconds [M, U] until an evaluated agent would first overlap one that is not behind it, if both go on so.

    Everyone keeps velocity and heading, and nobody meets others on another level. Infinite if that is more than
    :data:`HORIZON` away, or the agent has stopped or is not there.
    """
    size = max(1, _PAIRS // max(world.valid.size, 1))
    blocks = [evaluated[k : k + size] for k in range(0, max(len(evaluated), 1), size)]
    return np.concatenate([_time_to_collision(world, part) for part in blocks])


def _time_to_collision(world: World, evaluated: Indices) -> Reals:
    # By component, which is many times faster: [M, A, U] how much more everyone has than the evaluated agents.
    x, y, u, v = (
        values[None] - values[evaluated, None]
        for values in np.moveaxis(np.concatenate([world.position, world.velocity], -1), -1, 0)
    )
    radius = 0.5 * np.linalg.norm(world.size, axis=-1)
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
    who, other, step = near.nonzero()
    one = evaluated[who]
    parts = (
        np.stack([x[near], y[near]], -1),
        np.stack([u[near], v[near]], -1),
        world.heading[one, step],
        world.size[one],
        world.heading[other, step],
        world.size[other],
    )
    found = meeting_time(*(torch.from_numpy(part) for part in parts)).numpy()
    best = np.full((len(evaluated), world.valid.shape[1]), math.inf)
    np.minimum.at(best, (who, step), found)
    return np.where(best <= HORIZON, best, math.inf)
