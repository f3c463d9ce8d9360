"""Ranges of whole numbers, one after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def spans(begin: NDArray[np.int64] | int, length: NDArray[np.int64]) -> NDArray[np.int64]:
    """The numbers from ``begin`` on, ``length`` [R] of each, one after the other."""
    before = length.cumsum() - length
    return np.arange(length.sum()) + np.repeat(begin - before, length)
