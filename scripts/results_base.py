"""Records of the folder `results/`, and how a table is made of several."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from symphony.evaluation.paired import clustered_mean

ROOT = Path(__file__).resolve().parents[1]
RECORDS = ROOT / "results"
Record = dict[str, Any]
Grid = list[list[str]]
COLUMNS = {
    "collision_rate": ("collisions %", 1),
    "offroad_time": ("off-road %", 2),
    "ade": ("ADE m", 2),
    "min_sade": ("minSADE m", 2),
    "curvature_jsd": ("curvature JSD", 3),
}
"""Figures of a table: their headings, and the digits after their points."""
WITH_ERROR = ("collision_rate", "ade", "min_sade")
PLAYBACK = "log playback"


def records(pattern: str) -> list[Record]:
    """Those whose path below ``results/`` fits, by name.

    Raises:
        FileNotFoundError: if there is none.
    """
    found = [json.loads(path.read_text()) for path in sorted(RECORDS.glob(f"{pattern}.json"))]
    if not found:
        raise FileNotFoundError(f"no record fits results/{pattern}.json")
    return found


def means(rows: Sequence[tuple[str, str]], columns: Sequence[str] = tuple(COLUMNS)) -> Grid:
    """A line per row: means over seeds, with standard errors if there are several; the lowest simulated in bold."""
    values = [[[row[name] for row in records(pattern)] for name in columns] for _, pattern in rows]
    digits = [COLUMNS[name][1] for name in columns]
    # Rounded as text is: what looks equal is.
    shown = [[round(float(np.mean(v)), d) for v, d in zip(line, digits, strict=True)] for line in values]
    simulated = [line for line, (label, _) in zip(shown, rows, strict=True) if label != PLAYBACK]
    lowest = [min(column) for column in zip(*simulated, strict=True)]
    grid = [["", *(COLUMNS[name][0] for name in columns)]]
    for (label, _), line, rounded in zip(rows, values, shown, strict=True):
        cells = [mean_of(cell, number) for cell, number in zip(line, digits, strict=True)]
        bold = [label != PLAYBACK and mean == least for mean, least in zip(rounded, lowest, strict=True)]
        grid.append([label, *(f"**{text}**" if b else text for text, b in zip(cells, bold, strict=True))])
    return grid


def beside(rows: Sequence[tuple[str, str]], groups: dict[str, str], columns: Sequence[str]) -> Grid:
    """The same rows for several folders (their names stand for ``{}``), side by side under headings of their own."""
    parts = {
        title: means([(label, pattern.format(folder)) for label, pattern in rows], columns)
        for folder, title in groups.items()
    }
    for title, part in parts.items():
        part[0][1] = f"{title}: {part[0][1]}"
    labels = ["", *(label for label, _ in rows)]
    lines = zip(*parts.values(), strict=True)
    return [
        [label, *(cell for part in line for cell in part[1:])]
        for label, line in zip(labels, lines, strict=True)
    ]


def paired(before: Sequence[Record], after: Sequence[Record], name: str, digits: int) -> str:
    """By how much the second are above the first: mean over seeds and segments, standard error over segments."""
    rows = [
        np.array(json.loads(b["per_segment"][name])) - np.array(json.loads(a["per_segment"][name]))
        for a, b in zip(before, after, strict=True)
    ]
    each = np.mean(rows, 0)
    return f"{each.mean():+.{digits}f} ± {each.std(ddof=1) / len(each) ** 0.5:.{digits}f}"


def mean_of(values: Sequence[float], digits: int) -> str:
    """A mean with its standard error, if there are several values."""
    if len(values) == 1:
        return f"{values[0]:.{digits}f}"
    error = np.std(values, ddof=1) / len(values) ** 0.5
    return f"{np.mean(values):.{digits}f} ± {error:.{digits}f}"


def over(rows: Sequence[Record], key: str, digits: int) -> str:
    """Mean of a figure over some segments of a record, ± standard error over their recordings."""
    groups = np.unique([row["group"] for row in rows], return_inverse=True)[1]
    mean, error = clustered_mean(np.array([row[key] for row in rows], np.float64), groups)
    return f"{mean:.{digits}f} ± {error:.{digits}f}"


def figures(row: Record, columns: dict[str, tuple[str, int]]) -> list[str]:
    """Figures of a row, some with their errors."""
    return [
        f"{row[key]:.{digits}f}" + (f" ± {row[f'{key}_se']:.{digits}f}" if key in WITH_ERROR else "")
        for key, (_, digits) in columns.items()
    ]
