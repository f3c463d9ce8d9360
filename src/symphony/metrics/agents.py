"""What becomes of single agents while their log exists: with many of them, some rollout always has a collision.

Shapes: B segments, K rollouts, N interactive agents, T simulated steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from symphony.metrics.kinds import STANDING, CollisionKind, CollisionKinds

WIDTH, FASTEST = 0.5, 45.0
"""Bins of speeds, and the last of them, in m/s."""
_BINS = round(FASTEST / WIDTH)

Ratios = dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Sums and weights of every segment, by name."""


class AgentSteps(NamedTuple):
    """What agents did.

    Attributes:
        there: [B, K, N, T] where they are driven and evaluated.
        logged: [B, N, T] where the log has them.
        offroad: [B, K, N, T].
        kinds: [B, K, N] of their first collisions among the steps that are both.
        speed: [B, K, N, T] m/s.
        speed_log: [B, N, T].
        bounded: [B] whether the map has a boundary to be off.
    """

    there: Bool[Tensor, "B K N T"]
    logged: Bool[Tensor, "B N T"]
    offroad: Bool[Tensor, "B K N T"]
    kinds: CollisionKinds
    speed: Float[Tensor, "B K N T"]
    speed_log: Float[Tensor, "B N T"]
    bounded: Bool[Tensor, " B"]


@dataclass(frozen=True)
class AgentResult:
    """What one run segment adds; all of steps at which an agent is driven and logged.

    Attributes:
        agents: in all rollouts.
        collided: [kinds, 2] of them by the kind of their first collision, with a driven agent and with playback.
        offroad: agent-steps off the road, and those that could be.
        standing: agent-steps, simulated and logged.
        speed: [bins, 2] agent-steps by speed, simulated and logged.
        travel: m/s summed over agent-steps, simulated and logged.
    """

    agents: int
    collided: NDArray[np.int64]
    offroad: tuple[int, int]
    standing: tuple[int, int]
    speed: NDArray[np.int64]
    travel: tuple[float, float]


def agent_results(steps: AgentSteps) -> list[AgentResult]:
    """Of every segment of a batch."""
    there, logged, off, speed, speed_log = (
        value.cpu().numpy()
        for value in (steps.there, steps.logged, steps.offroad, steps.speed, steps.speed_log)
    )
    kind, playback = steps.kinds.kind.cpu().numpy(), steps.kinds.playback.cpu().numpy()
    found = []
    for b in range(len(there)):
        both = there[b] & logged[b]
        own, log = speed[b][both], np.broadcast_to(speed_log[b], both.shape)[both]
        same = (kind[b][..., None] == np.array(CollisionKind))[..., None]
        with_whom = np.stack([~playback[b], playback[b]], -1)[..., None, :]
        found.append(
            AgentResult(
                agents=int(both.any(-1).sum()),
                collided=(same & with_whom).sum((0, 1)),
                offroad=(int((off[b] & both).sum()), int(both.sum()) * bool(steps.bounded[b])),
                standing=(int((np.abs(own) < STANDING).sum()), int((np.abs(log) < STANDING).sum())),
                speed=np.stack([_histogram(own), _histogram(log)], -1),
                travel=(float(own.sum(dtype=np.float64)), float(log.sum(dtype=np.float64))),
            )
        )
    return found


def agent_rates(found: Sequence[AgentResult]) -> Ratios:
    """What :meth:`symphony.metrics.RolloutMetrics.compute` gives of agents, as sums over their weights."""

    def column(values: Sequence[Any]) -> NDArray[np.float64]:
        return np.array(values, dtype=np.float64)

    agents, collided = column([r.agents for r in found]), column([100 * r.collided for r in found])
    travel, steps = column([r.travel for r in found]), column([r.speed[:, 0].sum() for r in found])
    off, standing = column([r.offroad for r in found]), 100 * column([r.standing for r in found])
    return {
        "agent_collision_rate": (collided.sum((1, 2)), agents),
        **{
            f"agent_collision_{kind.name.lower()}": (collided[:, kind].sum(-1), agents)
            for kind in CollisionKind
        },
        "agent_collision_with_playback": (collided[..., 1].sum(-1), agents),
        "agent_offroad_time": (100 * off[:, 0], off[:, 1]),
        "agent_progress": (100 * travel[:, 0], travel[:, 1]),
        "agent_speed": (travel[:, 0], steps),
        "agent_speed_log": (travel[:, 1], steps),
        "agent_standing": (standing[:, 0], steps),
        "agent_standing_log": (standing[:, 1], steps),
    }


def speed_distance(found: Sequence[AgentResult]) -> float:
    """Wasserstein distance between the speeds of agents and of the log, m/s; NaN without any."""
    counts = np.sum([r.speed for r in found], axis=0)
    if not counts.sum():
        return float("nan")
    share = np.cumsum(counts / counts.sum(0), axis=0)
    return float(WIDTH * np.abs(share[:, 0] - share[:, 1]).sum())


def _histogram(speed: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
    return np.bincount((np.abs(speed) / WIDTH).astype(np.int64).clip(max=_BINS - 1), minlength=_BINS)
