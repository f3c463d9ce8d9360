"""Evaluate saved rollouts one by one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from symphony.cli.tables import number_cell, print_table
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
    """Where the report goes; by default the same folder."""
    evaluated: Literal["interactive", "ego"] = "interactive"
    """Which of the driven agents are evaluated: all, or only the ego."""
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
        plain = found.plain()
        table = Table(
            "",
            "",
            "",
            title=f"{found.agent}: {plain['runs']} runs, {plain['failed_runs']} failed",
            show_header=False,
        )
        totals = found.totals()
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
        if plain["runs"] == plain["failed_runs"]:
            Console().print("no run could be evaluated")
        Console().print(f"written: {out / 'report.html'}", soft_wrap=True, markup=False)
        if plain["runs"] and plain["failed_runs"] == plain["runs"]:
            raise AllFailedError(f"all {plain['runs']} runs failed; report.json says why each did")

    def _written(self, folder: RolloutFolder, out: Path) -> Found:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

        from symphony.evaluation.report import report
        from symphony.files import write_file, write_json
        from symphony.render.report_page import report_page
        from symphony.render.viewer import view_page

        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("segments"),
        )
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("Evaluating", total=len(folder))
            found = report(
                folder, self.evaluated, lambda done, total: bar.update(task, completed=done, total=total)
            )
        plain = found.plain()
        write_json(out / "report.json", plain)
        write_file(out / "report.csv", found.csv())
        write_file(out / "report.html", report_page(plain, "view.html" if self.view else None))
        if self.view:
            replays = ((saved, found.events[saved.segment.segment_id]) for saved in folder)
            write_file(out / "view.html", view_page(folder.about.agent, replays, folder.about.settings))
        return found
