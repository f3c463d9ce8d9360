"""Judge agents against the log."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from symphony.cli.tables import print_metrics, write_json
from symphony.config import EvaluateConfig

if TYPE_CHECKING:
    from symphony.trainers import Evaluation


@dataclass(frozen=True)
class Evaluate:
    """Simulate the interactive agents of every run segment and compare them with the log.

    The log itself is judged beside the agent: what the data would score.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="playback|RUN")]
    """Folder of a run (see `symphony train`), `playback` (the log itself) or `constant_velocity`."""
    data: Path
    """Store of run segments to simulate."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write all numbers to, those of every run segment included."""
    figure: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Picture of simulated rollouts to draw (.png, .pdf or .svg)."""
    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")] = field(default_factory=EvaluateConfig)

    def run(self) -> None:
        """Evaluate, print the numbers and write them."""
        from symphony.trainers import load_agent

        agent = load_agent(self.agent, self.config.device)
        result = evaluate_with_bar(self.agent, self.data, self.config)
        # The log is judged on the agents that this agent drives.
        log = evaluate_with_bar("playback", self.data, self.config, interactive=result.interactive)
        rows = [log.numbers(), result.numbers()] if agent.policy is not None else [result.numbers()]
        print_metrics(rows, title=str(self.data))
        if self.json is not None:
            write_json(
                self.json,
                {**result.numbers(), "playback": log.numbers(), "per_segment": result.metrics.rows()},
            )
        if self.figure is not None:
            from symphony.cli.pictures import draw_rollouts

            draw_rollouts(agent, self.data, self.figure, result.interactive, seed=self.config.seed)


def evaluate_with_bar(agent: str, data: Path, config: EvaluateConfig, interactive: int = 0) -> Evaluation:
    """Evaluate an agent, showing on stderr how far it is."""
    from dataclasses import replace

    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from symphony.trainers import evaluate

    if interactive:
        config = replace(config, interactive=interactive)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("segments"))
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(f"evaluating {agent}", total=None)
        return evaluate(
            agent, data, config, lambda done, total: bar.update(task, completed=done, total=total)
        )
