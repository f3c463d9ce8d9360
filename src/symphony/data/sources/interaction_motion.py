"""Velocities and headings of tracks that have none, or none that fit."""

from __future__ import annotations

import numpy as np

from symphony.data.resample import local_line
from symphony.data.segment import Bools
from symphony.data.sources.lines import Doubles

SIGMA = 0.2
"""Seconds: of the Gaussian weights of the line whose slope is the velocity."""
WALKING = 0.5
"""m/s above which the direction of motion is a heading."""


def from_positions(state: Doubles, valid: Bools, dt: float) -> Doubles:
    """Velocities as slopes of the positions; headings are left to :func:`headings`.

    A track that never moves keeps the logged heading.

    Args:
        state: [A, T, 5] x, y, velocity, heading; likewise returned.
        valid: [A, T].
        dt: seconds per step.
    """
    _, slope, _ = local_line(state[..., :2], valid, dt, SIGMA)
    moves = valid & (np.hypot(slope[..., 0], slope[..., 1]) > WALKING)
    found = state.copy()
    found[..., 2:4] = slope
    found[moves.any(axis=1), :, 4] = np.nan
    return found


def headings(state: Doubles, valid: Bools) -> Doubles:
    """Fill headings that are not known (NaN) with the direction of motion, in a standstill that of the nearest step.

    One that never moves and has no heading gets 0. Masked states become 0. Arguments as in :func:`from_positions`.
    """
    found = np.where(valid[..., None], state, 0.0)
    velocity = found[..., 2:4]
    course = np.arctan2(velocity[..., 1], velocity[..., 0])
    moves = valid & (np.hypot(velocity[..., 0], velocity[..., 1]) > WALKING)
    steps = np.arange(valid.shape[1])
    for agent in np.flatnonzero(np.isnan(found[..., 4]).any(axis=1)):
        known = np.flatnonzero(moves[agent])
        unknown = np.isnan(found[agent, :, 4])
        if len(known):
            nearest = known[np.abs(steps[unknown, None] - known).argmin(axis=1)]
            found[agent, unknown, 4] = course[agent, nearest]
        else:
            found[agent, unknown, 4] = 0.0
    return found
