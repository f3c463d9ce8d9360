"""The tree of a beam search over a run segment: what was simulated and what was pruned, on the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, to_hex, to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from symphony.data.segment import RunSegment
from symphony.render.agents import draw_boxes, draw_trails
from symphony.render.plots import (
    EVENTS,
    LOG_DASHES,
    agent_entries,
    colors_of,
    describe,
    draw_playback,
    playback_entry,
)
from symphony.render.roads import draw_roads, draw_signals, outline
from symphony.render.style import (
    AGENT_COLORS,
    INK,
    PLAYBACK,
    ROAD,
    Target,
    View,
    add_legend,
    font,
    frame,
    open_target,
    save,
    view_around,
)

WIDTH = 2.6
"""Metres, of the band that stands for a route: a little more than a car."""
BAND = 0.75
"""Share of white in its colour."""
SCORE_LABEL = "discriminator logit: high = looks simulated"
LEAF, DIED_OUT, PRUNED = range(3)
"""What became of a branch in a period: part of a leaf's history, survived the pruning right after but left no leaf,
pruned.
"""
FATES = ("leaf", "died-out", "pruned")


@dataclass(frozen=True)
class _Stroke:
    """How branches of one fate are drawn; ``pale`` is the share of white in their colour."""

    label: str
    width: float
    pale: float
    zorder: float


STROKES = (
    _Stroke("branch: reaches the end", 2.4, 0.0, 9.0),
    _Stroke("branch: survived, died out later", 1.3, 0.2, 8.6),
    _Stroke("branch: pruned", 0.9, 0.4, 8.2),
)


@dataclass(frozen=True)
class SearchTree:
    """What a beam search simulated, by the slot and period that simulated it.

    S branches (slots), T steps in P periods, N agents; the last period may be shorter.

    Attributes:
        position: [S, T, N, 2] box centres after each step, metres; NaN where an agent is not there.
        score: [S, T, N] of those states; high is bad. NaN where there is none.
        parents: [P, S] after period p slot s was continued from slot ``parents[p, s]``.
        reaches_leaf: [P, S] bool, whether what a slot simulated in a period is part of a leaf's history.
        prune_every: T_p, steps per period.
        agents: [N] which agents of the segment these are; negative for padding.
        collision: [S, T, N] bool, or None.
        offroad: [S, T, N] bool, or None.
        routes: for each agent the points [K, 2] of the route it follows, or None; empty without goals.

    Raises:
        ValueError: shapes that don't fit together.
    """

    position: NDArray[Any]
    score: NDArray[Any]
    parents: NDArray[Any]
    reaches_leaf: NDArray[Any]
    prune_every: int
    agents: NDArray[Any]
    collision: NDArray[Any] | None = None
    offroad: NDArray[Any] | None = None
    routes: Sequence[NDArray[Any] | None] = ()

    def __post_init__(self) -> None:
        shape = self.score.shape
        if len(shape) != 3 or self.position.shape != (*shape, 2):
            raise ValueError(
                f"position {self.position.shape}, score {shape}: must be [S, T, N, 2], [S, T, N]"
            )
        if self.prune_every < 1:
            raise ValueError(f"prune_every must be positive, is {self.prune_every}")
        periods = (-(-shape[1] // self.prune_every), shape[0])
        if self.parents.shape != periods or self.reaches_leaf.shape != periods:
            found = f"parents {self.parents.shape}, reaches_leaf {self.reaches_leaf.shape}"
            raise ValueError(f"{found}: must be [P, S] = {list(periods)}")
        if ((self.parents < 0) | (self.parents >= shape[0])).any():
            raise ValueError(f"parents must be slots 0 ... {shape[0] - 1}")
        if self.agents.shape != shape[2:]:
            raise ValueError(f"agents {self.agents.tolist()}: must name {shape[2]} agents")
        for name in ("collision", "offroad"):
            event = getattr(self, name)
            if event is not None and event.shape != shape:
                raise ValueError(f"{name} {event.shape}: must be [S, T, N] = {list(shape)}")
        if self.routes and len(self.routes) != shape[2]:
            raise ValueError(f"routes: {len(self.routes)} for {shape[2]} agents")

    @property
    def fate(self) -> NDArray[np.int64]:
        """[P, S] what became of each branch: ``LEAF``, ``DIED_OUT`` or ``PRUNED``."""
        return np.where(self.reaches_leaf, LEAF, np.where(self.copies > 0, DIED_OUT, PRUNED))

    @property
    def copies(self) -> NDArray[np.int64]:
        """[P, S] how many slots were continued from what each slot simulated in a period."""
        slots = np.arange(self.parents.shape[1])
        return (self.parents[:, :, None] == slots).sum(1)

    @property
    def real(self) -> NDArray[np.int64]:
        """The agents that are not padding."""
        return np.flatnonzero(self.agents >= 0)

    def by_step(self, values: NDArray[Any]) -> NDArray[Any]:
        """[S, T] from values [P, S] of whole periods."""
        return values.repeat(self.prune_every, 0)[: self.score.shape[1]].T

    def before(self, values: NDArray[Any], first: Any) -> NDArray[Any]:
        """Values [S, T, ...] one step earlier in each branch's history, `first` before the first step."""
        earlier = np.concatenate([np.broadcast_to(first, values[:, :1].shape), values[:, :-1]], 1)
        for period, parents in enumerate(self.parents[:-1], start=1):
            begin = period * self.prune_every
            earlier[:, begin] = values[parents, begin - 1]
        return earlier


