"""The measures of a planner in a suite, and their confidence: intervals over groups of segments.

Runs of one recording share its traffic, so the groups are the independent samples. Sources: Clopper and Pearson,
Biometrika 26 (1934); for groups Korn and Graubard, "Confidence intervals for proportions with small expected number
of positive counts estimated from survey data", Survey Methodology 24 (1998).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from symphony.evaluation.planners import run_score
from symphony.metrics.intervals import beta_quantile, effective_groups, grouped_mean, t_quantile

Run = dict[str, Any]
_ALIKE = 1e-9  # standard error below which groups do not differ but by rounding
Kind = Literal["rate", "share", "mean", "difference"]


@dataclass(frozen=True)
class Measure:
    """A number for each run, None where it is not defined: a ``rate``, 100 for a run in which something happens and 0
    for any other, a ``share`` from 0 to 100, or a ``mean``; with its unit and a description for people.
    """

    of: Callable[[Run], float | None]
    unit: str
    text: str
    kind: Literal["rate", "share", "mean"] = "mean"


def _happens(name: str, text: str) -> Measure:
    def of(run: Run) -> float | None:
        return None if run["failed"] or run[name] is None else 100.0 * bool(run[name])

    return Measure(of, "% of runs", text, "rate")


def _number(name: str, unit: str, text: str) -> Measure:
    kind: Literal["share", "mean"] = "share" if unit == "% of time" else "mean"
    return Measure(lambda run: None if run["failed"] else run[name], unit, text, kind)


MEASURES: dict[str, Measure] = {
    "at_fault_collision_rate": _happens("at_fault_collision", "collisions at fault"),
    "collision_rate": _happens("collision", "collisions"),
    "red_light_rate": _happens("red_lights", "runs of a red light"),
    "offroad_rate": _happens("offroad_time", "runs that leave the road"),
    "wrong_way_rate": _happens("wrong_way_time", "runs against the traffic"),
    "blocking_rate": _happens("blocking_time", "runs that block traffic"),
    "failed_rate": Measure(lambda run: 100.0 * bool(run["failed"]), "% of runs", "runs that failed", "rate"),
    "score": Measure(run_score, "of 100", "score", "share"),
    "pdm_score": Measure(lambda run: run["pdm_score"], "of 100", "PDM score", "share"),
    "progress_ratio": _number("progress_ratio", "", "progress relative to the log's"),
    "offroad_time": _number("offroad_time", "% of time", "time off the road"),
    "wrong_way_time": _number("wrong_way_time", "% of time", "time against the traffic"),
    "blocking_time": _number("blocking_time", "% of time", "time that traffic is blocked"),
    "low_ttc_time": _number("low_ttc_time", "% of time", "time within 1 s of a collision"),
    "log_distance": _number("log_distance", "m", "distance to the log"),
    "max_acceleration": _number("max_acceleration", "m/s²", "peak acceleration"),
    "max_braking": _number("max_braking", "m/s²", "peak braking"),
    "max_jerk": _number("max_jerk", "m/s³", "peak jerk"),
    "max_lateral_acceleration": _number("max_lateral_acceleration", "m/s²", "peak lateral acceleration"),
}


@dataclass(frozen=True)
class Estimate:
    """The mean over the runs that have a number, None if none has, and the groups of their segments. With this
    confidence each, the mean is not below ``low`` and not above ``high``; None where that is unknown.
    """

    mean: float | None
    low: float | None
    high: float | None
    runs: int
    groups: int


def estimate(
    values: Sequence[float | None], groups: Sequence[str], confidence: float, kind: Kind = "mean"
) -> Estimate:
    """Return the mean of the values of some runs (None where not defined; a rate's are 0 and 100) and its one-sided
    bounds over groups, each with a confidence between 0.5 and 1.

    The bounds of a mean are by Student's t, with the degrees of freedom of the effective number of equal groups, and
    unknown if all groups have the same mean. For a difference of rates or shares they are no nearer than the bound of
    a rate where nothing happened. A rate or a share, where few runs can be far from all others, has exact binomial
    bounds: for as many independent runs as the scatter between groups implies or, where nothing or everything
    happened, for as many as there are groups.
    """
    known = [(value, group) for value, group in zip(values, groups, strict=True) if value is not None]
    value = np.array([value for value, _ in known], np.float64)
    number = np.unique(np.array([group for _, group in known], str), return_inverse=True)[1]
    mean, error = grouped_mean(value, np.ones_like(value), number)
    if mean is None:
        return Estimate(None, None, None, 0, 0)
    count = int(number.max()) + 1
    if kind in ("rate", "share"):
        high, low = (_rate_bound(part, number, count, confidence) for part in (value / 100, 1 - value / 100))
        return Estimate(mean, 100.0 * (1 - low), 100.0 * high, len(value), count)
    if error is None or (error < _ALIKE and kind == "mean"):
        return Estimate(mean, None, None, len(value), count)
    spread = t_quantile(confidence, effective_groups(number) - 1) * error
    if kind == "difference":
        spread = max(spread, 100.0 * beta_quantile(confidence, 1, count))
    return Estimate(mean, mean - spread, mean + spread, len(value), count)


def measured(runs: Sequence[Run], measure: Measure, confidence: float = 0.95) -> Estimate:
    """Return the mean of a measure over runs, with its bounds."""
    groups = [run["group"] for run in runs]
    return estimate([measure.of(run) for run in runs], groups, confidence, measure.kind)


def _rate_bound(value: NDArray[np.float64], group: NDArray[np.int64], groups: int, confidence: float) -> float:
    """Return the upper bound of a rate from 0 to 1 (Korn and Graubard).

    The scatter is taken with one more group, as large as the largest, in which it always happened: few groups alone
    show too little for a rare event that some have throughout (in simulations the bound held in 88 %, not in 95 %).
    """
    rate, runs = float(value.mean()), len(value)
    if rate in (0.0, 1.0) or groups < 2:
        count = float(groups)
    else:
        more = int(np.bincount(group).max())
        mean, error = grouped_mean(
            np.append(value, np.ones(more)), np.ones(runs + more), np.append(group, np.full(more, groups))
        )
        count = mean * (1 - mean) / error**2 if mean and error else float(runs)
        # The scatter of few groups is poorly known.
        count *= (t_quantile(confidence, runs - 1) / t_quantile(confidence, groups - 1)) ** 2
        count = min(count, float(runs))
    rest = (1 - rate) * count
    return beta_quantile(confidence, rate * count + 1, rest) if rest > 0 else 1.0


def needed_groups(limit: float, confidence: float) -> int:
    """Return how many groups without an event it takes to know that a rate is at most ``limit`` percent, above 0."""
    return 1 if limit >= 100 else math.ceil(math.log(1 - confidence) / math.log1p(-limit / 100.0))


def paired(
    runs: Sequence[Run], others: Sequence[Run], of: Callable[[Run], float | None]
) -> tuple[list[float | None], list[str]]:
    """Return the differences of a number between two planners' runs of one segment and rollout, and their groups."""
    base = {(run["segment"], run["rollout"]): of(run) for run in others}
    both = [run for run in runs if (run["segment"], run["rollout"]) in base]
    values: list[float | None] = []
    for run in both:
        here, there = of(run), base[run["segment"], run["rollout"]]
        values.append(None if here is None or there is None else here - there)
    return values, [run["group"] for run in both]
