"""Whole pictures: a run segment, rollouts over it, several side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from symphony.data.segment import AgentType, RunSegment
from symphony.render.agents import CORNERS, draw_boxes, draw_trails, pieces, place
from symphony.render.roads import draw_roads, draw_signals
from symphony.render.style import (
    INK,
    PLAYBACK,
    Target,
    View,
    add_legend,
    agent_color,
    frame,
    new_figure,
    open_target,
    picture_path,
    save,
    view_around,
    with_aspect,
)

LOG_DASHES = (0, (4, 2))
ENTRIES = 8
"""Agents that a legend names; a crowd's would hide the picture."""
EVENTS = (("collision", "collision", "X"), ("offroad", "off road", "^"))


def plot_segment(
    segment: RunSegment,
    target: Target,
    *,
    step: int | None = None,
    interactive: Sequence[int] | None = None,
    view: View | None = None,
    title: str | None = None,
    legend: bool = True,
) -> Axes:
    """Draw a run segment: map, lights and boxes at one step, trails over the whole window.

    Args:
        segment: what to draw.
        target: file to write (png, pdf or svg) or axes to draw on.
        step: when the boxes and lights are shown; by default the segment's ``current_step``.
        interactive: agents in colour, along with the ego; by default the segment's ``interest``.
        view: limits in metres; by default around the trails of the agents in colour, on given axes a square.
        title: by default the segment's id.
        legend: whether to explain the colours.

    Raises:
        ValueError: a step or an agent outside the segment.
        ConfigError: a file of another kind.
    """
    step = segment.current_step if step is None else step
    if not 0 <= step < segment.num_steps:
        raise ValueError(f"step {step} outside the {segment.num_steps} steps")
    chosen = _highlighted(segment, segment.interest.tolist() if interactive is None else interactive)
    position, valid = segment.position[..., :2], segment.valid
    trails = position[chosen][valid[chosen]]
    view = view or _own_view(trails, target)
    axes, path = open_target(target, view)

    entries = draw_roads(axes, segment.road, view) + draw_signals(axes, segment, step, view)
    others = np.setdiff1d(np.arange(segment.num_agents), chosen)
    draw_trails(axes, position[others], valid[others], PLAYBACK, step=step, width=0.9, strength=0.6, zorder=7)
    draw_playback(axes, segment, step, others)
    for agent, color in zip(chosen, colors_of(segment, chosen), strict=True):
        one = [agent]
        draw_trails(
            axes, position[one], valid[one], color, step=step, width=2.2, zorder=8, gid=f"trail-{agent}"
        )
        if valid[agent, step]:
            draw_boxes(
                axes,
                position[one, step],
                segment.heading[one, step],
                segment.size[one],
                color,
                gid=f"box-{agent}",
            )
    seconds = step * segment.dt
    frame(axes, view, title or segment.segment_id, f"{describe(segment)}   ·   shown at {seconds:.1f} s")
    if legend:
        add_legend(axes, [*agent_entries(segment, chosen), playback_entry(), *entries], trails)
    if path is not None:
        save(axes.figure, path)
    return axes


