"""Comparisons of methods by run segment: the paper's relations, each held or not, and paired differences.

Paired means that what makes segments hard cancels out. Errors are over recordings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from symphony.config import PaperData, Setting, TableFormat
from symphony.errors import ConfigError, DataError
from symphony.evaluation.formats import markdown
from symphony.evaluation.paper import paper_figures
from symphony.evaluation.table import ASKED, COLUMNS, ROWS, Entry, method_name, number
from symphony.files import json_text
from symphony.metrics.intervals import clustered_mean

CLEAR = 2.0
"""Standard errors by which a number must differ from its bound to differ clearly."""
STANDING_POINTS = 5.0
"""Points by which the share of agents that stand at the end may differ from the log's."""
PAPER_NAMES: dict[PaperData, str] = {"proprietary": "own data", "womd": "WOMD"}
_COLUMNS = {column.key: column for column in (*COLUMNS, *ASKED["standing"])}

Kind = Literal["times", "lower", "not_higher", "higher", "near_log"]
_VERBS = {"lower": "falls", "not_higher": "does not rise", "higher": "rises"}


@dataclass(frozen=True)
class Statement:
    """What is claimed of one method, or of two.

    Attributes:
        kind: the metric falls at least ``bound`` times from ``before`` to ``after``; it is lower, or not higher, or
            higher for ``after`` than for ``before``; that of ``after`` is within ``bound`` of the log's.
        metric: name in a record.
        before: method; none for `near_log`.
        after: method.
        bound: see ``kind``.
        clearly: whether a difference counts only beyond :data:`CLEAR` standard errors.
    """

    kind: Kind
    metric: str
    before: str
    after: str
    bound: float = 0.0
    clearly: bool = False

    @property
    def text(self) -> str:
        """In words."""
        title, after = _COLUMNS[self.metric].title, method_name(self.after)
        if self.kind == "near_log":
            return f"{after}: {title} at the end as in the log, within {self.bound:g} points"
        verb = _VERBS.get(self.kind) or f"falls{f' at least {self.bound:g} times' if self.bound > 1 else ''}"
        return f"{method_name(self.before)} to {after}: {title} {verb}{', beyond sampling' if self.clearly else ''}"

    def shown(self, value: float) -> str:
        """A factor or a difference as text, without its unit."""
        column = _COLUMNS[self.metric]
        return f"{value:.1f}" if self.kind == "times" else f"{value * column.scale:+.{column.digits}f}"

    @property
    def unit(self) -> str:
        """The unit of a factor or a difference."""
        unit = _COLUMNS[self.metric].unit
        return "times" if self.kind == "times" else "points" if unit == "%" else unit


STATEMENTS = (
    Statement("times", "collision_rate", "bc", "bc_ts", 1.0),
    Statement("times", "collision_rate", "bc", "bc_ts_h", 9.3),
    Statement("times", "offroad_time", "bc", "bc_ts_h", 6.4),
    Statement("times", "collision_rate", "mgail", "mgail_ts", 1.0),
    Statement("times", "collision_rate", "mgail_h", "mgail_ts_h", 1.0),
    Statement("times", "collision_rate", "mgail", "mgail_ts_h", 2.2),
    Statement("lower", "collision_rate", "bc", "mgail"),
    Statement("not_higher", "min_sade", "bc_h", "bc_ts_h"),
    Statement("lower", "ade", "bc_ts", "bc_ts_h"),
    Statement("lower", "min_sade", "bc_ts", "bc_ts_h"),
    Statement("lower", "ade", "mgail_ts", "mgail_ts_h"),
    Statement("lower", "min_sade", "mgail_ts", "mgail_ts_h"),
    Statement("higher", "curvature_jsd", "bc", "bc_ts", clearly=True),
    Statement("lower", "curvature_jsd", "bc_ts", "bc_ts_h", clearly=True),
    Statement("higher", "curvature_jsd", "mgail", "mgail_ts", clearly=True),
    Statement("lower", "curvature_jsd", "mgail_ts", "mgail_ts_h", clearly=True),
    *(Statement("near_log", "standing", "", method, STANDING_POINTS) for method in ROWS[2:]),
)
"""What the paper's tables say (and one of the log: agents that have learned to stop are safe)."""


