"""Check a submission to the Waymo Open Sim Agents Challenge."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from symphony.errors import DataError

SHOWN = 20
"""Problems that are printed."""


@dataclass(frozen=True)
class Validate:
    """Check a submission offline for what the challenge's server would refuse.

    Archive, shards, metadata, number of rollouts and steps, numbers; with --scenario also that it holds exactly the
    scenarios and agents that have to be simulated.
    """

    submission: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """The submission (.tar.gz)."""
    scenario: Annotated[Path | None, tyro.conf.arg(metavar="FILE|DIR")] = None
    """Scenario file (TFRecord), folder of such files, or pattern with *: what has to be simulated."""

    def run(self) -> None:
        """Check and report."""
        from symphony.wosac.submission_check import check_submission, required_agents

        required = None if self.scenario is None else required_agents(self.scenario)
        report = check_submission(self.submission, required)
        for problem in report.problems[:SHOWN]:
            sys.stderr.write(f"{problem}\n")
        if report.count:
            raise DataError(f"{report.count} problem{'s' if report.count > 1 else ''}", file=self.submission)
        sys.stdout.write(
            f"{self.submission}: {len(report.scenarios)} scenarios in {report.shards} shards, all well\n"
        )
        if required is None:
            sys.stdout.write(
                "Not checked, for want of --scenario: whether scenarios and agents are the right ones\n"
            )
