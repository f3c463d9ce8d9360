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
    """
    way = np.diff(lines, axis=1)
    length = np.linalg.norm(way, axis=-1)
    direction = way / np.maximum(length, np.finfo(np.float64).tiny)[..., None]
    arc = np.concatenate([np.zeros_like(length[:, :1]), length.cumsum(1)], 1)
    row, found = np.arange(len(lines)), np.full(valid.shape, np.nan)
    station, last = np.full(len(lines), np.nan), np.zeros((len(lines), 2))
    for step in range(path.shape[1]):
        point = path[:, step]
        share, _, distance = to_pieces(lines[:, :-1], direction, length, point[:, None])
        reach = (_CUT * np.linalg.norm(point - last, axis=-1) + _SLACK)[:, None]
        began = ~np.isnan(station)[:, None]
        with np.errstate(invalid="ignore"):
            inside = (arc[:, 1:] >= station[:, None] - reach) & (arc[:, :-1] <= station[:, None] + reach)
        piece = np.where(began[:, 0], np.where(inside, distance, np.inf).argmin(1), earliest_pass(distance))
        here = valid[:, step]
        station = np.where(here, arc[row, piece] + share[row, piece], station)
        last = np.where(here[:, None], point, last)
        found[here, step] = station[here]
    return found


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
    offset = point - start
    share = (offset * direction).sum(-1).clip(0.0, length)
    away = offset - share[..., None] * direction
    return share, away, np.linalg.norm(away, axis=-1)
