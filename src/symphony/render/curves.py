"""Figures of numbers: the curves of trainings, and how often regions of each curvature are visited."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from symphony.errors import ConfigError, DataError, printable
from symphony.render.style import AGENT_COLORS, INK, LANE, new_panels, picture_path, save

Records = Sequence[Mapping[str, Any]]
"""Records of a run, each with its ``step``; other entries are metrics, and any may be absent or NaN."""

PANELS: dict[str, tuple[str, ...]] = {
    "policy loss": ("loss_policy", "loss_mgail", "loss_regression"),
    "negative log-likelihood": ("policy_nll_expert", "policy_nll_rollout"),
    "goal accuracy": ("goals_accuracy", "goals_accuracy_top3"),
    "discriminator accuracy": ("discriminator_accuracy_simulated", "discriminator_accuracy_data"),
    "discriminator logit": ("discriminator_score_simulated", "discriminator_score_data"),
    "search: share in collision": ("search_collision_all", "search_collision_kept"),
    "search: share off the road": ("search_offroad_all", "search_offroad_kept"),
    "validation: infractions, %": ("validation_collision_rate", "validation_offroad_time", "validation_infractions"),
    "validation: displacement, m": ("validation_ade", "validation_min_sade"),
    "gradient norm": ("gradient_norm_policy", "gradient_norm_discriminator", "gradient_norm_goals"),
}
"""Metrics that share a panel, by its title; quantiles share one, too, and all others have panels of their own."""
LAST = ("updates_per_second", "learning_rate", "skipped_updates")
"""Metrics that say how the training ran; their panels come last."""
DASHES: tuple[Any, ...] = ("-", (0, (3, 1.5)), (0, (1, 1)))
LOG_COLOR, POLICY_COLOR = "#0072B2", "#E69F00"
TITLE, LEAST_REACH = 40, 0.1
"""Sizes of a panel of curvature: characters of a line above, and the least 1/m shown to either side."""


def plot_curves(
    runs: Mapping[str, Records],
    path: str | Path,
    *,
    metrics: Sequence[str] = (),
    window: float = 0.1,
    columns: int = 4,
) -> Figure:
    """Draw the metrics of runs over their updates: pale as recorded, strong smoothed, one colour per run.

    Given metrics have a panel each; by default all are drawn, related ones together, at most ``columns`` in a row. A
    point of the smoothed line is averaged over a share (``window``) of a run's records; 0 to not smooth. Raises a
    :class:`ConfigError` for nothing to draw, a metric no run has, a window out of range, or a file not png, pdf, svg.
    """
    file = picture_path(path)
    if not 0 <= window <= 1:
        raise ConfigError(f"window must be from 0 to 1, is {window}")
    curves = {name: read_curves(records) for name, records in runs.items()}
    present = list(dict.fromkeys(metric for found in curves.values() for metric in found))
    if missing := [metric for metric in metrics if metric not in present]:
        raise ConfigError(f"no run has {', '.join(missing)}; there are {', '.join(present)}")
    panels = {metric: [metric] for metric in metrics} or panels_of(present)
    if not panels:
        raise ConfigError("no metrics to draw")
    figure, slots = new_panels(len(panels), min(columns, len(panels)), 3.3, 2.3, 0.5)
    colors = dict(zip(runs, run_colors(len(runs)), strict=True))
    for axes, (title, names) in zip(slots, panels.items(), strict=True):
        _style(axes, title)
        for run, found in curves.items():
            for name, dashes in zip(names, cycle(DASHES), strict=False):
                if name in found:
                    style = {"color": colors[run], "linestyle": dashes}
                    _draw_curve(axes, *found[name], window, f"{name}-{run}", **style)
        axes.grid(color=LANE, linewidth=0.4, alpha=0.6)
        axes.set_axisbelow(True)
        axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
        if len(names) > 1:
            ink: dict[str, Any] = {"color": INK, "linewidth": 1.2}
            pairs = zip(names, cycle(DASHES), strict=False)
            lines = [Line2D([], [], linestyle=dashes, label=name, **ink) for name, dashes in pairs]
            axes.legend(handles=lines, fontsize=6.5, framealpha=0.8, edgecolor="none", handlelength=2.2)
    for axes in slots[-columns:]:
        axes.set_xlabel("update", fontsize=8, color=INK)
    # What lies between two dollars would be set as a formula.
    shown = {printable(name).replace("$", r"\$"): color for name, color in colors.items()}
    handles = [Line2D([], [], color=color, linewidth=2.5, label=name) for name, color in shown.items()]
    place: dict[str, Any] = {"loc": "outside upper left", "ncols": min(len(handles), columns)}
    figure.legend(handles=handles, frameon=False, fontsize=9, **place)
    save(figure, file)
    return figure


def read_curves(records: Records) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return updates [K] and values [K] of each metric; what is not a number is left out, NaN is kept."""
    found: dict[str, tuple[list[float], list[float]]] = {}
    for record in records:
        for name, value in record.items():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if name != "step" and (value is None or number):
                steps, values = found.setdefault(name, ([], []))
                steps.append(float(record["step"]))
                values.append(math.nan if value is None else float(value))
    return {name: (np.asarray(steps), np.asarray(values)) for name, (steps, values) in found.items()}


