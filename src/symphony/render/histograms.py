"""Histograms of the turns that agents take, beside those of the log (the paper's figure of curvature)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from symphony.render.style import INK, LANE, new_figure, picture_path, save

LOG_COLOR = "#0072B2"
POLICY_COLOR = "#E69F00"
TITLE = 40
"""Characters of a line above a panel."""
LEAST_REACH = 0.1
"""Curvature in 1/m that is shown to either side, at least."""


def plot_curvature(
    panels: Mapping[str, tuple[NDArray[Any], NDArray[Any]]], path: str | Path, *, columns: int = 3
) -> Figure:
    """Draw how often branching regions of each average curvature are visited, a panel for each agent.

    Bars are shares of all visits, on a root scale: most regions are straight, and the turns are what is to be seen.

    Args:
        panels: by title, counts [K] of rollouts and of the log in K bins centred at equal steps from -1 to 1 (1/m).
        path: file to write (png, pdf or svg).
        columns: panels per row, at most.

    Raises:
        ValueError: no panels, counts of other shapes, or none visited.
        ConfigError: a file of another kind.
    """
    if not panels:
        raise ValueError("no panels to draw")
    file = picture_path(path)
    shares = {title: tuple(_shares(title, counts) for counts in pair) for title, pair in panels.items()}
    if len({share.shape for pair in shares.values() for share in pair}) > 1:
        raise ValueError("counts differ in their number of bins")
    reach = max(_reach(share) for pair in shares.values() for share in pair)
    top = max(share.max() for pair in shares.values() for share in pair)
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(4.2 * columns, 2.9 * rows + 0.4)
    grid = figure.add_gridspec(rows, columns)
    for k, (title, (policy, log)) in enumerate(shares.items()):
        axes = figure.add_subplot(grid[k // columns, k % columns])
        _draw_panel(axes, title, policy, log)
        axes.set_xlim(-reach, reach)
        axes.set_ylim(0, 1.05 * top)
        if k + columns >= len(panels):
            axes.set_xlabel("average curvature, 1/m (left turns are positive)", fontsize=8, color=INK)
        if k % columns == 0:
            axes.set_ylabel("share of visits", fontsize=8, color=INK)
    handles = [Patch(color=LOG_COLOR, alpha=0.6, label="log"), Patch(color=POLICY_COLOR, label="policy")]
    figure.legend(handles=handles, loc="outside upper right", ncols=2, frameon=False, fontsize=9)
    save(figure, file)
    return figure


def _shares(title: str, counts: NDArray[Any]) -> NDArray[np.float64]:
    """Shares [K] of counts [K]."""
    array = np.asarray(counts, np.float64)
    if array.ndim != 1 or len(array) < 2 or not np.isfinite(array).all() or (array < 0).any():
        raise ValueError(f"{title}: counts must be [K] and not negative, are {list(array.shape)}")
    if array.sum() == 0:
        raise ValueError(f"{title}: no branching region was visited")
    return array / array.sum()


def _centres(share: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linspace(-1, 1, len(share))


def _reach(share: NDArray[np.float64]) -> float:
    """Curvature up to which there is something to see, with a little room."""
    width = 2 / (len(share) - 1)
    return max(LEAST_REACH, float(np.abs(_centres(share)[share > 0]).max())) + 2 * width


def _draw_panel(axes: Axes, title: str, policy: NDArray[np.float64], log: NDArray[np.float64]) -> None:
    centres, width = _centres(log), 2 / (len(log) - 1)
    edges = np.append(centres - width / 2, centres[-1] + width / 2)
    axes.stairs(log, edges, fill=True, color=LOG_COLOR, alpha=0.6, gid="log")
    axes.stairs(policy, edges, color=POLICY_COLOR, linewidth=1.5, gid="policy")
    axes.set_yscale("function", functions=(lambda y: np.sqrt(np.maximum(y, 0)), np.square))
    axes.set_title(fill(title, TITLE), loc="left", fontsize=9, fontweight="bold", color=INK, parse_math=False)
    axes.tick_params(labelsize=7.5, color=LANE, labelcolor=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(LANE)
    axes.yaxis.set_major_formatter(lambda y, _: f"{100 * y:g} %")
    axes.set_yticks([0.001, 0.01, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8])
