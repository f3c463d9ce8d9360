"""Curvature JSD: how far the turns that are chosen differ from those in the logs (paper, section V-B)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

BINS = 201
"""Bins of width 0.01 1/m, centred at the multiples of 0.01 in [-1, 1]."""


def curvature_histogram(curvature: NDArray[Any]) -> NDArray[np.int64]:
    """Counts [201] of average curvatures [...] in 1/m; values beyond +-1 fall into the outermost bins."""
    half = BINS // 2
    flat = np.asarray(curvature, dtype=np.float64).reshape(-1).clip(-1, 1)
    return np.bincount(np.rint(flat * half).astype(np.int64) + half, minlength=BINS)


def jensen_shannon(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.float64]:
    """Jensen-Shannon divergence [...] of histograms [..., K], in nats (0 to ln 2); NaN where either is empty.

    It is the divergence itself, not its square root.
    """
    p, q = (_normalised(np.asarray(counts, dtype=np.float64)) for counts in (first, second))
    middle = (p + q) / 2
    divergence = (_relative(p, middle) + _relative(q, middle)) / 2
    return np.maximum(divergence, 0.0)


class Divergence(NamedTuple):
    """A divergence between what rollouts and logs chose, and what is left of it without sampling.

    Attributes:
        value: of the summed histograms, nats.
        error: standard error (jackknife); NaN for a single sample.
        corrected: the value less the bias that finite samples give it; NaN for a single sample.
        parts: [n] pseudo-values of the samples, whose mean is the corrected value.
    """

    value: float
    error: float
    corrected: float
    parts: NDArray[np.float64]


def sampled_divergence(counts: NDArray[Any], counts_log: NDArray[Any]) -> Divergence:
    """Jensen-Shannon divergence of the sums of n independent samples, its error and bias by leaving one out.

    Samples are drawn as pairs: of segments that are alike in rollouts and log less is sampling than of others, and
    rollouts that are alike count as what they are.

    Args:
        counts: [n, K] histogram of the rollouts of each sample (a recording, or a segment).
        counts_log: [n, K] histogram of the log of each sample.

    Source: Quenouille, "Notes on bias in estimation", Biometrika 43 (1956).
    """
    total, total_log, number = counts.sum(0), counts_log.sum(0), len(counts)
    value = float(jensen_shannon(total, total_log))
    if number < 2:
        return Divergence(value, math.nan, math.nan, np.full(number, math.nan))
    without = jensen_shannon(total - counts, total_log - counts_log)
    parts = number * value - (number - 1) * without
    error = float(parts.std(ddof=1) / np.sqrt(number))
    return Divergence(value, error, float(parts.mean()), parts)


def sampling_floor(counts_log: NDArray[Any], draws: int = 200) -> float:
    """What a log of this size scores against the distribution that it is a sample of, nats.

    No policy is known to be better, however many rollouts it has. It is estimated by bootstrap samples of the
    segments against all of them. Two logs of this size differ by about twice as much. It is too low where segments of
    one recording are alike, or many turns are so rare that the log has none.

    Args:
        counts_log: [n, K] histogram of the log of each segment.
        draws: bootstrap samples to average over, always the same ones.
    """
    number = len(counts_log)
    often = np.random.default_rng(0).multinomial(number, np.full(number, 1 / number), size=draws)
    values = jensen_shannon(often @ counts_log, counts_log.sum(0)[None])
    known = values[np.isfinite(values)]  # a draw without any curvature has no distribution
    return float(known.mean()) if len(known) else math.nan


def _normalised(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    total = counts.sum(-1, keepdims=True)
    return np.where(total > 0, counts / np.where(total > 0, total, 1.0), np.nan)


def _relative(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of p ln(p / q) over the bins where p is not 0; NaN stays NaN."""
    none = p == 0
    return (p * np.log(np.where(none, 1.0, p) / np.where(none, 1.0, q))).sum(-1)
