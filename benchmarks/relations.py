"""Check which of the paper's relations between the methods hold in some evaluated runs, with paired errors:

    python benchmarks/relations.py RUN ... [--setting main] [--evaluation NAME ...] [--json FILE]
    python benchmarks/relations.py RUN ... --paired METHOD      # every method less one of them instead

Paired means that what makes segments hard cancels out. Errors are over recordings.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from symphony.config import PaperData, Setting
from symphony.errors import ConfigError, DataError
from symphony.evaluation.table import (
    COLUMNS,
    METRICS,
    SETTINGS,
    Entry,
    collect,
    compare,
    markdown,
    method_name,
    paper_figures,
)
from symphony.files import write_json
from symphony.metrics.intervals import clustered_mean

CLEAR = 2.0
"""Standard errors by which a number must differ from its bound to differ clearly."""
STATEMENTS: tuple[tuple[str, str, str, str | float], ...] = (
    ("collision_rate", "bc", "bc_ts", 1.0),
    ("collision_rate", "bc", "bc_ts_h", 9.3),
    ("offroad_time", "bc", "bc_ts_h", 6.4),
    ("collision_rate", "mgail", "mgail_ts", 1.0),
    ("collision_rate", "mgail_h", "mgail_ts_h", 1.0),
    ("collision_rate", "mgail", "mgail_ts_h", 2.2),
    ("collision_rate", "bc", "mgail", "falls"),
    ("min_sade", "bc_h", "bc_ts_h", "does not rise"),
    ("ade", "bc_ts", "bc_ts_h", "falls"),
    ("min_sade", "bc_ts", "bc_ts_h", "falls"),
    ("ade", "mgail_ts", "mgail_ts_h", "falls"),
    ("min_sade", "mgail_ts", "mgail_ts_h", "falls"),
    ("curvature_jsd", "bc", "bc_ts", "rises"),
    ("curvature_jsd", "bc_ts", "bc_ts_h", "falls"),
    ("curvature_jsd", "mgail", "mgail_ts", "rises"),
    ("curvature_jsd", "mgail_ts", "mgail_ts_h", "falls"),
)
"""The statements of the paper's tables: a metric, from which method to which, and what it does: a number is how many
times it falls at least. The divergence must do so beyond its sampling."""

Relation = dict[str, Any]
"""A statement beside our numbers, see :func:`relations`."""


def relations(entries: Sequence[Entry], setting: Setting = "main") -> list[Relation]:
    """Say whether the paper's relations hold in some evaluated runs, one evaluation of each.

    Seeds of a method are averaged; errors are of the paired differences between run segments (the linearised error of
    a factor), clustered by recording. Divergences are compared without their bias by sampling.

    Returns:
        For each statement ``metric``, ``before``, ``after``, ``does`` and ``text``; ``value``, the factor or the
        difference, ``se``, and ``paper``, the same of its figures by data set; ``held`` (None where it can't be said,
        as something is ``missing``); ``clear``, whether the value is :data:`CLEAR` errors away from the bound.

    Raises:
        ConfigError: a method was simulated in several ways.
        DataError: an evaluation lacks a number that is needed.
    """
    methods, papers = (
        by_method(entries),
        {name: paper_figures(setting, name) for name in get_args(PaperData)},
    )
    found = []
    for metric, before, after, does in STATEMENTS:
        ends = {name: [rows[m][metric][0] for m in (before, after)] for name, rows in papers.items() if rows}
        paper = {k: a / b if isinstance(does, float) else b - a for k, (a, b) in ends.items()}
        verb = does if isinstance(does, str) else f"falls at least {does:g} times" if does > 1 else "falls"
        verb += ", beyond sampling" * (metric == "curvature_jsd")
        text = f"{method_name(before)} to {method_name(after)}: {COLUMNS[metric].title} {verb}"
        one: Relation = {"metric": metric, "before": before, "after": after, "does": does, "text": text}
        one |= {
            "paper": paper,
            "held": None,
            "clear": False,
            "value": math.nan,
            "se": math.nan,
            "missing": "",
        }
        if absent := [method_name(method) for method in (before, after) if method not in methods]:
            one["missing"] = f"no runs of {' and '.join(absent)}"
        else:
            _check(one, methods[before], methods[after])
        found.append(one)
    return found


def _check(one: Relation, before: Sequence[Entry], after: Sequence[Entry]) -> None:
    """Fill in the findings."""
    metric, does, sampled = one["metric"], one["does"], one["metric"] == "curvature_jsd"
    first, second = (float(np.mean([entry.number(metric) for entry in each])) for each in (before, after))
    if sampled:
        # What each recording adds to the corrected divergence; a number that is not defined is None in JSON.
        parts = [[entry.record["curvature"]["parts"] for entry in each] for each in (before, after)]
        names = sorted(set.intersection(*(set(part) for each in parts for part in each)))
        a, b = (np.array([[p[n] for n in names] for p in each], np.float64).mean(0) for each in parts)
        # All turns may be of one recording, or there is but one.
        known = np.isfinite(a).all() and np.isfinite(b).all()
        value, error = clustered_mean(b - a, np.arange(len(names))) if known else (math.nan, math.nan)
    else:
        member, ((a,), (b,)) = segment_rows([before, after], [metric])
        value, error = second - first, clustered_mean(b - a, member)[1]
        if isinstance(does, float):
            value = first / second if second else math.inf if first else math.nan
            error = clustered_mean((a - value * b) / second, member)[1] if second else math.nan
    if math.isnan(value):
        one["missing"] = "no number: both are 0, or a mean over nothing"
        return
    away = value - does if isinstance(does, float) else value if does == "rises" else -value
    clear = abs(away) > CLEAR * error  # never of none against few, whose error is not known
    # What stays the same does not fall.
    held = away > 0 or (away == 0 and does not in ("falls", "rises", 1.0))
    one |= {"held": held and (clear or not sampled), "clear": clear, "value": value, "se": error}


def by_method(entries: Sequence[Entry]) -> dict[str, list[Entry]]:
    """Return the entries of each method; a ConfigError says which was simulated in several ways."""
    methods: dict[str, list[Entry]] = {}
    for entry in entries:
        methods.setdefault(entry.method, []).append(entry)
    for method, mine in methods.items():
        if len(ways := sorted({entry.way for entry in mine})) > 1:
            what = f"{method_name(method)} was simulated in several ways"
            raise ConfigError(f"{what}, choose one with --evaluation: {', '.join(ways)}")
    return methods


def segment_rows(
    sides: Sequence[Sequence[Entry]], metrics: Sequence[str]
) -> tuple[NDArray[np.int64], list[NDArray[np.float64]]]:
    """Return the recordings of the run segments [K] that all evaluations of two methods have, and for each method its
    numbers of these segments [metrics, K], averaged over its evaluations.
    """
    tables = []
    for entry in (entry for side in sides for entry in side):
        rows: Any = entry.record.get("per_segment")
        if not isinstance(rows, list):
            raise DataError("is missing", file=str(entry), field="per_segment")
        tables.append((entry, {str(row["segment"]): row for row in rows}))
    names = sorted(set.intersection(*(set(rows) for _, rows in tables)))
    if not names:
        raise ConfigError(f"{' and '.join(method_name(side[0].method) for side in sides)} share no run segment")
    numbers = [[[entry.number(key, rows[name]) for name in names] for key in metrics] for entry, rows in tables]
    groups = [str(tables[0][1][name].get("group") or name) for name in names]
    split = np.split(np.array(numbers), [len(sides[0])])
    return np.unique(groups, return_inverse=True)[1], [part.mean(0) for part in split]


def paired_lines(entries: Sequence[Entry], base: str) -> list[str]:
    """Say how every method differs from one of them, a line for each; seeds of a method are averaged first.

    Raises:
        ConfigError: the base is not among them, one was simulated in several ways, or they share no segments.
        DataError: an evaluation has no rows of its segments.
    """
    methods, keys, lines = by_method(entries), METRICS[:4], []  # no segment has a divergence of its own
    if base not in methods:
        raise ConfigError(f"'{base}' is not among the methods {', '.join(methods)}")
    for method in (method for method in methods if method != base):
        member, (mine, other) = segment_rows([methods[method], methods[base]], keys)
        means = [clustered_mean(away, member) for away in mine - other]
        texts = [f"{mean:+.2f} ± {error:.2f} {COLUMNS[k].unit}" for k, (mean, error) in zip(keys, means, strict=True)]
        away = ", ".join(f"{COLUMNS[key].title} {text}" for key, text in zip(keys, texts, strict=True))
        count = f"{len(member)} segments of {member.max() + 1} groups"
        lines.append(f"{method_name(method)} less {method_name(base)}: {away} ({count})")
    return lines


def relations_text(found: Sequence[Relation]) -> str:
    """Return relations as a table: what is claimed, ours, the paper's, whether it is held."""
    grid = [["", "here", "paper, own data", "paper, WOMD", "is it so?"]]
    for one in found:
        column = COLUMNS[one["metric"]]
        factor = isinstance(one["does"], float)
        form, scale = ("{:.1f}", 1.0) if factor else (f"{{:+.{column.digits}f}}", column.scale)
        unit = "times" if factor else column.unit.replace("%", "points")
        error = "" if math.isnan(one["se"]) else f" ± {form.replace('+', '').format(one['se'] * scale)}"
        here = one["missing"] or f"{form.format(one['value'] * scale)}{error} {unit}"
        theirs = (one["paper"].get(name, math.nan) * scale for name in get_args(PaperData))
        paper = ["–" if math.isnan(value) else form.format(value) for value in theirs]
        verdict = "not known" if one["held"] is None else "held" if one["held"] else "not held"
        within = "" if one["held"] is None or one["clear"] else ", within the error"
        grid.append([one["text"], here, *paper, verdict + within])
    return markdown(grid)


def main(args: Sequence[str] | None = None) -> None:
    """Print the relations."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--setting", choices=SETTINGS, default="main")
    parser.add_argument("--evaluation", nargs="+", default=())
    parser.add_argument("--json", type=Path)
    parser.add_argument("--paired", metavar="METHOD")
    given = parser.parse_args(args)
    entries, _ = collect(given.runs, given.setting, given.evaluation)
    compare(entries, given.setting)  # fail if they are not comparable
    if given.paired is not None:
        print("\n".join(paired_lines(entries, given.paired)))
        return
    found = relations(entries, given.setting)
    if given.json is not None:
        write_json(given.json, found)
    print(relations_text(found))


if __name__ == "__main__":
    main()
