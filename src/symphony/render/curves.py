"""Training curves of one or several runs, a panel for each metric."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from symphony.render.style import AGENT_COLORS, INK, LANE, new_figure, picture_path, save

Records = Sequence[Mapping[str, Any]]
"""Of a run, each with its ``step``; other entries are metrics, and any may be absent or NaN."""

Panel = tuple[str, Mapping[str, str]]
"""Title, and the metrics with what each is called where there are several."""


def _quantiles(title: str, name: str) -> Panel:
    labels = {"p90": "90 %", "p50": "median", "p10": "10 %"}
    return f"preview: {title}", {f"preview_{name}_{level}": label for level, label in labels.items()}


PANELS: tuple[Panel, ...] = (
    ("policy loss", {"loss_policy": "whole", "loss_mgail": "MGAIL", "loss_regression": "regression"}),
    ("negative log-likelihood", {"policy_nll_expert": "expert", "policy_nll_rollout": "rollout"}),
    ("accuracy", {"policy_accuracy": ""}),
    ("entropy", {"policy_entropy": ""}),
    ("MGAIL: discriminator logit", {"policy_mgail_score": ""}),
    ("goal loss", {"loss_goals": ""}),
    ("goal accuracy", {"goals_accuracy": "most likely", "goals_accuracy_top3": "among the best 3"}),
    ("goal entropy", {"goals_entropy": ""}),
    ("discriminator loss", {"loss_discriminator": ""}),
    (
        "discriminator accuracy",
        {"discriminator_accuracy_simulated": "simulated", "discriminator_accuracy_data": "data"},
    ),
    (
        "discriminator logit",
        {"discriminator_score_simulated": "simulated", "discriminator_score_data": "data"},
    ),
    ("discriminator AUC", {"discriminator_auc": ""}),
    ("discriminator gradient penalty", {"discriminator_gradient_penalty": ""}),
    ("search: AUC of collisions", {"search_auc_collision": ""}),
    ("search: AUC of off-road states", {"search_auc_offroad": ""}),
    ("search: share in collision", {"search_collision_all": "all", "search_collision_kept": "kept"}),
    ("search: share off the road", {"search_offroad_all": "all", "search_offroad_kept": "kept"}),
    (
        "validation: infractions, %",
        {
            "validation_collision_rate": "collision rate",
            "validation_offroad_time": "off-road time",
            "validation_infractions": "sum",
        },
    ),
    ("validation: displacement, m", {"validation_ade": "ADE", "validation_min_sade": "minSADE"}),
    ("validation: curvature JSD", {"validation_curvature_jsd": ""}),
    _quantiles("ADE, m", "ade"),
    _quantiles("speed, m/s", "speed"),
    _quantiles("logged speed, m/s", "speed_log"),
    _quantiles("acceleration, m/s²", "acceleration"),
    _quantiles("logged acceleration, m/s²", "acceleration_log"),
    _quantiles("turn, rad/s", "turn"),
    _quantiles("logged turn, rad/s", "turn_log"),
    _quantiles("logit, simulated", "score_simulated"),
    _quantiles("logit, data", "score_data"),
    (
        "gradient norm",
        {
            "gradient_norm_policy": "policy",
            "gradient_norm_discriminator": "discriminator",
            "gradient_norm_goals": "goals",
        },
    ),
)
"""In this order; whatever else there is follows in panels of its own, and then what is in :data:`LAST`."""
LAST: tuple[Panel, ...] = (
    ("updates per second", {"updates_per_second": ""}),
    ("learning rate", {"learning_rate": ""}),
    ("skipped updates", {"skipped_updates": ""}),
)
DASHES: tuple[Any, ...] = ("-", (0, (3, 1.5)), (0, (1, 1)))
WINDOW = 0.1
"""Share of a run's records that a point of the smoothed line is averaged over."""


