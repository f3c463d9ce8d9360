"""Exact intervals of rates and of means of few samples.

Sources: Clopper and Pearson, "The use of confidence or fiducial limits", Biometrika 26 (1934); "Student", "The
probable error of a mean", Biometrika 6 (1908); the incomplete beta function is DLMF 8.17.22.
"""

from __future__ import annotations

import math

_TINY = 1e-300


def binomial_interval(hits: int, of: int, confidence: float = 0.95) -> tuple[float, float]:
    """Interval of a rate from 0 to 1 of which ``hits`` of so many independent samples are known (Clopper-Pearson).

    With none or all of them it has one side only, with all of the doubt on it: of n samples without any the rate is
    at most 1 - 0.05^(1/n), about 3 / n.

    Raises:
        ValueError: not 0 <= hits <= of, or no samples.
    """
    if not 0 <= hits <= of or of < 1:
        raise ValueError(f"{hits} of {of} samples are no rate")
    doubt = (1.0 - confidence) / (1 if hits in (0, of) else 2)
    low = 0.0 if hits == 0 else beta_quantile(doubt, hits, of - hits + 1)
    return low, 1.0 if hits == of else beta_quantile(1.0 - doubt, hits + 1, of - hits)


def zero_bound(of: int) -> float:
    """Percent that a rate has at most, with 95 % confidence, of which so many independent samples show nothing."""
    return 100.0 * binomial_interval(0, of)[1]


def t_quantile(probability: float, freedom: int) -> float:
    """Quantile of Student's t: of a mean of n samples, in standard errors, with n - 1 degrees of freedom.

    Raises:
        ValueError: no degree of freedom, or a probability that is not between 0 and 1.
    """
    if freedom < 1 or not 0 < probability < 1:
        raise ValueError(f"no quantile {probability} of t with {freedom} degrees of freedom")
    if probability == 0.5:
        return 0.0
    tail = 2 * min(probability, 1 - probability)
    # Of x = v / (v + t^2), or of what is left of 1 where that is nearly all.
    x = beta_quantile(tail, freedom / 2, 0.5)
    rest = 1 - x if x < 0.5 else beta_quantile(1 - tail, 0.5, freedom / 2)
    return math.copysign(math.sqrt(freedom * rest / x), probability - 0.5)


def beta_quantile(probability: float, a: float, b: float) -> float:
    """Quantile of the beta distribution, by halving until nothing is left between two numbers."""
    low, high = 0.0, 1.0
    while True:
        middle = 0.5 * (low + high) if low > 0 else high / 1024 if high > _TINY else 0.0
        if not low < middle < high:
            return high
        low, high = (middle, high) if _beta(middle, a, b) < probability else (low, middle)


def _beta(x: float, a: float, b: float) -> float:
    """Regularised incomplete beta function I_x(a, b)."""
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
