"""What a segment's rollouts count, and rates of that with standard errors over recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from symphony.metrics.agents import AgentResult
from symphony.metrics.choices import Choice, Standing
from symphony.metrics.kinds import CollisionKind, CollisionKinds


@dataclass(frozen=True)
class SegmentResult:
    """What one run segment adds to the table.

    Attributes:
        collided: rollouts in which an interactive agent collided, in some step or at some state.
        at_states: those of them in which one did at a state; None where not given.
        rollouts: K.
        offroad: agent-steps off the road, over all rollouts.
        steps: agent-steps simulated where the map has a boundary, over all rollouts.
        error: [K] displacement error summed over agents and steps, metres.
        logged: [K] agent-steps at which the log is valid and the agent is there.
        histogram: [201] curvatures of the branching regions visited by the rollouts.
        histogram_log: [201] likewise by the log.
        kinds: [kinds, 2] rollouts by the :class:`CollisionKind` of their first collision, with an interactive agent
            and with a playback agent; None where not asked for.
        agents: [2, kinds] agents of all rollouts by the kind of their first collision: egos, other interactive
            agents; None where kinds are.
        simulated: egos, and other interactive agents, in all rollouts.
        group: the recording the segment is part of; None where not given.
        single: what became of single agents while their log exists; None where not asked for.
        standing: of all rollouts, agents that stand at the end, agents whose log stands there, and agents that are
            compared; None where not given.
        choice: what the search made of the goals; None without search or goals.
    """

    collided: int
    rollouts: int
    offroad: int
    steps: int
    error: NDArray[np.float64]
    logged: NDArray[np.float64]
    histogram: NDArray[np.int64]
    histogram_log: NDArray[np.int64]
    kinds: NDArray[np.int64] | None = None
    agents: NDArray[np.int64] | None = None
    simulated: tuple[int, int] = (0, 0)
    group: str | None = None
    single: AgentResult | None = None
    standing: tuple[int, int, int] | None = None
    choice: Choice | None = None
    at_states: int | None = None

    @property
    def nearest(self) -> tuple[float, float]:
        """Error and agent-steps of the rollout that is nearest to the log on average; 0 where none is compared."""
        each = np.where(self.logged > 0, self.error / np.maximum(self.logged, 1), np.inf)
        best = int(each.argmin())
        return float(self.error[best]), float(self.logged[best])


def count_kinds(
    segment_ids: Sequence[str], kinds: CollisionKinds, hit: Bool[Tensor, "B K"]
) -> NDArray[np.int64]:
    """Rollouts [B, kinds, 2] by kind and whether the other is a playback agent."""
    kind, playback = (value.cpu().numpy() for value in kinds.first())
    if kind.shape != tuple(hit.shape):
        raise ValueError(f"kinds are of {list(kind.shape)} rollouts, expected {list(hit.shape)}")
    wrong = ((kind >= 0) != hit.cpu().numpy()).any(1)
    if wrong.any():
        raise ValueError(f"segment {segment_ids[int(wrong.argmax())]}: kinds are not those of its collisions")
    both = np.stack([~playback, playback], -1)[..., None, :]
    return ((kind[..., None] == np.array(CollisionKind))[..., None] & both).sum(1)


def kind_rates(
    found: Sequence[SegmentResult],
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Percent times rollouts, and rollouts, of every segment."""
    given = [s.kinds for s in found if s.kinds is not None]
    if not given:
        return {}
    if len(given) < len(found):
        raise ValueError(f"collision kinds were given for {len(given)} of {len(found)} segments")
    counts = 100.0 * np.stack(given)
    rollouts = np.array([s.rollouts for s in found], dtype=np.float64)
    rates = {kind.name.lower(): counts[:, kind].sum(-1) for kind in CollisionKind}
    rates["with_playback"] = counts[..., 1].sum(-1)
    rates["rear_ended_by_playback"] = counts[:, CollisionKind.REAR_ENDED, 1]
    return {f"collision_{name}": (total, rollouts) for name, total in rates.items()}


def count_agents(kinds: CollisionKinds) -> NDArray[np.int64]:
    """Agents [B, 2, kinds] by kind: egos, other interactive agents, of all rollouts."""
    same = kinds.kind.cpu().numpy()[..., None] == np.array(CollisionKind)
    counts = same.sum(1)
    return np.stack([counts[:, 0], counts[:, 1:].sum(1)], axis=1)


def role_rates(
    found: Sequence[SegmentResult],
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Percent times agents, and agents, of every segment: all kinds, then each."""
    given = [s.agents for s in found if s.agents is not None]
    if not given:
        return {}
    counts = 100.0 * np.stack(given)
    weights = np.array([s.simulated for s in found], dtype=np.float64)
    rates = {}
    for k, who in enumerate(("ego", "others")):
        rates[f"{who}_collision_rate"] = counts[:, k].sum(-1), weights[:, k]
        for kind in CollisionKind:
            rates[f"{who}_collision_{kind.name.lower()}"] = counts[:, k, kind], weights[:, k]
    return rates


def count_standing(standing: Standing) -> list[tuple[int, int, int]]:
    """Of every segment and all its rollouts: agents that stand, whose log stands, and that are compared."""
    counted = standing.counted
    each = (standing.rollouts & counted, standing.log[:, None] & counted, counted)
    return list(zip(*(flags.sum((1, 2)).tolist() for flags in each), strict=True))


def standing_rates(
    found: Sequence[SegmentResult],
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Percent times agents, and agents, of every segment: those of the rollouts, and of the log."""
    given = [s.standing for s in found if s.standing is not None]
    if not given:
        return {}
    if len(given) < len(found):
        raise ValueError(f"who stands was given for {len(given)} of {len(found)} segments")
    slow, slow_log, agents = np.array(given, dtype=np.float64).T
    return {"standing": (100 * slow, agents), "standing_log": (100 * slow_log, agents)}


def group_numbers(found: Sequence[SegmentResult]) -> NDArray[np.int64] | None:
    """[segments] number of the group each is in, from 0; None where none were given."""
    given = [s.group for s in found if s.group is not None]
    if not given:
        return None
    if len(given) < len(found):
        raise ValueError(f"groups were given for {len(given)} of {len(found)} segments")
    return np.unique(np.array(given), return_inverse=True)[1]


def summed(values: NDArray[Any], member: NDArray[np.int64] | None) -> NDArray[Any]:
    """Sums over the segments of each group; the segments' own values without groups."""
    if member is None:
        return values
    out = np.zeros((int(member.max()) + 1, *values.shape[1:]), values.dtype)
    np.add.at(out, member, values)
    return out


def ratio(
    total: NDArray[np.float64], weight: NDArray[np.float64], member: NDArray[np.int64] | None = None
) -> tuple[float, float]:
    """Ratio of sums and its standard error over segments or groups (linearised; NaN for a single one).

    Those without anything to count are no samples: of two recordings of which one is empty there is no error.
    """
    if weight.sum() == 0:
        return math.nan, math.nan
    rate = total.sum() / weight.sum()
    total, weight = summed(total, member), summed(weight, member)
    some = (total != 0) | (weight != 0)
    total, weight = total[some], weight[some]
    count = len(total)
    if count < 2:
        return float(rate), math.nan
    residual = (total - rate * weight) / weight.mean()
    return float(rate), float(np.sqrt((residual**2).sum() / (count - 1) / count))
