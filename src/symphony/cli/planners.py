"""Compare planners among crowds."""

from __future__ import annotations

from typing import Annotated

from tyro.conf import Positional, arg

from symphony.cli import shared


class Planners(shared.Command):
    """Compare planners, each among several crowds: one table, and which planner is first in each crowd.

    The score of a run is its progress relative to the log's, in percent, at most 100; 0 if it failed, if the planner
    is at fault in a collision, runs a red light or leaves the road. Runs whose progress is not defined have none.
    """

    #: Folders of rollouts that `symphony simulate --planner` made.
    records: Annotated[Positional[shared.Paths], arg(metavar="SIM ...")]
    out: shared.ResultFile = None  # File to write the table to; otherwise it is printed.
    json: shared.Json = None

    def __call__(self) -> None:
        from symphony.evaluation.planners import check_crowds, planner_record, planners_text
        from symphony.saved.folder import load_rollouts

        records = [planner_record(load_rollouts(path)) for path in self.records]
        check_crowds(records)
        if shared.write_numbers(self.json, {"records": records}) or self.out is not None:
            shared.write_text(self.out, planners_text(records))