def plot_tree(
    segment: RunSegment,
    tree: SearchTree,
    target: Target,
    *,
    start: int = 0,
    view: View | None = None,
    title: str | None = None,
    legend: bool = True,
) -> Axes:
    """Draw the tree of a beam search over the map, each step of each agent coloured by its score.

    Boxes stand where the search begins. What reaches a leaf is thick and on top, what was pruned thin and pale.
    Branches along one lane cover each other; :func:`plot_genealogy` takes them apart.

    Args:
        segment: the log.
        tree: what was simulated.
        target: file to write (png, pdf or svg) or axes to draw on.
        start: step of the log at which the search begins.
        view: limits in metres; by default around the tree and the log of its agents.
        title: by default the segment's id.
        legend: whether to explain what is drawn.

    Raises:
        ValueError: agents or steps outside the segment.
        ConfigError: a file of another kind.
    """
    points = tree_points(segment, tree, start)
    view = view or view_around(points)
    axes, path = open_target(target, view)
    entries = draw_tree(axes, segment, tree, start, view, title)
    add_color_bar(axes, tree)
    if legend:
        add_legend(axes, entries, points)
    if path is not None:
        save(axes.figure, path)
    return axes


def tree_points(segment: RunSegment, tree: SearchTree, start: int) -> NDArray[Any]:
    """[K, 2] where the agents are in the tree and in the log, once both are known to fit together.

    Raises:
        ValueError: agents or steps outside the segment.
    """
    steps = tree.score.shape[1]
    if (tree.agents >= segment.num_agents).any():
        raise ValueError(f"agents {tree.agents.tolist()}: the segment has {segment.num_agents}")
    if start < 0 or start + steps >= segment.num_steps:
        raise ValueError(f"steps {start} to {start + steps} are outside the {segment.num_steps} of the log")
    log, logged = _log(segment, tree, start)
    simulated = tree.position[:, :, tree.real].reshape(-1, 2)
    return np.concatenate([simulated[np.isfinite(simulated).all(-1)], log[logged]])


