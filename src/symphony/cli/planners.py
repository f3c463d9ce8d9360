"""Compare planners among crowds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from symphony.cli import shared


class Planners(shared.Command):
    """Compare planners, each among several crowds: one table, and which planner is first in each crowd.

    The score of a run is its progress relative to the log's, in percent, at most 100; 0 if it failed, if the planner
    is at fault in a collision, runs a red light or leaves the road. Runs whose progress is not defined have none.
    """

    #: Folders of rollouts that `symphony simulate --planner` made, or records that `symphony
    #: evaluate --planner --json` wrote.
    records: Annotated[Positional[shared.Paths], arg(metavar="SIM|FILE ...")]
    format: Literal["text", "markdown"] = "text"  # Format of the table.
    out: shared.ResultFile = None  # File to write the table to; otherwise it is printed.
    json: shared.Json = None

    def __call__(self) -> None:
        from symphony.evaluation.planners import check_crowds, planner_record, read_planner_record
        from symphony.saved.folder import load_rollouts

        records = [
            planner_record(load_rollouts(path)) if path.is_dir() else read_planner_record(path)
            for path in self.records
        ]
        check_crowds(records)
        if shared.write_numbers(self.json, {"records": records}) or self.out is not None:
            shared.write_text(self.out, table_text(records, self.format))


def table_text(records: Sequence[dict[str, Any]], form: Literal["text", "markdown"] = "text") -> str:
    """The table of some records, and which planner is first in each crowd."""
    from symphony.evaluation.formats import aligned, markdown
    from symphony.evaluation.planners import counted_at_states, planner_grid, winners, without_score

    table = (markdown if form == "markdown" else aligned)(planner_grid(records))
    sentences = [*winners(records), *without_score(records), *counted_at_states(records)]
    return "\n".join([table, *sentences]).rstrip() + "\n"
