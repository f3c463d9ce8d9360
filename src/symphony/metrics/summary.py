"""The paper's table of metrics (section V-B), accumulated segment by segment.

Shapes: B segments, K rollouts, N interactive agents, T simulated steps. The first state, where simulation and log
agree by construction, is not among the steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from symphony.metrics.intervals import ratio, summed, zero_bound
from symphony.metrics.kinds import STANDING, CollisionKind, CollisionKinds

DRAWS = 200  # bootstrap samples that are averaged over, always the same ones
BINS = 201  # bins of width 0.01 1/m, centred at the multiples of 0.01 in [-1, 1]


def curvature_histogram(curvature: NDArray[Any]) -> NDArray[np.int64]:
    """Return the counts [201] of average curvatures [...] in 1/m; values beyond +-1 fall into the outermost bins."""
    half = BINS // 2
    flat = np.asarray(curvature, dtype=np.float64).reshape(-1).clip(-1, 1)
    return np.bincount(np.rint(flat * half).astype(np.int64) + half, minlength=BINS)


def jensen_shannon(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.float64]:
    """Return the Jensen-Shannon divergence (no root) [...] of histograms [..., K] in nats; NaN if one is empty."""
    counts = [np.asarray(each, dtype=np.float64) for each in (first, second)]
    totals = [each.sum(-1, keepdims=True) for each in counts]
    p, q = (np.divide(c, t, out=np.full_like(c, np.nan), where=t > 0) for c, t in zip(counts, totals, strict=True))
    middle = (p + q) / 2
    divergence = (_relative(p, middle) + _relative(q, middle)) / 2
    return np.maximum(divergence, 0.0)


class Divergence(NamedTuple):
    """A divergence between the choices of rollouts and logs, with and without the bias of sampling."""

    value: float  # of the summed histograms, nats
    error: float  # standard error (jackknife); NaN for a single sample
    corrected: float  # the value less the bias that finite samples give it; NaN for a single sample
    parts: NDArray[np.float64]  # [n] pseudo-values of the samples, whose mean is the corrected value


def sampled_divergence(counts: NDArray[Any], counts_log: NDArray[Any]) -> Divergence:
    """Return the Jensen-Shannon divergence of sums of n independent samples, its error and bias by leaving one out.

    A sample is left out with its rollouts and its log together. So noise that the two have in common is not counted
    as bias, and rollouts of a sample that are alike are not taken for independent ones.

    Takes the histograms [n, K] of rollouts and log of each sample (a recording, or a segment). Source: Quenouille,
    "Notes on bias in estimation", Biometrika 43 (1956).
    """
    total, total_log, number = counts.sum(0), counts_log.sum(0), len(counts)
    value = float(jensen_shannon(total, total_log))
    if number < 2:
        return Divergence(value, math.nan, math.nan, np.full(number, math.nan))
    without = jensen_shannon(total - counts, total_log - counts_log)
    parts = number * value - (number - 1) * without
    error = float(parts.std(ddof=1) / np.sqrt(number))
    return Divergence(value, error, float(parts.mean()), parts)


def sampling_floor(counts_log: NDArray[Any]) -> float:
    """Return the score in nats of a log of this size against the distribution that it is a sample of.

    No policy is known to be better, however many rollouts it has. It is estimated by bootstrap samples of the
    segments, of which it takes the log's histograms [n, K], against all of them. Two logs of this size differ by
    about twice as much. It is too low where segments of one recording are alike, or many turns too rare for the log.
    """
    number = len(counts_log)
    often = np.random.default_rng(0).multinomial(number, np.full(number, 1 / number), size=DRAWS)
    values = jensen_shannon(often @ counts_log, counts_log.sum(0)[None])
    known = values[np.isfinite(values)]  # a draw without any curvature has no distribution
    return float(known.mean()) if len(known) else math.nan


def _relative(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum of p ln(p / q) over the bins where p is not 0; NaN stays NaN."""
    none = p == 0
    return (p * np.log(np.where(none, 1.0, p) / np.where(none, 1.0, q))).sum(-1)