@dataclass(frozen=True)
class Relation:
    """A statement beside our numbers.

    Attributes:
        statement: what is claimed.
        held: whether it is so; None where it can't be said.
        value: the factor, or the difference.
        error: its standard error, paired over recordings (over run segments where they are not known).
        clear: whether the value is more than :data:`CLEAR` errors away from the bound.
        paper: the same of the paper's figures, by data set.
        missing: what is not there, where it can't be said.
    """

    statement: Statement
    held: bool | None = None
    value: float = math.nan
    error: float = math.nan
    clear: bool = False
    paper: Mapping[PaperData, float] = field(default_factory=dict)
    missing: str = ""

    @property
    def verdict(self) -> str:
        """In words."""
        if self.held is None:
            return "not known"
        return ("held" if self.held else "not held") + ("" if self.clear else ", within the error")


def relations(entries: Sequence[Entry], setting: Setting = "main") -> list[Relation]:
    """Whether the paper's relations hold in some evaluated runs, one evaluation of each.

    Seeds of a method are averaged; errors are of the paired differences between run segments (the linearised error of
    a factor), clustered by recording. Divergences are compared without their bias by sampling.

    Raises:
        DataError: an evaluation without a number that is needed.
    """
    return [replace(_checked(one, entries), paper=_paper(one, setting)) for one in STATEMENTS]


def _checked(one: Statement, entries: Sequence[Entry]) -> Relation:
    runs = [[e for e in entries if e.method == method] for method in (one.before, one.after)]
    names = [method for method in (one.before, one.after) if method]
    absent = [method_name(m) for m in names if not any(e.method == m for e in entries)]
    if absent:
        return Relation(one, missing=f"no runs of {' and '.join(absent)}")
    found = _measured(one, *runs)
    if found is None:
        return Relation(one, missing="not in these evaluations: evaluate again")
    value, error = found
    if math.isnan(value):
        return Relation(one, missing="no number: both are 0, or a mean over nothing")
    away = {"times": value - one.bound, "higher": value - one.bound, "near_log": one.bound - abs(value)}.get(
        one.kind, one.bound - value
    )
    clear = abs(away) > CLEAR * error or math.isinf(value)
    # What stays the same does not fall.
    strict = one.clearly or one.kind in ("lower", "higher") or one.bound == 1.0
    held = (away > 0 if strict else away >= 0) and (clear or not one.clearly)
    return Relation(one, held, value, error, clear)


def _measured(one: Statement, before: Sequence[Entry], after: Sequence[Entry]) -> tuple[float, float] | None:
    """The factor by which a metric falls, or the difference, and its error; None where records lack it."""
    if one.metric == "curvature_jsd":
        return _divergence(before, after)
    if one.kind == "near_log":
        keys = ("standing", "standing_log")
        if any(key not in entry.record for entry in after for key in keys):
            return None
        member, (values, _) = _rows([after, after], keys)
        error = clustered_mean(values[:, 0] - values[:, 1], member)[1]
        return _mean(after, keys[0]) - _mean(after, keys[1]), error
    first, second = _mean(before, one.metric), _mean(after, one.metric)
    member, (a, b) = _rows([before, after], [one.metric])
    if one.kind != "times":
        return second - first, clustered_mean(b[:, 0] - a[:, 0], member)[1]
    if second == 0:
        return (math.inf if first > 0 else math.nan), math.nan
    ratio = first / second
    return ratio, clustered_mean((a[:, 0] - ratio * b[:, 0]) / second, member)[1]


def _mean(entries: Sequence[Entry], key: str) -> float:
    return float(np.mean([number(entry, entry.record, key) for entry in entries]))


def _rows(
    sides: Sequence[Sequence[Entry]], metrics: Sequence[str]
) -> tuple[NDArray[np.int64], list[NDArray[np.float64]]]:
    """Numbers of the run segments that all evaluations of two methods have, averaged over those of each.

    Returns:
        The number of the recording of each segment [K], and for each method its numbers [K, metrics].

    Raises:
        ConfigError: there is no such segment.
        DataError: an evaluation without rows of its segments.
    """
    tables = []
    for entry in (entry for side in sides for entry in side):
        rows: Any = entry.record.get("per_segment")
        if not isinstance(rows, list):
            raise DataError("is missing", file=f"{entry.folder}: {entry.name}", field="per_segment")
        tables.append({str(row["segment"]): (entry, row) for row in rows})
    names = sorted(set.intersection(*map(set, tables)))
    if not names:
        each = " and ".join(method_name(side[0].method) for side in sides)
        raise ConfigError(f"{each} share no run segment")
    numbers = np.array(
        [
            [[number(table[name][0], {key: None} | table[name][1], key) for key in metrics] for name in names]
            for table in tables
        ]
    )
    groups = [str(tables[0][name][1].get("group") or name) for name in names]
    split = np.split(numbers, [len(sides[0])])
    return np.unique(groups, return_inverse=True)[1], [part.mean(0) for part in split]


