"""Who goes first in rollouts and in the log: all pairs of vehicles whose logged paths merge or cross."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import relations
from symphony.metrics import OrderStatistics, order_statistics, passing_gap
from symphony.wosac.scorer import SimulatedRollouts

EVERY = 2
"""Steps of 0.1 s between those at which paths are looked at."""


class PassingGaps(NamedTuple):
    """Seconds by which the first of each of K pairs is ahead of the second, NaN where their paths don't meet."""

    simulated: Float[Tensor, "R K"]
    log: Float[Tensor, " K"]


def passing_pairs(window: RunSegment) -> NDArray[np.int64]:
    """[K, 2] rows of the vehicles that merge or cross in the log after the current step, both valid at it."""
    now = window.current_step
    timed = ("position", "heading", "velocity", "valid", "signal_state")
    future = window.replace(
        dt=window.dt * EVERY, current_step=0, **{name: getattr(window, name)[:, now::EVERY] for name in timed}
    )
    rows = np.flatnonzero(window.valid[:, now] & (window.agent_type == AgentType.VEHICLE))
    pairs = []
    for k, row in enumerate(rows[:-1]):
        others = rows[k + 1 :]
        found = relations(future.replace(ego=int(row)), others)
        pairs += [(row, other) for other in others[np.minimum(found.merge, found.crossing) < np.inf]]
    return np.array(pairs, np.int64).reshape(-1, 2)


def passing_gaps(window: RunSegment, pairs: NDArray[np.int64], rollouts: SimulatedRollouts) -> PassingGaps:
    """Gaps of K pairs of rows [K, 2] (see :func:`passing_pairs`) in rollouts of everyone and in the log."""
    column = {int(name): k for k, name in enumerate(rollouts.object_id)}
    simulated, log = [torch.zeros(len(rollouts.x), 0)], [torch.zeros(0)]
    for pair in pairs:
        # Steps 12, 14, …: of rollouts, which begin with step 11, every other one.
        columns = [column[int(window.agent_id[row])] for row in pair]
        states = np.stack([rollouts.x, rollouts.y], -1)[:, columns, EVERY - 1 :: EVERY] - window.origin[:2]
        first, second = torch.from_numpy(states).unbind(1)
        always = torch.ones(first.shape[:-1], dtype=torch.bool)
        dt = window.dt * EVERY
        simulated.append(passing_gap(first, second, always, always, dt)[:, None])
        future = slice(window.current_step + EVERY, None, EVERY)
        place = torch.from_numpy(window.position[pair][:, future, :2].astype(np.float64))
        valid = torch.from_numpy(window.valid[pair][:, future])
        log.append(passing_gap(place[0], place[1], valid[0], valid[1], dt)[None])
    return PassingGaps(torch.cat(simulated, -1), torch.cat(log))


def order_of(found: Sequence[PassingGaps]) -> OrderStatistics:
    """All pairs of all run segments together."""
    return order_statistics(torch.cat([one[0] for one in found], -1), torch.cat([one[1] for one in found]))
