"""Everyone in one saved rollout: driven agents where they were driven, all others as logged."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.saved.rollouts import SavedRollouts

Reals = NDArray[np.float64]
Bools = NDArray[np.bool_]


class World(NamedTuple):
    """Everyone in one rollout. Legend: A agents, U states.

    Attributes:
        position: [A, U, 2].
        heading: [A, U].
        velocity: [A, U, 2].
        valid: [A, U].
        size: [A, 2] length, width.
        height: [A, U, 2] height and level, see :mod:`symphony.data.levels`; None where the map has no levels.
    """

    position: Reals
    heading: Reals
    velocity: Reals
    valid: Bools
    size: Reals
    height: NDArray[np.float32] | None = None

    @property
    def speed(self) -> Reals:
        """[A, U] along the heading, negative when reversing."""
        return self.velocity[..., 0] * np.cos(self.heading) + self.velocity[..., 1] * np.sin(self.heading)


def world_of(saved: SavedRollouts, rollout: int) -> World:
    """Everyone in one rollout: driven agents where they were driven, all others as logged."""
    segment, within = saved.segment, slice(saved.start, saved.last + 1)
    position, heading = (
        segment.position[:, within, :2].astype(np.float64),
        segment.heading[:, within].astype(np.float64),
    )
    velocity, valid = segment.velocity[:, within].astype(np.float64), segment.valid[:, within].copy()
    there = saved.there[rollout].T
    state = np.where(there[..., None], saved.state[rollout].swapaxes(0, 1), 0).astype(np.float64)
    direction = np.stack([np.cos(state[..., 2]), np.sin(state[..., 2])], -1)
    position[saved.agents], heading[saved.agents] = state[..., :2], state[..., 2]
    velocity[saved.agents], valid[saved.agents] = state[..., 3:] * direction, there
    size = segment.size[:, :2].astype(np.float64)
    return World(position, heading, velocity, valid, size, _heights(saved, rollout))


def _heights(saved: SavedRollouts, rollout: int) -> NDArray[np.float32] | None:
    """[A, U, 2] as logged; of driven agents those of the nearest places of their logs."""
    if not len(saved.log_height):
        return None
    segment, agents = saved.segment, saved.agents[:, None]
    log, valid = segment.position[agents, :, :2], segment.valid[agents]
    place = saved.state[rollout].swapaxes(0, 1)[..., :2]
    away = np.square(log - place[:, :, None]).sum(-1)
    step = np.where(valid, away, np.inf).argmin(-1)
    found = saved.log_height[saved.start : saved.last + 1].swapaxes(0, 1).copy()
    found[saved.agents] = saved.log_height[step, agents]
    return found
