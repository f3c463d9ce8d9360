"""Evaluate agents against the log."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from symphony.cli.helps import TrustCode
from symphony.cli.tables import print_metrics, short_name, write_numbers
from symphony.config import EvaluateConfig, WosacSettings
from symphony.config.evaluation import check_planner_seconds
from symphony.errors import ConfigError

if TYPE_CHECKING:
    from symphony.agents import Agent
    from symphony.data.store import SegmentStore
    from symphony.evaluation import EvaluatedBatch, Evaluation
    from symphony.evaluation.pictures import ClipKeeper


@dataclass(frozen=True)
class Evaluate:
    """Simulate the interactive agents of every run segment and compare them with the log.

    The log itself and agents at constant velocity are evaluated beside the agent. A run keeps what was found in its
    folder, as evaluations/NAME.json, where `symphony table` looks for it; the same evaluation made again replaces it.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="playback|RUN")]
    """Folder of a run (see `symphony train`), `pretrained:NAME` (an agent that comes with the package), `playback`
    (the log itself), `constant_velocity` or `idm` (the intelligent driver model, along the route of the log)."""
    data: Path
    """Store of run segments to simulate."""
    segments: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID ...")] = ()
    """Only these run segments, by their ids or their numbers in the store; then the folder of the run is left as it
    is."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write all numbers to, those of every run segment included; - for standard output."""
    planner: str = ""
    """Evaluate a planner as the ego instead, among agents that the agent drives (among the log with `playback`): see
    `symphony simulate`. Its numbers are those of `symphony planners`; no folder of a run is touched."""
    planner_seconds: float = 60.0
    """Seconds that it has for one answer; a longer one fails the run."""
    figure: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Picture of some of the rollouts (.png, .pdf or .svg), or animation of them (.gif)."""
    save_rollouts: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder to keep the very rollouts in that are evaluated (see `symphony view`, `report` and `export`)."""
    details: bool = False
    """Print more than the table: kinds of collision, what the divergence owes to sampling, where agents stand at the
    end, what a search made of the goals, and what becomes of single agents. The file of `--json` has it all."""
    keep: bool = True
    """Leave the folder of the run as it is."""
    metrics: tuple[Literal["wosac"], ...] = ()
    """More scores for the record and for `symphony table`: `wosac`, of 32 rollouts of everyone for 8 s, by the same
    search or without it (see docs/wosac.md)."""
    wosac_config: Literal["2024", "2025"] = "2025"
    """Year of the challenge whose weights the WOSAC score has."""
    trust_code: TrustCode = False
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)

    def __post_init__(self) -> None:
        if self.planner and self.figure is not None:
            raise ConfigError(
                "--figure goes without --planner: keep the rollouts and draw them, symphony view"
            )
        if self.planner and (self.metrics or self.config.metric):
            raise ConfigError("--metrics and --metric go without --planner: they are of the agent")
        check_planner_seconds(self.planner_seconds)

    def run(self) -> None:
        """Evaluate, print the numbers and write them."""
        if self.planner:
            self._evaluate_planner()
            return
        if self.config.workers > 1 and self.config.engine == "local":
            from symphony.parallel import get_ready

            get_ready(["symphony.rollouts.workers", "symphony.evaluation.evaluator"])
        from symphony.agents import load_agent
        from symphony.cli.plot import segment_indices
        from symphony.data.store import SegmentStore
        from symphony.evaluation.records import evaluation_record, keep_evaluation
        from symphony.learning.demonstrations import evenly_spaced
        from symphony.saved.folder import About, RolloutWriter
        from symphony.saved.identity import identity_of
        from symphony.saved.saving import plain_settings

        if self.figure is not None:
            from symphony.evaluation.pictures import check_picture  # with matplotlib, which takes a while

            check_picture(self.figure)
        agent = load_agent(self.agent, self.config.device, trust_code=self.trust_code)
        store, config = SegmentStore(self.data), self.config
        chosen = segment_indices(store, self.segments)
        if self.metrics:
            from symphony.wosac.evaluate import scorable

            future = WosacSettings.of(config).future
            scorable(store, chosen or range(len(store)), future)  # or complain now, not after the work
        clips: ClipKeeper | None = None
        keepers: list[Callable[[EvaluatedBatch], None]] = []
        if self.figure is not None:
            from symphony.evaluation.pictures import PANELS, ClipKeeper

            shown = evenly_spaced(len(chosen or store), PANELS)
            clips = ClipKeeper(shown, title=f"{short_name(agent.name)}: ")
            keepers.append(clips)
        if self.save_rollouts is not None:
            from symphony.evaluation.pictures import RolloutKeeper

            plain = plain_settings(config, agent.interactive, agent.duration) | identity_of(agent)
            about = About.of(agent.name, store, plain, seed=config.seed)
            keepers.append(RolloutKeeper(RolloutWriter(self.save_rollouts, about), agent.name, config.others))

        def observe(batch: EvaluatedBatch) -> None:
            for keeper in keepers:
                keeper(batch)

        found = evaluate_with_bar(
            agent,
            store,
            config,
            observe=observe if keepers else None,
            baselines=True,
            items=chosen or None,
        )
        print_evaluation(found, self.data, aside=str(self.json) == "-", details=self.details)
        record = evaluation_record(agent, found, store)
        if "wosac" in self.metrics:
            settings = WosacSettings.of(config)
            record |= self._wosac(agent, store, chosen or range(len(store)), settings, record)
        if self.keep and not chosen:
            keep_evaluation(agent.name, record)
        if self.json is not None:
            write_numbers(self.json, record)
        if self.figure is not None and clips is not None:
            from symphony.evaluation.pictures import draw_clips

            draw_clips(clips.clips, self.figure)

    def _wosac(
        self,
        agent: Agent,
        store: SegmentStore,
        items: Sequence[int],
        settings: WosacSettings,
        record: dict[str, Any],
    ) -> dict[str, Any]:
        """Parts of the record with the WOSAC score."""
        from symphony.cli.wosac import print_wosac
        from symphony.wosac.evaluate import evaluate_wosac, wosac_parts

        with segments_bar(f"WOSAC score of {agent.name}") as advance:
            found = evaluate_wosac(agent, store, items, settings, self.wosac_config, advance)
        print_wosac(found, aside=str(self.json) == "-")
        return wosac_parts(found, record)

    def _evaluate_planner(self) -> None:
        from tempfile import TemporaryDirectory

        from symphony.cli.planners import table_text
        from symphony.cli.plot import segment_indices
        from symphony.cli.simulate import Simulate, tell_failed
        from symphony.data.store import SegmentStore
        from symphony.evaluation.planners import planner_record

        with TemporaryDirectory() as spare:
            folder = Simulate(
                agent=self.agent,
                data=self.data,
                out=self.save_rollouts or Path(spare),
                segments=self.segments,
                planner=self.planner,
                planner_seconds=self.planner_seconds,
                trust_code=self.trust_code,
                config=self.config,
            ).simulated()
            store = SegmentStore(self.data)
            chosen = segment_indices(store, self.segments) or range(len(store))
            folder = folder.only(store.ids[i] for i in chosen)
            record = planner_record(folder)
            if self.json is not None:
                write_numbers(self.json, record)
            (sys.stderr if str(self.json) == "-" else sys.stdout).write(table_text([record]))
            tell_failed(folder, lambda line: sys.stderr.write(f"{line}\n"))


