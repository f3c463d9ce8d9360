"""Evaluate agents against the log."""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

import symphony
from symphony.cli import shared
from symphony.cli.planners import table_text
from symphony.config import WosacSettings
from symphony.errors import ConfigError

if TYPE_CHECKING:
    from symphony.agents import Agent
    from symphony.data.store import SegmentStore


class Evaluate(shared.Simulation):
    """Simulate the interactive agents of every run segment and compare them with the log.

    The log itself and agents at constant velocity are evaluated beside the agent. A run keeps what was found in its
    folder, as evaluations/NAME.json, where `symphony table` looks for it; the same evaluation made again replaces it.
    With --segments or --planner the folder of a run is left as it is. The numbers of a planner are those of `symphony
    planners`.
    """

    json: shared.Json = None
    #: Picture of some of the rollouts (.png, .pdf or .svg), or animation of them (.gif).
    figure: shared.ResultFile = None
    #: Folder for the rollouts that are evaluated (see `symphony view`, `report` and `export`).
    save_rollouts: Annotated[Path | None, arg(metavar="DIR")] = None
    #: Print every number of each agent, not only the table: kinds of collision, what the divergence owes to sampling,
    #: where agents stand at the end, what a search made of the goals, and what becomes of single agents.
    details: bool = False
    keep: bool = True  # Leave the folder of the run as it is.
    #: More scores for the record and for `symphony table`: `wosac` (2025), of 32 rollouts of everyone for 8 s, by the
    #: same search or without it (see docs/wosac.md).
    metrics: tuple[Literal["wosac"], ...] = ()

    def __post_init__(self) -> None:
        if self.planner and (self.figure is not None or self.metrics or self.config.metric):
            raise ConfigError("--figure, --metrics and --metric go without --planner: they are of the agent")

    def __call__(self) -> None:
        if self.planner:
            return self._evaluate_planner()
        from symphony.evaluation.records import evaluation_record, keep_evaluation

        if self.figure is not None:
            from symphony.render.style import ANIMATIONS, FORMATS, picture_path

            picture_path(self.figure, (*FORMATS, *ANIMATIONS))
        agent = symphony.load_agent(self.agent, self.config.device, trust_code=self.trust_code)
        store, config = symphony.SegmentStore(self.data), self.config
        chosen = shared.segment_indices(store, self.segments)
        if self.metrics:
            from symphony.wosac.evaluate import evaluate_wosac, scorable, wosac_parts

            # Complain now, not after the work.
            scorable(store, chosen or range(len(store)), WosacSettings.of(config).future)
        keepers = self._keepers(agent, store, len(chosen or store))
        observe: Any = (lambda *found: [keeper(*found) for keeper in keepers.values()]) if keepers else None
        with shared.progress(f"evaluating {agent.name}") as advance:
            more: dict[str, Any] = {"items": chosen or None, "observe": observe}
            found = symphony.evaluate(agent, store, config, advance, baselines=True, **more)
        record = evaluation_record(agent, found, store)
        if self.metrics:
            rows = chosen or range(len(store))
            with shared.progress(f"WOSAC score of {agent.name}") as advance:
                scored = evaluate_wosac(agent, store, rows, WosacSettings.of(config), progress=advance)
            record |= wosac_parts(scored, record)
        if shared.write_numbers(self.json, record):
            others = [one.numbers() for one in found.baselines if one.agent != found.agent]
            shared.print_metrics([*others, found.numbers()], str(self.data), details=self.details)
            if self.metrics:
                from symphony.wosac.table import wosac_table

                sys.stdout.write(wosac_table([scored.record()]))
        if self.keep and not chosen:
            keep_evaluation(agent.name, record)
        if self.figure is not None:
            from symphony.render import draw_clips

            draw_clips(keepers["figure"].clips, self.figure)

    def _keepers(self, agent: Agent, store: SegmentStore, count: int) -> dict[str, Any]:
        """What looks at the rollouts of every run segment: to draw some of them, to save them."""
        keepers: dict[str, Any] = {}
        if self.figure is not None:
            from symphony.evaluation.pictures import PANELS, ClipKeeper
            from symphony.learning.demonstrations import evenly_spaced

            title = f"{shared.short_name(agent.name)}: "
            keepers["figure"] = ClipKeeper(evenly_spaced(count, PANELS), title=title)
        if self.save_rollouts is not None:
            from symphony.evaluation.pictures import RolloutKeeper
            from symphony.saved.folder import About, RolloutWriter
            from symphony.saved.saving import plain_settings

            plain = plain_settings(self.config, agent, agent.interactive, agent.duration)
            about = About.of(agent.name, store, plain, seed=self.config.seed)
            keepers["rollouts"] = RolloutKeeper(RolloutWriter(self.save_rollouts, about))
        return keepers

    def _evaluate_planner(self) -> None:
        from symphony.evaluation.planners import planner_record

        with TemporaryDirectory() as spare:
            folder = self.simulated(self.save_rollouts or Path(spare))
            store = symphony.SegmentStore(self.data)
            chosen = shared.segment_indices(store, self.segments) or range(len(store))
            folder = folder.only(store.ids[i] for i in chosen)
            record = planner_record(folder)
            if shared.write_numbers(self.json, record):
                sys.stdout.write(table_text([record]))
            shared.tell_failed(folder)
