"""The paper's table of metrics (section V-B), accumulated segment by segment.

Shapes: B segments, K rollouts, N interactive agents, T simulated steps. The first state, where simulation and log
agree by construction, is not among the steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from symphony.metrics.agents import AgentSteps, agent_rates, agent_results, speed_distance
from symphony.metrics.choices import Choice, Standing, choice_numbers
from symphony.metrics.curvature import (
    BINS,
    Divergence,
    curvature_histogram,
    sampled_divergence,
    sampling_floor,
)
from symphony.metrics.intervals import zero_bound
from symphony.metrics.kinds import CollisionKinds
from symphony.metrics.rates import (
    SegmentResult,
    count_agents,
    count_kinds,
    count_standing,
    group_numbers,
    kind_rates,
    ratio,
    role_rates,
    standing_rates,
    summed,
)


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
        kinds: CollisionKinds | None = None,
        groups: Sequence[str] | None = None,
        single: AgentSteps | None = None,
        standing: Standing | None = None,
        choices: Sequence[Choice] | None = None,
        at_states: Bool[Tensor, "B K N T"] | None = None,
        bounded: Bool[Tensor, " B"] | None = None,
    ) -> None:
        """Add the rollouts of some segments.

        Args:
            segment_ids: [B], each seen once in all updates.
            collided: whether an agent's box overlaps another at some time of a step.
            offroad: whether its centre is off the road.
            displacement: metres from the log.
            simulated: agent-steps that exist; the rest counts for nothing.
            logged: where the log is valid; the rest does not count for ADE and minSADE.
            curvature: per segment, the average curvature of every branching region visited by each rollout.
            curvature_log: per segment, likewise by the log.
            kinds: [B, K, N] of the collisions of simulated agents, the ego first, for all segments or for none.
            groups: [B] the recording each segment is part of (see ``RunSegment.group``), for all segments or for
                none. Segments of one recording are no independent samples: standard errors are then over groups.
            single: what single agents did, for all segments or for none.
            standing: who stands at the end, for all segments or for none.
            choices: [B] what the search made of the goals, for all segments or for none.
            at_states: whether boxes overlap at the state after each step, for all segments or for none.
            bounded: whether the map of a segment has a boundary: where it has none nobody is off or on the road.

        Raises:
            ValueError: for a segment that was added before, shapes that do not fit together, a displacement or
                curvature that is not finite, or kinds of other collisions.
        """
        _check_shapes(len(segment_ids), simulated, collided, offroad, displacement, logged)
        compared = simulated & logged[:, None]
        away = displacement.detach().double().masked_fill(~compared, 0.0).flatten(2).tolist()
        # Sums are exact, so that padding among what is summed does not change how they are rounded.
        error = np.array([[math.fsum(rollout) for rollout in segment] for segment in away])
        if not np.isfinite(error).all():
            bad = segment_ids[int(np.argwhere(~np.isfinite(error))[0, 0])]
            raise ValueError(f"segment {bad}: displacement is not finite")
        hit = (collided & simulated).flatten(2).any(-1)
        counts = None if kinds is None else count_kinds(segment_ids, kinds, hit)
        by_agent = None if kinds is None else count_agents(kinds)
        there = simulated.any(-1).sum(1)
        if groups is not None and len(groups) != len(segment_ids):
            raise ValueError(f"{len(groups)} groups for {len(segment_ids)} segments")
        singles = None if single is None else agent_results(single)
        ends = None if standing is None else count_standing(standing)
        hits = hit.sum(1)
        off, steps = (offroad & simulated).sum((1, 2, 3)), simulated.sum((1, 2, 3))
        if bounded is not None:
            steps = steps * bounded.to(steps.device)
        touched = None if at_states is None else (at_states & simulated).flatten(2).any(-1).sum(1).tolist()
        count = compared.sum((2, 3))
        for b, (name, seen, seen_log) in enumerate(zip(segment_ids, curvature, curvature_log, strict=True)):
            if name in self.segments:
                raise ValueError(f"segment {name} was added twice")
            self.segments[name] = SegmentResult(
                collided=int(hits[b]),
                rollouts=simulated.shape[1],
                offroad=int(off[b]),
                steps=int(steps[b]),
                error=error[b],
                logged=count[b].double().cpu().numpy(),
                histogram=curvature_histogram(seen),
                histogram_log=curvature_histogram(seen_log),
                kinds=None if counts is None else counts[b],
                agents=None if by_agent is None else by_agent[b],
                simulated=(int(there[b, 0]), int(there[b, 1:].sum())),
                group=None if groups is None else groups[b],
                single=None if singles is None else singles[b],
                standing=None if ends is None else ends[b],
                choice=None if choices is None else choices[b],
                at_states=None if touched is None else touched[b],
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
        """One row per segment, ordered by its id, for paired comparisons; ``group`` is the recording it is part of.

        ``collision_rate`` and ``offroad_time`` in percent, ``ade`` and ``min_sade`` in metres (NaN where the log is
        valid at no step, and off-road time where the map has no boundary); where given ``collision_rate_at_states``,
        ``collision_with_playback``, ``standing`` and ``standing_log`` in percent, and
        ``goals_variation``.
        """
        return [
            {
                "segment": name,
                "group": s.group or name,
                "collision_rate": 100.0 * s.collided / s.rollouts,
                "offroad_time": 100.0 * s.offroad / s.steps if s.steps else math.nan,
                "ade": s.error.sum() / s.logged.sum() if s.logged.any() else math.nan,
                "min_sade": s.nearest[0] / s.nearest[1] if s.logged.any() else math.nan,
                **_more(s),
            }
            for name, s in sorted(self.segments.items())
        ]

    def mean(self, values: Mapping[str, float]) -> tuple[float, float]:
        """Mean of another number of every segment, and its standard error over the same groups; NaN is left out."""
        known = {name: value for name, value in sorted(values.items()) if not math.isnan(value)}
        if not known:
            return math.nan, math.nan
        if any(map(math.isinf, known.values())):
            return sum(known.values()), math.nan
        member = group_numbers([self.segments[name] for name in known])
        return ratio(np.array(list(known.values())), np.ones(len(known)), member)

    def curvature_histograms(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Counts [201] of the branching regions visited by their average curvature: rollouts, and logs."""
        visited, visited_log = np.zeros((2, BINS), np.int64)
        for segment in self.segments.values():
            visited += segment.histogram
            visited_log += segment.histogram_log
        return visited, visited_log

    def curvature_divergence(self) -> tuple[Divergence, list[str]]:
        """The divergence, and the names of its samples: the groups, or without any the segments."""
        found = [self.segments[name] for name in sorted(self.segments)]
        member = group_numbers(found)
        names = sorted(self.segments) if member is None else sorted({str(s.group) for s in found})
        counts = (
            np.stack(each) for each in zip(*((s.histogram, s.histogram_log) for s in found), strict=True)
        )
        return sampled_divergence(*(summed(each, member) for each in counts)), names

    def compute(self) -> dict[str, Any]:
        """The table row.

        Returns:
            ``collision_rate`` (percent of rollouts with at least one collision of an interactive agent),
            ``offroad_time`` (percent of agent-steps), ``ade`` and ``min_sade`` (metres, means over agent-steps of
            all segments), ``curvature_jsd`` (nats, NaN if rollouts or logs visit no branching region), each with its
            standard error over segments under ``*_se`` (linearised for the ratios, jackknife for the divergence);
            ``segments`` and ``rollouts`` (per segment); ``offroad_segments``, those with a boundary, of which alone
            the off-road time is (NaN without any). Of each percentage that is zero ``*_bound`` is the exact one-sided
            bound with 95 % confidence over these samples (:func:`symphony.metrics.intervals.zero_bound`), else NaN.
            ``collision_rate_at_states`` (where given) counts overlaps at states only, as the paper and WOSAC do, and
            not those between states. ``curvature_jsd_floor`` is what the
            log's finite size alone gives, ``curvature_jsd_corrected`` the divergence without its bias by sampling
            (its error is that of the divergence; NaN for a single segment or group). Where kinds were given, likewise
            the percent of rollouts whose first collision is of a kind, ``collision_into_leader`` and so on for every
            :class:`CollisionKind` (they sum to ``collision_rate``), that is with a playback agent,
            ``collision_with_playback``, and that is both, ``collision_rear_ended_by_playback``; and of the agents
            themselves, the ego apart, the percent that collide, ``ego_collision_rate`` and
            ``others_collision_rate``, and by kind, ``ego_collision_into_leader`` and so on.
            Where steps of single agents were given, of those at which an agent is driven and logged: the percent of
            agents that collide, ``agent_collision_rate``, by kind and ``agent_collision_with_playback``;
            ``agent_offroad_time``; metres driven in percent of the log's, ``agent_progress``; mean speed,
            ``agent_speed``, and the percent of time that agents stand, ``agent_standing``, both also as ``*_log``;
            and how far the speeds are from the log's, ``agent_speed_distance`` (Wasserstein, m/s).
            Where standing was given, ``standing`` and ``standing_log`` are the percent of agents that stand at the
            last step, of those whose log lasts that long. Where choices were given, see :func:`choice_numbers`.
            Where groups were given, ``groups`` is how many, and all standard errors are over them (as if each were
            one segment: cluster-robust, and a jackknife that leaves out a group).

        Raises:
            ValueError: if nothing was added, or kinds or groups for some segments only.
        """
        if not self.segments:
            raise ValueError("no segments were added")
        found = [self.segments[name] for name in sorted(self.segments)]

        def column(values: Sequence[float]) -> NDArray[np.float64]:
            return np.array(values, dtype=np.float64)

        single = [s.single for s in found if s.single is not None]
        if 0 < len(single) < len(found):
            raise ValueError(f"steps of agents were given for {len(single)} of {len(found)} segments")
        nearest = [s.nearest for s in found]
        parts = {
            "collision_rate": (
                100 * column([s.collided for s in found]),
                column([s.rollouts for s in found]),
            ),
            "offroad_time": (100 * column([s.offroad for s in found]), column([s.steps for s in found])),
            "ade": (column([s.error.mean() for s in found]), column([s.logged.mean() for s in found])),
            "min_sade": (column([error for error, _ in nearest]), column([steps for _, steps in nearest])),
            **_touching(found),
            **kind_rates(found),
            **role_rates(found),
            **(agent_rates(single) if single else {}),
            **standing_rates(found),
        }
        member = group_numbers(found)
        out: dict[str, Any] = {}
        for name, (total, weight) in parts.items():
            out[name], out[f"{name}_se"] = ratio(total, weight, member)
            if name in _SHARES:
                samples = int((summed(weight, member) > 0).sum())
                out[f"{name}_bound"] = zero_bound(samples) if out[name] == 0 else math.nan
        divergence, _ = self.curvature_divergence()
        out["curvature_jsd"], out["curvature_jsd_se"] = divergence.value, divergence.error
        out["curvature_jsd_floor"] = sampling_floor(np.stack([s.histogram_log for s in found]))
        out["curvature_jsd_corrected"] = divergence.corrected
        chosen = [s.choice for s in found if s.choice is not None]
        out |= choice_numbers(chosen) if chosen else {}
        if single:
            out["agent_speed_distance"] = speed_distance(single)
        out["segments"] = len(found)
        out["offroad_segments"] = sum(s.steps > 0 for s in found)
        if member is not None:
            out["groups"] = int(member.max()) + 1
        out["rollouts"] = max(s.rollouts for s in found)
        return out


