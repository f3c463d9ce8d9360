"""Test planners against the thresholds of a suite."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from symphony.cli import shared
from symphony.errors import CouldNotRunError, SymphonyError
from symphony.files import write_file

if TYPE_CHECKING:
    from symphony.bench.run import Result

NAMED = 5
"""Regressions that are printed; all of them are in the files."""


class Test(shared.Command):
    """Test planners among crowds against a suite of thresholds, such as collisions at fault in at most 1 % of runs.

    The suite is a TOML file (see docs/test-bench.md and examples/suite.toml). The exit status is 0 if every threshold
    is kept, 1 if one is not, and 2 if the suite could not run. An interrupted suite is continued by the same command.
    """

    suite: Annotated[Positional[Path], arg(metavar="SUITE")]  # File of the suite.
    #: Folder of the results: index.html, result.json, junit.xml, and the rollouts of each planner and crowd.
    out: Annotated[Path, arg(metavar="DIR")] = Path("out/test")
    junit: shared.ResultFile = None  # File to write the JUnit XML to as well.
    json: shared.Json = None
    view: bool = True  # Leave the pages that play the rollouts unwritten.
    workers: shared.Workers = 1
    engine: shared.EngineName = "local"
    device: str = "cpu"  # Device that simulates: `cpu`, `cuda` or `cuda:N`.

    def __call__(self) -> None:
        try:
            result = self._written()
        except (SymphonyError, OSError) as error:
            raise CouldNotRunError(str(error)) from error
        failing, page = sum(one.status != "passes" for one in result.verdicts), self.out / "index.html"
        if failing:
            raise SymphonyError(f"{failing} of {len(result.verdicts)} thresholds are not kept: see {page}")

    def _written(self) -> Result:
        from symphony.bench.pages import junit, page, sentence
        from symphony.bench.run import run_suite
        from symphony.bench.suite import read_suite

        suite = read_suite(self.suite, workers=self.workers, engine=self.engine, device=self.device)
        with shared.progress(suite.name, "runs") as advance:

            def show(name: str, done: int, total: int) -> None:
                advance(done, total, name)

            result = run_suite(suite, self.out, show, view=self.view)
        for file in (self.out / "junit.xml", self.junit):
            if file is not None:
                write_file(file, junit(result))
        write_file(self.out / "index.html", page(result, view=self.view))
        if shared.write_numbers(self.json, result.plain()):
            for one in result.verdicts:
                shared.say(f"{one.status:8}{one.planner} among {one.crowd}: {sentence(one)}")
            for run in result.regressions[:NAMED]:
                which = (
                    f"segment {run['segment']}, rollout {run['rollout']}, seed {run['seed']}: {run['what']}"
                )
                shared.say(f"worse than the baseline: {run['planner']} among {run['crowd']}, {which}")
            shared.say(f"written: {self.out / 'index.html'}")
        return result