def print_evaluation(found: Evaluation, data: Path, *, aside: bool = False, details: bool = False) -> None:
    """Print baselines and agent as one table (see :func:`~symphony.cli.tables.print_metrics`)."""
    others = [baseline.numbers() for baseline in found.baselines if baseline.agent != found.agent]
    print_metrics([*others, found.numbers()], title=str(data), aside=aside, details=details)


def evaluate_with_bar(
    agent: Agent | str,
    data: SegmentStore | Path,
    config: EvaluateConfig,
    *,
    baselines: bool = False,
    observe: Callable[[EvaluatedBatch], None] | None = None,
    items: Sequence[int] | None = None,
) -> Evaluation:
    """Evaluate an agent on a store, or on some of its items, showing on stderr how far it is."""
    from symphony.evaluation import evaluate

    with segments_bar(f"evaluating {agent if isinstance(agent, str) else agent.name}") as advance:
        return evaluate(agent, data, config, advance, items=items, baselines=baselines, observe=observe)


def segments_bar(description: str) -> Any:
    """A progress bar on stderr, as a context that gives a function of the segments done and their total."""
    from contextlib import contextmanager

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    @contextmanager
    def bar() -> Any:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("segments"),
        )
        with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as shown:
            task = shown.add_task(description, total=None)
            yield lambda done, total: shown.update(task, completed=done, total=total)

    return bar()
