"""The branches of a beam search taken apart: who goes on from whom, over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from symphony.data.segment import RunSegment
from symphony.render.plots import EVENTS
from symphony.render.style import INK, Target, font, new_figure, picture_path, save, view_around
from symphony.render.tree import (
    SearchTree,
    add_color_bar,
    draw_branches,
    draw_events,
    draw_forks,
    draw_tree,
    tree_points,
)

BEND = 0.4
"""Share of a period in which a branch moves from its parent's row to its own."""
HEIGHT = 7.0
"""Inches that the map is high."""


def rows(tree: SearchTree) -> NDArray[np.int64]:
    """[P, S] a row for each branch in each period, such that lines from parents to children don't cross.

    Among branches of one parent, those that go on in more copies come first.
    """
    found = np.empty_like(tree.parents)
    above = np.zeros(tree.parents.shape[1], np.int64)
    for period, copies in enumerate(tree.copies):
        found[period] = np.lexsort((-copies, above)).argsort()
        above = found[period][tree.parents[period]]
    return found


def plot_genealogy(tree: SearchTree, target: Target, *, dt: float, start: int = 0) -> Axes:
    """Draw every branch of a beam search in a row of its own, from left to right in time.

    Coloured by the highest score among the agents, step by step. What reaches a leaf is thick, what was pruned ends.

    Args:
        tree: what was simulated.
        target: file to write (png, pdf or svg) or axes to draw on.
        dt: seconds per step.
        start: step of the log at which the search begins.

    Raises:
        ConfigError: a file of another kind.
    """
    path = None
    if not isinstance(target, Axes):
        path = picture_path(target)
        target = new_figure(7.0, 1.5 + 0.3 * len(tree.score)).add_subplot()
    draw_genealogy(target, tree, dt, start)
    add_color_bar(target, tree)
    if path is not None:
        save(target.figure, path)
    return target


def draw_genealogy(axes: Axes, tree: SearchTree, dt: float, start: int) -> None:
    """See :func:`plot_genealogy`."""
    branches, steps = tree.score.shape[:2]
    time = (start + 1 + np.arange(steps)) * dt
    places = np.stack([np.broadcast_to(time, (branches, steps)), _heights(tree)], -1)
    root = np.array([start * dt, (branches - 1) / 2])
    score = np.where(np.isfinite(tree.score[..., tree.real]), tree.score[..., tree.real], -np.inf)
    worst = score.max(-1, initial=-np.inf)
    draw_branches(axes, tree, np.stack([tree.before(places, root), places], 2), worst, "all")
    draw_forks(axes, tree, places)
    for event in EVENTS:
        draw_events(axes, tree, places[:, :, None].repeat(len(tree.real), 2), *event)
    for period in range(1, len(tree.parents) + 1):
        pruned = min(period * tree.prune_every, steps)
        axes.axvline((start + pruned) * dt, color="#C8C4BC", linewidth=0.8, zorder=1, gid="pruning")
    axes.set_xlim(root[0] - 0.02 * steps * dt, time[-1] + 0.02 * steps * dt)
    axes.set_ylim(branches - 0.3, -0.7)
    axes.set_yticks([])
    axes.tick_params(labelsize=font(axes, 8), color=INK, labelcolor=INK)
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.set_xlabel("seconds; pruned at the vertical lines", color=INK, fontsize=font(axes, 9))
    title: dict[str, Any] = {"fontweight": "bold", "color": INK, "loc": "left", "pad": 20}
    axes.set_title("The same branches over time", fontsize=font(axes, 11), **title)
    place: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points", "color": "#5B616B"}
    axes.annotate(
        "coloured by the agent that scores highest", (0, 1), (0, 6), fontsize=font(axes, 8.5), **place
    )


def plot_search(
    segment: RunSegment, tree: SearchTree, path: str | Path, *, start: int = 0, title: str | None = None
) -> Figure:
    """One picture of a beam search: on the map, and beside it every branch over time.

    Args:
        segment: the log.
        tree: what was simulated.
        path: file to write (png, pdf or svg).
        start: step of the log at which the search begins.
        title: by default the segment's id.

    Raises:
        ValueError: agents or steps outside the segment.
        ConfigError: a file of another kind.
    """
    file = picture_path(path)
    view = view_around(tree_points(segment, tree, start))
    width = HEIGHT * (view[1] - view[0]) / (view[3] - view[2])
    figure = new_figure(width + 6.5, HEIGHT + 1.6)
    left, right = figure.subplots(1, 2, width_ratios=[width, 5.0])
    entries = draw_tree(left, segment, tree, start, view, title)
    draw_genealogy(right, tree, segment.dt, start)
    add_color_bar(right, tree)
    columns = max(3, int(figure.get_figwidth() / 2.6))
    figure.legend(
        handles=entries,
        loc="outside lower left",
        ncols=columns,
        fontsize=8.5,
        frameon=False,
        handlelength=1.8,
    )
    save(figure, file)
    return figure


def _heights(tree: SearchTree) -> NDArray[np.float64]:
    """[S, T] the row of each branch after each step, on its way from its parent's."""
    own, steps = rows(tree).astype(float), tree.score.shape[1]
    origin = np.full_like(own, (own.shape[1] - 1) / 2)
    for period, parents in enumerate(tree.parents[:-1]):
        origin[period + 1] = own[period][parents]
    step = np.arange(steps) % tree.prune_every + 1
    way = np.clip(step / max(1.0, round(BEND * tree.prune_every)), 0, 1)
    way = way * way * (3 - 2 * way)
    return tree.by_step(origin) * (1 - way) + tree.by_step(own) * way
