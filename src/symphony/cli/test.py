"""Test planners against the thresholds of a suite."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from symphony.errors import CouldNotRunError, SymphonyError, ThresholdError

if TYPE_CHECKING:
    from collections.abc import Callable

    from symphony.bench.run import Result
    from symphony.bench.suite import Suite


@dataclass(frozen=True)
class Test:
    """Test planners among crowds against a suite of thresholds, such as collisions at fault in at most 1 % of runs.

    The suite is a TOML file (see docs/test-bench.md and examples/suite.toml). The exit status is 0 if every threshold
    is kept, 1 if one is not, and 2 if the suite could not run. An interrupted suite is continued by the same command.
    """

    suite: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SUITE")]
    """The suite."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/test")
    """Folder of the results: index.html, result.json, junit.xml, and the rollouts of each planner and crowd."""
    junit: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write the JUnit XML to as well."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write all numbers to as well; - for standard output, the table then goes to standard error."""
    view: bool = True
    """Leave the pages that play the rollouts unwritten."""
    workers: int = 1
    """Processes that simulate (this changes the speed, not the results)."""
    engine: Literal["local", "ray"] = "local"
    """Where they are: on this machine, or on a Ray cluster."""
    device: str = "cpu"
    """`cpu`, `cuda` or `cuda:N`."""

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
        from symphony.cli.tables import write_numbers
        from symphony.files import write_file

        suite = read_suite(self.suite, workers=self.workers, engine=self.engine, device=self.device)
        result = self._run(suite, run_suite)
        text = junit(result)
        write_file(self.out / "junit.xml", text)
        write_file(self.out / "index.html", page(result, view=self.view))
        if self.junit is not None:
            write_file(self.junit, text)
        if self.json is not None:
            write_numbers(self.json, result.plain())
        self._print(result)
        return result

    def _run(self, suite: Suite, run: Callable[..., Result]) -> Result:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("runs"))
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(suite.name, total=None)
            return run(
                suite,
                self.out,
                lambda name, done, total: bar.update(task, description=name, completed=done, total=total),
                view=self.view,
            )

    def _print(self, result: Result) -> None:
        from rich.console import Console
        from rich.table import Table

        from symphony.bench.pages import sentence
        from symphony.cli.tables import print_table

        console = Console(stderr=str(self.json) == "-")
        table = Table("", "planner", "crowd", "threshold and what was found", title=result.suite.name)
        for one in result.verdicts:
            style = "green" if one.status == "passes" else "red"
            table.add_row(f"[{style}]{one.status}[/]", one.planner, one.crowd, sentence(one))
        print_table(table, console)
        for pair in result.pairs:
            if pair.stopped:
                console.print(
                    f"{pair.report.agent}: stopped after {len(pair.runs)} of {pair.planned} runs, a threshold is lost"
                )
        for run in result.regressions[:NAMED]:
            console.print(
                f"worse than the baseline: {run['planner']} among {run['crowd']}, segment {run['segment']}, "
                f"rollout {run['rollout']}, seed {run['seed']}: {run['what']}",
                soft_wrap=True,
                markup=False,
            )
        if len(result.regressions) > NAMED:
            console.print(f"and {len(result.regressions) - NAMED} more runs worse than the baseline")
        console.print(f"written: {self.out / 'index.html'}", soft_wrap=True, markup=False)


NAMED = 5
"""Regressions that are printed; all of them are in the files."""