_SHARES = (
    "collision_rate",
    "collision_rate_at_states",
    "offroad_time",
    "agent_collision_rate",
    "agent_offroad_time",
)
"""Percentages of which a bound is known where they are zero."""


def _touching(found: Sequence[SegmentResult]) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Collisions at states only, of all segments or of none."""
    given = [s.at_states for s in found if s.at_states is not None]
    if not given:
        return {}
    if len(given) < len(found):
        raise ValueError(f"collisions at states were given for {len(given)} of {len(found)} segments")
    rollouts = np.array([s.rollouts for s in found], np.float64)
    return {"collision_rate_at_states": (100 * np.array(given, np.float64), rollouts)}


def _more(s: SegmentResult) -> dict[str, float]:
    """What a row has where it was asked for."""
    out: dict[str, float] = {}
    if s.at_states is not None:
        out["collision_rate_at_states"] = 100.0 * s.at_states / s.rollouts
    if s.kinds is not None:
        out["collision_with_playback"] = 100.0 * float(s.kinds[:, 1].sum()) / s.rollouts
    if s.standing is not None:
        slow, slow_log, agents = s.standing
        out["standing"] = 100.0 * slow / agents if agents else math.nan
        out["standing_log"] = 100.0 * slow_log / agents if agents else math.nan
    if s.choice is not None:
        out["goals_variation"] = s.choice.variation
    return out


def _check_shapes(
    batch: int, simulated: Tensor, collided: Tensor, offroad: Tensor, displacement: Tensor, logged: Tensor
) -> None:
    shape = tuple(simulated.shape)
    if len(shape) != 4 or shape[0] != batch or shape[1] < 1:
        raise ValueError(f"simulated is {list(shape)}, expected [B = {batch}, K >= 1, N, T]")
    for name, value in (("collided", collided), ("offroad", offroad), ("displacement", displacement)):
        if tuple(value.shape) != shape:
            raise ValueError(f"{name} is {list(value.shape)}, expected {list(shape)}")
    if tuple(logged.shape) != (batch, *shape[2:]):
        raise ValueError(f"logged is {list(logged.shape)}, expected {[batch, *shape[2:]]}")
