"""Agents, and the map below them: road surface, lanes, boundary, marks and lights."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from symphony.data.segment import MarkType, Polylines, RoadMap, RunSegment, SignalState
from symphony.render.style import AGENT_COLORS, BOUNDARY, CAUTION, GO, INK, LANE, MARK, ROAD, STOP, View

CORNERS = np.array([(0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5)])
NOSE = np.array([(0.46, 0.0), (0.12, 0.36), (0.12, -0.36)])


def place(shape: NDArray[Any], position: NDArray[Any], heading: NDArray[Any], size: NDArray[Any]) -> NDArray[Any]:
    """Put a shape [V, 2], fractions of length and width along and left of the heading, into the world [A, V, 2]."""
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

    Returns the steps [K, 2, 2] of a path [T, 2], and the index [K] each begins at.
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


SLIT = 0.4
ARROW_SPACING = 14.0
ARROW = np.array([(-0.7, 0.7), (0.0, 0.0), (-0.7, -0.7)])
"""Metres: a chevron whose tip is at the origin, pointing along +x."""

# Shape as well as colour, so that the lights can be told apart without seeing red and green.
SIGNALS = {
    "stop": ("s", STOP, {SignalState.STOP, SignalState.ARROW_STOP, SignalState.FLASHING_STOP}),
    "caution": ("D", CAUTION, {SignalState.CAUTION, SignalState.ARROW_CAUTION, SignalState.FLASHING_CAUTION}),
    "go": ("o", GO, {SignalState.GO, SignalState.ARROW_GO}),
}


def draw_roads(axes: Axes, road: RoadMap, view: View) -> list[Line2D]:
    """Draw the part of a map that touches the view; return legend entries for what needs explaining."""
    surface = shapely.union_all([road_ribbon(road, k) for k in _visible(road.lanes, view)])
    # Closes the slits where one lane meets the next at an angle.
    surface = surface.buffer(SLIT, quad_segs=2).buffer(-SLIT, quad_segs=2)
    for polygon in () if surface.is_empty else shapely.get_parts(surface):
        axes.add_patch(PathPatch(outline(polygon), facecolor=ROAD, edgecolor="none", zorder=1, gid="surface"))
    entries = _draw_marks(axes, road, view)
    lanes = [road.lanes[k][:, :2] for k in _visible(road.lanes, view)]
    edges = [road.boundary[k][:, :2] for k in _visible(road.boundary, view)]
    chevrons = [arrow for lane in lanes for arrow in lane_arrows(lane)]
    _draw_lines(axes, lanes, LANE, 0.6, 3, "lanes")
    _draw_lines(axes, chevrons, "#AEB4BC", 0.7, 3, "directions")
    _draw_lines(axes, edges, BOUNDARY, 1.2, 4, "boundary")
    return entries


def _draw_lines(axes: Axes, lines: Any, color: str, width: float, zorder: float, gid: str) -> None:
    drawn = LineCollection(lines, colors=color, linewidths=width, zorder=zorder, gid=gid)
    axes.add_collection(drawn, autolim=False)


def draw_signals(axes: Axes, segment: RunSegment, step: int, view: View) -> list[Line2D]:
    """Draw the lights at their stop points as they are at a step; return legend entries of visible states."""
    point, state = segment.signal_point[:, :2], segment.signal_state[:, step]
    inside = _inside(point, view)
    entries: list[Line2D] = []
    for name, (marker, color, states) in SIGNALS.items():
        chosen = inside & np.isin(state, [int(s) for s in states])
        if chosen.any():
            style: dict[str, Any] = {"marker": marker, "zorder": 6, "linewidths": 0.7, "edgecolors": "white"}
            axes.scatter(point[chosen, 0], point[chosen, 1], s=26, c=color, gid=f"signals-{name}", **style)
            shown: dict[str, Any] = {"marker": marker, "color": color, "markersize": 5.5}
            entries.append(Line2D([], [], linestyle="none", label=f"light: {name}", **shown))
    x, y = point[inside & (state == SignalState.UNKNOWN)].T
    if len(x):
        style = {"edgecolors": INK, "linewidths": 0.6, "zorder": 6, "gid": "signals-unknown"}
        axes.scatter(x, y, s=16, c="none", **style)
    return entries


def _draw_marks(axes: Axes, road: RoadMap, view: View) -> list[Line2D]:
    lines, signs = [], []
    for k in _visible(road.marks, view):
        points, kind = road.marks[k][:, :2], road.mark_type[k]
        if kind == MarkType.STOP_SIGN:
            signs.append(points[0])
        elif kind in {MarkType.CROSSWALK, MarkType.SPEED_BUMP, MarkType.DRIVEWAY} and len(points) > 2:
            style: dict[str, Any] = {"facecolor": "#EFEDE8", "edgecolor": MARK, "linewidth": 0.5, "zorder": 2}
            style |= {"hatch": "||||"} if kind == MarkType.CROSSWALK else {}
            area = Outline(np.concatenate([points, points[:1]]), closed=True)
            axes.add_patch(PathPatch(area, gid=f"mark-{MarkType(kind).name.lower()}", **style))
        else:
            lines.append(points)
    _draw_lines(axes, lines, MARK, 0.8, 2, "marks")
    if not signs:
        return []
    style = {"marker": "8", "edgecolors": STOP, "linewidths": 1.5, "zorder": 5, "gid": "stop-signs"}
    x, y = np.stack(signs).T
    axes.scatter(x, y, s=34, c="white", **style)
    style = {"linestyle": "none", "markersize": 5.5, "markeredgewidth": 1.5, "markeredgecolor": STOP}
    return [Line2D([], [], marker="8", color="white", label="stop sign", **style)]


def road_ribbon(road: RoadMap, lane: int) -> Any:
    """Return the area covered by one lane: its centre line widened to its width; none for a single point."""
    if len(road.lanes[lane]) < 2:
        return shapely.Polygon()
    width = road.widths[lane]
    # A little wider than the lane, or hairlines of land would show between neighbours.
    return shapely.LineString(road.lanes[lane][:, :2]).buffer(width / 2 + 0.15, quad_segs=4, cap_style="flat")


def lane_arrows(line: NDArray[Any]) -> NDArray[Any]:
    """Return [K, 3, 2] chevrons along a polyline [P, 2], pointing the way it runs."""
    delta = np.diff(line.astype(np.float64), axis=0)
    length = np.hypot(delta[:, 0], delta[:, 1])
    total = float(length.sum())
    if total < ARROW_SPACING / 2:
        return np.zeros((0, 3, 2))
    count = max(1, int(total / ARROW_SPACING))
    at = (np.arange(count) + 0.5) * total / count
    ends = np.cumsum(length)
    piece = np.minimum(np.searchsorted(ends, at, side="right"), len(length) - 1)
    direction = delta[piece] / length[piece, None]
    tip = line[piece] + direction * (at - (ends - length)[piece])[:, None]
    left = np.stack([-direction[:, 1], direction[:, 0]], -1)
    return tip[:, None] + ARROW[:, :1] * direction[:, None] + ARROW[:, 1:] * left[:, None]


def outline(polygon: Any) -> Outline:
    """Return a polygon with its holes as one path."""
    rings = [polygon.exterior, *polygon.interiors]
    return Outline.make_compound_path(*(Outline(np.asarray(r.coords)[:, :2], closed=True) for r in rings))


def _visible(lines: Polylines, view: View) -> Iterator[int]:
    """Yield the indices of the polylines whose bounding box meets the view."""
    for k in range(len(lines)):
        low, high = lines[k][:, :2].min(0), lines[k][:, :2].max(0)
        if low[0] <= view[1] and high[0] >= view[0] and low[1] <= view[3] and high[1] >= view[2]:
            yield k


def _inside(points: NDArray[Any], view: View) -> NDArray[np.bool_]:
    x, y = points[:, 0], points[:, 1]
    return (x >= view[0]) & (x <= view[1]) & (y >= view[2]) & (y <= view[3])
