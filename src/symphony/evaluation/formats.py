"""A table of the paper as text, Markdown, LaTeX and JSON."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Callable
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from symphony.config import TableFormat
from symphony.evaluation.table import ABSENT, SETTINGS, Cell, Column, Comparison, family, method_name
from symphony.files import json_text

NOTHING = "–"


def _shown(cell: Cell, column: Column, plus: str = " ± ") -> str:
    if math.isnan(cell.mean):
        return NOTHING
    mean = column.shown(cell.mean)
    return mean if math.isnan(cell.error) else f"{mean}{plus}{column.shown(cell.error)}"


def print_text(comparison: Comparison, console: Console) -> None:
    """Print the table; the best values bold on a terminal and with a star elsewhere."""
    table = Table(title=comparison.title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    ways, beside = any(row.way for row in comparison.rows), comparison.dataset is not None
    table.add_column("method", max_width=None if ways else 10)  # wide enough for MGAIL+TS+H
    table.add_column("seeds", justify="right")
    for column in comparison.columns:
        table.add_column(f"{column.title}\n{column.unit}", justify="right", no_wrap=True)
    for row, following in zip(comparison.rows, [*comparison.rows[1:], None], strict=True):
        label = Text(method_name(row.method))
        label.append(f"\n  {row.way}" if row.way else "", "dim").append("\n  paper" if beside else "", "dim")
        cells = []
        for column in comparison.columns:
            text = Text(justify="right")
            lines = [(row.cells[column.key], ""), (row.paper.get(column.key, ABSENT), "dim")]
            for k, (cell, faint) in enumerate(lines[: 1 + beside]):
                star = "*" if cell.best and not console.is_terminal else ""
                style = f"{'bold' * cell.best} {faint}".strip()
                text.append("\n" * (k > 0)).append(_shown(cell, column, "±") + star, style)
            cells.append(text)
        # Families stand apart, as in the paper.
        apart = following is not None and family(row.method) != family(following.method)
        table.add_row(label, str(len(row.seeds) or ""), *cells, end_section=apart)
    # As wide as what is in it: neither names nor numbers are cut.
    before, unlimited = console.width, console.options.update(max_width=sys.maxsize)
    console.width = max(before, Measurement.get(console, unlimited, table).maximum)
    console.print(table, crop=False)
    console.width = before
    for note in comparison.notes:
        plain = note if console.is_terminal else note.replace("bold:", "*:")
        console.print(plain, style="dim", markup=False, highlight=False)


def _as_text(comparison: Comparison) -> str:
    file = io.StringIO()
    print_text(comparison, Console(file=file, width=200, force_terminal=False, color_system=None))
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines()) + "\n"


def _grid(comparison: Comparison, shown: Callable[[Cell, Column], str]) -> list[list[str]]:
    """A line for each row: its name, its seeds, and its cells, each followed by the paper's where these are shown."""
    grid = []
    for row in comparison.rows:
        line = [row.name, str(len(row.seeds) or "")]
        for column in comparison.columns:
            line.append(shown(row.cells[column.key], column))
            if comparison.dataset is not None:
                line.append(shown(row.paper.get(column.key, ABSENT), column))
        grid.append(line)
    return grid


def _as_markdown(comparison: Comparison) -> str:
    """The paper's figures have columns of their own."""

    def shown(cell: Cell, column: Column) -> str:
        return f"**{_shown(cell, column)}**" if cell.best else _shown(cell, column)

    paper = [] if comparison.dataset is None else ["paper"]
    heads = [part for column in comparison.columns for part in (f"{column.title} {column.unit}", *paper)]
    lines = [["method", "seeds", *heads], ["---", *["---:"] * (len(heads) + 1)], *_grid(comparison, shown)]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"{table}\n\n{comparison.title}: {_escaped('; '.join(comparison.notes), '_*|')}.\n"


def _as_latex(comparison: Comparison) -> str:
    """A ``tabular`` that needs no package."""

    def shown(cell: Cell, column: Column) -> str:
        if math.isnan(cell.mean):
            return "--"
        text = column.shown(cell.mean)
        text = rf"\textbf{{{text}}}" if cell.best else text
        return text if math.isnan(cell.error) else rf"{text} {{\scriptsize $\pm${column.shown(cell.error)}}}"

    double = comparison.dataset is not None
    units = {"%": r"\%", "10⁻³": r"$\times 10^{-3}$"}
    first, second = ["Method", "Seeds"], ["", ""]
    for column in comparison.columns:
        title = _escaped(column.title.replace("curvature JSD", "curv. JSD"), "_%&#$")
        head = f"{title} ({units.get(column.unit, column.unit)})"
        first.append(rf"\multicolumn{{2}}{{c}}{{{head}}}" if double else head)
        second += ["ours", "paper"]
    lines = [f"% {note}" for note in comparison.notes]
    lines.append(rf"\begin{{tabular}}{{lr{'r' * len(comparison.columns) * (1 + double)}}}")
    lines += [r"\hline", *(rf"{' & '.join(line)} \\" for line in [first, second][: 1 + double])]
    last = ""
    for row, (name, *cells) in zip(comparison.rows, _grid(comparison, shown), strict=True):
        lines += [r"\hline"] if family(row.method) != last else []
        last = family(row.method)
        lines.append(rf"{' & '.join([_escaped(name.replace('+', ' + '), '_%&#$'), *cells])} \\")
    return "\n".join([*lines, r"\hline", r"\end{tabular}"]) + "\n"


def _escaped(text: str, letters: str) -> str:
    return "".join(f"\\{letter}" if letter in letters else letter for letter in text)


def _as_json(comparison: Comparison) -> str:
    """Values of every seed, means, errors (null for one seed); the divergence in nats."""

    def plain(cell: Cell) -> dict[str, Any]:
        return {"mean": cell.mean, "se": cell.error, "best": cell.best}

    rows = []
    for row in comparison.rows:
        found: dict[str, Any] = {"method": row.method, "name": row.name, "seeds": row.seeds}
        found |= {"evaluations": row.evaluations} | ({"way": row.way} if row.way else {})
        found |= {key: plain(cell) | {"values": cell.values} for key, cell in row.cells.items()}
        found |= {"paper": {key: plain(cell) for key, cell in row.paper.items()}} if row.paper else {}
        rows.append(found)
    interactive, seconds = SETTINGS[comparison.setting]
    about = {"setting": comparison.setting, "interactive": interactive, "duration": seconds}
    return json_text(about | {"paper": comparison.dataset, "rows": rows, "notes": comparison.notes})


FORMATS: dict[TableFormat, Callable[[Comparison], str]] = {
    "text": _as_text,
    "markdown": _as_markdown,
    "latex": _as_latex,
    "json": _as_json,
}
"""How a table is written."""
