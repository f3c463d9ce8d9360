"""Curvature JSD: how far the turns that are chosen differ from those in the logs (paper, section V-B)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

BINS = 201
"""Bins of width 0.01 1/m, centred at the multiples of 0.01 in [-1, 1]."""


def curvature_histogram(curvature: NDArray[Any]) -> NDArray[np.int64]:
    """Counts [201] of average curvatures [...] in 1/m; values beyond +-1 fall into the outermost bins."""
    flat = np.asarray(curvature, dtype=np.float64).reshape(-1)
    if not np.isfinite(flat).all():
        raise ValueError("curvatures must be finite")
    half = BINS // 2
    return np.bincount(np.rint(flat.clip(-1, 1) * half).astype(np.int64) + half, minlength=BINS)


def jensen_shannon(first: NDArray[Any], second: NDArray[Any]) -> float:
    """Jensen-Shannon divergence of two histograms, in nats (0 to ln 2); NaN if either is empty.

    The divergence itself, not its square root.
    """
    if first.sum() == 0 or second.sum() == 0:
        return math.nan
    p, q = first / first.sum(), second / second.sum()
    middle = (p + q) / 2

    def relative(a: NDArray[Any]) -> float:
        some = a > 0
        return float((a[some] * np.log(a[some] / middle[some])).sum())

    return max(0.0, (relative(p) + relative(q)) / 2)
