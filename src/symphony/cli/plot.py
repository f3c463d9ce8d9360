"""Draw run segments, routes, the curves of a training, the paper's figure of curvature."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import symphony
from symphony import errors, render
from symphony.cli import shared
from symphony.config.checks import Bounds, Count

Runs = Annotated[Positional[shared.Paths], Bounds(distinct=True), arg(metavar="RUN ...", help="Run folders.")]


class Curvature(shared.Command):
    """Draw how often the policy, and the log, visit branching regions of each average curvature.

    Each run (or `pretrained:NAME`) has a panel, from the results of `symphony evaluate`; left turns are positive (in
    the paper, right turns).
    """

    runs: Runs
    out: shared.Picture
    evaluation: shared.Names = ()  # Name of the evaluation to take of a run, as in `symphony table`.

    def __call__(self) -> None:
        import numpy as np

        from symphony.agents.choice import split_name
        from symphony.evaluation.records import choose_evaluation, kept_evaluations, read_run
        from symphony.evaluation.table import method_name
        from symphony.metrics import jensen_shannon

        panels = {}
        for run in self.runs:
            folder = split_name(str(run))[0]
            method = method_name(read_run(folder)["method"])
            held = choose_evaluation(folder, kept_evaluations(folder), self.evaluation)["curvature"]
            counts = np.array([held.get("policy"), held.get("log")], dtype=object)  # of lists of one length
            if counts.ndim != 2 or not all(type(n) is int and 0 <= n < 1 << 53 for n in counts.flat):
                raise errors.DataError("an evaluation holds no counts", file=folder, field="curvature")
            policy, log = counts.astype(np.int64)
            title = f"{method} ({run}): JSD {1000 * float(jensen_shannon(policy, log)):.2f} · 10⁻³"
            panels[title] = policy, log
        render.plot_curvature(panels, self.out)


class Curves(shared.Command):
    """Draw the training curves of one or several runs, a panel for each metric."""

    runs: Runs
    out: shared.Picture
    metrics: shared.Names = ()  # Names of the metrics to draw; by default all.
    #: Share of a run's records that a point is averaged over; 0 for no smoothing.
    window: Annotated[float, Bounds(0, 1)] = 0.1

    def __call__(self) -> None:
        from symphony.training.logging import read_metrics

        found = {str(folder): read_metrics(folder) for folder in self.runs}
        if empty := [folder for folder, records in found.items() if not records]:
            raise errors.DataError("is not a run: it holds no metrics.jsonl with records", file=empty[0])
        render.plot_curves(found, self.out, metrics=self.metrics, window=self.window)


class Segment(shared.Command):
    """Draw a run segment: map, lights and agents, with the tracks of the whole log."""

    store: shared.Store
    segment: str  # Id of the run segment, or its number in the store.
    out: shared.Picture
    interactive: Count = 2  # Agents in colour, the ego included.
    step: int = 0  # Step at which boxes and lights are shown.

    def __call__(self) -> None:
        from symphony.data.selection import interactive_choice
        from symphony.render.style import picture_path

        picture_path(self.out)
        store = symphony.SegmentStore(self.store)
        segment = store[shared.segment_indices(store, [self.segment])[0]]
        if not 0 <= self.step < segment.num_steps:
            raise errors.ConfigError(f"--step {self.step}: the segment has {segment.num_steps} steps")
        choice = interactive_choice(segment, self.interactive)
        title = segment.segment_id + (f" ({choice.context})" if choice.context else "")
        render.plot_segment(segment, self.out, step=self.step, interactive=choice.agents.tolist(), title=title)


class Routes(shared.Command):
    """Draw the feasible routes of agents on the map, and mark the one that each took.

    One panel shows one interactive agent of a run segment; by default of three segments, spread over the store.
    """

    data: Path  # Store of run segments.
    out: shared.Picture
    segments: shared.Segments = ()
    interactive: Count = 2  # Agents of each run segment, the ego included.

    def __call__(self) -> None:
        from symphony.data.selection import interactive_choice
        from symphony.envs.routes import route_table
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.roadgraph import LaneGraph

        store, panels = symphony.SegmentStore(self.data).filled(), []
        for number in shared.segment_indices(store, self.segments) or evenly_spaced(len(store), 3):
            segment = store[number]
            graph = LaneGraph(segment.road)
            for agent in interactive_choice(segment, self.interactive, fewer=True).agents.tolist():
                table = route_table(segment, graph, agent)
                lines = [table.line(route) for route in range(len(table.count))]
                panels.append(partial(render.plot_routes, segment, agent, lines, table.logged))
        render.plot_grid(panels, self.out, columns=self.interactive if self.interactive > 1 else 3, size=6.0)
