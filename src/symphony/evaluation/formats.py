"""A table of the paper as text, Markdown, LaTeX and JSON."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Callable, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from symphony.config import TableFormat
from symphony.evaluation.comparison import Cell, Column, Comparison, Row
from symphony.evaluation.entries import SETTINGS, family, method_name
from symphony.files import json_text

NOTHING = "–"
ABSENT = Cell((), math.nan, math.nan)
WIDE = 200
"""Columns of text that goes to no terminal."""


def print_text(comparison: Comparison, console: Console) -> None:
    """Print the table; the best values bold on a terminal and with a star elsewhere."""
    table = Table(title=comparison.title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    ways = any(row.way for row in comparison.rows)
    table.add_column("method", max_width=None if ways else 10)  # wide enough for MGAIL+TS+H
    table.add_column("seeds", justify="right")
    for column in comparison.columns:
        table.add_column(f"{column.title}\n{column.unit}", justify="right", no_wrap=True)
    for row, following in zip(comparison.rows, [*comparison.rows[1:], None], strict=True):
        cells = []
        for column in comparison.columns:
            text = Text(justify="right")
            lines = [(row.cells[column.key], "bold", "")]
            if comparison.dataset is not None:
                lines.append((row.paper.get(column.key, ABSENT), "bold dim", "dim"))
            for number, (cell, strong, weak) in enumerate(lines):
                star = "*" if cell.best and not console.is_terminal else ""
                text.append("\n" if number else "")
                text.append(_number(cell, column, "±") + star, strong if cell.best else weak)
            cells.append(text)
        label = Text(method_name(row.method))
        if row.way:
            label.append(f"\n  {row.way}", "dim")
        if comparison.dataset is not None:
            label.append("\n  paper", "dim")
        # Families stand apart, as in the paper.
        apart = following is not None and family(row.method) != family(following.method)
        table.add_row(label, str(len(row.seeds) or ""), *cells, end_section=apart)
    # As wide as what is in it: neither names nor numbers are cut.
    before, unlimited = console.width, console.options.update(max_width=sys.maxsize)
    console.width = max(before, Measurement.get(console, unlimited, table).maximum)
    console.print(table, crop=False)
    console.width = before
    for note in comparison.notes:
        console.print(
            note if console.is_terminal else note.replace("bold:", "*:"),
            style="dim",
            markup=False,
            highlight=False,
        )


def as_text(comparison: Comparison) -> str:
    """The table as plain text."""
    file = io.StringIO()
    print_text(comparison, Console(file=file, width=WIDE, force_terminal=False, color_system=None))
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines()) + "\n"


def as_markdown(comparison: Comparison) -> str:
    """The table in Markdown; the paper's figures have columns of their own."""
    head = ["method", "seeds"]
    for column in comparison.columns:
        head.append(f"{column.title} {column.unit}")
        if comparison.dataset is not None:
            head.append("paper")
    lines = [head, ["---", *["---:"] * (len(head) - 1)]]
    for row in comparison.rows:
        cells = _cells(row, comparison, lambda cell, column: _bold(_number(cell, column), cell, "**", "**"))
        lines.append([row.name, str(len(row.seeds) or ""), *cells])
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    notes = "; ".join(_escaped(note) for note in comparison.notes)
    return f"{table}\n\n{comparison.title}: {notes}.\n"


def as_latex(comparison: Comparison) -> str:
    """The table as a LaTeX ``tabular`` that needs no package."""
    double = comparison.dataset is not None
    heads = [_latex_text(column.title.replace("curvature JSD", "curv. JSD")) for column in comparison.columns]
    units = [
        {"%": r"\%", "10⁻³": r"$\times 10^{-3}$"}.get(column.unit, column.unit)
        for column in comparison.columns
    ]
    first, second = ["Method", "Seeds"], ["", ""]
    for head, unit in zip(heads, units, strict=True):
        first.append(rf"\multicolumn{{2}}{{c}}{{{head} ({unit})}}" if double else f"{head} ({unit})")
        second += ["ours", "paper"]
    lines = [*(f"% {note}" for note in comparison.notes)]
    lines.append(rf"\begin{{tabular}}{{lr{'r' * len(comparison.columns) * (2 if double else 1)}}}")
    lines += [r"\hline", rf"{' & '.join(first)} \\"]
    if double:
        lines.append(rf"{' & '.join(second)} \\")
    last = ""
    for row in comparison.rows:
        group = family(row.method)
        if group != last:
            lines.append(r"\hline")
        last = group
        cells = _cells(row, comparison, _latex_cell)
        name = _latex_text(row.name.replace("+", " + "))
        lines.append(rf"{' & '.join([name, str(len(row.seeds) or ''), *cells])} \\")
    return "\n".join([*lines, r"\hline", r"\end{tabular}"]) + "\n"


def as_json(comparison: Comparison) -> str:
    """The table in JSON: values of every seed, means, errors (null for one seed); the divergence in nats."""
    interactive, seconds = SETTINGS[comparison.setting]
    return json_text(
        {
            "setting": comparison.setting,
            "interactive": interactive,
            "duration": seconds,
            "paper": comparison.dataset,
            "rows": [_json_row(row) for row in comparison.rows],
            "notes": comparison.notes,
        }
    )


FORMATS: dict[TableFormat, Callable[[Comparison], str]] = {
    "text": as_text,
    "markdown": as_markdown,
    "latex": as_latex,
    "json": as_json,
}


def _json_row(row: Row) -> dict[str, Any]:
    found: dict[str, Any] = {"method": row.method, "name": row.name, "seeds": row.seeds}
    found["evaluations"] = row.evaluations
    found |= {"way": row.way} if row.way else {}
    for key, cell in row.cells.items():
        found[key] = {"mean": cell.mean, "se": cell.error, "best": cell.best, "values": cell.values}
    if row.paper:
        found["paper"] = {
            key: {"mean": cell.mean, "se": cell.error, "best": cell.best} for key, cell in row.paper.items()
        }
    return found


def _cells(row: Row, comparison: Comparison, text: Callable[[Cell, Column], str]) -> Sequence[str]:
    """Our cells, each followed by the paper's where it is asked for."""
    found = []
    for column in comparison.columns:
        found.append(text(row.cells[column.key], column))
        if comparison.dataset is not None:
            found.append(text(row.paper.get(column.key, ABSENT), column))
    return found


def _number(cell: Cell, column: Column, plus: str = " ± ") -> str:
    if math.isnan(cell.mean):
        return NOTHING
    mean = column.shown(cell.mean)
    return mean if math.isnan(cell.error) else f"{mean}{plus}{column.shown(cell.error)}"


def _latex_cell(cell: Cell, column: Column) -> str:
    if math.isnan(cell.mean):
        return "--"
    text = _bold(column.shown(cell.mean), cell, r"\textbf{", "}")
    return text if math.isnan(cell.error) else rf"{text} {{\scriptsize $\pm${column.shown(cell.error)}}}"


def _latex_text(text: str) -> str:
    return "".join(f"\\{letter}" if letter in "_%&#$" else letter for letter in text)


def _bold(text: str, cell: Cell, before: str, after: str) -> str:
    return f"{before}{text}{after}" if cell.best else text


def _escaped(text: str) -> str:
    return "".join(f"\\{letter}" if letter in "_*|" else letter for letter in text)