WIDTH, FASTEST = 0.5, 45.0  # bins of speeds, and the last of them, in m/s
_SPEEDS = round(FASTEST / WIDTH)
_SHARES = ("collision_rate", "collision_rate_at_states", "offroad_time", "agent_collision_rate", "agent_offroad_time")
"""Percentages of which a bound is known where they are zero."""
_ROW = (
    "collision_rate",
    "offroad_time",
    "min_sade",
    "collision_rate_at_states",
    "collision_with_playback",
    "collision_rear_ended",
    "standing",
    "standing_log",
)
"""Numbers that every run segment has for itself."""
WEIGHTED = ("ade", "min_sade", "offroad_time")  # of these, those of which longer segments weigh more


@dataclass(frozen=True)
class SegmentResult:
    """The contribution of one run segment to the table."""

    group: str  # the recording it is part of
    rollouts: int  # K
    #: of every number that is a ratio of sums over segments, what the segment adds to the two sums
    sums: dict[str, tuple[float, float]]
    ade: float  # its own ADE, metres; NaN where the log is valid at no step
    histogram: NDArray[np.int64]  # [201] curvatures of the branching regions visited by the rollouts
    histogram_log: NDArray[np.int64]  # [201] curvatures of those visited by the log
    speeds: NDArray[np.int64]  # [bins, 2] agent-steps by speed, simulated and logged