def plot_rollout(
    segment: RunSegment,
    position: Any,
    heading: Any,
    agent_index: Any,
    target: Target,
    *,
    start: int = 0,
    valid: Any = None,
    collision: Any = None,
    offroad: Any = None,
    view: View | None = None,
    title: str | None = None,
    legend: bool = True,
) -> Axes:
    """Draw K rollouts of the interactive agents over the log, with boxes where they end.

    Playback agents, and the lights, are shown as logged at the last step; those that were hit also where that was.

    Args:
        segment: the log.
        position: [K, N, T, 2] simulated box centres, metres.
        heading: [K, N, T] radians.
        agent_index: [N] which agents of the segment these are; negative for padding.
        target: file to write (png, pdf or svg) or axes to draw on.
        start: step of the log at which the rollouts begin.
        valid: [N, T] or [K, N, T] bool, all by default; steps that are not are left out.
        collision: [K, N, T] bool, crossed out where each collision begins.
        offroad: [K, N, T] bool, marked by a triangle where each departure begins.
        view: limits in metres; by default around rollouts and log of those agents, on given axes a square.
        title: by default the segment's id.
        legend: whether to explain the colours.

    Raises:
        ValueError: shapes that don't fit together, or steps outside the log.
        ConfigError: a file of another kind.
    """
    runs = Rollouts.of(segment, position, heading, agent_index, start, valid, collision, offroad)
    steps = runs.position.shape[2]
    last = start + steps - 1
    log = segment.position[runs.agents, start : last + 1, :2]
    logged = segment.valid[runs.agents, start : last + 1]
    trails = np.concatenate([runs.position[runs.valid], log[logged]])
    view = view or _own_view(trails, target)
    axes, path = open_target(target, view)

    entries = draw_roads(axes, segment.road, view) + draw_signals(axes, segment, last, view)
    others = np.setdiff1d(np.arange(segment.num_agents), runs.agents)
    draw_playback(axes, segment, last, others)
    hit = draw_hit(axes, segment, runs, others, start)
    for rank, (agent, color) in enumerate(zip(runs.agents, colors_of(segment, runs.agents), strict=True)):
        shown = np.where(logged[rank, :, None], log[rank], np.nan)
        axes.plot(*shown.T, color=INK, linestyle=LOG_DASHES, linewidth=1.4, zorder=9, gid=f"log-{agent}")
        _draw_agent(axes, runs, rank, segment.size[agent], color)
    marks = [draw_events(axes, runs, *event) for event in EVENTS]
    subtitle = f"{describe(segment)}   ·   {runs.words()} of {(steps - 1) * segment.dt:.1f} s"
    frame(axes, view, title or segment.segment_id, subtitle)
    if legend:
        logline = Line2D([], [], color=INK, linestyle=LOG_DASHES, linewidth=1.4, label="log")
        playback = playback_entry("playback, at the end")
        found = filter(None, [hit, *marks])
        explained = [*agent_entries(segment, runs.agents), logline, playback, *found, *entries]
        add_legend(axes, explained, trails)
    if path is not None:
        save(axes.figure, path)
    return axes


