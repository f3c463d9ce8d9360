"""Draw run segments, routes, what agents do, the tree of a search, the curves of a training, the paper's figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from symphony.cli.curvature import Curvature
from symphony.cli.helps import TrustCode
from symphony.cli.tables import short_name
from symphony.config import EvaluateConfig
from symphony.errors import ConfigError, DataError

if TYPE_CHECKING:
    from symphony.data.store import SegmentStore

app = tyro.extras.SubcommandApp()
app.command(name="curvature")(Curvature)


@app.command(name="tree")
@dataclass(frozen=True)
class Tree:
    """Draw the beam search of one run segment: every branch on the map and over time, coloured by what the
    discriminator says of it; what was pruned is pale.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Folder of a run that was trained with search (see `symphony train`), or `pretrained:NAME`."""
    data: Path
    """Store of run segments."""
    segment: str
    """The segment's id, or its number in the store."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Picture to write (.png, .pdf or .svg)."""
    trust_code: TrustCode = False
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)

    def run(self) -> None:
        """Search and draw."""
        from symphony.agents import load_agent
        from symphony.data.store import SegmentStore
        from symphony.evaluation.pictures import search_tree
        from symphony.render import plot_search
        from symphony.render.style import picture_path
        from symphony.rollouts.crowd import crowd_dataset

        picture_path(self.out)
        agent, config = load_agent(self.agent, self.config.device, trust_code=self.trust_code), self.config
        store = SegmentStore(self.data)
        dataset = crowd_dataset(store, agent, config, [segment_index(store, self.segment)])
        plot_search(dataset.segment(0), search_tree(agent, dataset, 0, config), self.out)


@app.command(name="rollouts")
@dataclass(frozen=True)
class Rollouts:
    """Draw what an agent does beside the log, or animate it.

    The rollouts are those that `symphony evaluate` counts with the same settings.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Folder of a run (see `symphony train`), `pretrained:NAME`, `playback`, `constant_velocity` or `idm`."""
    data: Path
    """Store of run segments."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Picture to write (.png, .pdf or .svg), or animation (.gif)."""
    segments: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID ...")] = ()
    """Their ids, or their numbers in the store; by default some, spread evenly over the store."""
    panels: int = 3
    """How many, if none are named."""
    drawn: int = 8
    """Rollouts drawn of each segment, at most."""
    trust_code: TrustCode = False
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)

    def __post_init__(self) -> None:
        for name in ("panels", "drawn"):
            if getattr(self, name) < 1:
                raise ConfigError(f"--{name} must be at least 1, is {getattr(self, name)}")

    def run(self) -> None:
        """Simulate and draw."""
        from symphony.agents import load_agent
        from symphony.cli.evaluate import segments_bar
        from symphony.data.store import SegmentStore
        from symphony.evaluation.evaluator import evaluate_dataset
        from symphony.evaluation.pictures import ClipKeeper, check_picture, draw_clips
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.rollouts.crowd import crowd_dataset

        check_picture(self.out)
        agent, store, config = (
            load_agent(self.agent, self.config.device, trust_code=self.trust_code),
            SegmentStore(self.data),
            self.config,
        )
        if len(store) == 0:
            raise DataError("the store holds no run segments", file=store.path)
        chosen = segment_indices(store, self.segments)
        dataset = crowd_dataset(store, agent, config, chosen or evenly_spaced(len(store), self.panels))
        clips = ClipKeeper(range(len(dataset)), self.drawn, f"{short_name(agent.name)}: ")
        with segments_bar(f"simulating {agent.name}") as advance:
            evaluate_dataset(agent, dataset, config, advance, observe=clips)
        draw_clips(clips.clips, self.out)


@app.command(name="curves")
@dataclass(frozen=True)
class Curves:
    """Draw the training curves of one or several runs, a panel for each metric."""

    runs: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="RUN ...", help_behavior_hint="(required)"),
    ]
    """Folders of runs, still training or done."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Picture to write (.png, .pdf or .svg)."""
    metrics: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Draw these metrics only; by default all there are."""
    window: float = 0.1
    """Share of a run's records that a point of the smoothed line is averaged over; 0 for not smoothing."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ConfigError("no runs given")
        if not 0 <= self.window <= 1:
            raise ConfigError(f"--window must be from 0 to 1, is {self.window}")

    def run(self) -> None:
        """Draw them."""
        from symphony.render import plot_curves
        from symphony.training.logging import read_metrics

        found = {}
        for folder, name in zip(self.runs, run_names(self.runs), strict=True):
            if not (folder / "metrics.jsonl").is_file():
                raise ConfigError(f"{folder} is no run: it has no metrics.jsonl")
            found[name] = read_metrics(folder)
            if not found[name]:
                raise DataError("no metrics recorded yet", file=folder / "metrics.jsonl")
        try:
            plot_curves(found, self.out, metrics=self.metrics, window=self.window)
        except ValueError as error:
            raise ConfigError(str(error)) from error


