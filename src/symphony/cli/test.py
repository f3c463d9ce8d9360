"""Test planners against the thresholds of a suite."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from symphony.cli.shared import ResultFile, print_table, progress, write_numbers
from symphony.errors import CouldNotRunError, SymphonyError, ThresholdError

if TYPE_CHECKING:
    from symphony.bench.run import Result

NAMED = 5
"""Regressions that are printed; all of them are in the files."""


@dataclass(frozen=True)
class Test:
    """Test planners among crowds against a suite of thresholds, such as collisions at fault in at most 1 % of runs.

    The suite is a TOML file (see docs/test-bench.md and examples/suite.toml). The exit status is 0 if every threshold
    is kept, 1 if one is not, and 2 if the suite could not run. An interrupted suite is continued by the same command.
    """

    suite: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SUITE")]
    """File of the suite."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/test")
    """Folder of the results: index.html, result.json, junit.xml, and the rollouts of each planner and crowd."""
    junit: ResultFile = None
    """File to write the JUnit XML to as well."""
    json: ResultFile = None
    """File to write all numbers to as well; - for standard output, the table then goes to standard error."""
    view: bool = True
    """Leave the pages that play the rollouts unwritten."""
    workers: int = 1
    """Processes that simulate (this changes the speed, not the results)."""
    engine: Literal["local", "ray"] = "local"
    """Engine that runs these processes: `local`, on this machine, or `ray`, on a Ray cluster."""
    device: str = "cpu"
    """Device that simulates: `cpu`, `cuda` or `cuda:N`."""

    def run(self) -> None:
        """Run the suite, write what it found, and say whether it passes."""
        try:
            result = self._written()
        except (SymphonyError, OSError) as error:
            raise CouldNotRunError(str(error)) from error
        failing = sum(one.status != "passes" for one in result.verdicts)
        if failing:
            raise ThresholdError(
                f"{failing} of {len(result.verdicts)} thresholds are not kept: see {self.out / 'index.html'}"
            )

    def _written(self) -> Result:
        from symphony.bench.pages import junit, page
        from symphony.bench.run import run_suite
        from symphony.bench.suite import read_suite
        from symphony.files import write_file

        suite = read_suite(self.suite, workers=self.workers, engine=self.engine, device=self.device)
        with progress(suite.name, "runs") as advance:
            result = run_suite(
                suite, self.out, lambda name, done, total: advance(done, total, name), view=self.view
            )
        text = junit(result)
        write_file(self.out / "junit.xml", text)
        write_file(self.out / "index.html", page(result, view=self.view))
        if self.junit is not None:
            write_file(self.junit, text)
        write_numbers(self.json, result.plain())
        self._print(result)
        return result

    def _print(self, result: Result) -> None:
        from rich.console import Console
        from rich.table import Table

        from symphony.bench.pages import sentence

        console = Console(stderr=str(self.json) == "-")
        table = Table("", "planner", "crowd", "threshold and what was found", title=result.suite.name)
        for one in result.verdicts:
            style = "green" if one.status == "passes" else "red"
            table.add_row(f"[{style}]{one.status}[/]", one.planner, one.crowd, sentence(one))
        print_table(table, console)
        lines = [
            f"{pair.report.agent}: stopped after {len(pair.runs)} of {pair.planned} runs, a threshold is lost"
            for pair in result.pairs
            if pair.stopped
        ]
        lines += [
            f"worse than the baseline: {run['planner']} among {run['crowd']}, segment {run['segment']}, "
            f"rollout {run['rollout']}, seed {run['seed']}: {run['what']}"
            for run in result.regressions[:NAMED]
        ]
        if len(result.regressions) > NAMED:
            lines.append(f"and {len(result.regressions) - NAMED} more runs worse than the baseline")
        for line in [*lines, f"written: {self.out / 'index.html'}"]:
            console.print(line, soft_wrap=True, markup=False)
