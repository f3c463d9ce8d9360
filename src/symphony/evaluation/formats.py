"""A table of the paper as text, Markdown, LaTeX and JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from symphony.config import TableFormat
from symphony.evaluation.table import ABSENT, SETTINGS, Cell, Column, Comparison, family
from symphony.files import json_text

NOTHING = "–"
Grid = Sequence[Sequence[str]]
"""Lines of cells, the heading first."""


def aligned(grid: Grid) -> str:
    """A grid as plain text: columns of one width each, the first one flush left."""
    widths = [max(map(len, column)) for column in zip(*grid, strict=True)]
    lines = [
        "  ".join(
            cell.rjust(width) if k else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in grid
    ]
    return "".join(f"{line}\n" for line in [lines[0], "-" * max(map(len, lines)), *lines[1:]])


def markdown(grid: Grid) -> str:
    """A grid as a table in Markdown."""
    rule = ["---", *["---:"] * (len(grid[0]) - 1)]
    return "".join(f"| {' | '.join(line)} |\n" for line in [grid[0], rule, *grid[1:]])


def _grid(
    comparison: Comparison, best: Callable[[str], str], plus: str = " ± ", nothing: str = NOTHING
) -> list[list[str]]:
    """The table with the paper's figures in columns of their own; ``best`` marks the best of a family."""
    paper = comparison.dataset is not None
    head = ["method", "seeds"]
    for column in comparison.columns:
        head += [f"{column.title} {column.unit}".strip(), *["paper"] * paper]

    def shown(cell: Cell, column: Column) -> str:
        if math.isnan(cell.mean):
            return nothing
        error = "" if math.isnan(cell.error) else f"{plus}{column.shown(cell.error)}"
        return best(column.shown(cell.mean) + error) if cell.best else column.shown(cell.mean) + error

    lines = [head]
    for row in comparison.rows:
        line = [row.name, str(len(row.seeds) or "")]
        for column in comparison.columns:
            cells = (row.cells[column.key], row.paper.get(column.key, ABSENT))
            line += [shown(cell, column) for cell in cells[: 1 + paper]]
        lines.append(line)
    return lines


def _as_text(comparison: Comparison) -> str:
    notes = "".join(f"{note}\n" for note in comparison.notes).replace("bold:", "*:")
    return f"{comparison.title}\n\n{aligned(_grid(comparison, '{}*'.format, plus='±'))}\n{notes}"


def _as_markdown(comparison: Comparison) -> str:
    notes = _escaped("; ".join(comparison.notes), "_*|")
    return f"{markdown(_grid(comparison, '**{}**'.format))}\n{comparison.title}: {notes}.\n"


def _as_latex(comparison: Comparison) -> str:
    """A ``tabular`` that needs no package; families of methods stand apart."""
    head, *rows = _grid(comparison, r"\textbf{{{}}}".format, plus=r" $\pm$ ", nothing="--")
    titles = [_escaped(title, "_%&#$").replace("10⁻³", r"$\times 10^{-3}$") for title in head]
    lines = [f"% {note}" for note in comparison.notes]
    lines += [rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}", r"\hline", rf"{' & '.join(titles)} \\"]
    last = ""
    for row, (name, *cells) in zip(comparison.rows, rows, strict=True):
        lines += [r"\hline"] if family(row.method) != last else []
        last = family(row.method)
        lines.append(rf"{' & '.join([_escaped(name, '_%&#$'), *cells])} \\")
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
