"""Standard errors over groups, exact bounds of rates of which nothing was seen, and quantiles of Student's t."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


def summed(values: NDArray[Any], member: NDArray[np.int64]) -> NDArray[Any]:
    """Sums of values [segments, ...] over the segments of each group, by the number of the group of each."""
    out = np.zeros((int(member.max(initial=-1)) + 1, *values.shape[1:]), values.dtype)
    np.add.at(out, member, values)
    return out


def ratio(
    total: NDArray[np.float64], weight: NDArray[np.float64], member: NDArray[np.int64]
) -> tuple[float, float]:
    """Ratio of sums and its standard error over groups (linearised; NaN for a single one).

    Groups without anything to count are no samples: of two recordings of which one is empty there is no error.

    Args:
        total: [segments] what each adds to the numerator.
        weight: [segments] what each adds to the denominator.
        member: [segments] number of the group of each.
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


def clustered_mean(values: NDArray[np.float64], member: NDArray[np.int64]) -> tuple[float, float]:
    """Mean of the finite ones of some values and its standard error, where those of one group are not independent.

    Args:
        values: [K].
        member: [K] number of the group of each.
    """
    known = np.isfinite(values)
    return ratio(values[known], np.ones(known.sum()), member[known])


def zero_bound(of: int) -> float:
    """Percent that a rate has at most, with 95 % confidence, of which so many independent samples show nothing.

    It is about 300 / n.

    Source: Clopper and Pearson, "The use of confidence or fiducial limits", Biometrika 26 (1934).
    """
    return 100.0 * (1.0 - 0.05 ** (1.0 / of))


def t_quantile(probability: float, freedom: int) -> float:
    """Quantile of Student's t: of a mean of n samples, in standard errors, with n - 1 degrees of freedom."""
    low, high = -1.0, 1.0
    while _t_share(low, freedom) > probability:
        low *= 2
    while _t_share(high, freedom) < probability:
        high *= 2
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if _t_share(middle, freedom) < probability else (low, middle)
    return high


def _t_share(value: float, freedom: int) -> float:
    """Probability that Student's t is below a value, for a whole number of degrees of freedom.

    Source: Abramowitz and Stegun, "Handbook of Mathematical Functions" (1964), 26.7.3 and 26.7.4.
    """
    angle = math.atan(value / math.sqrt(freedom))
    squared, odd = math.cos(angle) ** 2, freedom % 2
    term = math.sin(angle) * (math.cos(angle) if odd else 1.0)
    total = 0.0
    for k in range(2 + odd, freedom + 1, 2):
        total += term
        term *= squared * (k - 1) / k
    share = 2 / math.pi * (angle + total) if odd else total
    return 0.5 + 0.5 * share
