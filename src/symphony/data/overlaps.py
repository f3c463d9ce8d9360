"""Vehicles that drive through each other in the log: errors of the tracking, but collisions to every metric."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.levels import LEVEL, ground
from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import MOVING, travel

Doubles = NDArray[np.float64]

MANY = 0.05  # share of a store's segments with overlaps above which a conversion warns
BLOCK = 500_000  # states that are compared at a time, drivers times agents times steps
TAG = "overlaps"  # of a stored segment that has some: how many pairs of agents


def overlapping(segment: RunSegment) -> NDArray[np.int64]:
    """Return [P, 2] pairs of agents, rows in order, whose oriented boxes overlap at some step.

    At least one of the two is a vehicle that moves (more than :data:`~symphony.data.selection.MOVING` metres).
    Touching does not count, nor do boxes whose logged heights differ by :data:`~symphony.data.levels.LEVEL`.
    """
    drivers = np.flatnonzero((segment.agent_type == AgentType.VEHICLE) & (travel(segment) > MOVING))
    rows = max(BLOCK // segment.valid.size, 1)
    found = [_pairs(segment, drivers[k : k + rows]) for k in range(0, len(drivers), rows)]
    return np.unique(np.concatenate([np.zeros((0, 2), np.int64), *found]), axis=0)


def _pairs(segment: RunSegment, drivers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return [P, 2] pairs of one of the drivers and any agent, each in order, once for each step of an overlap."""
    position = segment.position[..., :2].astype(np.float64)
    heading = segment.heading.astype(np.float64)
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
    way = position[other, step] - position[one, step]
    hit = box_depth(way, heading[one, step], size[one], heading[other, step], size[other]) > 1e-9
    return np.sort(np.stack([one[hit], other[hit]], axis=-1), axis=1)


def box_depth(way: Doubles, angle_a: Doubles, size_a: Doubles, angle_b: Doubles, size_b: Doubles) -> Doubles:
    """Return [N] metres by which two boxes overlap, by the separating-axis test; 0 or less if they do not. Takes the
    way [N, 2] from the centre of one to that of the other, headings [N], lengths and widths [N, 2].
    """
    boxes: Any = ((angle_a, size_a / 2), (angle_b, size_b / 2))
    depth = np.full(len(way), np.inf)
    for owner, _ in boxes:
        for turn in (0.0, np.pi / 2):
            angle = owner + turn
            axis = np.stack([np.cos(angle), np.sin(angle)], -1)
            extent = np.zeros(len(way))
            for heading, half in boxes:
                relative = heading - angle
                extent += half[:, 0] * np.abs(np.cos(relative)) + half[:, 1] * np.abs(np.sin(relative))
            depth = np.minimum(depth, extent - np.abs((way * axis).sum(-1)))
    return depth
