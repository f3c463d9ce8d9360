"""Build the paper's tables from evaluated runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from symphony.cli.shared import ResultFile
from symphony.config import Method, PaperData, Setting, TableColumns, TableFormat
from symphony.errors import ConfigError
from symphony.files import write_file

NAMED = 5
"""Runs left out for the same reason that are named."""


@dataclass(frozen=True)
class Table:
    """Build one of the paper's tables from runs that `symphony evaluate` (or a recipe) has evaluated.

    A row for each method there is, mean and standard error over its seeds, the best of the BC methods and of the
    MGAIL methods in bold. Runs of other settings are left out.
    """

    setting: Setting
    """Setting of the table. `main`: 10 s, 2 interactive agents; `long`: 20 s; `many`: 8 interactive agents."""
    runs: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="DIR ...", help_behavior_hint="(required)")] = ()
    """Folders of runs, or folders that hold some."""
    evaluation: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Name of the evaluation of a run that counts, where it keeps several (in its folder `evaluations`); * and ?
    stand for anything. Of several names, the first that fits one decides."""
    each: bool = False
    """Write a row for each way that a method was simulated in (of those that `evaluation` fits), with its cost."""
    columns: tuple[TableColumns, ...] = ()
    """More columns: `split`, collisions with playback agents and the rest; `standing`, agents that stand at the end;
    `corrected`, the divergence without its bias; `goals`, what the search made of the drawn goals."""
    paper: PaperData | None = None
    """Show the paper's own figures on this data set beside ours."""
    paired: Annotated[Method | None, tyro.conf.arg(metavar="METHOD")] = None
    """Also print every method less this one, paired over run segments, to standard error."""
    relations: bool = False
    """Print, instead of the table, which of the paper's relations between the methods hold, with paired errors."""
    format: TableFormat = "text"
    """Format of the table."""
    out: ResultFile = None
    """File to write the table to; otherwise it is printed."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise ConfigError("no runs given: --runs DIR ...")
        if self.each and (self.relations or self.paired is not None):
            raise ConfigError(
                "relations and paired differences are of one evaluation of each run, not of each"
            )
        if self.relations and self.format == "latex":
            raise ConfigError("relations are written as text, markdown or json")

    def run(self) -> None:
        """Collect, compare and write."""
        from symphony.evaluation.formats import FORMATS
        from symphony.evaluation.relations import RELATION_FORMATS, paired_lines, relations
        from symphony.evaluation.table import collect, compare

        entries, left_out = collect(self.runs, self.setting, self.evaluation, each=self.each)
        for reason, folders in left_out.items():
            more = f" and {len(folders) - NAMED} more" if len(folders) > NAMED else ""
            sys.stderr.write(f"left out, {reason}: {', '.join(map(str, folders[:NAMED]))}{more}\n")
        comparison = compare(entries, self.setting, self.paper, self.columns)
        if self.paired is not None:
            for line in paired_lines(entries, self.paired):
                sys.stderr.write(f"{line}\n")
        if self.relations:
            text = RELATION_FORMATS[self.format](relations(entries, self.setting))
        else:
            text = FORMATS[self.format](comparison)
        if self.out is not None:
            write_file(self.out, text)
        else:
            sys.stdout.write(text)
