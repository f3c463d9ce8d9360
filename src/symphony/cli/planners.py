"""Compare planners among crowds."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from symphony.cli.shared import ResultFile, write_numbers
from symphony.errors import ConfigError


@dataclass(frozen=True)
class Planners:
    """Compare planners, each among several crowds: one table, and which planner is first in each crowd.

    The score of a run is its progress relative to the log's, in percent, at most 100; 0 if it failed, if the planner
    is at fault in a collision, runs a red light or leaves the road. Runs whose progress is not defined have none.
    """

    found: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="SIM|FILE ...", help_behavior_hint="(required)"),
    ]
    """Folders of rollouts that `symphony simulate --planner` made, or records that `symphony evaluate --planner
    --json` wrote."""
    format: Literal["text", "markdown"] = "text"
    """Format of the table."""
    out: ResultFile = None
    """File to write the table to; otherwise it is printed."""
    json: ResultFile = None
    """File to write all numbers to; - for standard output, in place of the table."""

    def __post_init__(self) -> None:
        if not self.found:
            raise ConfigError("no rollouts and no records given")

    def run(self) -> None:
        """Evaluate what is not evaluated yet, and write the table."""
        from symphony.evaluation.planners import check_crowds, planner_record, read_planner_record
        from symphony.files import write_file
        from symphony.saved.folder import load_rollouts

        records = [
            planner_record(load_rollouts(path)) if path.is_dir() else read_planner_record(path)
            for path in self.found
        ]
        check_crowds(records)
        write_numbers(self.json, {"records": records})
        text = table_text(records, self.format)
        if self.out is not None:
            write_file(self.out, text)
        elif str(self.json) != "-":
            sys.stdout.write(text)


def table_text(records: Sequence[dict[str, Any]], form: Literal["text", "markdown"] = "text") -> str:
    """The table of some records, and which planner is first in each crowd."""
    from symphony.evaluation.formats import aligned, markdown
    from symphony.evaluation.planners import counted_at_states, planner_grid, winners, without_score

    grid = planner_grid(records)
    sentences = [*winners(records), *without_score(records), *counted_at_states(records)]
    table = markdown(grid) if form == "markdown" else aligned(grid)
    return "\n".join([table, *sentences]).rstrip() + "\n"
