"""Build the paper's tables from evaluated runs."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import arg

from symphony.cli import shared
from symphony.config import PaperData, Setting, TableFormat
from symphony.files import json_text

NAMED = 5
"""Runs left out for the same reason that are named."""


class Table(shared.Command):
    """Build one of the paper's tables from runs that `symphony evaluate` (or a recipe) has evaluated.

    A row for each method there is (and each way that it was simulated in), mean and standard error over its seeds,
    the best of the BC methods and of the MGAIL methods in bold. Runs of other settings are left out.
    """

    #: Setting of the table. `main`: 10 s, 2 interactive agents; `long`: 20 s; `many`: 8 interactive agents.
    setting: Setting
    #: Folders of runs, or folders that hold some.
    runs: Annotated[shared.Paths, arg(metavar="DIR ...")] = ()
    #: Names of the evaluations of a run that count, where it keeps several (in its folder `evaluations`); * and ?
    #: stand for anything. Of several names, the first that fits any decides.
    evaluation: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    paper: PaperData | None = None  # Data set on which the paper's own figures are shown beside ours.
    format: TableFormat = "markdown"  # Format of the table.
    out: shared.ResultFile = None  # File to write the table to; otherwise it is printed.

    def __call__(self) -> None:
        from symphony.evaluation.table import collect, compare, table_text

        entries, left_out = collect(self.runs, self.setting, self.evaluation)
        for reason, folders in left_out.items():
            more = f" and {len(folders) - NAMED} more" if len(folders) > NAMED else ""
            shared.tell(f"left out, {reason}: {', '.join(map(str, folders[:NAMED]))}{more}")
        table = compare(entries, self.setting, self.paper)
        shared.write_text(self.out, json_text(table) if self.format == "json" else table_text(table))
