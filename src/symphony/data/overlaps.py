"""Vehicles that drive through each other in the log: errors of the tracking, but collisions to every metric."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from symphony.data.levels import ground
from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import MOVING, travel
from symphony.geometry import boxes_overlap
from symphony.geometry.levels import LEVEL

MANY = 0.05
"""Share of a store's segments with overlaps above which a conversion warns."""
BLOCK = 500_000
"""States that are compared at a time, drivers times agents times steps."""
TAG = "overlaps"
"""Tag of a stored segment that has some: how many pairs of agents."""


def overlapping(segment: RunSegment) -> NDArray[np.int64]:
    """[P, 2] pairs of agents, rows in order, whose oriented boxes overlap at some step.

    At least one of the two is a vehicle that moves (more than :data:`~symphony.data.selection.MOVING` metres).
    Touching does not count, nor do boxes whose logged heights differ by :data:`~symphony.geometry.LEVEL`.
    """
    drivers = np.flatnonzero((segment.agent_type == AgentType.VEHICLE) & (travel(segment) > MOVING))
    rows = max(BLOCK // segment.valid.size, 1)
    found = [_pairs(segment, drivers[k : k + rows]) for k in range(0, len(drivers), rows)]
    return np.unique(np.concatenate([np.zeros((0, 2), np.int64), *found]), axis=0)


def _pairs(segment: RunSegment, drivers: NDArray[np.int64]) -> NDArray[np.int64]:
    """[P, 2] pairs of one of the drivers and anybody, each in order, once for each step of an overlap."""
    position = segment.position[..., :2].astype(np.float64)
    size = segment.size[:, :2].astype(np.float64)
    radius = np.hypot(*size.T) / 2
    away = position[drivers, None] - position[None]
    reach = radius[drivers, None] + radius
    # Boxes can only overlap where the circles around them do. [drivers, A, T]
    near = (away**2).sum(-1) < (reach**2)[..., None]
    near &= segment.valid[drivers, None] & segment.valid
    height = ground(segment)[..., 2]
    near &= np.abs(height[drivers, None] - height) < LEVEL
    near[np.arange(len(drivers)), drivers] = False
    driver, other, step = near.nonzero()
    one = drivers[driver]

    def boxes(rows: NDArray[np.integer[Any]]) -> tuple[torch.Tensor, ...]:
        heading = segment.heading[rows, step].astype(np.float64)
        return tuple(map(torch.from_numpy, (position[rows, step], heading, size[rows])))

    hit = boxes_overlap(*boxes(one), *boxes(other)).numpy()
    return np.sort(np.stack([one[hit], other[hit]], axis=-1), axis=1)


def tags(segment: RunSegment) -> dict[str, int] | None:
    """What a store notes of a segment with overlaps; None for one without."""
    found = len(overlapping(segment))
    return {TAG: found} if found else None
