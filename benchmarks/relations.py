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
from symphony.metrics.summary import WEIGHTED

CLEAR = 2.0
"""Standard errors by which a number must differ from its bound to differ clearly."""
STEPS: tuple[tuple[str, str], ...] = (
    ("bc", "bc_ts"), ("bc_h", "bc_ts_h"), ("mgail", "mgail_ts"), ("mgail_h", "mgail_ts_h"),
    ("bc", "bc_h"), ("bc_ts", "bc_ts_h"), ("mgail", "mgail_h"), ("mgail_ts", "mgail_ts_h"),
    ("bc", "mgail"), ("bc_h", "mgail_h"), ("bc_ts", "mgail_ts"), ("bc_ts_h", "mgail_ts_h"),
)  # fmt: skip
"""Pairs of methods that differ by one thing: the search, goals, or MGAIL instead of BC."""
FACTORS: tuple[tuple[str, str, str, float], ...] = (
    ("collision_rate", "bc", "bc_ts_h", 9.3),
    ("offroad_time", "bc", "bc_ts_h", 6.4),
    ("collision_rate", "mgail", "mgail_ts_h", 2.2),
)
"""What the paper's text claims: a metric falls at least so many times from one method to another."""

Relation = dict[str, Any]
"""A relation beside our numbers, see :func:`relations`."""


def relations(entries: Sequence[Entry], setting: Setting = "main") -> list[Relation]:
    """Say whether the paper's relations hold in some evaluated runs, one evaluation of each: for :data:`STEPS` each
    metric, then :data:`FACTORS`.

    Seeds of a method are averaged; errors are of the paired differences between run segments (the linearised error of
    a factor), clustered by recording. Divergences are compared without their bias by sampling.

    Returns:
        For each relation ``metric``, ``before``, ``after``, ``text`` and what it ``does``: a factor, or where the
        paper's data sets agree and are clear together, "falls" or "rises", else None; ``value``, the factor or the
        difference, ``se``, and ``paper``, the same of its figures by data set; ``held`` (None where it can't be said,
        as the paper has no direction, or something is ``missing``); ``clear``, whether the value is :data:`CLEAR`
        errors away from the bound.

    Raises:
        ConfigError: a method was simulated in several ways.
        DataError: an evaluation lacks a number that is needed.
    """
    methods = by_method(entries)
    papers = {name: rows for name in get_args(PaperData) if (rows := paper_figures(setting, name))}
    found = []
    claims: list[tuple[str, str, str, float | None]] = [(m, *step, None) for step in STEPS for m in METRICS]
    for metric, before, after, factor in claims + list(FACTORS):
        ends = {name: [rows[m][metric] for m in (before, after)] for name, rows in papers.items()}
        paper = {name: a / b if factor else b - a for name, ((a, _), (b, _)) in ends.items()}
        does = factor or _direction(list(ends.values()))
        verb = "changes" if does is None else does if isinstance(does, str) else f"falls at least {does:g} times"
        text = f"{method_name(before)} to {method_name(after)}: {COLUMNS[metric].title} {verb}"
        one: Relation = {"metric": metric, "before": before, "after": after, "does": does, "text": text}
        one |= {"paper": paper, "held": None, "clear": False, "value": math.nan, "se": math.nan, "missing": ""}
        if absent := [method_name(method) for method in (before, after) if method not in methods]:
            one["missing"] = f"no runs of {' and '.join(absent)}"
        else:
            _check(one, methods[before], methods[after])
        found.append(one)
    return found


def _direction(ends: Sequence[Sequence[tuple[float, float]]]) -> str | None:
    """Return the direction in which the paper's data sets agree, if it is clear in them together."""
    away = [(b - a) / math.hypot(first, second) for (a, first), (b, second) in ends]
    signs = {math.copysign(1.0, each) for each in away}
    if len(signs) > 1 or abs(sum(away)) <= CLEAR * math.sqrt(len(away)):
        return None
    return "rises" if signs == {1.0} else "falls"


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
        value, error = clustered_mean(b - a, member)
        if isinstance(does, float):
            value = first / second if second else math.inf if first else math.nan
            error = clustered_mean((a - value * b) / second, member)[1] if second else math.nan
    if math.isnan(value):
        one["missing"] = "no number: both are 0, or a mean over nothing"
        return
    away = value - does if isinstance(does, float) else value if does == "rises" else -value
    clear = abs(away) > CLEAR * error  # never of none against few, whose error is not known
    # What stays the same does not fall.
    held = away > 0 or (away == 0 and isinstance(does, float))
    one |= {"held": None if does is None else held, "clear": clear, "value": value, "se": error}


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
    """Return the recordings of the run segments [K] that all evaluations of two methods have, and for each method
    parts [metrics, K] of which its numbers of these segments are the means, averaged over its evaluations.

    Where longer segments weigh more a part is linearised: the number plus the weighted residual.
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
    numbers = [[_parts(entry, key, [rows[name] for name in names]) for key in metrics] for entry, rows in tables]
    groups = [str(tables[0][1][name].get("group") or name) for name in names]
    split = np.split(np.array(numbers), [len(sides[0])])
    return np.unique(groups, return_inverse=True)[1], [part.mean(0) for part in split]


def _parts(entry: Entry, key: str, rows: Sequence[Any]) -> NDArray[np.float64]:
    own = np.array([entry.number(key, row) for row in rows])
    if key not in WEIGHTED:
        return own
    weight = np.array([entry.number(f"{key}_weight", row) for row in rows]) * np.isfinite(own)
    number = np.nansum(own * weight) / max(weight.sum(), 1)
    return number + weight * (own - number) / max(weight[weight > 0].mean(), 1) if weight.any() else own


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


def tables(found: Sequence[Relation]) -> tuple[list[list[str]], list[list[str]]]:
    """Return relations as a table of the steps, a line for each, and one of the factors."""
    steps: dict[str, list[str]] = {}
    factors = [["", "here", *(f"paper, {name}" for name in get_args(PaperData))]]
    for one in found:
        column, factor = COLUMNS[one["metric"]], isinstance(one["does"], float)
        form, scale = ("{:.1f}", 1.0) if factor else (f"{{:+.{column.digits}f}}", column.scale)
        error = "" if math.isnan(one["se"]) else f" ± {form.replace('+', '').format(one['se'] * scale)}"
        here = "–" if one["missing"] else form.format(one["value"] * scale) + error + mark(one)
        if factor:
            paper = [one["paper"].get(name, math.nan) for name in get_args(PaperData)]
            factors.append([one["text"], here, *("–" if math.isnan(each) else f"{each:.1f}" for each in paper)])
        else:
            steps.setdefault(one["text"].partition(":")[0].replace(" to ", "→"), []).append(here)
    titles = [f"{COLUMNS[metric].title} {COLUMNS[metric].unit.replace('%', 'points')}".strip() for metric in METRICS]
    return [["", *titles], *([name, *row] for name, row in steps.items())], factors


def mark(one: Relation) -> str:
    """Return how a number stands to the paper: as there, the other way, or within its error of the bound."""
    return "" if one["held"] is None else "≈" if not one["clear"] else "✓" if one["held"] else "✗"


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
    print(*map(markdown, tables(found)), sep="\n")


if __name__ == "__main__":
    main()