def panels_of(present: Sequence[str]) -> dict[str, list[str]]:
    """Return the metrics of each panel by its title, for the metrics that are present: in order, but for the last."""
    titles = {name: title for title, names in PANELS.items() for name in names}
    panels: dict[str, list[str]] = {}
    for name in sorted(present, key=lambda name: LAST.index(name) if name in LAST else -1):
        title = titles.get(name) or re.sub(r"_p\d+$", "", name).replace("_", " ")
        panels.setdefault(title, []).append(name)
    return panels


def smoothed(values: NDArray[np.float64], window: float) -> NDArray[np.float64]:
    """Return averages [K] of the finite among values [K] around each, over a share of all; NaN if none is finite."""
    reach = round(window * len(values) / 2)
    if reach == 0:
        return np.where(np.isfinite(values), values, np.nan)
    kernel, finite = np.ones(2 * reach + 1), np.isfinite(values)
    total = np.convolve(np.where(finite, values, 0.0), kernel)[reach:-reach]
    count = np.convolve(finite.astype(float), kernel)[reach:-reach]
    return np.where(count > 0.5, total / np.maximum(count, 1.0), np.nan)


def run_colors(count: int) -> list[str]:
    """Return a colour for each run, all different."""
    if count <= len(AGENT_COLORS):
        return list(AGENT_COLORS[:count])
    return [to_hex(color) for color in colormaps["turbo"](np.linspace(0.05, 0.95, count))]


def plot_curvature(
    panels: Mapping[str, tuple[NDArray[Any], NDArray[Any]]], path: str | Path, *, columns: int = 3
) -> Figure:
    """Draw how often branching regions of each average curvature are visited, a panel for each agent.

    Bars are shares of all visits, on a root scale: most regions are straight, and the turns are what is to be seen.

    Takes, by title, counts [K] of rollouts and of the log in K bins centred at equal steps from -1 to 1 (1/m). Raises
    a :class:`DataError` where no region was visited, or counts differ in their number of bins.
    """
    file = picture_path(path)
    for title, pair in panels.items():
        if min(counts.sum() for counts in pair) == 0:
            raise DataError(f"{title}: no branching region was visited")
    every = [counts / counts.sum() for pair in panels.values() for counts in pair]
    if len({len(shares) for shares in every}) > 1:
        raise DataError("counts differ in their number of bins")
    centres, width = np.linspace(-1, 1, len(every[0])), 2 / (len(every[0]) - 1)
    reach = max(LEAST_REACH, *(np.abs(centres[shares > 0]).max() for shares in every)) + 2 * width
    columns = min(columns, len(panels))
    figure, slots = new_panels(len(panels), columns, 4.2, 2.9, 0.5)
    for axes, title, policy, log in zip(slots, panels, every[::2], every[1::2], strict=True):
        _style(axes, fill(title, TITLE))
        edges = np.append(centres - width / 2, centres[-1] + width / 2)
        axes.stairs(log, edges, fill=True, color=LOG_COLOR, alpha=0.6, gid="log")
        axes.stairs(policy, edges, color=POLICY_COLOR, linewidth=1.5, gid="policy")
        axes.set_yscale("function", functions=(lambda y: np.sqrt(np.maximum(y, 0)), np.square))
        axes.yaxis.set_major_formatter(lambda y, _: f"{100 * y:g} %")
        axes.set_yticks([0.001, 0.01, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8])
        axes.set_xlim(-reach, reach)
        axes.set_ylim(0, 1.05 * max(shares.max() for shares in every))
    for axes in slots[-columns:]:
        axes.set_xlabel("average curvature, 1/m (left turns are positive)", fontsize=8, color=INK)
    for axes in slots[::columns]:
        axes.set_ylabel("share of visits", fontsize=8, color=INK)
    handles = [Patch(color=LOG_COLOR, alpha=0.6, label="log"), Patch(color=POLICY_COLOR, label="policy")]
    figure.legend(handles=handles, loc="outside upper right", ncols=2, frameon=False, fontsize=9)
    save(figure, file)
    return figure


def _style(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left", fontsize=9, fontweight="bold", color=INK, parse_math=False)
    axes.tick_params(labelsize=7.5, color=LANE, labelcolor=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(LANE)


def _draw_curve(axes: Axes, steps: NDArray[Any], values: NDArray[Any], window: float, gid: str, **style: Any) -> None:
    """Draw a metric of a run, pale as recorded and strong smoothed."""
    axes.plot(steps, values, linewidth=0.7, alpha=0.3, gid=f"raw-{gid}", **style)
    # A lone record has no line.
    marker = "o" if np.isfinite(values).sum() == 1 else ""
    smooth = smoothed(values, window)
    axes.plot(steps, smooth, linewidth=1.6, marker=marker, markersize=4, gid=gid, **style)
