"""A table of WOSAC scores."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from symphony.files import write_file


@dataclass(frozen=True)
class Table:
    """Put the scores of several agents on the same run segments into one table (Markdown).

    One line for the agent of each record, after the baselines.
    """

    records: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE ...")]
    """What `symphony wosac evaluate --json FILE` wrote."""
    names: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Names of the agents; by default what the records say."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write it to; otherwise it is printed."""

    def run(self) -> None:
        """Read, compare and write."""
        from symphony.wosac.table import grid_note, markdown_table, read_wosac, wosac_grid

        records = [read_wosac(file) for file in self.records]
        text = f"{markdown_table(wosac_grid(records, self.names))}\n{grid_note(records)}.\n"
        if self.out is None:
            sys.stdout.write(text)
        else:
            write_file(self.out, text)