def draw_tree(
    axes: Axes, segment: RunSegment, tree: SearchTree, start: int, view: View, title: str | None
) -> list[Any]:
    """Map, log and tree; see :func:`plot_tree`.

    Returns:
        Legend entries.
    """
    agents = tree.agents[tree.real]
    log, logged = _log(segment, tree, start)
    entries = draw_roads(axes, segment.road, view) + draw_signals(axes, segment, start, view)
    others = np.setdiff1d(np.arange(segment.num_agents), agents)
    trails, seen = (values[others, start:] for values in (segment.position[..., :2], segment.valid))
    draw_trails(axes, trails, seen, PLAYBACK, step=0, width=0.9, strength=0.6, zorder=7)
    draw_playback(axes, segment, start, others)
    for rank, (n, agent) in enumerate(zip(tree.real, agents, strict=True)):
        color = colors_of(segment, agents)[rank]
        if tree.routes and tree.routes[n] is not None:
            # Narrower one after the other, for agents on one route.
            width = WIDTH * (1 - 0.5 * rank / len(agents))
            _draw_route(axes, tree.routes[n], width, color, f"route-{agent}")
        first = np.where(logged[rank, :1], log[rank, 0], np.nan)
        position = tree.position[:, :, n]
        paths = np.stack([tree.before(position, first), position], 2)
        draw_branches(axes, tree, paths, tree.score[:, :, n], str(agent))
        shown = np.where(logged[rank, :, None], log[rank], np.nan)
        # Dark dashes on dark branches need a light edge.
        style: dict[str, Any] = {"linestyle": LOG_DASHES, "linewidth": 1.2, "zorder": 9.4}
        axes.plot(
            *shown.T,
            color=INK,
            path_effects=[withStroke(linewidth=2.8, foreground=ROAD)],
            **style,
            gid=f"log-{agent}",
        )
        if logged[rank, 0]:
            box = log[rank, :1], segment.heading[[agent], start], segment.size[[agent]]
            draw_boxes(axes, *box, color, gid=f"box-{agent}")
    places = tree.position[:, :, tree.real]
    forks = draw_forks(axes, tree, places)
    events = [draw_events(axes, tree, places, *event) for event in EVENTS]
    period = f"pruned every {tree.prune_every * segment.dt:g} s"
    subtitle = f"{describe(segment)}   ·   beam search, {len(tree.score)} branches, {period}"
    frame(axes, view, title or segment.segment_id, subtitle)
    lines = [Line2D([], [], color=INK, linestyle=LOG_DASHES, linewidth=1.1, label="log")]
    if any(line is not None for line in tree.routes):
        lines.append(
            Line2D([], [], color=_pale(AGENT_COLORS[0], BAND), linewidth=7, label="route it follows")
        )
    strokes = [_stroke_entry(kind) for kind in np.unique(tree.fate)]
    marks = filter(None, [forks, *events])
    playback = playback_entry("playback, at the start")
    return [*agent_entries(segment, agents), *lines, *strokes, *marks, playback, *entries]


