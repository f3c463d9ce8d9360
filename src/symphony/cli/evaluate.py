"""Evaluate agents against the log."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from symphony.cli.planners import table_text
from symphony.cli.shared import (
    Names,
    ResultFile,
    TrustCode,
    print_evaluation,
    progress,
    segment_indices,
    short_name,
    write_numbers,
)
from symphony.cli.simulate import Simulate, tell_failed
from symphony.config import EvaluateConfig, WosacSettings
from symphony.config.evaluation import check_planner_seconds
from symphony.errors import ConfigError

if TYPE_CHECKING:
    from symphony.evaluation.evaluator import Observer
    from symphony.saved.rollouts import SavedRollouts


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
    segments: Names = ()
    """Ids of the only run segments to simulate, or their numbers in the store; the folder of the run is then left as
    it is."""
    json: ResultFile = None
    """File to write all numbers to, those of every run segment included; - for standard output."""
    planner: str = ""
    """Planner to evaluate as the ego instead, among agents that the agent drives (among the log with `playback`): see
    `symphony simulate`. Its numbers are those of `symphony planners`; no folder of a run is touched."""
    planner_seconds: float = 60.0
    """Seconds that a planner has for one answer; a longer one fails the run."""
    figure: ResultFile = None
    """Picture of some of the rollouts (.png, .pdf or .svg), or animation of them (.gif)."""
    save_rollouts: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the rollouts that are evaluated (see `symphony view`, `report` and `export`)."""
    details: bool = False
    """Print every number of each agent, not only the table: kinds of collision, what the divergence owes to sampling,
    where agents stand at the end, what a search made of the goals, and what becomes of single agents."""
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
        from symphony.data.store import SegmentStore
        from symphony.evaluation import evaluate
        from symphony.evaluation.records import evaluation_record, keep_evaluation

        if self.figure is not None or self.save_rollouts is not None:
            from symphony.evaluation import pictures  # with matplotlib, which takes a while
        if self.figure is not None:
            pictures.check_picture(self.figure)
        agent = load_agent(self.agent, self.config.device, trust_code=self.trust_code)
        store, config = SegmentStore(self.data), self.config
        chosen = segment_indices(store, self.segments)
        if self.metrics:
            from symphony.wosac.evaluate import scorable

            # Complain now, not after the work.
            scorable(store, chosen or range(len(store)), WosacSettings.of(config).future)
        keepers: list[Observer] = []
        if self.figure is not None:
            from symphony.learning.demonstrations import evenly_spaced

            shown = evenly_spaced(len(chosen or store), pictures.PANELS)
            clips = pictures.ClipKeeper(shown, title=f"{short_name(agent.name)}: ")
            keepers.append(clips)
        if self.save_rollouts is not None:
            from symphony.saved.folder import About, RolloutWriter
            from symphony.saved.identity import identity_of
            from symphony.saved.saving import plain_settings

            plain = plain_settings(config, agent.interactive, agent.duration) | identity_of(agent)
            about = About.of(agent.name, store, plain, seed=config.seed)
            keepers.append(pictures.RolloutKeeper(RolloutWriter(self.save_rollouts, about)))

        def observe(item: int, saved: SavedRollouts) -> None:
            for keeper in keepers:
                keeper(item, saved)

        watched: dict[str, Any] = {"observe": observe} if keepers else {}
        with progress(f"evaluating {agent.name}") as advance:
            found = evaluate(agent, store, config, advance, items=chosen or None, baselines=True, **watched)
        print_evaluation(found, self.data, aside=str(self.json) == "-", details=self.details)
        record = evaluation_record(agent, found, store)
        if self.metrics:
            from symphony.cli.wosac import print_wosac
            from symphony.wosac.evaluate import evaluate_wosac, wosac_parts

            items, settings = chosen or range(len(store)), WosacSettings.of(config)
            with progress(f"WOSAC score of {agent.name}") as advance:
                scored = evaluate_wosac(agent, store, items, settings, self.wosac_config, advance)
            print_wosac(scored, aside=str(self.json) == "-")
            record |= wosac_parts(scored, record)
        if self.keep and not chosen:
            keep_evaluation(agent.name, record)
        write_numbers(self.json, record)
        if self.figure is not None:
            from symphony.render.video import draw_clips

            draw_clips(clips.clips, self.figure)

    def _evaluate_planner(self) -> None:
        from tempfile import TemporaryDirectory

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
            write_numbers(self.json, record)
            (sys.stderr if str(self.json) == "-" else sys.stdout).write(table_text([record]))
            tell_failed(folder, lambda line: sys.stderr.write(f"{line}\n"))