def plot_grid(
    panels: Sequence[Callable[[Axes], Any]], path: str | Path, *, columns: int = 3, size: float = 4.5
) -> Figure:
    """Several pictures in one file.

    Args:
        panels: functions that draw on the axes they are given, such as
            ``lambda axes: plot_segment(segment, axes)``.
        path: file to write (png, pdf or svg).
        columns: pictures per row, at most.
        size: inches a picture is wide and high.

    Raises:
        ValueError: no panels.
        ConfigError: a file of another kind.
    """
    if not panels:
        raise ValueError("no panels to draw")
    file = picture_path(path)
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(size * columns, size * rows)
    grid = figure.add_gridspec(rows, columns)
    for k, draw in enumerate(panels):
        draw(figure.add_subplot(grid[k // columns, k % columns]))
    save(figure, file)
    return figure


def _own_view(trails: NDArray[Any], target: Target) -> View:
    """Around trails [P, 2]; a square where it is one panel among others, so that all are of one size."""
    view = view_around(trails)
    return with_aspect(view) if isinstance(target, Axes) else view


@dataclass(frozen=True)
class Rollouts:
    """K rollouts of the N agents that are not padding; see :func:`plot_rollout` for the arrays."""

    position: NDArray[np.float64]
    heading: NDArray[np.float64]
    valid: NDArray[np.bool_]
    agents: NDArray[np.int64]
    collision: NDArray[np.bool_] | None
    offroad: NDArray[np.bool_] | None

    @classmethod
    def of(
        cls,
        segment: RunSegment,
        position: Any,
        heading: Any,
        agents: Any,
        start: int,
        valid: Any,
        collision: Any,
        offroad: Any,
    ) -> Rollouts:
        """Check what was given against the segment and leave the padding out."""
        position, heading = np.asarray(position, np.float64), np.asarray(heading, np.float64)
        agents = np.asarray(agents, np.int64)
        shape = heading.shape
        if len(shape) != 3 or position.shape != (*shape, 2):
            raise ValueError(f"position {position.shape}, heading {shape}: must be [K, N, T, 2], [K, N, T]")
        if agents.shape != shape[1:2] or (agents >= segment.num_agents).any():
            raise ValueError(f"agent_index {agents.tolist()}: must name {shape[1]} agents of the segment")
        if start < 0 or start + shape[2] > segment.num_steps:
            end = start + shape[2] - 1
            raise ValueError(f"steps {start} to {end} are outside the {segment.num_steps} of the log")
        seen = np.broadcast_to(np.ones((), bool) if valid is None else np.asarray(valid, bool), shape)
        seen = seen & np.isfinite(position).all(-1) & np.isfinite(heading)
        events = []
        for name, event in (("collision", collision), ("offroad", offroad)):
            array = None if event is None else np.asarray(event, bool)
            if array is not None and array.shape != shape:
                raise ValueError(f"{name} {array.shape}: must be [K, N, T] = {list(shape)}")
            events.append(array)
        kept = agents >= 0
        cut = [None if array is None else array[:, kept] for array in events]
        return cls(position[:, kept], heading[:, kept], seen[:, kept], agents[kept], cut[0], cut[1])

    @property
    def distinct(self) -> int:
        """How many of the rollouts differ: leaves of a search may share all of their history."""
        known = self.valid[..., None]
        state = np.concatenate([self.position, self.heading[..., None]], -1)
        rows = np.concatenate([np.where(known, state, 0.0), known], -1).reshape(len(state), -1)
        return len(np.unique(rows, axis=0))

    def words(self) -> str:
        """Such as `16 rollouts, 3 distinct`."""
        count = len(self.position)
        same = f", {self.distinct} distinct" if self.distinct < count else ""
        return f"{count} rollout{'s' if count > 1 else ''}{same}"

    def until(self, step: int) -> Rollouts:
        """As if they ended after a step."""
        past = slice(0, step + 1)
        return Rollouts(
            self.position[:, :, past],
            self.heading[:, :, past],
            self.valid[:, :, past],
            self.agents,
            None if self.collision is None else self.collision[:, :, past],
            None if self.offroad is None else self.offroad[:, :, past],
        )


def _draw_agent(axes: Axes, runs: Rollouts, rank: int, size: NDArray[Any], color: str) -> None:
    """One agent's path in every rollout, and its box at the last valid step of each."""
    agent, count = runs.agents[rank], len(runs.position)
    lines: list[NDArray[Any]] = []
    ends: list[tuple[int, int]] = []
    for k in range(count):
        valid = runs.valid[k, rank]
        lines.extend(pieces(runs.position[k, rank], valid)[0])
        if valid.any():
            ends.append((k, int(np.flatnonzero(valid)[-1])))
    alpha = float(np.clip(2.5 / count, 0.3, 0.9))
    axes.add_collection(
        LineCollection(
            lines, colors=[to_rgba(color, alpha)], linewidths=1.6, zorder=8, gid=f"rollouts-{agent}"
        ),
        autolim=False,
    )
    if ends:
        k, t = np.asarray(ends).T
        sizes = np.broadcast_to(size, (len(k), len(size)))
        at = runs.position[k, rank, t], runs.heading[k, rank, t], sizes
        draw_boxes(axes, *at, color, alpha=max(alpha, 0.45), gid=f"ends-{agent}")


def beginnings(runs: Rollouts, name: str) -> NDArray[np.bool_]:
    """[K, N, T] where each run of true steps of an event begins; nowhere if it is not known."""
    event = getattr(runs, name)
    if event is None:
        return np.zeros_like(runs.valid)
    happening = event & runs.valid
    return happening & ~np.pad(happening[..., :-1], ((0, 0), (0, 0), (1, 0)))


def draw_events(axes: Axes, runs: Rollouts, name: str, label: str, marker: str) -> Line2D | None:
    """Mark where each run of true steps of an event begins; None where there is none."""
    points = runs.position[beginnings(runs, name)]
    if len(points) == 0:
        return None
    style: dict[str, Any] = {"marker": marker, "linewidths": 0.9, "edgecolors": "white"}
    axes.scatter(points[:, 0], points[:, 1], s=60, c=INK, zorder=12, gid=name, **style)
    return Line2D([], [], linestyle="none", marker=marker, color=INK, markersize=6.5, label=label)


def draw_hit(
    axes: Axes, segment: RunSegment, runs: Rollouts, others: NDArray[Any], start: int
) -> Patch | None:
    """Outline the playback agents among ``others`` [K] that were hit, where they were when it began.

    Returns:
        Legend entry, None where nobody was hit.
    """
    found: set[tuple[int, int]] = set()
    for rollout, rank, at in np.argwhere(beginnings(runs, "collision")).tolist():
        step = start + at
        near = others[segment.valid[others, step]]
        boxes = [_box(segment.position[a, step], segment.heading[a, step], segment.size[a]) for a in near]
        own = _box(
            runs.position[rollout, rank, at], runs.heading[rollout, rank, at], segment.size[runs.agents[rank]]
        )
        found |= {(int(agent), step) for agent, box in zip(near, boxes, strict=True) if own.intersects(box)}
    if not found:
        return None
    agent, step = np.array(sorted(found)).T
    corners = place(CORNERS, segment.position[agent, step], segment.heading[agent, step], segment.size[agent])
    style: dict[str, Any] = {"facecolors": [to_rgba(PLAYBACK, 0.55)], "edgecolors": INK, "linewidths": 0.8}
    axes.add_collection(PolyCollection(list(corners), zorder=7.8, gid="hit", **style), autolim=False)
    return Patch(facecolor=to_rgba(PLAYBACK, 0.55), edgecolor=INK, label="playback, when it was hit")


def _box(position: NDArray[Any], heading: float, size: NDArray[Any]) -> shapely.Polygon:
    return shapely.Polygon(place(CORNERS, position[None], np.array([heading]), size[None])[0])


def draw_playback(axes: Axes, segment: RunSegment, step: int, agents: NDArray[Any]) -> None:
    """Draw those of the agents [K] that are seen at a step, in grey."""
    shown = agents[segment.valid[agents, step]]
    if len(shown):
        at = segment.position[shown, step, :2], segment.heading[shown, step], segment.size[shown]
        draw_boxes(axes, *at, PLAYBACK, zorder=7.5, gid="playback")


def _highlighted(segment: RunSegment, interactive: Sequence[int]) -> list[int]:
    """The ego, then the interactive agents, each once."""
    chosen = list(dict.fromkeys([segment.ego, *(int(agent) for agent in interactive)]))
    if min(chosen) < 0 or max(chosen) >= segment.num_agents:
        raise ValueError(f"interactive {chosen[1:]}: the segment has {segment.num_agents} agents")
    return chosen


def colors_of(segment: RunSegment, agents: Any) -> list[str]:
    """One for each agent: the ego's is the same in every picture."""
    others = [int(agent) for agent in agents if agent != segment.ego]
    return [agent_color(0 if agent == segment.ego else 1 + others.index(int(agent))) for agent in agents]


def describe(segment: RunSegment) -> str:
    """Source, duration, rate and agents of a segment, for a caption."""
    duration = (segment.num_steps - 1) * segment.dt
    return (
        f"{segment.source}   ·   {duration:.1f} s at {1 / segment.dt:g} Hz   ·   {segment.num_agents} agents"
    )


def agent_entries(segment: RunSegment, agents: Any) -> list[Patch]:
    """Legend entries of agents in colour, of a crowd the first :data:`ENTRIES`."""

    def label(agent: int) -> str:
        role = "ego" if agent == segment.ego else "interactive"
        return f"{role} {AgentType(segment.agent_type[agent]).name.lower()} {segment.agent_id[agent]}"

    colors = colors_of(segment, agents)
    shown = list(zip(agents, colors, strict=True))[:ENTRIES]
    entries = [Patch(color=color, label=label(int(agent))) for agent, color in shown]
    more = [Patch(color="none", label=f"and {len(agents) - ENTRIES} more in colour")]
    return entries + more * (len(agents) > ENTRIES)


def playback_entry(label: str = "playback") -> Patch:
    """Legend entry of the agents in grey."""
    return Patch(color=PLAYBACK, label=label)
