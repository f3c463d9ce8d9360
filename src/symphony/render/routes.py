"""The routes that an agent may take, over the map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from symphony.data.segment import RunSegment
from symphony.render.agents import draw_boxes
from symphony.render.plots import LOG_DASHES, colors_of, describe, draw_playback
from symphony.render.roads import draw_roads
from symphony.render.style import INK, Target, add_legend, frame, open_target, save, view_around, with_aspect

LOGGED = "#C2410C"
"""Colour of the route that the log took."""


def plot_routes(
    segment: RunSegment,
    agent: int,
    lines: Sequence[NDArray[Any]],
    logged: int,
    target: Target,
    *,
    step: int = 0,
) -> Axes:
    """Draw the routes of an agent, a dot for each of their points, the one that it took on top, and its log.

    Args:
        segment: the run segment.
        agent: row of it.
        lines: points [P, 2] of the routes.
        logged: which of them it took, -1 for none.
        target: file to write (png, pdf or svg) or axes to draw on.
        step: at which boxes are shown.
    """
    path = segment.position[agent, :, :2][segment.valid[agent]]
    places = np.concatenate([path, *lines])
    view = view_around(places)
    axes, file = open_target(target, with_aspect(view) if isinstance(target, Axes) else view)
    view = with_aspect(view) if isinstance(target, Axes) else view
    entries = draw_roads(axes, segment.road, view)
    others = np.setdiff1d(np.arange(segment.num_agents), [agent])
    draw_playback(axes, segment, step, others)
    style: dict[str, Any] = {"marker": ".", "markersize": 2.2, "solid_capstyle": "butt"}
    own = colors_of(segment, np.array([segment.ego]))[0]
    for number, line in enumerate(lines):
        if number != logged:
            axes.plot(*line.T, color=own, linewidth=0.7, alpha=0.75, zorder=8, **style)
    shown = [Line2D([], [], color=own, linewidth=1.0, marker=".", label=f"feasible route ({len(lines)})")]
    if logged >= 0:
        axes.plot(*lines[logged].T, color=LOGGED, linewidth=1.6, zorder=9, **style)
        shown.append(Line2D([], [], color=LOGGED, linewidth=1.6, marker=".", label="the one that was taken"))
    axes.plot(*path.T, color=INK, linestyle=LOG_DASHES, linewidth=1.1, zorder=9.5)
    shown.append(Line2D([], [], color=INK, linestyle=LOG_DASHES, linewidth=1.1, label="log"))
    if segment.valid[agent, step]:
        box = segment.position[[agent], step, :2], segment.heading[[agent], step], segment.size[[agent]]
        draw_boxes(axes, *box, own, gid=f"box-{agent}")
    frame(axes, view, f"{segment.segment_id}, agent {segment.agent_id[agent]}", describe(segment))
    add_legend(axes, [*shown, *entries], places)
    if file is not None:
        save(axes.figure, file)
    return axes
