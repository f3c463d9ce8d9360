"""Standard errors over groups, exact bounds of rates of which nothing was seen, and quantiles of Student's t."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TINY = 1e-300


def summed(values: NDArray[Any], member: NDArray[np.int64]) -> NDArray[Any]:
    """Return the sums of values [segments, ...] over the segments of each group, given each segment's group."""
    out = np.zeros((int(member.max(initial=-1)) + 1, *values.shape[1:]), values.dtype)
    np.add.at(out, member, values)
    return out


def ratio(total: NDArray[np.float64], weight: NDArray[np.float64], member: NDArray[np.int64]) -> tuple[float, float]:
    """Return a ratio of sums and its standard error over groups (jackknife; NaN for a single one).

    Takes what each segment adds to numerator and denominator, and the number of its group. Groups without anything to
    count are not samples: of two recordings of which one is empty there is no error.
    """
    if weight.sum() == 0:
        return math.nan, math.nan
    rate = total.sum() / weight.sum()
    total, weight = summed(total, member), summed(weight, member)
    some = (total != 0) | (weight != 0)
    total, weight = total[some], weight[some]
    count = len(total)
    if count < 2 or weight.max() == weight.sum():
        return float(rate), math.nan
    # What the ratio would change by without the group: linearised, one that holds nearly all would have no error.
    residual = (total - rate * weight) * (count - 1) / (weight.sum() - weight)
    return float(rate), float(np.sqrt((residual**2).sum() / (count - 1) / count))


def grouped_mean(
    value: NDArray[np.float64], weight: NDArray[np.float64], member: NDArray[np.int64]
) -> tuple[float | None, float | None]:
    """Return a weighted mean and its standard error over groups (see :func:`ratio`); None for NaN."""
    mean, error = ratio(value * weight, weight, member)
    return None if math.isnan(mean) else mean, None if math.isnan(error) else error


def clustered_mean(values: NDArray[np.float64], member: NDArray[np.int64]) -> tuple[float, float]:
    """Return mean and standard error of finite values, where those of one group (``member``) are not independent."""
    known = np.isfinite(values)
    return ratio(values[known], np.ones(known.sum()), member[known])


def effective_groups(member: NDArray[np.int64]) -> float:
    """Return how many groups of equal size scatter as much as these, given each segment's group; 0 without any."""
    return len(member) ** 2 / max(int((np.bincount(member) ** 2).sum()), 1)


def zero_bound(of: int) -> float:
    """Return the percent, about 300 / n, that a rate has at most, with 95 % confidence, if n samples show nothing.
    Source: Clopper and Pearson, "The use of confidence or fiducial limits", Biometrika 26 (1934).
    """
    return 100.0 * (1.0 - 0.05 ** (1.0 / of))


def t_quantile(probability: float, freedom: float) -> float:
    """Return the quantile of Student's t: of a mean of n samples, in standard errors, with n - 1 degrees."""
    if probability == 0.5:
        return 0.0
    tail = 2 * min(probability, 1 - probability)
    # Of x = v / (v + t^2), or of what is left of 1 where that is nearly all.
    x = beta_quantile(tail, freedom / 2, 0.5)
    rest = 1 - x if x < 0.5 else beta_quantile(1 - tail, 0.5, freedom / 2)
    return math.copysign(math.sqrt(freedom * rest / x), probability - 0.5)


def beta_quantile(probability: float, a: float, b: float) -> float:
    """Return the quantile of the beta distribution, by halving until nothing is left between two numbers."""
    low, high = 0.0, 1.0
    while True:
        middle = 0.5 * (low + high) if low > 0 else high / 1024 if high > _TINY else 0.0
        if not low < middle < high:
            return high
        low, high = (middle, high) if _beta(middle, a, b) < probability else (low, middle)


def _beta(x: float, a: float, b: float) -> float:
    """Return the regularised incomplete beta function I_x(a, b), by its continued fraction (DLMF 8.17.22)."""
    if x > (a + 1) / (a + b + 2):
        return 1.0 - _beta(1.0 - x, b, a)
    front = a * math.log(x) + b * math.log1p(-x) + math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    # Lentz's way through the continued fraction.
    c, d = 1.0, 1.0 / (1.0 - (a + b) * x / (a + 1))
    result, k = d, 0
    while k < 10_000:
        k += 1
        for term in (
            k * (b - k) * x / ((a + 2 * k - 1) * (a + 2 * k)),
            -(a + k) * (a + b + k) * x / ((a + 2 * k) * (a + 2 * k + 1)),
        ):
            d, c = 1.0 / ((1.0 + term * d) or _TINY), (1.0 + term / c) or _TINY
            result *= c * d
        if abs(c * d - 1.0) < 1e-15:
            break
    return math.exp(front) * result / a
