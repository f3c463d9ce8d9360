"""Evaluate saved rollouts one by one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from symphony.cli import shared
from symphony.errors import AllFailedError
from symphony.files import write_file, write_json


class Report(shared.Command):
    """Report what happened in saved rollouts: collisions and whose fault, red lights, progress, comfort and more.

    Writes report.html (one page, worst runs first, each a click away from its replay), report.json and report.csv.
    """

    folder: shared.Saved
    #: Folder of the report; by default the same folder.
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    #: Agents that are evaluated: all that are driven, or only the ego.
    evaluated: Literal["interactive", "ego"] = "interactive"
    view: bool = True  # Leave the page that plays the rollouts unwritten.

    def __call__(self) -> None:
        from symphony.cli.view import write_view
        from symphony.evaluation.report import report
        from symphony.render.report_page import report_page
        from symphony.saved.folder import load_rollouts

        folder, out = load_rollouts(self.folder), self.folder if self.out is None else self.out
        with shared.locked_folder(out, "report.lock"):
            with shared.progress("evaluating") as advance:
                found = report(folder, self.evaluated, advance)
            plain, totals = found.plain(), found.totals()
            write_json(out / "report.json", plain)
            write_file(out / "report.csv", found.csv())
            write_file(out / "report.html", report_page(plain, "view.html" if self.view else None))
            if self.view:
                write_view(folder, found, out / "view.html")
        rows, runs, failed = [], plain["runs"], plain["failed_runs"]
        for name, value in totals.items():
            count = totals.get(f"{name}_segments", totals["segments"])
            of = "" if count == totals["segments"] else f"{count} of {totals['segments']} segments"
            if f"{name}_se" in totals:
                cell = shared.number_cell(value, totals[f"{name}_se"], 2, totals.get(f"{name}_bound"))
                rows.append([name, cell, of])
        shared.print_table(rows, f"{found.agent}: {runs} runs, {failed} failed")
        shared.say(f"written: {out / 'report.html'}")
        if runs and runs == failed:
            raise AllFailedError(f"all {runs} runs failed; report.json says why each did")
