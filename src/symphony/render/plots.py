"""Whole pictures: a run segment, rollouts over it, the routes of an agent, several side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from symphony.data.levels import LEVEL, agent_heights
from symphony.data.segment import AgentType, RunSegment
from symphony.render.roads import CORNERS, draw_boxes, draw_roads, draw_signals, draw_trails, pieces, place
from symphony.render.style import (
    INK,
    PLAYBACK,
    Target,
    View,
    add_legend,
    agent_color,
    frame,
    new_panels,
    open_target,
    picture_path,
    save,
    view_around,
    with_aspect,
)

if TYPE_CHECKING:
    from symphony.saved.rollouts import SavedRollouts

LOG_DASHES = (0, (4, 2))
ROUTE = "#C2410C"
"""Colour of the route that the log took."""
ENTRIES = 8  # agents that a legend names; a crowd's would hide the picture
EVENTS = (("collision", "collision", "X"), ("offroad", "off road", "^"))


def plot_segment(
    segment: RunSegment,
    target: Target,
    *,
    step: int | None = None,
    interactive: Sequence[int] | None = None,
    view: View | None = None,
    title: str | None = None,
) -> Axes:
    """Draw a run segment: map, lights and boxes at one step, trails over the whole window.

    The target is a file (png, pdf or svg; a :class:`ConfigError` for another) or axes to draw on. By default boxes
    and lights are those of the ``current_step``, and the segment's ``interest`` is in colour, as the ego is; the
    view, in metres, is around the trails of those in colour, on given axes a square.
    """
    step = segment.current_step if step is None else step
    named = segment.interest.tolist() if interactive is None else interactive
    chosen = list(dict.fromkeys([segment.ego, *(int(agent) for agent in named)]))
    position, valid = segment.position[..., :2], segment.valid
    trails = position[chosen][valid[chosen]]
    view = view or _own_view(trails, target)
    axes, path = open_target(target, view)

    entries = draw_roads(axes, segment.road, view) + draw_signals(axes, segment, step, view)
    others = np.setdiff1d(np.arange(segment.num_agents), chosen)
    draw_trails(axes, position[others], valid[others], PLAYBACK, step=step, width=0.9, strength=0.6, zorder=7)
    draw_playback(axes, segment, step, others)
    for agent, color in zip(chosen, colors_of(segment, chosen), strict=True):
        one, gid = [agent], f"trail-{agent}"
        draw_trails(axes, position[one], valid[one], color, step=step, width=2.2, gid=gid)
        if valid[agent, step]:
            at = position[one, step], segment.heading[one, step], segment.size[one]
            draw_boxes(axes, *at, color, gid=f"box-{agent}")
    seconds = step * segment.dt
    frame(axes, view, title or segment.segment_id, f"{describe(segment)}   ·   shown at {seconds:.1f} s")
    add_legend(axes, [*agent_entries(segment, chosen), playback_entry(), *entries], trails)
    if path is not None:
        save(axes.figure, path)
    return axes


@dataclass(frozen=True)
class Clip:
    """K rollouts of N agents of a run segment, to be drawn or animated."""

    segment: RunSegment  # the log
    position: NDArray[Any]  # [K, N, T, 2] simulated box centres, metres
    heading: NDArray[Any]  # [K, N, T] radians
    agents: NDArray[np.int64]  # [N] which agents of the segment these are
    start: int  # step of the log at which the rollouts begin
    valid: NDArray[np.bool_]  # [K, N, T]; other steps are left out
    collision: NDArray[np.bool_]  # [K, N, T], marked where each collision begins
    offroad: NDArray[np.bool_]  # [K, N, T], marked where each departure from the road begins
    view: View | None = None  # limits in metres; by default around rollouts and log of those agents
    title: str | None = None  # by default the segment's id

    @property
    def steps(self) -> slice:
        """The steps of the log that the rollouts cover."""
        return slice(self.start, self.start + self.heading.shape[2])

    @property
    def log(self) -> NDArray[Any]:
        """The places [N, T, 2] of the agents in the log, NaN where there are none."""
        position = self.segment.position[self.agents, self.steps, :2]
        return np.where(self.segment.valid[self.agents, self.steps, None], position, np.nan)

    @property
    def points(self) -> NDArray[Any]:
        """The places [P, 2] of the agents in the rollouts and in the log."""
        return np.concatenate([self.position[self.valid], self.log.reshape(-1, 2)])

    @property
    def others(self) -> NDArray[np.int64]:
        """The agents that play back the log."""
        return np.setdiff1d(np.arange(self.segment.num_agents), self.agents)

    @property
    def alpha(self) -> float:
        """The opacity of one rollout in the picture."""
        return float(np.clip(2.5 / len(self.position), 0.3, 0.9))

    def words(self) -> str:
        """Return a summary such as `16 rollouts, 3 distinct`: leaves of a search may share all of their history."""
        known = self.valid[..., None]
        state = np.concatenate([self.position, self.heading[..., None]], -1)
        rows = np.concatenate([np.where(known, state, 0.0), known], -1).reshape(len(state), -1)
        count, distinct = len(state), len(np.unique(rows, axis=0))
        return f"{count} rollout{'s' * (count > 1)}" + (f", {distinct} distinct" if distinct < count else "")

    def beginnings(self, name: str, until: int | None = None) -> NDArray[np.bool_]:
        """Return [K, N, T] where each run of true steps of an event begins, up to a step."""
        happening = getattr(self, name) & self.valid
        begins = happening & ~np.pad(happening[..., :-1], ((0, 0), (0, 0), (1, 0)))
        return begins if until is None else begins & (np.arange(begins.shape[-1]) <= until)


def saved_clip(saved: SavedRollouts, count: int | None = None, title: str | None = None) -> Clip:
    """Return the first ``count`` rollouts of a run segment, all by default, to be drawn or animated."""
    state, valid = saved.state[:count].swapaxes(1, 2).astype(np.float64), saved.there[:count].swapaxes(1, 2)
    judged = np.isin(np.arange(len(saved.agents)), saved.evaluated)
    flags = ((part & judged)[:count].swapaxes(1, 2) for part in (saved.collision, saved.offroad))
    collision, offroad = (np.pad(part, ((0, 0), (0, 0), (1, 0))) for part in flags)
    place = state[..., :2], state[..., 2], saved.agents, saved.start
    return Clip(saved.segment, *place, valid, collision, offroad, title=title)


def plot_rollout(clip: Clip, target: Target) -> Axes:
    """Draw rollouts of the interactive agents over the log, with boxes where they end.

    Playback agents, and the lights, are shown as logged at the last step; those that were hit also where that was.
    The target is a file (png, pdf or svg; a :class:`ConfigError` for another) or axes to draw on.
    """
    segment, last, trails = clip.segment, clip.steps.stop - 1, clip.points
    view = clip.view or _own_view(trails, target)
    axes, path = open_target(target, view)
    entries = draw_roads(axes, segment.road, view) + draw_signals(axes, segment, last, view)
    draw_playback(axes, segment, last, clip.others)
    hit = draw_hit(axes, clip)
    style: dict[str, Any] = {"color": INK, "linestyle": LOG_DASHES, "linewidth": 1.4}
    for rank, (agent, color) in enumerate(zip(clip.agents, colors_of(segment, clip.agents), strict=True)):
        axes.plot(*clip.log[rank].T, zorder=9, gid=f"log-{agent}", **style)
        draw_ways(axes, clip, rank, color, width=1.6, gid=f"rollouts-{agent}")
        seen = clip.valid[:, rank]
        k = np.flatnonzero(seen.any(1))
        if len(k):
            t = seen.shape[1] - 1 - seen[k, ::-1].argmax(1)
            size = np.broadcast_to(segment.size[agent], (len(k), 3))
            at = clip.position[k, rank, t], clip.heading[k, rank, t], size
            draw_boxes(axes, *at, color, alpha=max(clip.alpha, 0.45), gid=f"ends-{agent}")
    marks = [draw_events(axes, clip, *event) for event in EVENTS]
    duration = (clip.heading.shape[2] - 1) * segment.dt
    subtitle = f"{describe(segment)}   ·   {clip.words()} of {duration:.1f} s"
    frame(axes, view, clip.title or segment.segment_id, subtitle)
    explained = [*agent_entries(segment, clip.agents), Line2D([], [], label="log", **style)]
    found = filter(None, [hit, *marks])
    add_legend(axes, [*explained, playback_entry("playback, at the end"), *found, *entries], trails)
    if path is not None:
        save(axes.figure, path)
    return axes


def plot_routes(segment: RunSegment, agent: int, lines: Sequence[NDArray[Any]], logged: int, target: Target) -> Axes:
    """Draw the routes of an agent, a dot for each of their points, the one that it took on top, and its log.

    Takes the agent's row of the segment, the points [P, 2] of its routes, and which of them it took, -1 for none.
    Boxes are those of the first step. The target is a file (png, pdf or svg) or axes to draw on.
    """
    path = segment.position[agent, :, :2][segment.valid[agent]]
    places = np.concatenate([path, *lines])
    view = _own_view(places, target)
    axes, file = open_target(target, view)
    entries = draw_roads(axes, segment.road, view)
    draw_playback(axes, segment, 0, np.setdiff1d(np.arange(segment.num_agents), [agent]))
    style: dict[str, Any] = {"marker": ".", "markersize": 2.2, "solid_capstyle": "butt"}
    own = colors_of(segment, np.array([segment.ego]))[0]
    for number, line in enumerate(lines):
        if number != logged:
            axes.plot(*line.T, color=own, linewidth=0.7, alpha=0.75, zorder=8, **style)
    shown = [Line2D([], [], color=own, linewidth=1.0, marker=".", label=f"feasible route ({len(lines)})")]
    if logged >= 0:
        axes.plot(*lines[logged].T, color=ROUTE, linewidth=1.6, zorder=9, **style)
        shown.append(Line2D([], [], color=ROUTE, linewidth=1.6, marker=".", label="the one that was taken"))
    axes.plot(*path.T, color=INK, linestyle=LOG_DASHES, linewidth=1.1, zorder=9.5)
    shown.append(Line2D([], [], color=INK, linestyle=LOG_DASHES, linewidth=1.1, label="log"))
    if segment.valid[agent, 0]:
        box = segment.position[[agent], 0, :2], segment.heading[[agent], 0], segment.size[[agent]]
        draw_boxes(axes, *box, own, gid=f"box-{agent}")
    frame(axes, view, f"{segment.segment_id}, agent {segment.agent_id[agent]}", describe(segment))
    add_legend(axes, [*shown, *entries], places)
    if file is not None:
        save(axes.figure, file)
    return axes


def plot_grid(
    panels: Sequence[Callable[[Axes], Any]], path: str | Path, *, columns: int = 3, size: float = 4.5
) -> Figure:
    """Draw several pictures in one file (png, pdf or svg; a :class:`ConfigError` for another).

    Panels are functions that draw on the axes they are given, such as ``lambda axes: plot_segment(segment, axes)``,
    of a ``size`` in inches; there are at most ``columns`` in a row.
    """
    file = picture_path(path)
    figure, slots = new_panels(len(panels), min(columns, len(panels)), size, size)
    for draw, axes in zip(panels, slots, strict=True):
        draw(axes)
    save(figure, file)
    return figure


def _own_view(trails: NDArray[Any], target: Target) -> View:
    """Return the view around trails [P, 2]; a square for one panel among others, so that all are of one size."""
    view = view_around(trails)
    return with_aspect(view) if isinstance(target, Axes) else view


def draw_ways(
    axes: Axes, clip: Clip, rank: int, color: str, *, width: float, until: int | None = None, gid: str | None = None
) -> None:
    """Draw the way of one of the agents in every rollout, up to a step."""
    past = slice(None if until is None else until + 1)
    ways = zip(clip.position[:, rank, past], clip.valid[:, rank, past], strict=True)
    lines = [step for way, valid in ways for step in pieces(way, valid)[0]]
    drawn = LineCollection(lines, colors=[to_rgba(color, clip.alpha)], linewidths=width, zorder=8, gid=gid)
    axes.add_collection(drawn, autolim=False)


def draw_events(
    axes: Axes, clip: Clip, name: str, label: str, marker: str, until: int | None = None
) -> Line2D | None:
    """Mark where each run of true steps of an event begins, up to a step; None where there is none."""
    points = clip.position[clip.beginnings(name, until)]
    if len(points) == 0:
        return None
    style: dict[str, Any] = {"marker": marker, "linewidths": 0.9, "edgecolors": "white"}
    axes.scatter(points[:, 0], points[:, 1], s=60, c=INK, zorder=12, gid=name, **style)
    return Line2D([], [], linestyle="none", marker=marker, color=INK, markersize=6.5, label=label)


def draw_hit(axes: Axes, clip: Clip) -> Patch | None:
    """Outline the playback agents that were hit, where states begin to overlap; return a legend entry if any."""
    segment, heights = clip.segment, agent_heights(clip.segment)
    over: set[tuple[int, int, int, int]] = set()
    for rollout, rank, at in np.argwhere(clip.collision & clip.valid).tolist():
        step, agent = clip.start + at, clip.agents[rank]
        near = clip.others[segment.valid[clip.others, step]]
        if len(heights):  # as in `symphony.geometry.frames.levels_apart`
            # An agent is as high as its log where that is nearest, as in `symphony.saved.rollouts.world_of`.
            away = np.linalg.norm(segment.position[agent, :, :2] - clip.position[rollout, rank, at], axis=-1)
            mine = heights[np.where(segment.valid[agent], away, np.inf).argmin(), agent]
            its = heights[step, near]
            apart = (its[:, 1] != mine[1]) & (its[:, 1] * mine[1] > 0) & (abs(its[:, 0] - mine[0]) >= LEVEL)
            near = near[~apart]
        size = segment.size[[agent]]
        here = clip.position[[rollout], rank, at], clip.heading[[rollout], rank, at], size
        there = segment.position[near, step], segment.heading[near, step], segment.size[near]
        own, boxes = shapely.Polygon(place(CORNERS, *here)[0]), shapely.polygons(place(CORNERS, *there))
        over |= {(rollout, rank, other, step) for other in near[shapely.intersects(own, boxes)].tolist()}
    # One may go on when the next begins.
    found = {(agent, step) for *run, agent, step in over if (*run, agent, step - 1) not in over}
    if not found:
        return None
    agent, step = np.array(sorted(found)).T
    corners = place(CORNERS, segment.position[agent, step], segment.heading[agent, step], segment.size[agent])
    style: dict[str, Any] = {"facecolors": [to_rgba(PLAYBACK, 0.55)], "edgecolors": INK, "linewidths": 0.8}
    axes.add_collection(PolyCollection(list(corners), zorder=7.8, gid="hit", **style), autolim=False)
    return Patch(facecolor=to_rgba(PLAYBACK, 0.55), edgecolor=INK, label="playback, when it was hit")


def draw_playback(axes: Axes, segment: RunSegment, step: int, agents: NDArray[Any]) -> None:
    """Draw those of the agents [K] that are valid at a step, in grey."""
    shown = agents[segment.valid[agents, step]]
    if len(shown):
        at = segment.position[shown, step, :2], segment.heading[shown, step], segment.size[shown]
        draw_boxes(axes, *at, PLAYBACK, zorder=7.5, gid="playback")


def colors_of(segment: RunSegment, agents: Any) -> list[str]:
    """Return a colour for each agent: the ego's is the same in every picture."""
    others = [int(agent) for agent in agents if agent != segment.ego]
    return [agent_color(0 if agent == segment.ego else 1 + others.index(int(agent))) for agent in agents]