class RolloutMetrics:
    """Collision rate, off-road time, ADE, minSADE and curvature JSD over any number of batches. The order and the
    division into batches or processes do not change the result.
    """

    def __init__(self) -> None:
        self.segments: dict[str, SegmentResult] = {}

    def update(
        self,
        segment_ids: Sequence[str],
        groups: Sequence[str],
        *,
        simulated: Bool[Tensor, "B K N T"],
        logged: Bool[Tensor, "B N T"],
        at_states: Bool[Tensor, "B K N T"],
        offroad: Bool[Tensor, "B K N T"],
        bounded: Bool[Tensor, " B"],
        displacement: Float[Tensor, "B K N T"],
        speed: Float[Tensor, "B K N T"],
        speed_log: Float[Tensor, "B N T"],
        last: Int[Tensor, " B"],
        kinds: CollisionKinds,
        kinds_logged: CollisionKinds,
        curvature: Sequence[NDArray[Any]],
        curvature_log: Sequence[NDArray[Any]],
    ) -> None:
        """Add the rollouts of some segments, each seen once in all updates, else a ValueError is raised.

        Segments of one recording (``groups``, see ``RunSegment.group``) are not independent samples: standard errors
        are over groups. Only agent-steps that exist (``simulated``) count, and where the log is valid (``logged``)
        distances from it, ``displacement`` in metres. Flags say whether an agent's box overlaps another at the state
        after a step, and whether its centre is off the road, which nobody is where the map has no boundary
        (``bounded``). Speeds are in m/s, ``last`` numbers the last step of each segment, ``kinds`` [B, K, N] are
        first collisions, those logged while their log exists. ``curvature`` is the average curvature of every
        branching region that rollouts of a segment visit, and the log.
        """
        # Sums are exact, so that padding among what is summed does not change how they are rounded.
        away = displacement.double().masked_fill(~(simulated & logged[:, None]), 0.0).flatten(2).tolist()
        kind, playback = (part.cpu().numpy() for part in kinds.first())
        kind_logged, playback_logged = (part.cpu().numpy() for part in (kinds_logged.kind, kinds_logged.playback))
        steps = [part.cpu().numpy() for part in (simulated, logged, at_states, offroad, speed, speed_log)]
        ends, edged = last.tolist(), bounded.tolist()
        for b, name in enumerate(segment_ids):
            if name in self.segments:
                raise ValueError(f"segment {name} was added twice")
            there, has_log, touching, off, own, log = (part[b] for part in steps)
            both, log = there & has_log, np.broadcast_to(log, own.shape)
            at_end = both[..., ends[b]]
            rollouts, agents, compared = len(there), both.any(-1).sum(), both.sum()
            first = _by_kind(kind[b], playback[b])
            met = _by_kind(kind_logged[b], playback_logged[b])
            shares = {
                **_collision_shares("", first.sum(-1), rollouts),
                "collision_with_playback": (first[:, 1].sum(), rollouts),
                "collision_rear_ended_by_playback": (first[CollisionKind.REAR_ENDED, 1], rollouts),
                "collision_rate_at_states": ((touching & there).any((1, 2)).sum(), rollouts),
                "offroad_time": ((off & there).sum(), there.sum() * edged[b]),
                **_collision_shares("agent_", met.sum(-1), agents),
                "agent_collision_with_playback": (met[:, 1].sum(), agents),
                "agent_offroad_time": ((off & both).sum(), compared * edged[b]),
                "agent_progress": (own[both].sum(dtype=np.float64), log[both].sum(dtype=np.float64)),
            }
            error = np.array([math.fsum(rollout) for rollout in away[b]])
            count = both.sum((1, 2)).astype(np.float64)
            sums = {"ade": (error.mean(), count.mean()), "min_sade": _nearest(error, count)}
            for beside, driven in (("", own), ("_log", log)):
                slow = np.abs(driven) < STANDING
                sums[f"agent_speed{beside}"] = driven[both].sum(dtype=np.float64), compared
                shares[f"agent_standing{beside}"] = (slow & both).sum(), compared
                shares[f"standing{beside}"] = (slow[..., ends[b]] & at_end).sum(), at_end.sum()
            sums |= {key: (100.0 * total, weight) for key, (total, weight) in shares.items()}
            self.segments[name] = SegmentResult(
                group=groups[b],
                rollouts=rollouts,
                sums={key: (float(total), float(weight)) for key, (total, weight) in sums.items()},
                ade=_quotient(error.sum(), count.sum()),
                histogram=curvature_histogram(curvature[b]),
                histogram_log=curvature_histogram(curvature_log[b]),
                speeds=np.stack([_speeds(driven[both]) for driven in (own, log)], -1),
            )

    def merge(self, other: RolloutMetrics) -> None:
        """Add all that another process or batch has seen. Raises ValueError if both have seen the same segment."""
        twice = self.segments.keys() & other.segments.keys()
        if twice:
            raise ValueError(f"segments {sorted(twice)[:3]} were added twice")
        self.segments.update(other.segments)

    def rows(self) -> list[dict[str, Any]]:
        """Return a row per segment, ordered by id, for paired comparisons; ``group`` is the recording it is part of.

        Percentages (see :meth:`compute`), ``ade`` and ``min_sade`` in metres; NaN for a mean over nothing.
        ``ade_weight`` and so on: agent-steps, its weight in :meth:`compute`.
        """
        found = []
        for name, segment in sorted(self.segments.items()):
            own: dict[str, Any] = {key: _quotient(*segment.sums[key]) for key in _ROW}
            own |= {f"{key}_weight": segment.sums[key][1] for key in WEIGHTED}
            found.append({"segment": name, "group": segment.group, "ade": segment.ade} | own)
        return found

    def mean(self, values: Mapping[str, float]) -> tuple[float, float]:
        """Return the mean of a further number of every segment and its standard error over groups, without NaN."""
        known = {name: value for name, value in sorted(values.items()) if not math.isnan(value)}
        if any(map(math.isinf, known.values())):
            return sum(known.values()), math.nan
        member = np.unique([self.segments[name].group for name in known], return_inverse=True)[1]
        return ratio(np.array(list(known.values())), np.ones(len(known)), member)

    def curvature_divergence(self) -> tuple[Divergence, list[str]]:
        """Return the divergence, and the names of its samples: the groups."""
        found = [self.segments[name] for name in sorted(self.segments)]
        # Segments without a turn on either side are no samples.
        found = [one for one in found if one.histogram.any() or one.histogram_log.any()] or found
        names, member = np.unique([one.group for one in found], return_inverse=True)
        counts = (np.stack(each) for each in zip(*((s.histogram, s.histogram_log) for s in found), strict=True))
        return sampled_divergence(*(summed(each, member) for each in counts)), names.tolist()

    def compute(self) -> dict[str, Any]:
        """Return the table row.

        Returns:
            Percentages, distances in metres, most with a standard error over groups under ``*_se`` (jackknife). Of
            the collision rates and times off the road that are zero ``*_bound`` is the exact bound with 95 %
            confidence over groups (:func:`symphony.metrics.intervals.zero_bound`), else NaN.

            The paper's: ``collision_rate``, rollouts with at least one collision of an interactive agent;
            ``offroad_time``, of agent-steps; ``ade`` and ``min_sade``, means over agent-steps of all segments;
            ``curvature_jsd``, nats, NaN if rollouts or logs visit no branching region. Beside it
            ``curvature_jsd_floor`` is what the log's finite size alone gives, ``curvature_jsd_corrected`` the
            divergence without its bias by sampling (NaN for a single group).

            Of collisions: ``collision_rate_at_states`` counts overlaps at states only, as the paper and WOSAC do;
            ``collision_into_leader`` and so on are rollouts by the :class:`CollisionKind` of their first collision
            (they sum to ``collision_rate``), ``collision_with_playback`` those in which that is with a playback
            agent, ``collision_rear_ended_by_playback`` both.

            Of single agents while they are driven and logged: ``agent_collision_rate``, by kind, and
            ``agent_collision_with_playback``, percent of agents; ``agent_offroad_time``; ``agent_progress``, metres
            driven in percent of the log's; ``agent_speed``, its mean, and ``agent_standing``, percent of time, both
            also as ``*_log``; ``agent_speed_distance``, how far the speeds are from the log's (Wasserstein, m/s).

            ``standing`` and ``standing_log`` are the percent of agents that stand at the last step, of those whose
            log lasts that long. ``segments``, ``offroad_segments`` (those with a boundary, of which alone the
            off-road time is), ``groups`` and ``rollouts`` (per segment) say how many there are.
        """
        found = [self.segments[name] for name in sorted(self.segments)]
        groups, member = np.unique([one.group for one in found], return_inverse=True)
        out: dict[str, Any] = {}
        for name in found[0].sums:
            total, weight = np.array([one.sums[name] for one in found]).T
            out[name], out[f"{name}_se"] = ratio(total, weight, member)
            if name in _SHARES:
                samples = int((summed(weight, member) > 0).sum())
                out[f"{name}_bound"] = zero_bound(samples) if out[name] == 0 else math.nan
        divergence, _ = self.curvature_divergence()
        out["curvature_jsd"], out["curvature_jsd_se"] = divergence.value, divergence.error
        out["curvature_jsd_floor"] = sampling_floor(np.stack([one.histogram_log for one in found]))
        out["curvature_jsd_corrected"] = divergence.corrected
        speeds = np.sum([one.speeds for one in found], axis=0)
        share = np.cumsum(speeds / speeds.sum(0), axis=0) if speeds.any() else np.full((1, 2), math.nan)
        out["agent_speed_distance"] = float(WIDTH * np.abs(share[:, 0] - share[:, 1]).sum())
        out["segments"] = len(found)
        out["offroad_segments"] = sum(one.sums["offroad_time"][1] > 0 for one in found)
        out["groups"] = len(groups)
        out["rollouts"] = max(one.rollouts for one in found)
        return out


def _nearest(error: NDArray[np.float64], count: NDArray[np.float64]) -> tuple[float, float]:
    """Return the error and agent-steps of the rollout nearest to the log on average; 0 where none is compared."""
    best = int(np.where(count > 0, error / np.maximum(count, 1), np.inf).argmin())
    return float(error[best]), float(count[best])


def _by_kind(kind: NDArray[np.int64], playback: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of collisions by kind and whether the other is a playback agent [kinds, 2]."""
    same = kind[..., None] == np.array(CollisionKind)
    other = playback[..., None] == np.array([False, True])
    return (same[..., None] & other[..., None, :]).sum(tuple(range(kind.ndim)))


def _collision_shares(who: str, counts: NDArray[np.int64], of: Any) -> dict[str, tuple[Any, Any]]:
    each = {f"{who}collision_{kind.name.lower()}": (counts[kind], of) for kind in CollisionKind}
    return {f"{who}collision_rate": (counts.sum(), of), **each}


def _quotient(total: float, weight: float) -> float:
    return float(total / weight) if weight else math.nan


def _speeds(speed: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
    return np.bincount((np.abs(speed) / WIDTH).astype(np.int64).clip(max=_SPEEDS - 1), minlength=_SPEEDS)
