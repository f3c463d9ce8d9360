"""Draw run segments, routes, the curves of a training, the paper's figure of curvature."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from symphony.cli.shared import Names, at_least, segment_index, segment_indices
from symphony.errors import ConfigError, DataError

app = tyro.extras.SubcommandApp()

Picture = Annotated[Path, tyro.conf.arg(metavar="FILE")]
Runs = Annotated[
    tyro.conf.Positional[tuple[Path, ...]],
    tyro.conf.arg(metavar="RUN ...", help_behavior_hint="(required)"),
]


@app.command(name="curvature")
@dataclass(frozen=True)
class Curvature:
    """Draw how often the policy, and the log, visit branching regions of each average curvature.

    A panel for each run, from what `symphony evaluate` found; left turns are positive (in the paper, right turns).
    """

    runs: Runs
    """Folders of runs, or `pretrained:NAME`."""
    out: Picture
    """Picture to write (.png, .pdf or .svg)."""
    evaluation: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Name of the evaluation of a run that counts, as in `symphony table`."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ConfigError("no runs given")

    def run(self) -> None:
        """Draw them."""
        import numpy as np

        from symphony.agents.included import run_folder
        from symphony.evaluation.records import choose_evaluation, kept_evaluations, read_run
        from symphony.evaluation.table import method_name
        from symphony.metrics import jensen_shannon
        from symphony.render.curves import plot_curvature
        from symphony.render.style import picture_path

        picture_path(self.out)
        panels = {}
        for run, name in zip(self.runs, run_names(self.runs), strict=True):
            folder = run_folder(run)
            if not (folder / "config.json").is_file():
                raise ConfigError(f"{folder} is no run: it has no config.json")
            held = choose_evaluation(folder, kept_evaluations(folder), self.evaluation)[1]["curvature"]
            try:
                policy, log = (np.array(held[part], dtype=np.int64) for part in ("policy", "log"))
                divergence = 1000 * float(jensen_shannon(policy, log))
            except (ValueError, TypeError) as error:
                raise DataError(f"no histogram ({error})", file=folder, field="curvature") from error
            score = f"JSD {divergence:.2f} · 10⁻³".replace(" ", "\N{NO-BREAK SPACE}")  # on one line
            panels[f"{method_name(read_run(folder)['method'])} ({name}): {score}"] = policy, log
        plot_curvature(panels, self.out)


@app.command(name="curves")
@dataclass(frozen=True)
class Curves:
    """Draw the training curves of one or several runs, a panel for each metric."""

    runs: Runs
    """Folders of runs, still training or done."""
    out: Picture
    """Picture to write (.png, .pdf or .svg)."""
    metrics: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Names of the only metrics to draw; by default all there are."""
    window: float = 0.1
    """Share of a run's records that a point of the smoothed line is averaged over; 0 for not smoothing."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ConfigError("no runs given")
        if not 0 <= self.window <= 1:
            raise ConfigError(f"--window must be from 0 to 1, is {self.window}")

    def run(self) -> None:
        """Draw them."""
        from symphony.render.curves import plot_curves
        from symphony.training.logging import read_metrics

        found = {}
        for folder, name in zip(self.runs, run_names(self.runs), strict=True):
            if not (folder / "metrics.jsonl").is_file():
                raise ConfigError(f"{folder} is no run: it has no metrics.jsonl")
            found[name] = read_metrics(folder)
            if not found[name]:
                raise DataError("no metrics recorded yet", file=folder / "metrics.jsonl")
        plot_curves(found, self.out, metrics=self.metrics, window=self.window)


@app.command(name="segment")
@dataclass(frozen=True)
class Segment:
    """Draw a run segment: map, lights and agents, with the tracks of the whole window."""

    store: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """Folder of the store."""
    segment: str
    """Id of the run segment, or its number in the store."""
    out: Picture
    """Picture to write (.png, .pdf or .svg)."""
    interactive: int = 2
    """Agents in colour, the ego included."""
    step: int = 0
    """Step at which boxes and lights are shown."""

    def run(self) -> None:
        """Draw it."""
        from symphony.data.selection import interactive_choice
        from symphony.data.store import SegmentStore
        from symphony.render.plots import plot_segment
        from symphony.render.style import picture_path

        picture_path(self.out)
        store = SegmentStore(self.store)
        segment = store[segment_index(store, self.segment)]
        if not 0 <= self.step < segment.num_steps:
            raise ConfigError(f"--step {self.step} is outside the {segment.num_steps} steps of the segment")
        at_least(1, interactive=self.interactive)
        choice = interactive_choice(segment, self.interactive)
        title = segment.segment_id + (f" ({choice.context})" if choice.context else "")
        plot_segment(segment, self.out, step=self.step, interactive=choice.agents.tolist(), title=title)


@app.command(name="routes")
@dataclass(frozen=True)
class Routes:
    """Draw the feasible routes of agents on the map, and mark the one that each took.

    A panel is drawn for each interactive agent of each run segment.
    """

    data: Path
    """Store of run segments."""
    out: Picture
    """Picture to write (.png, .pdf or .svg)."""
    segments: Names = ()
    """Ids of the run segments, or their numbers in the store; by default three, spread evenly over the store."""
    interactive: int = 2
    """Agents of each run segment, the ego included."""

    def __post_init__(self) -> None:
        at_least(1, interactive=self.interactive)

    def run(self) -> None:
        """Find the routes and draw them."""
        from symphony.data.selection import interactive_choice
        from symphony.data.store import SegmentStore
        from symphony.envs.routes import route_table
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.render.plots import plot_grid, plot_routes
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