def _log(segment: RunSegment, tree: SearchTree, start: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Positions [N, T + 1, 2] and validity of the tree's agents in the log, padding left out."""
    agents, steps = tree.agents[tree.real], slice(start, start + tree.score.shape[1] + 1)
    return segment.position[agents, steps, :2], segment.valid[agents, steps]


def score_colors(tree: SearchTree) -> tuple[Colormap, Normalize]:
    """Colour map, dark to bright, and scale of the scores; a few extreme ones don't squeeze the others."""
    # The bright end of the map can't be seen on white.
    shade = LinearSegmentedColormap.from_list("score", colormaps["plasma"](np.linspace(0.0, 0.78, 64)))
    score = tree.score[..., tree.real]
    score = score[np.isfinite(score)]
    low, high = np.percentile(score, [1, 99]).tolist() if len(score) else (0.0, 1.0)
    return shade, Normalize(low, high if high > low else low + 1.0, clip=True)


def draw_branches(axes: Axes, tree: SearchTree, paths: NDArray[Any], score: NDArray[Any], name: str) -> None:
    """Draw steps [S, T, 2 ends, 2] coloured by scores [S, T], one collection per fate."""
    shade, norm = score_colors(tree)
    drawn = np.isfinite(paths).all((-2, -1))
    for kind, stroke in enumerate(STROKES):
        chosen = drawn & (tree.by_step(tree.fate) == kind)
        if not chosen.any():
            continue
        color = shade(norm(np.nan_to_num(score[chosen])))[:, :3]
        axes.add_collection(
            LineCollection(
                list(paths[chosen]),
                colors=stroke.pale + (1 - stroke.pale) * color,
                linewidths=stroke.width,
                capstyle="round",
                zorder=stroke.zorder,
                gid=f"{FATES[kind]}-{name}",
            ),
            autolim=False,
        )


def draw_forks(axes: Axes, tree: SearchTree, places: NDArray[Any]) -> Line2D | None:
    """A ring where what was simulated, at places [S, T, ..., 2], goes on in several copies.

    Returns:
        Legend entry, None without forks.
    """
    # After the last pruning nothing is simulated any more.
    period, slot = np.nonzero(tree.copies[:-1] > 1)
    if len(period) == 0:
        return None
    points = places[slot, (period + 1) * tree.prune_every - 1].reshape(-1, 2)
    style: dict[str, Any] = {"marker": "o", "linewidths": 0.8, "edgecolors": INK}
    axes.scatter(points[:, 0], points[:, 1], s=11, c="white", zorder=9.6, gid="forks", **style)
    shape: dict[str, Any] = {"color": "white", "markeredgecolor": INK, "markersize": 4}
    return Line2D([], [], linestyle="none", marker="o", label="fork", **shape)


def draw_events(
    axes: Axes, tree: SearchTree, places: NDArray[Any], name: str, label: str, marker: str
) -> Line2D | None:
    """Mark where, at places [S, T, N, 2], each run of true steps of an event begins; larger in a leaf's history.

    Returns:
        Legend entry, None where there is nothing to mark.
    """
    event = getattr(tree, name)
    if event is None:
        return None
    event = np.asarray(event, bool)[..., tree.real]
    begins = event & ~tree.before(event, False)
    leaf = tree.by_step(tree.reaches_leaf)[..., None]
    style: dict[str, Any] = {"marker": marker, "linewidths": 0.7, "edgecolors": "white"}
    for kind, chosen, size, color in (
        ("pruned", begins & ~leaf, 24, "#7B808A"),
        ("leaf", begins & leaf, 60, INK),
    ):
        points = places[chosen]
        if len(points):
            place: dict[str, Any] = {"s": size, "c": color, "zorder": 12 if kind == "leaf" else 11}
            axes.scatter(points[:, 0], points[:, 1], **place, gid=f"{name}-{kind}", **style)
    if not begins.any():
        return None
    return Line2D([], [], linestyle="none", marker=marker, color=INK, markersize=6.5, label=label)


def add_color_bar(axes: Axes, tree: SearchTree) -> None:
    """Explain the colours, to the right of the axes."""
    figure = axes.get_figure(root=True)
    assert figure is not None  # noqa: S101 - axes that are drawn on have one
    shade, norm = score_colors(tree)
    slot = axes.inset_axes((1.02, 0.0, 0.025, 1.0))
    bar = figure.colorbar(ScalarMappable(norm, shade), cax=slot, extend="both")
    bar.set_label(SCORE_LABEL, color=INK, fontsize=font(axes, 9))
    slot.tick_params(labelsize=font(axes, 8), color=INK, labelcolor=INK)
    bar.outline.set(edgecolor="#C8C4BC")
    slot.set_gid("scores")


def _draw_route(axes: Axes, route: Any, width: float, color: str, gid: str) -> None:
    """A pale band along points [K, 2]."""
    band = shapely.LineString(np.asarray(route)).buffer(width / 2, cap_style="flat")
    for polygon in shapely.get_parts(band):
        axes.add_patch(
            PathPatch(outline(polygon), facecolor=_pale(color, BAND), edgecolor="none", zorder=2.5, gid=gid)
        )


def _stroke_entry(kind: int) -> Line2D:
    stroke = STROKES[kind]
    return Line2D([], [], color=_pale(INK, stroke.pale), linewidth=stroke.width, label=stroke.label)


def _pale(color: str, share: float) -> str:
    """The colour with a share of white, opaque, so that overlaps of one thing with itself don't show."""
    red, green, blue = share * np.asarray(to_rgb(ROAD)) + (1 - share) * np.asarray(to_rgb(color))
    return to_hex((red, green, blue))