@app.command(name="segment")
@dataclass(frozen=True)
class Segment:
    """Draw a run segment: map, lights and agents, with the tracks of the whole window."""

    store: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """Folder of the store."""
    segment: str
    """Its id, or its number in the store."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Picture to write (.png, .pdf or .svg)."""
    interactive: int = 2
    """Agents in colour, the ego included."""
    step: int = 0
    """Step at which boxes and lights are shown."""

    def run(self) -> None:
        """Draw it."""
        from symphony.data.selection import interactive_choice
        from symphony.data.store import SegmentStore
        from symphony.render import plot_segment
        from symphony.render.style import picture_path

        picture_path(self.out)
        store = SegmentStore(self.store)
        segment = store[segment_index(store, self.segment)]
        if not 0 <= self.step < segment.num_steps:
            raise ConfigError(f"--step {self.step} is outside the {segment.num_steps} steps of the segment")
        if self.interactive < 1:
            raise ConfigError(f"--interactive must be at least 1, is {self.interactive}")
        choice = interactive_choice(segment, self.interactive)
        title = segment.segment_id + (f" ({choice.context})" if choice.context else "")
        chosen = choice.agents.tolist()
        plot_segment(segment, self.out, step=self.step, interactive=chosen, title=title)


@app.command(name="routes")
@dataclass(frozen=True)
class Routes:
    """Draw the feasible routes of agents on the map, and mark the one that each took.

    A panel is drawn for each interactive agent of each segment.
    """

    data: Path
    """Store of run segments."""
    out: Path
    """Picture to write (.png, .pdf or .svg)."""
    segments: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID ...")] = ()
    """Their ids, or their numbers in the store; by default three, spread evenly over the store."""
    interactive: int = 2
    """Agents of each segment, the ego included."""

    def __post_init__(self) -> None:
        if self.interactive < 1:
            raise ConfigError(f"--interactive must be at least 1, is {self.interactive}")

    def run(self) -> None:
        """Find the routes and draw them."""
        from functools import partial

        from symphony.data.selection import interactive_choice
        from symphony.data.store import SegmentStore
        from symphony.envs.routes import route_table
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.render import plot_grid, plot_routes
        from symphony.roadgraph import LaneGraph

        store = SegmentStore(self.data)
        if len(store) == 0:
            raise DataError("the store holds no run segments", file=store.path)
        panels = []
        for number in segment_indices(store, self.segments) or evenly_spaced(len(store), 3):
            segment = store[number]
            graph = LaneGraph(segment.road)
            for agent in interactive_choice(segment, self.interactive, fewer=True).agents.tolist():
                table = route_table(segment, graph, agent)
                lines = [table.line(route) for route in range(len(table.count))]
                panels.append(partial(plot_routes, segment, agent, lines, table.logged))
        plot_grid(panels, self.out, columns=self.interactive if self.interactive > 1 else 3, size=6.0)


def segment_index(store: SegmentStore, name: str) -> int:
    """Place in a store of a segment named by its id or its number.

    Raises:
        DataError: there is no such segment.
    """
    return store.index_of(int(name) if name not in store.ids and name.isdecimal() else name)


def segment_indices(store: SegmentStore, names: Sequence[str]) -> list[int]:
    """Places in a store of some segments, each named once.

    Raises:
        ConfigError: one is named twice, by its id or its number.
        DataError: there is no such segment.
    """
    found: dict[int, str] = {}
    for name in names:
        place = segment_index(store, name)
        if place in found:
            raise ConfigError(f"segment {store.ids[place]} is named twice: {found[place]}, {name}")
        found[place] = name
    return list(found)


def run_names(folders: tuple[Path, ...]) -> list[str]:
    """The folders' names, with as much of their paths as tells them apart.

    Raises:
        ConfigError: a folder given twice.
    """
    parts = [folder.resolve().parts for folder in folders]
    if len(set(parts)) < len(parts):
        raise ConfigError(f"a run is given twice among {', '.join(map(str, folders))}")
    length = 1
    while len({part[-length:] for part in parts}) < len(parts):
        length += 1
    return ["/".join(part[-length:]).replace("//", "/") for part in parts]
