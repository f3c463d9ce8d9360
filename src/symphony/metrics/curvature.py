"""Curvature JSD: how far the turns that are chosen differ from those in the logs (paper, section V-B)."""

from __future__ import annotations

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


def jensen_shannon(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.float64]:
    """Jensen-Shannon divergence [...] of histograms [..., K], in nats (0 to ln 2); NaN where either is empty.

    The divergence itself, not its square root.
    """
    p, q = (_normalised(np.asarray(counts, dtype=np.float64)) for counts in (first, second))
    middle = (p + q) / 2
    divergence = (_relative(p, middle) + _relative(q, middle)) / 2
    return np.maximum(divergence, 0.0)


def _normalised(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    total = counts.sum(-1, keepdims=True)
    return np.where(total > 0, counts / np.where(total > 0, total, 1.0), np.nan)


def _relative(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum of p ln(p / q) over the bins where p is not 0; NaN stays NaN."""
    none = p == 0
    return (p * np.log(np.where(none, 1.0, p) / np.where(none, 1.0, q))).sum(-1)
