"""Who goes first in rollouts and in the log: all pairs of vehicles whose logged paths merge or cross."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from symphony.data.context import relations
from symphony.data.segment import AgentType, RunSegment
from symphony.metrics import OrderStatistics, order_statistics, passing_gap
from symphony.wosac.rollouts import RolloutArrays

EVERY = 2
"""Steps of 0.1 s between those at which paths are looked at."""


@dataclass(frozen=True)
class PassingGaps:
    """Seconds by which the first of each of K pairs is ahead of the second, NaN where their paths don't meet."""

    simulated: Float[Tensor, "R K"]
    log: Float[Tensor, " K"]


def passing_pairs(window: RunSegment) -> NDArray[np.int64]:
    """[K, 2] rows of the vehicles that merge or cross in the log after the current step, both valid at it."""
    now = window.current_step
    timed = ("position", "heading", "velocity", "valid")
    future = window.replace(
        dt=window.dt * EVERY,
        **{name: getattr(window, name)[:, now::EVERY] for name in timed},
        signal_state=window.signal_state[:, now::EVERY],
        current_step=0,
    )
    rows = np.flatnonzero(window.valid[:, now] & (window.agent_type == AgentType.VEHICLE))
    pairs = []
    for k, row in enumerate(rows[:-1]):
        others = rows[k + 1 :]
        found = relations(future.replace(ego=int(row)), others)
        pairs += [(row, other) for other in others[np.minimum(found.merge, found.crossing) < np.inf]]
    return np.array(pairs, np.int64).reshape(-1, 2)


def passing_gaps(window: RunSegment, pairs: NDArray[np.int64], rollouts: RolloutArrays) -> PassingGaps:
    """Gaps of some pairs in rollouts of everyone and in the log.

    Args:
        window: steps of 0.1 s.
        pairs: [K, 2] rows, see :func:`passing_pairs`.
        rollouts: of the steps after the current one.
    """
    future = slice(window.current_step + EVERY, None, EVERY)
    column = {int(name): k for k, name in enumerate(rollouts.object_id)}
    simulated, log = [], []
    for pair in pairs:
        columns = [column[int(window.agent_id[row])] for row in pair]
        # Steps 12, 14, …: of rollouts, which begin with step 11, every other one.
        first, second = (
            torch.from_numpy(
                np.stack([values[:, k, EVERY - 1 :: EVERY] for values in (rollouts.x, rollouts.y)], -1)
                - window.origin[:2]
            )
            for k in columns
        )
        always = torch.ones(first.shape[:-1], dtype=torch.bool)
        simulated.append(passing_gap(first, second, always, always, window.dt * EVERY))
        place = torch.from_numpy(window.position[pair][:, future, :2].astype(np.float64))
        valid = torch.from_numpy(window.valid[pair][:, future])
        log.append(passing_gap(place[0], place[1], valid[0], valid[1], window.dt * EVERY))
    if not log:
        return PassingGaps(torch.zeros(len(rollouts.x), 0), torch.zeros(0))
    return PassingGaps(torch.stack(simulated, -1), torch.stack(log))


def order_of(found: Sequence[PassingGaps]) -> OrderStatistics:
    """All pairs of all run segments together."""
    return order_statistics(
        torch.cat([one.simulated for one in found], -1), torch.cat([one.log for one in found])
    )
