"""Judge agents against the log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from symphony.cli.tables import print_metrics
from symphony.config import EvaluateConfig
from symphony.files import write_json

if TYPE_CHECKING:
    from symphony.agents import Agent
    from symphony.data.store import SegmentStore
    from symphony.evaluation import Evaluation


@dataclass(frozen=True)
class Evaluate:
    """Simulate the interactive agents of every run segment and compare them with the log.

    The log itself is judged beside the agent: what the data would score. A run keeps what was found in its folder,
    as evaluations/NAME.json, where `symphony table` looks for it; the same evaluation made again replaces it.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="playback|RUN")]
    """Folder of a run (see `symphony train`), `pretrained:NAME` (an agent that comes with the package), `playback`
    (the log itself) or `constant_velocity`."""
    data: Path
    """Store of run segments to simulate."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write all numbers to, those of every run segment included."""
    figure: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Picture of simulated rollouts to draw (.png, .pdf or .svg), or animation of them (.gif)."""
    keep: bool = True
    """Leave the folder of the run as it is."""
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)

    def run(self) -> None:
        """Evaluate, print the numbers and write them."""
        found = judge(self.agent, self.data, self.config)
        print_metrics(found.rows, title=str(self.data))
        if self.keep:
            found.keep()
        if self.json is not None:
            write_json(self.json, found.record)
        if self.figure is not None:
            from symphony.cli.pictures import draw_rollouts

            draw_rollouts(
                found.agent,
                self.data,
                self.figure,
                found.record["interactive"],
                seed=self.config.seed,
                device=self.config.device,
            )


@dataclass(frozen=True)
class Judged:
    """An agent and how it was judged.

    Attributes:
        agent: that was judged.
        rows: numbers of log playback, then those of the agent; one row where they are the same.
        record: all of it as JSON can hold it (see :func:`symphony.evaluation.records.evaluation_record`).
    """

    agent: Agent
    rows: Sequence[dict[str, Any]]
    record: dict[str, Any]

    def keep(self) -> Path | None:
        """Keep the record in the folder of the run and return the file.

        None for a baseline, which has no folder, and for an agent that comes with the package, whose folder is not
        the user's.
        """
        from symphony.agents.choice import split_name
        from symphony.agents.included import is_pretrained
        from symphony.evaluation.records import keep_evaluation

        if self.record["run"] is None or is_pretrained(self.agent.name):
            return None
        return keep_evaluation(split_name(self.agent.name)[0], self.record)


def judge(name: str, data: Path, config: EvaluateConfig) -> Judged:
    """Judge an agent, and log playback beside it, on every run segment of a store.

    Args:
        name: of the agent (see :func:`symphony.agents.load_agent`).
        data: folder of the store.
        config: how.
    """
    from symphony.agents import load_agent
    from symphony.data.store import SegmentStore
    from symphony.evaluation.records import evaluation_record

    agent, store = load_agent(name, config.device), SegmentStore(data)
    result = log = evaluate_with_bar(agent, store, config)
    if agent.policy is not None:
        # The log is judged on the agents that this agent drives, and for as long.
        same = replace(config, interactive=result.interactive, duration=config.duration or agent.duration)
        log = evaluate_with_bar("playback", store, same)
    rows = [log.numbers(), result.numbers()] if agent.policy is not None else [result.numbers()]
    return Judged(agent, rows, evaluation_record(agent, result, log, store))


def evaluate_with_bar(agent: Agent | str, data: SegmentStore | Path, config: EvaluateConfig) -> Evaluation:
    """Evaluate an agent, showing on stderr how far it is."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from symphony.evaluation import evaluate

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("segments"))
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(f"evaluating {agent if isinstance(agent, str) else agent.name}", total=None)
        return evaluate(
            agent, data, config, lambda done, total: bar.update(task, completed=done, total=total)
        )
