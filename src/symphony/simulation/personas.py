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
ALIGNED = np.pi / 4
"""Largest angle between a vehicle and the one it follows."""


def styles(segment: RunSegment, graph: LaneGraph) -> Floats:
    """[A, 2] median time headway in seconds while following, and the speed, relative to the lane's limit, that a
    vehicle stays below nine tenths of the time while it is free and drives straight. NaN where the log does not tell.
    """
    position, heading = segment.position[..., :2].astype(np.float64), segment.heading.astype(np.float64)
    velocity = segment.velocity[..., :2].astype(np.float64)
    speed = velocity[..., 0] * np.cos(heading) + velocity[..., 1] * np.sin(heading)
    vehicle = (segment.agent_type == AgentType.VEHICLE)[:, None]
    moves = segment.valid & vehicle & (speed > SLOWEST)
    headway = np.stack([_headway(segment, step, position, heading) for step in range(segment.num_steps)], 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        headway = headway / speed
    follows = moves & (headway <= FOLLOWING)
    turn = np.abs(wrap(np.diff(heading, axis=1, append=heading[:, -1:])))
    limit = np.full(position.shape[:2], np.nan)
    free = moves & ~(headway <= FOLLOWING) & (turn <= STRAIGHT * segment.dt)
    if free.any():
        lane = lane_of(graph, position[free], heading[free])
        limit[free] = np.where(lane >= 0, segment.road.speed_limit[lane], np.nan)
    free &= limit > SLOWEST
    found = np.full((segment.num_agents, 2), np.nan)
    for agent in range(segment.num_agents):
        if follows[agent].sum() * segment.dt >= LEAST:
            found[agent, 0] = np.median(headway[agent, follows[agent]])
        if free[agent].sum() * segment.dt >= LEAST:
            found[agent, 1] = np.quantile((speed / limit)[agent, free[agent]], 0.9)
    return found


def _headway(segment: RunSegment, step: int, position: Floats, heading: Floats) -> Floats:
    """[A] metres from the front of each agent to the rear of what is next in its straight corridor; inf for none."""
    there = np.flatnonzero(segment.valid[:, step])
    gap = np.full(segment.num_agents, np.inf)
    if not len(there):
        return gap
    where, angle, size = position[there, step], heading[there, step], segment.size[there].astype(np.float64)
    delta = where[None] - where[:, None]
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    ahead, aside = delta[..., 0] * cos + delta[..., 1] * sin, delta[..., 1] * cos - delta[..., 0] * sin
    turn = np.abs(wrap(angle[None] - angle[:, None]))
    inside = (ahead > 0) & (np.abs(aside) < (size[:, None, 1] + size[None, :, 1]) / 2) & (turn < ALIGNED)
    between = ahead - (size[:, None, 0] + size[None, :, 0]) / 2
    gap[there] = np.where(inside, np.maximum(between, 0.0), np.inf).min(1)
    return gap


@dataclass(frozen=True)
class PersonaScale:
    """What styles are usual: a persona is where a vehicle's own stands among all.

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
        """From the :func:`styles` of segments."""
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
