"""Driving style of logged vehicles: how fast each drives where nothing hinders it, and how closely it follows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from symphony.agents.networks import PERSONAS
from symphony.data.resample import wrap
from symphony.data.segment import AgentType, RunSegment
from symphony.roadgraph import LaneGraph, lane_of

Floats = NDArray[np.float64]
SLOWEST = 2.0
"""m/s below which a vehicle shows no style."""
FOLLOWING = 3.0
"""Seconds of headway up to which a vehicle counts as following the one ahead; beyond, or with none, it is free."""
STRAIGHT = 0.1
"""rad/s up to which a vehicle counts as driving straight."""
LEAST = 1.0
"""Seconds of either that it takes to tell."""
STANDSTILL = 2.0
"""Metres to the one ahead that a driver keeps even at a stop: not part of the headway."""
STEADY_SPEED = 4.0
"""m/s below which gaps are those of a queue that dissolves, whoever drives."""
STEADY_CLOSING = 1.0
"""m/s by which the gap may shrink or grow while a vehicle follows steadily."""
STEADY_CHANGE = 0.8
"""m/s^2 up to which it keeps its speed meanwhile."""
ALIGNED = np.pi / 4
"""Largest angle between a vehicle and the one it follows."""


def styles(segment: RunSegment, graph: LaneGraph) -> Floats:
    """[A, 2] headway in seconds, and the speed, relative to the lane's limit, that a vehicle stays below nine
    tenths of the time while it is free and drives straight. NaN where the log does not tell.

    The headway is the median of (gap - 2 m) / speed while a vehicle follows steadily. Where it brakes behind another
    or starts behind it, the gap is that of the situation: such steps are left out, as they hide the driver.
    """
    position, heading = segment.position[..., :2].astype(np.float64), segment.heading.astype(np.float64)
    velocity = segment.velocity[..., :2].astype(np.float64)
    speed = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
    vehicle = (segment.agent_type == AgentType.VEHICLE)[:, None]
    moves = segment.valid & vehicle & (speed > SLOWEST)
    gap, closing = np.stack(
        [_ahead(segment, step, position, heading, velocity) for step in range(segment.num_steps)], -1
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        follows = moves & (gap / speed <= FOLLOWING)
        headway = (gap - STANDSTILL) / speed
    steady = follows & (speed > STEADY_SPEED) & (np.abs(closing) < STEADY_CLOSING)
    steady &= _change(speed, segment.valid, segment.dt) < STEADY_CHANGE
    turn = np.abs(wrap(np.diff(heading, axis=1, append=heading[:, -1:])))
    limit = np.full(position.shape[:2], np.nan)
    free = moves & ~follows & (turn <= STRAIGHT * segment.dt)
    if free.any():
        lane = lane_of(graph, position[free], heading[free])
        limit[free] = np.where(lane >= 0, segment.road.speed_limit[lane], np.nan)
    free &= limit > SLOWEST
    found = np.full((segment.num_agents, 2), np.nan)
    for agent in range(segment.num_agents):
        if steady[agent].sum() * segment.dt >= LEAST:
            found[agent, 0] = np.median(headway[agent, steady[agent]])
        if free[agent].sum() * segment.dt >= LEAST:
            found[agent, 1] = np.quantile((speed / limit)[agent, free[agent]], 0.9)
    return found


def _ahead(segment: RunSegment, step: int, position: Floats, heading: Floats, velocity: Floats) -> Floats:
    """[2, A] metres from the front of each agent to the rear of what is next in its straight corridor (inf for none),
    and m/s by which that gap shrinks.
    """
    there = np.flatnonzero(segment.valid[:, step])
    found = np.stack([np.full(segment.num_agents, np.inf), np.zeros(segment.num_agents)])
    if not len(there):
        return found
    where, angle, size = position[there, step], heading[there, step], segment.size[there].astype(np.float64)
    delta = where[None] - where[:, None]
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    ahead, aside = delta[..., 0] * cos + delta[..., 1] * sin, delta[..., 1] * cos - delta[..., 0] * sin
    turn = np.abs(wrap(angle[None] - angle[:, None]))
    inside = (ahead > 0) & (np.abs(aside) < (size[:, None, 1] + size[None, :, 1]) / 2) & (turn < ALIGNED)
    between = np.where(inside, np.maximum(ahead - (size[:, None, 0] + size[None, :, 0]) / 2, 0.0), np.inf)
    leader, own = between.argmin(1), np.arange(len(there))
    apart = velocity[there, step] - velocity[there[leader], step]
    found[:, there] = between[own, leader], (apart * np.concatenate([cos, sin], 1)).sum(1)
    return found


def _change(speed: Floats, valid: NDArray[np.bool_], dt: float) -> Floats:
    """[A, T] m/s^2 by which speeds change from the step before to the one after; inf where either is missing."""
    found = np.full(speed.shape, np.inf)
    known = valid[:, :-2] & valid[:, 2:]
    found[:, 1:-1][known] = np.abs(speed[:, 2:] - speed[:, :-2])[known] / (2 * dt)
    return found


@dataclass(frozen=True)
class PersonaScale:
    """The usual styles of driving: a persona is where a vehicle's own style stands among all.

    Attributes:
        headway: of all vehicles that tell, ascending, seconds.
        speed: likewise, relative to the limit.
        draws: [M, 2] personas of the vehicles that tell either.
    """

    headway: Floats
    speed: Floats
    draws: NDArray[np.float32]

    @classmethod
    def of(cls, found: Iterable[Floats]) -> PersonaScale:
        """The scale made from the :func:`styles` of segments."""
        known = np.concatenate([np.zeros((0, 2)), *found])
        known = known[~np.isnan(known).all(1)]
        headway, speed = (np.sort(column[~np.isnan(column)]) for column in known.T)
        return cls(headway, speed, cls(headway, speed, np.zeros((0, 2), np.float32)).personas(known))

    def personas(self, found: Floats) -> NDArray[np.float32]:
        """[A, 2] from -1 (the shortest headway, the slowest) to 1, in equal shares of the vehicles; 0 for the median,
        and where the log does not tell.
        """
        columns = []
        for scale, values in zip((self.headway, self.speed), found.T, strict=True):
            ranks = np.searchsorted(scale, values, "left") + np.searchsorted(scale, values, "right")
            columns.append(np.where(np.isnan(values), 0.0, ranks / max(1, len(scale)) - 1.0))
        return np.stack(columns, -1).astype(np.float32)

    def table(self) -> Float[Tensor, "M 2"]:
        """:data:`PERSONAS` of them, evenly spaced over those of the log; zeros if there are none."""
        if not len(self.draws):
            return torch.zeros(PERSONAS, 2)
        return torch.from_numpy(self.draws[np.arange(PERSONAS) * len(self.draws) // PERSONAS])
