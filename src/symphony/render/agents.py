"""Agents as boxes with a nose, and trails that fade with time."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from numpy.typing import NDArray

from symphony.render.style import AGENT_COLORS, INK

CORNERS = np.array([(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)])
NOSE = np.array([(0.46, 0.0), (0.12, 0.36), (0.12, -0.36)])


def place(
    shape: NDArray[Any], position: NDArray[Any], heading: NDArray[Any], size: NDArray[Any]
) -> NDArray[Any]:
    """Put a shape given in units of the box into the world.

    Args:
        shape: [V, 2] along and left of the heading, as fractions of length and width.
        position: [A, 2 or more] box centres, metres.
        heading: [A] radians.
        size: [A, 2 or more] length, width, metres.

    Returns:
        [A, V, 2] world coordinates.
    """
    local = shape * size[:, None, :2]
    ahead = np.stack([np.cos(heading), np.sin(heading)], -1)[:, None]
    left = np.stack([-ahead[..., 1], ahead[..., 0]], -1)
    return local[..., :1] * ahead + local[..., 1:] * left + position[:, None, :2]


def draw_boxes(
    axes: Axes,
    position: NDArray[Any],
    heading: NDArray[Any],
    size: NDArray[Any],
    color: str,
    *,
    alpha: float = 1.0,
    zorder: float = 10,
    gid: str | None = None,
) -> None:
    """Draw boxes [A] whose pale wedge points ahead (see :func:`place` for the arrays); the ego has a dark outline."""
    ego = color == AGENT_COLORS[0]
    edge = to_rgba(INK if ego else "white" if alpha > 0.5 else color, min(1.0, alpha + 0.3))
    style: dict[str, Any] = {"edgecolors": [edge], "linewidths": 1.2 if ego else 0.7, "gid": gid}
    for shape, face, more in (
        (CORNERS, to_rgba(color, alpha), {**style, "zorder": zorder}),
        (NOSE, to_rgba("white", 0.85 * alpha), {"edgecolors": "none", "zorder": zorder + 0.1}),
    ):
        boxes = list(place(shape, position, heading, size))
        axes.add_collection(PolyCollection(boxes, facecolors=[face], **more), autolim=False)


def pieces(path: NDArray[Any], valid: NDArray[Any] | None = None) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Cut a path into its steps, leaving out those with an end that is not valid or not finite.

    Args:
        path: [T, 2].
        valid: [T] bool, all by default.

    Returns:
        [K, 2, 2] the steps, and [K] the index each begins at.
    """
    seen = np.isfinite(path).all(-1) if valid is None else np.isfinite(path).all(-1) & valid
    begin = np.flatnonzero(seen[:-1] & seen[1:])
    return np.stack([path[begin], path[begin + 1]], 1), begin


def draw_trails(
    axes: Axes,
    paths: NDArray[Any],
    valid: NDArray[Any] | None,
    color: str,
    *,
    step: int,
    width: float = 1.5,
    strength: float = 0.85,
    zorder: float = 8,
    gid: str | None = None,
) -> None:
    """Draw paths [A, T, 2] (valid [A, T]), strongest at ``step`` and fading before and after it."""
    lines: list[NDArray[Any]] = []
    alphas: list[float] = []
    reach = max(step, paths.shape[1] - 1 - step, 1)
    for k, path in enumerate(paths):
        found, begin = pieces(path, None if valid is None else valid[k])
        lines.extend(found)
        alphas.extend(strength * (1 - 0.8 * np.abs(begin + 0.5 - step) / reach))
    colors = [to_rgba(color, float(np.clip(a, 0, 1))) for a in alphas]
    drawn = LineCollection(lines, colors=colors, linewidths=width, zorder=zorder, capstyle="butt", gid=gid)
    axes.add_collection(drawn, autolim=False)