def _divergence(before: Sequence[Entry], after: Sequence[Entry]) -> tuple[float, float] | None:
    """Difference of the corrected divergences, from what each recording adds to them."""
    parts = [[entry.record["curvature"].get("parts") for entry in entries] for entries in (before, after)]
    if any(one is None for each in parts for one in each):
        return None
    names = sorted(set.intersection(*(set(one) for each in parts for one in each)))
    # A number that is not defined is None in JSON.
    first, second = (
        np.array([[one[name] for name in names] for one in each], dtype=np.float64).mean(0) for each in parts
    )
    if np.isnan(first).any() or np.isnan(second).any():  # all turns are of one recording, or there is but one
        return math.nan, math.nan
    return clustered_mean(second - first, np.arange(len(names)))


def _paper(one: Statement, setting: Setting) -> dict[PaperData, float]:
    found: dict[PaperData, float] = {}
    for dataset in get_args(PaperData):
        figures = paper_figures(setting, dataset)
        if figures and one.kind != "near_log":
            first, second = (figures[method][one.metric][0] for method in (one.before, one.after))
            found[dataset] = first / second if one.kind == "times" else second - first
    return found


def paired_lines(entries: Sequence[Entry], base: str) -> list[str]:
    """Every method less one of them, a line for each; seeds of a method are averaged first.

    Raises:
        ConfigError: the base is not among them, or they have no segments in common.
        DataError: an evaluation without rows of its segments.
    """
    methods = list(dict.fromkeys(entry.method for entry in entries))
    if base not in methods:
        raise ConfigError(f"'{base}' is not among the methods {', '.join(methods)}")
    columns = [column for column in COLUMNS if column.key != "curvature_jsd"]  # no segment has one of its own
    lines = []
    for method in methods:
        if method == base:
            continue
        sides = [[entry for entry in entries if entry.method == each] for each in (method, base)]
        member, (mine, other) = _rows(sides, [column.key for column in columns])
        parts = []
        for column, away in zip(columns, (mine - other).T, strict=True):
            mean, error = clustered_mean(away, member)
            parts.append(
                f"{column.title} {mean:+.{column.digits}f} ± {error:.{column.digits}f} {column.unit}"
            )
        count = f"{len(member)} segments of {member.max() + 1} groups"
        lines.append(f"{method_name(method)} less {method_name(base)}: {', '.join(parts)} ({count})")
    return lines


# --- text ---


def grid(found: Sequence[Relation]) -> list[list[str]]:
    """A line per relation under a heading: what is claimed, ours, the paper's, whether it is held."""
    lines = [["", "here", *(f"paper, {name}" for name in PAPER_NAMES.values()), "is it so?"]]
    for relation in found:
        one, error = relation.statement, relation.error
        plus = "" if math.isnan(error) else f" ± {one.shown(error).lstrip('+')}"
        here = (
            f"{one.shown(relation.value)}{plus} {one.unit}" if relation.held is not None else relation.missing
        )
        paper = [one.shown(relation.paper[data]) if data in relation.paper else "–" for data in PAPER_NAMES]
        lines.append([one.text, here, *paper, relation.verdict])
    return lines


def _as_text(found: Sequence[Relation]) -> str:
    lines = []
    for text, here, *paper, verdict in grid(found)[1:]:
        beside = ", ".join(f"{n} {p}" for n, p in zip(PAPER_NAMES.values(), paper, strict=True) if p != "–")
        lines.append(f"{verdict}: {text}: {here}{f' (paper: {beside})' if beside else ''}\n")
    return "".join(lines)


def _as_json(found: Sequence[Relation]) -> str:
    rows = []
    for one in found:
        names = ("kind", "metric", "before", "after", "bound")
        about = {"text": one.statement.text} | {name: getattr(one.statement, name) for name in names}
        ours = {"held": one.held, "clear": one.clear, "value": one.value, "se": one.error}
        rows.append(about | ours | {"paper": dict(one.paper), "missing": one.missing})
    return json_text(rows)


RELATION_FORMATS: dict[TableFormat, Callable[[Sequence[Relation]], str]] = {
    "text": _as_text,
    "markdown": lambda found: markdown(grid(found)),
    "json": _as_json,
}
"""How relations are written."""
