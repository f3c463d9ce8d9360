"""Score rollouts as the Waymo Open Sim Agents Challenge does."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from symphony.cli.shared import write_numbers
from symphony.errors import ConfigError, printable

if TYPE_CHECKING:
    from symphony.data.report import Skip
    from symphony.wosac.files import ScenarioScore


@dataclass(frozen=True)
class Score:
    """Score rollouts, made by anything, against logged scenarios of the Waymo Open Motion Dataset.

    The numbers are those of the official scorer. See docs/wosac.md for what they mean, and for the legal notice that
    goes with the metric.
    """

    scenario: Annotated[Path, tyro.conf.arg(metavar="FILE|DIR")]
    """Scenario file (TFRecord) with one or many scenarios, folder of such files, or pattern with *."""
    rollouts: Annotated[Path, tyro.conf.arg(metavar="FILE|DIR")]
    """Rollouts of the only scenario (.npz with object_id [n] and x, y, z, heading [32, n, 80]), or folder with a file
    SCENARIO_ID.npz for each scenario."""
    config: Literal["2024", "2025"] = "2025"
    """Year of the challenge."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write all numbers to; - for standard output, the table then goes to standard error."""
    per_object: bool = False
    """In that file, give the numbers of each scored object, too."""
    features: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder to write what is compared to, per object and step, as SCENARIO_ID.npz."""
    partial: bool = False
    """Leave out scenarios without rollouts; otherwise each must have some."""
    strict: bool = False
    """Stop at a scenario that can't be scored (without road edges, vehicles or a future), instead of leaving it
    out."""
    workers: int = 1
    """Processes that score."""

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ConfigError(f"--workers must be at least 1, is {self.workers}")
        if self.per_object and self.json is None:
            raise ConfigError("--per-object goes with --json")

    def run(self) -> None:
        """Score, showing how far it is, and report."""
        from symphony.wosac.files import summary

        results, skipped = self._score()
        found = summary(results, skipped, self.config)
        _print(found, aside=str(self.json) == "-")
        print_left_out(skipped)
        if self.json is not None:
            write_numbers(self.json, found)

    def _score(self) -> tuple[list[ScenarioScore], list[Skip]]:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from symphony.wosac.files import score_files

        columns = (TextColumn("Scoring"), BarColumn(), MofNCompleteColumn(), TextColumn("scenarios"))
        with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("", total=None)
            return score_files(
                self.scenario,
                self.rollouts,
                self.config,
                workers=self.workers,
                partial=self.partial,
                per_object=self.per_object,
                features=self.features,
                strict=self.strict,
                progress=lambda done, total: bar.update(task, completed=done, total=total),
            )


def print_left_out(skipped: list[Skip]) -> None:
    """Print why scenarios have no score, on standard error."""
    from symphony.data.report import left_out

    for line in left_out(skipped):
        sys.stderr.write(f"left out: {printable(line)}\n")


def _print(found: dict[str, object], *, aside: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    title = f"WOSAC {found['config']}, {found['scenario_count']} scenarios"
    table = Table(show_header=False, box=None, pad_edge=False, title=title, title_justify="left")
    for name, value in found.items():
        if isinstance(value, float):
            table.add_row(name, f"{value:.6f}")
    Console(stderr=aside).print(table)