def describe(segment: RunSegment) -> str:
    """Return source, duration, rate and number of agents of a segment, for a caption."""
    duration = (segment.log_steps - 1) * segment.dt
    rate, agents = f"{1 / segment.dt:g} Hz", f"{segment.num_agents} agents"
    rate += " of log" * (segment.logged > 0)
    return f"{segment.source}   ·   {duration:.1f} s at {rate}   ·   {agents}"


def agent_entries(segment: RunSegment, agents: Any) -> list[Patch]:
    """Return legend entries of the coloured agents, of a crowd the first :data:`ENTRIES`."""

    def label(agent: int) -> str:
        role = "ego " if agent == segment.ego else ""
        return f"{role}{AgentType(segment.agent_type[agent]).name.lower()} {segment.agent_id[agent]}"

    colors = colors_of(segment, agents)
    shown = list(zip(agents, colors, strict=True))[:ENTRIES]
    entries = [Patch(color=color, label=label(int(agent))) for agent, color in shown]
    more = [Patch(color="none", label=f"and {len(agents) - ENTRIES} more in colour")]
    return entries + more * (len(agents) > ENTRIES)


def playback_entry(label: str = "playback") -> Patch:
    """Return the legend entry of the agents in grey."""
    return Patch(color=PLAYBACK, label=label)
