"""Which vehicle is the ego where a recording names none."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import AgentType, Bools

NEAR = 50.0
"""Metres within which another agent counts as a neighbour of an ego candidate."""
MOVING = 2.0
"""Metres an agent must get away from where it is first seen to count as moving."""


def busiest_first(
    agent_id: NDArray[np.int64],
    agent_type: NDArray[np.uint8],
    position: NDArray[np.float64],
    valid: Bools,
    dynamic: Bools | None = None,
) -> NDArray[np.int64]:
    """Rows of the vehicles that move and are valid at every step, most moving neighbours first.

    Args:
        agent_id: [A]; the lowest goes first on ties.
        agent_type: [A].
        position: [A, T, 2] metres.
        valid: [A, T].
        dynamic: [A] which may be egos; all by default.
    """
    # Not the length of the path: the jitter of a parked car's track would add up.
    start = position[np.arange(len(position)), valid.argmax(1), None]
    away = np.hypot(*np.moveaxis(position - start, -1, 0))
    moving = np.where(valid, away, 0).max(axis=1, initial=0) > MOVING
    able = (agent_type == AgentType.VEHICLE) & moving & valid.all(axis=1)
    rows = np.flatnonzero(able if dynamic is None else able & dynamic)
    scores = []
    for row in rows:
        distance = np.hypot(*np.moveaxis(position[moving] - position[row], -1, 0))
        scores.append(int(((distance < NEAR) & valid[moving]).sum()))
    return rows[np.lexsort((agent_id[rows], -np.array(scores, np.int64)))]
