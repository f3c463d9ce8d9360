"""Find the critical run segments of a store."""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from symphony.errors import ConfigError


@dataclass(frozen=True)
class Hardest:
    """List the run segments of a store that are most critical for the ego, the hardest first.

    Four things make a segment critical, each with up to one point: a short time to collision, a short time between
    the ego and another who crosses its way, hard braking, and a small distance to the road's boundary.
    """

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """The store of run segments."""
    count: int = 20
    """How many segments are listed."""
    ids: bool = False
    """Print only their ids, for the option --segments of other commands."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File to write the list to; - for standard output, in place of the table."""

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ConfigError(f"--count must be at least 1, is {self.count}")

    def run(self) -> None:
        """Look at every segment and print the hardest."""
        from rich.console import Console
        from rich.table import Table

        from symphony.bench.criticality import hardest
        from symphony.cli.evaluate import segments_bar
        from symphony.cli.tables import print_table, write_numbers
        from symphony.data.store import SegmentStore

        with segments_bar("looking at the log") as advance:
            found = [one for _, one in hardest(SegmentStore(self.data), self.count, progress=advance)]
        if self.json is not None:
            write_numbers(self.json, [{**asdict(one), "score": one.score} for one in found])
        if self.ids:
            sys.stdout.write("".join(f"{one.segment}\n" for one in found))
        elif str(self.json) != "-":
            table = Table("segment", "critical", "TTC s", "PET s", "braking m/s²", "to the edge m")
            for one in found:
                numbers = (one.score, one.time_to_collision, one.encroachment, one.braking, one.margin)
                table.add_row(one.segment, *("–" if abs(n) == float("inf") else f"{n:.2f}" for n in numbers))
            print_table(table, Console())
