"""What an agent observes of map points, compiled by numba where the extra ``compiled`` is installed.

One pass over memory instead of a dozen. The same operations in the same order, so the same bits.
"""

from __future__ import annotations

import importlib.util
import os
import warnings
from collections.abc import Callable
from functools import cache

from symphony.envs.tables import POINT_FEATURES
from symphony.geometry.edges import Indices, Reals

Writer = Callable[..., None]
"""As :func:`_write_points`."""


@cache
def point_writer() -> Writer | None:
    """:func:`_write_points`, compiled; None without numba, or where ``SYMPHONY_COMPILED=0`` asks for none.

    Compiled at the first call in a process.
    """
    if os.environ.get("SYMPHONY_COMPILED") == "0" or importlib.util.find_spec("numba") is None:
        return None
    try:
        from numba import njit  # noqa: PLC0415 - half a second, and optional
    except ImportError as error:
        warnings.warn(f"numba can't be used, so nothing is compiled: {error}", RuntimeWarning, stacklevel=2)
        return None
    # No fast mathematics, which would round otherwise; a division by zero is what it is in NumPy. Not kept on disk,
    # where it would be a pickle: to compile takes a sixth of a second.
    return njit(nogil=True, error_model="numpy")(_write_points)


def _write_points(
    index: Indices,
    table: Reals,
    x: Reals,
    y: Reals,
    cos: Reals,
    sin: Reals,
    speed: Reals,
    scale: float,
    out: Reals,
) -> None:
    """Rows of a table, turned into the frame of each agent.

    Args:
        index: [R, K] rows that each agent sees.
        table: [T, F] features in the world's frame: position (metres), direction, and what all see alike.
        x: [R] of the agents, metres.
        y: likewise.
        cos: [R] of the angle by which the world is turned.
        sin: likewise.
        speed: [R] of the agents, scaled.
        scale: metres that become 1, of the table's type.
        out: [R, K, F], written to.
    """
    for r in range(index.shape[0]):
        here_x, here_y, c, s, own = x[r], y[r], cos[r], sin[r], speed[r]
        for k in range(index.shape[1]):
            row = index[r, k]
            # A constant number, so that the loop becomes a few wide copies.
            for f in range(4, POINT_FEATURES):
                out[r, k, f] = table[row, f]
            right, up = table[row, 0] - here_x, table[row, 1] - here_y
            ahead, left = table[row, 2], table[row, 3]
            out[r, k, 0] = (c * right - s * up) / scale
            out[r, k, 1] = (s * right + c * up) / scale
            out[r, k, 2] = c * ahead - s * left
            out[r, k, 3] = s * ahead + c * left
            out[r, k, 5] = own
