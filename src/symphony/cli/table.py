"""Build the paper's tables from evaluated runs."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import arg

from symphony.cli import shared
from symphony.config import Method, PaperData, Setting, TableColumns, TableFormat
from symphony.errors import ConfigError

NAMED = 5
"""Runs left out for the same reason that are named."""


class Table(shared.Command):
    """Build one of the paper's tables from runs that `symphony evaluate` (or a recipe) has evaluated.

    A row for each method there is, mean and standard error over its seeds, the best of the BC methods and of the
    MGAIL methods in bold. Runs of other settings are left out.
    """

    #: Setting of the table. `main`: 10 s, 2 interactive agents; `long`: 20 s; `many`: 8 interactive agents.
    setting: Setting
    #: Folders of runs, or folders that hold some.
    runs: Annotated[shared.Paths, arg(metavar="DIR ...")] = ()
    #: Name of the evaluation of a run that counts, where it keeps several (in its folder `evaluations`); * and ?
    #: stand for anything. Of several names, the first that fits one decides.
    evaluation: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ()
    #: Write a row for each way that a method was simulated in (of those that `evaluation` fits), with its cost.
    each: bool = False
    #: More columns: `split`, collisions with playback agents and the rest; `standing`, agents that stand at the
    #: end; `corrected`, the divergence without its bias; `goals`, what the search made of the drawn goals.
    columns: tuple[TableColumns, ...] = ()
    paper: PaperData | None = None  # Data set on which the paper's own figures are shown beside ours.
    #: Method that every other is compared with, paired over run segments; printed on standard error.
    paired: Annotated[Method | None, arg(metavar="METHOD")] = None
    #: Print, instead of the table, which of the paper's relations between the methods hold, with paired errors.
    relations: bool = False
    format: TableFormat = "text"  # Format of the table.
    out: shared.ResultFile = None  # File to write the table to; otherwise it is printed.

    def __post_init__(self) -> None:
        if self.each and (self.relations or self.paired is not None):
            raise ConfigError(
                "--relations and --paired go without --each: they are of one evaluation of a run"
            )
        if self.relations and self.format == "latex":
            raise ConfigError("relations are written as text, markdown or json")

    def __call__(self) -> None:
        from symphony.evaluation.formats import FORMATS
        from symphony.evaluation.relations import RELATION_FORMATS, paired_lines, relations
        from symphony.evaluation.table import collect, compare

        entries, left_out = collect(self.runs, self.setting, self.evaluation, each=self.each)
        for reason, folders in left_out.items():
            more = f" and {len(folders) - NAMED} more" if len(folders) > NAMED else ""
            shared.tell(f"left out, {reason}: {', '.join(map(str, folders[:NAMED]))}{more}")
        comparison = compare(entries, self.setting, self.paper, self.columns)
        for line in [] if self.paired is None else paired_lines(entries, self.paired):
            shared.tell(line)
        related = RELATION_FORMATS[self.format](relations(entries, self.setting)) if self.relations else ""
        shared.write_text(self.out, related or FORMATS[self.format](comparison))
