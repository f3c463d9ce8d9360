"""The paper's table of metrics (section V-B), accumulated segment by segment.

Shapes: B segments, K rollouts, N interactive agents, T simulated steps. The first state, where simulation and log
agree by construction, is not among the steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from symphony.metrics.curvature import curvature_histogram, jensen_shannon


@dataclass(frozen=True)
class SegmentResult:
    """What one run segment adds to the table.

    Attributes:
        collided: rollouts in which an interactive agent collided at some step.
        rollouts: K.
        offroad: agent-steps off the road, over all rollouts.
        steps: agent-steps simulated, over all rollouts.
        error: [K] displacement error summed over agents and steps, metres.
        logged: agent-steps at which the log is valid, of one rollout.
        histogram: [201] curvatures of the branching regions visited by the rollouts.
        histogram_log: [201] likewise by the log.
    """

    collided: int
    rollouts: int
    offroad: int
    steps: int
    error: NDArray[np.float64]
    logged: int
    histogram: NDArray[np.int64]
    histogram_log: NDArray[np.int64]


class RolloutMetrics:
    """Collision rate, off-road time, ADE, minSADE and curvature JSD over any number of batches.

    The order and the division into batches or processes do not change the result.
    """

    def __init__(self) -> None:
        self.segments: dict[str, SegmentResult] = {}

    def update(
        self,
        segment_ids: Sequence[str],
        *,
        collided: Bool[Tensor, "B K N T"],
        offroad: Bool[Tensor, "B K N T"],
        displacement: Float[Tensor, "B K N T"],
        simulated: Bool[Tensor, "B K N T"],
        logged: Bool[Tensor, "B N T"],
        curvature: Sequence[NDArray[Any]],
        curvature_log: Sequence[NDArray[Any]],
    ) -> None:
        """Add the rollouts of some segments.

        Args:
            segment_ids: [B], each seen once in all updates.
            collided: whether an agent's box overlaps another.
            offroad: whether its centre is off the road.
            displacement: metres from the log.
            simulated: agent-steps that exist; the rest counts for nothing.
            logged: where the log is valid; the rest does not count for ADE and minSADE.
            curvature: per segment, the average curvature of every branching region visited by each rollout.
            curvature_log: per segment, likewise by the log.

        Raises:
            ValueError: for a segment that was added before.
        """
        compared = simulated & logged[:, None]
        error = displacement.double().masked_fill(~compared, 0.0).sum((2, 3)).numpy()
        hits = (collided & simulated).flatten(2).any(-1).sum(1)
        off, steps = (offroad & simulated).sum((1, 2, 3)), simulated.sum((1, 2, 3))
        # The same agent-steps are compared in every rollout, up to those a rollout does not simulate.
        count = compared.sum((2, 3)).amax(1)
        for b, name in enumerate(segment_ids):
            if name in self.segments:
                raise ValueError(f"segment {name} was added twice")
            self.segments[name] = SegmentResult(
                collided=int(hits[b]),
                rollouts=simulated.shape[1],
                offroad=int(off[b]),
                steps=int(steps[b]),
                error=error[b],
                logged=int(count[b]),
                histogram=curvature_histogram(curvature[b]),
                histogram_log=curvature_histogram(curvature_log[b]),
            )

    def merge(self, other: RolloutMetrics) -> None:
        """Add all that another process or batch has seen.

        Raises:
            ValueError: if both have seen the same segment.
        """
        twice = self.segments.keys() & other.segments.keys()
        if twice:
            raise ValueError(f"segments {sorted(twice)[:3]} were added twice")
        self.segments.update(other.segments)

    def rows(self) -> list[dict[str, Any]]:
        """One row per segment, ordered by its id, for paired comparisons.

        ``collision_rate`` and ``offroad_time`` in percent, ``ade`` and ``min_sade`` in metres (NaN where the log is
        valid at no step).
        """
        return [
            {
                "segment": name,
                "collision_rate": 100.0 * s.collided / s.rollouts,
                "offroad_time": 100.0 * s.offroad / s.steps if s.steps else math.nan,
                "ade": s.error.mean() / s.logged if s.logged else math.nan,
                "min_sade": s.error.min() / s.logged if s.logged else math.nan,
            }
            for name, s in sorted(self.segments.items())
        ]

    def compute(self) -> dict[str, Any]:
        """The table row.

        Returns:
            ``collision_rate`` (percent of rollouts with at least one collision of an interactive agent),
            ``offroad_time`` (percent of agent-steps), ``ade`` and ``min_sade`` (metres, means over agent-steps of
            all segments), each with its standard error over segments under ``*_se``; ``curvature_jsd`` (nats, NaN
            if rollouts or logs visit no branching region), ``segments`` and ``rollouts`` (per segment).

        Raises:
            ValueError: if nothing was added.
        """
        if not self.segments:
            raise ValueError("no segments were added")
        found = [self.segments[name] for name in sorted(self.segments)]

        def column(values: Sequence[float]) -> NDArray[np.float64]:
            return np.array(values, dtype=np.float64)

        logged = column([s.logged for s in found])
        parts = {
            "collision_rate": (
                100 * column([s.collided for s in found]),
                column([s.rollouts for s in found]),
            ),
            "offroad_time": (100 * column([s.offroad for s in found]), column([s.steps for s in found])),
            "ade": (column([s.error.mean() for s in found]), logged),
            "min_sade": (column([s.error.min() for s in found]), logged),
        }
        out: dict[str, Any] = {}
        for name, (total, weight) in parts.items():
            out[name], out[f"{name}_se"] = _ratio(total, weight)
        out["curvature_jsd"] = jensen_shannon(
            np.sum([s.histogram for s in found], axis=0), np.sum([s.histogram_log for s in found], axis=0)
        )
        out["segments"] = len(found)
        out["rollouts"] = max(s.rollouts for s in found)
        return out


def _ratio(total: NDArray[np.float64], weight: NDArray[np.float64]) -> tuple[float, float]:
    """Ratio of sums and its standard error over segments (linearised; NaN for a single segment)."""
    if weight.sum() == 0:
        return math.nan, math.nan
    ratio = total.sum() / weight.sum()
    count = len(total)
    if count < 2:
        return float(ratio), math.nan
    residual = (total - ratio * weight) / weight.mean()
    return float(ratio), float(np.sqrt((residual**2).sum() / (count - 1) / count))
