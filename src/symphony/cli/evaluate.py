"""Evaluate agents against the log."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

import symphony
from symphony.cli import shared
from symphony.config import WosacSettings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from symphony.saved.folder import RolloutWriter
    from symphony.saved.rollouts import SavedRollouts

PANELS, SHOWN = 6, 8
"""Run segments in one picture, and rollouts that are drawn of each."""


class Evaluate(shared.Simulation):
    """Simulate the interactive agents of every run segment and compare them with the log.

    The log itself and agents at constant velocity are evaluated beside the agent. A run keeps what was found in its
    folder, as evaluations/NAME.json, where `symphony table` looks for it; the same evaluation made again replaces it.
    With --segments the folder of a run is left as it is.
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
    #: More scores for the record and `symphony table`: `wosac` (2025), 32 rollouts of everyone (see docs/wosac.md).
    metrics: tuple[Literal["wosac"], ...] = ()

    def __call__(self) -> None:
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
        shown: Sequence[int] = ()
        kept: list[SavedRollouts] = []
        writer: RolloutWriter | None = None
        if self.figure is not None:
            from symphony.learning.demonstrations import evenly_spaced

            shown = evenly_spaced(len(chosen or store), PANELS)
        if self.save_rollouts is not None:
            from symphony.saved import folder
            from symphony.saved.saving import plain_settings

            plain = plain_settings(config, agent, agent.interactive, agent.duration)
            about = folder.About.of(agent.name, store, plain, seed=config.seed)
            writer = folder.RolloutWriter(self.save_rollouts, about)

        def observe(item: int, saved: SavedRollouts) -> None:
            if item in shown:
                kept.append(saved)
            if writer is not None and not writer.has(saved.segment.segment_id):
                writer.add(saved)

        watched: dict[str, Any] = {"observe": observe} if shown or writer is not None else {}
        with shared.progress(f"evaluating {agent.name}") as advance:
            items = chosen or None
            found = symphony.evaluate(agent, store, config, advance, items=items, baselines=True, **watched)
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
            from symphony.render import draw_clips, saved_clip

            name = shared.short_name(agent.name)
            clips = [saved_clip(saved, SHOWN, f"{name}: {saved.segment.segment_id}") for saved in kept]
            draw_clips(clips, self.figure)
