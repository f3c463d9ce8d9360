"""Evaluate saved rollouts one by one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from symphony.cli.shared import number_cell, print_table, progress, say
from symphony.errors import AllFailedError

if TYPE_CHECKING:
    from symphony.evaluation.report import Report as Found
    from symphony.saved.folder import RolloutFolder


@dataclass(frozen=True)
class Report:
    """Report what happened in saved rollouts: collisions and whose fault, red lights, progress, comfort and more.

    Writes report.html (one page, worst runs first, each a click away from its replay), report.json and report.csv.
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SIM")]
    """Folder of saved rollouts."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the report; by default the same folder."""
    evaluated: Literal["interactive", "ego"] = "interactive"
    """Agents that are evaluated: all that are driven, or only the ego."""
    view: bool = True
    """Leave the page that plays the rollouts unwritten."""

    def run(self) -> None:
        """Evaluate, write, and print the totals."""
        from rich.console import Console
        from rich.table import Table

        from symphony.files import Lock, naming
        from symphony.saved.folder import load_rollouts

        folder, out = load_rollouts(self.folder), self.folder if self.out is None else self.out
        with naming(out):
            out.mkdir(parents=True, exist_ok=True)
        with Lock(out / "report.lock"):
            found = self._written(folder, out)
        totals, plain = found.totals(), found.plain()
        runs, failed = plain["runs"], plain["failed_runs"]
        table = Table("", "", "", title=f"{found.agent}: {runs} runs, {failed} failed", show_header=False)
        for name, value in totals.items():
            if name.endswith(("_se", "_bound", "_segments")) or not (
                isinstance(value, float) or f"{name}_segments" in totals
            ):
                continue
            count = totals.get(f"{name}_segments", totals["segments"])
            of = "" if count == totals["segments"] else f"{count} of {totals['segments']} segments"
            cell = number_cell(value, totals.get(f"{name}_se"), 2, totals.get(f"{name}_bound"))
            table.add_row(name, cell, of)
        print_table(table, Console())
        if runs == failed:
            say("no run could be evaluated")
        say(f"written: {out / 'report.html'}")
        if runs and runs == failed:
            raise AllFailedError(f"all {runs} runs failed; report.json says why each did")

    def _written(self, folder: RolloutFolder, out: Path) -> Found:
        from symphony.evaluation.report import report
        from symphony.files import write_file, write_json
        from symphony.render.report_page import report_page
        from symphony.render.viewer import view_page

        with progress("evaluating") as advance:
            found = report(folder, self.evaluated, advance)
        plain = found.plain()
        write_json(out / "report.json", plain)
        write_file(out / "report.csv", found.csv())
        write_file(out / "report.html", report_page(plain, "view.html" if self.view else None))
        if self.view:
            replays = ((saved, found.events[saved.segment.segment_id]) for saved in folder)
            write_file(out / "view.html", view_page(folder.about.agent, replays, folder.about.settings))
        return found
