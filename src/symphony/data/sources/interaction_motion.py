"""Velocities and headings of tracks that have none, or none that fit."""

from __future__ import annotations

import numpy as np

from symphony.data.resample import local_line, wrap
from symphony.data.segment import Bools
from symphony.data.sources.lines import Doubles

SIGMA = 0.2
"""Seconds: of the Gaussian weights of the line whose slope is the velocity."""
WALKING = 1.0
"""m/s above which the direction of motion is a heading."""
OFF = np.deg2rad(45)
"""Angle to the motion from which on a logged heading does not count."""


def from_positions(state: Doubles, valid: Bools, dt: float) -> Doubles:
    """Velocities as slopes of the positions; headings that don't fit them are left to :func:`headings`.

    A heading is compared with the motion at the nearest step at which the agent moves: trackers give 0 to what stands
    before it moves. An agent that never moves keeps what was logged; that one drives backwards can't be told.

    Args:
        state: [A, T, 5] x, y, velocity, heading; likewise returned, with NaN for headings.
        valid: [A, T].
        dt: seconds per step.
    """
    # The line reaches over 4 sigma: at least to the next step.
    _, slope, _ = local_line(state[..., :2], valid, dt, max(SIGMA, dt / 4))
    found = state.copy()
    found[..., 2:4] = slope
    course = _nearest_course(found, valid)
    found[np.abs(wrap(found[..., 4] - course)) > OFF, 4] = np.nan
    return found


def headings(state: Doubles, valid: Bools) -> Doubles:
    """Fill headings that are not known (NaN) with the direction of motion, in a standstill that of the nearest step.

    One that never moves and has no heading gets 0. Masked states become 0. Arguments as in :func:`from_positions`.
    """
    found = np.where(valid[..., None], state, 0.0)
    unknown = np.isnan(found[..., 4])
    found[unknown, 4] = np.nan_to_num(_nearest_course(found, valid)[unknown])
    return found


def _nearest_course(state: Doubles, valid: Bools) -> Doubles:
    """[A, T] direction of motion at the step nearest to each at which the agent moves; NaN if it never does."""
    velocity = state[..., 2:4]
    moves = valid & (np.hypot(velocity[..., 0], velocity[..., 1]) > WALKING)
    steps = np.arange(valid.shape[1])
    course = np.full(valid.shape, np.nan)
    for agent in np.flatnonzero(moves.any(axis=1)):
        known = np.flatnonzero(moves[agent])
        nearest = known[np.abs(steps[:, None] - known).argmin(axis=1)]
        course[agent] = np.arctan2(velocity[agent, nearest, 1], velocity[agent, nearest, 0])
    return course
