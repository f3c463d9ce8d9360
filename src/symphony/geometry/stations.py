"""Where along a line something is that follows it, also on lines that pass the same place twice.

The nearest place of all is no answer there: on a route around a block it jumps from one pass to the other.

Legend: R lines and what follows each, P points of a line, U steps.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

Reals = NDArray[np.float64]

NEAR = 1.0
"""Metres by which an earlier pass may be farther away than the nearest and is still where a path begins."""
_SLACK = 3.0
"""Metres along the line, besides the way driven, within which the next place is looked for."""
_CUT = 1.5
"""Metres along the line to a metre driven: who cuts a corner gets on faster."""
_TOGETHER = 1 << 15
"""Distances of points to pieces that are found together."""


def stations_along(
    lines: Float[NDArray[np.float64], "R P 2"],
    path: Float[NDArray[np.float64], "R U 2"],
    valid: Bool[NDArray[np.bool_], "R U"],
) -> Float[NDArray[np.float64], "R U"]:
    """Metres along each line of the points of a path that follows it; NaN where it is not valid.

    A path begins at the earliest place that is nearest to it, or nearly so, and goes on from there: a step leads no
    farther along the line than the way that was driven, and some metres.

    Args:
        lines: shorter ones end with their last point again.
        path: in the order of time.
        valid: which of its points exist.

    Raises:
        ValueError: a point that exists is not finite; names line and step.
    """
    wrong = np.argwhere(valid & ~np.isfinite(path).all(-1))
    if len(wrong):
        raise ValueError(f"path {wrong[0, 0]}, step {wrong[0, 1]}: a point that exists is not finite")
    way = np.diff(lines, axis=1)
    length = np.linalg.norm(way, axis=-1)
    direction = way / np.maximum(length, np.finfo(np.float64).tiny)[..., None]
    arc = np.concatenate([np.zeros_like(length[:, :1]), length.cumsum(1)], 1)
    row, found = np.arange(len(lines)), np.full(valid.shape, np.nan)
    first, reach = valid.argmax(1), _reach(path, valid)
    station = np.zeros(len(lines))
    block = max(1, _TOGETHER // max(1, length.size))
    for a in range(0, path.shape[1], block):
        part = path[:, a : a + block, None]
        share, _, distance = to_pieces(lines[:, None, :-1], direction[:, None], length[:, None], part)
        # Each step depends on the one before; all that does not is known by now.
        for k in range(part.shape[1]):
            step, near = a + k, distance[:, k]
            low, high = (station - reach[:, step])[:, None], (station + reach[:, step])[:, None]
            inside = (arc[:, 1:] >= low) & (arc[:, :-1] <= high)
            piece = np.where(inside, near, np.inf).argmin(1)
            begins = np.flatnonzero(first == step)
            if len(begins):
                piece[begins] = earliest_pass(near[begins])
            station = np.where(valid[:, step], arc[row, piece] + share[row, k, piece], station)
            found[:, step] = station
    return np.where(valid, found, np.nan)


def _reach(
    path: Float[NDArray[np.float64], "R U 2"], valid: Bool[NDArray[np.bool_], "R U"]
) -> Float[NDArray[np.float64], "R U"]:
    """Metres along the line within which the next place is looked for, from the last point that exists."""
    steps = np.arange(path.shape[1])
    before = np.maximum.accumulate(np.where(valid, steps, 0), 1)[:, :-1]
    last = np.take_along_axis(path, before[..., None], 1)
    driven = np.linalg.norm(path[:, 1:] - last, axis=-1)
    return _CUT * np.pad(driven, ((0, 0), (1, 0))) + _SLACK


def earliest_pass(distance: Float[NDArray[np.float64], "*b pieces"]) -> NDArray[np.int64]:
    """The first piece of a line that is nearer than those beside it, and nearly the nearest of all."""
    beside = np.pad(distance, [(0, 0)] * (distance.ndim - 1) + [(1, 1)], constant_values=np.inf)
    lowest = (distance <= beside[..., :-2]) & (distance <= beside[..., 2:])
    return (lowest & (distance <= distance.min(-1, keepdims=True) + NEAR)).argmax(-1)


def to_pieces(
    start: Reals, direction: Reals, length: Reals, point: NDArray[np.floating]
) -> tuple[Reals, Reals, Reals]:
    """Metres along each piece of a line to its place nearest to a point, what lies between the two [..., 2], and how
    far that is.

    Args:
        start: [..., 2] of each piece, in metres.
        direction: [..., 2] unit vectors; zero for pieces of no length.
        length: [...] metres.
        point: [..., 2] metres.
    """
    # Component by component: sums over a last dimension of 2 are slow.
    x, y = (point[..., k] - start[..., k] for k in (0, 1))
    along_x, along_y = direction[..., 0], direction[..., 1]
    share = (x * along_x + y * along_y).clip(0.0, length)
    x, y = x - share * along_x, y - share * along_y
    return share, np.stack([x, y], -1), np.sqrt(x * x + y * y)