def plot_curves(
    runs: Mapping[str, Records],
    path: str | Path,
    *,
    metrics: Sequence[str] = (),
    window: float = WINDOW,
    columns: int = 4,
) -> Figure:
    """Draw the metrics of runs over their updates: pale as recorded, strong smoothed, one colour per run.

    Args:
        runs: records of each run by its name.
        path: file to write (png, pdf or svg).
        metrics: draw these only, each in a panel of its own; by default all there are, related ones together.
        window: share of a run's records that a point of the smoothed line is averaged over; 0 to not smooth.
        columns: panels per row, at most.

    Raises:
        ValueError: nothing to draw, or a metric that no run has.
        ConfigError: a file of another kind.
    """
    file = picture_path(path)
    curves = {name: read_curves(records) for name, records in runs.items()}
    present = list(dict.fromkeys(metric for found in curves.values() for metric in found))
    if missing := [metric for metric in metrics if metric not in present]:
        raise ValueError(f"no run has {', '.join(missing)}; there are {', '.join(present)}")
    panels = [_own_panel(metric) for metric in metrics] or panels_of(present)
    if not panels:
        raise ValueError("no metrics to draw")
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(3.3 * columns, 2.3 * rows + 0.5)
    grid = figure.add_gridspec(rows, columns)
    colors = dict(zip(runs, run_colors(len(runs)), strict=True))
    for k, (title, names) in enumerate(panels):
        axes = figure.add_subplot(grid[k // columns, k % columns])
        _draw_panel(axes, title, names, curves, colors, window)
        if k + columns >= len(panels):
            axes.set_xlabel("update", fontsize=8, color=INK)
    handles = [Line2D([], [], color=color, linewidth=2.5, label=name) for name, color in colors.items()]
    figure.legend(
        handles=handles, loc="outside upper left", ncols=min(len(handles), columns), frameon=False, fontsize=9
    )
    save(figure, file)
    return figure


def read_curves(records: Records) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Updates [K] and values [K] of each metric; what is no number is left out, NaN is kept."""
    found: dict[str, tuple[list[float], list[float]]] = {}
    for record in records:
        step = record.get("step", "")
        if not _is_number(step):
            continue
        for name, value in record.items():
            if name != "step" and (value is None or _is_number(value)):
                steps, values = found.setdefault(name, ([], []))
                steps.append(float(step))
                values.append(math.nan if value is None else float(value))
    return {name: (np.asarray(steps), np.asarray(values)) for name, (steps, values) in found.items()}


def panels_of(present: Sequence[str]) -> list[Panel]:
    """The panels for the metrics there are."""
    known = {name for _, names in (*PANELS, *LAST) for name in names}
    others = [_own_panel(name) for name in present if name not in known]
    panels = [
        (title, {name: label for name, label in names.items() if name in present})
        for title, names in (*PANELS, *others, *LAST)
    ]
    return [panel for panel in panels if panel[1]]


def smoothed(values: NDArray[np.float64], window: float) -> NDArray[np.float64]:
    """Averages [K] of the finite among the values [K] around each, over a share of them all; NaN where none is."""
    reach = round(window * len(values) / 2)
    if reach == 0:
        return np.where(np.isfinite(values), values, np.nan)
    kernel, finite = np.ones(2 * reach + 1), np.isfinite(values)
    total = np.convolve(np.where(finite, values, 0.0), kernel)[reach:-reach]
    count = np.convolve(finite.astype(float), kernel)[reach:-reach]
    return np.where(count > 0.5, total / np.maximum(count, 1.0), np.nan)


def run_colors(count: int) -> list[str]:
    """A colour for each run, all different."""
    if count <= len(AGENT_COLORS):
        return list(AGENT_COLORS[:count])
    return [to_hex(color) for color in colormaps["turbo"](np.linspace(0.05, 0.95, count))]


def _draw_panel(
    axes: Axes,
    title: str,
    names: Mapping[str, str],
    curves: Mapping[str, Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]],
    colors: Mapping[str, str],
    window: float,
) -> None:
    for run, found in curves.items():
        for name, dashes in zip(names, DASHES, strict=False):
            if name not in found:
                continue
            steps, values = found[name]
            raw: dict[str, Any] = {"color": colors[run], "linewidth": 0.7, "alpha": 0.3, "linestyle": dashes}
            axes.plot(steps, values, **raw, gid=f"raw-{name}-{run}")
            strong: dict[str, Any] = {"color": colors[run], "linewidth": 1.6, "linestyle": dashes}
            # A lone record has no line.
            marker = "o" if np.isfinite(values).sum() == 1 else ""
            axes.plot(
                steps, smoothed(values, window), **strong, marker=marker, markersize=4, gid=f"{name}-{run}"
            )
    axes.set_title(title, loc="left", fontsize=9, fontweight="bold", color=INK, parse_math=False)
    axes.tick_params(labelsize=7.5, color=LANE, labelcolor=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(LANE)
    axes.grid(color=LANE, linewidth=0.4, alpha=0.6)
    axes.set_axisbelow(True)
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    if len(names) > 1:
        styles = [
            Line2D([], [], color=INK, linewidth=1.2, linestyle=dashes, label=label)
            for label, dashes in zip(names.values(), DASHES, strict=False)
        ]
        axes.legend(handles=styles, fontsize=6.5, framealpha=0.8, edgecolor="none", handlelength=2.2)


def _own_panel(metric: str) -> Panel:
    return metric, {metric: metric}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
