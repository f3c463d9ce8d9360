"""The paper's relations between the methods, each held or not by our runs, with numbers and paired errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from symphony.config import PaperData, Setting, TableFormat
from symphony.errors import ConfigError
from symphony.evaluation.comparison import METHOD_COLUMNS
from symphony.evaluation.entries import ROWS, Entry, method_name, number
from symphony.evaluation.paired import clustered_mean, mean_rows
from symphony.evaluation.paper import paper_figures
from symphony.files import json_text

CLEAR = 2.0
"""Standard errors by which a number must differ from its bound to differ clearly."""
STANDING_POINTS = 5.0
"""Points by which the share of agents that stand at the end may differ from the log's."""
PAPER_NAMES: dict[PaperData, str] = {"proprietary": "own data", "womd": "WOMD"}

Kind = Literal["times", "lower", "not_higher", "higher", "near_log"]


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
        title = METHOD_COLUMNS[self.metric].title
        if self.kind == "near_log":
            return (
                f"{method_name(self.after)}: {title} at the end as in the log, within {self.bound:g} points"
            )
        pair = f"{method_name(self.before)} to {method_name(self.after)}"
        if self.kind == "times":
            return f"{pair}: {title} falls{f' at least {self.bound:g} times' if self.bound > 1 else ''}"
        verb = {"lower": "falls", "not_higher": "does not rise", "higher": "rises"}[self.kind]
        return f"{pair}: {title} {verb}{', beyond sampling' if self.clearly else ''}"


def _statements() -> tuple[Statement, ...]:
    jsd = "curvature_jsd"
    found = [
        Statement("times", "collision_rate", "bc", "bc_ts", 1.0),
        Statement("times", "collision_rate", "bc", "bc_ts_h", 9.3),
        Statement("times", "offroad_time", "bc", "bc_ts_h", 6.4),
        Statement("times", "collision_rate", "mgail", "mgail_ts", 1.0),
        Statement("times", "collision_rate", "mgail_h", "mgail_ts_h", 1.0),
        Statement("times", "collision_rate", "mgail", "mgail_ts_h", 2.2),
        Statement("lower", "collision_rate", "bc", "mgail"),
        Statement("not_higher", "min_sade", "bc_h", "bc_ts_h"),
    ]
    for base in ("bc", "mgail"):
        found += [Statement("lower", metric, f"{base}_ts", f"{base}_ts_h") for metric in ("ade", "min_sade")]
    for base in ("bc", "mgail"):
        found.append(Statement("higher", jsd, base, f"{base}_ts", clearly=True))
        found.append(Statement("lower", jsd, f"{base}_ts", f"{base}_ts_h", clearly=True))
    return (*found, *(Statement("near_log", "standing", "", method, STANDING_POINTS) for method in ROWS[2:]))


STATEMENTS = _statements()
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
    runs = {
        method: [e for e in entries if e.method == method] for method in (one.before, one.after) if method
    }
    absent = [method_name(method) for method, mine in runs.items() if not mine]
    if absent:
        return Relation(one, missing=f"no runs of {' and '.join(absent)}")
    if one.metric == "curvature_jsd":
        found = _divergence(runs[one.before], runs[one.after])
    elif one.kind == "near_log":
        found = _near_log(runs[one.after])
    else:
        found = _pair(one, runs[one.before], runs[one.after])
    if found is None:
        return Relation(one, missing="not in these evaluations: evaluate again")
    value, error = found
    if math.isnan(value):
        return Relation(one, missing="no number: both are 0, or a mean over nothing")
    away = {
        "times": value - one.bound,
        "lower": one.bound - value,
        "not_higher": one.bound - value,
        "higher": value - one.bound,
        "near_log": one.bound - abs(value),
    }[one.kind]
    clear = abs(away) > CLEAR * error or math.isinf(value)
    # What stays the same does not fall.
    strict = one.clearly or one.kind in ("lower", "higher") or one.bound == 1.0
    held = (away > 0 if strict else away >= 0) and (clear or not one.clearly)
    return Relation(one, held, value, error, clear)


def _mean(entries: Sequence[Entry], key: str) -> float:
    return float(np.mean([number(entry, entry.record, key) for entry in entries]))


def _pair(one: Statement, before: Sequence[Entry], after: Sequence[Entry]) -> tuple[float, float]:
    """The factor by which a metric falls, or the difference, and its error."""
    first, second = _mean(before, one.metric), _mean(after, one.metric)
    rows = [mean_rows(entries, [one.metric]) for entries in (before, after)]
    names = sorted(rows[0].keys() & rows[1].keys())
    if not names:
        raise ConfigError(f"{method_name(one.before)} and {method_name(one.after)} share no run segment")
    groups = np.unique([rows[0][name][0] for name in names], return_inverse=True)[1]
    a, b = (np.array([each[name][1][one.metric] for name in names]) for each in rows)
    if one.kind != "times":
        return second - first, clustered_mean(b - a, groups)[1]
    if second == 0:
        return (math.inf if first > 0 else math.nan), math.nan
    ratio = first / second
    return ratio, clustered_mean((a - ratio * b) / second, groups)[1]


def _divergence(before: Sequence[Entry], after: Sequence[Entry]) -> tuple[float, float] | None:
    """Difference of the corrected divergences, from what each recording adds to them."""
    parts = [[entry.record["curvature"].get("parts") for entry in entries] for entries in (before, after)]
    if any(one is None for each in parts for one in each):
        return None
    names = sorted(set.intersection(*(set(one) for each in parts for one in each)))
    means = [np.mean([_row(one, names) for one in each], axis=0) for each in parts]
    if np.isnan(means).any():  # all turns are of one recording, or there is but one
        return math.nan, math.nan
    return clustered_mean(means[1] - means[0], np.arange(len(names)))


def _row(parts: Mapping[str, Any], names: Sequence[str]) -> NDArray[np.float64]:
    return np.array([math.nan if parts[name] is None else parts[name] for name in names], dtype=np.float64)


def _near_log(entries: Sequence[Entry]) -> tuple[float, float] | None:
    """By how many points more agents stand at the end than in the log."""
    keys = ("standing", "standing_log")
    if any(key not in entry.record for entry in entries for key in keys):
        return None
    rows = mean_rows(entries, keys).values()
    away = np.array([numbers[keys[0]] - numbers[keys[1]] for _, numbers in rows])
    groups = np.unique([group for group, _ in rows], return_inverse=True)[1]
    return _mean(entries, keys[0]) - _mean(entries, keys[1]), clustered_mean(away, groups)[1]


def _paper(one: Statement, setting: Setting) -> dict[PaperData, float]:
    found: dict[PaperData, float] = {}
    for dataset in get_args(PaperData):
        figures = paper_figures(setting, dataset)
        if figures is None or one.kind == "near_log":
            continue
        first, second = (figures[method][one.metric][0] for method in (one.before, one.after))
        found[dataset] = first / second if one.kind == "times" else second - first
    return found


def formatted(one: Statement, value: float) -> str:
    """A factor or a difference as text, without its unit."""
    if one.kind == "times":
        return f"{value:.1f}"
    column = METHOD_COLUMNS[one.metric]
    return f"{value * column.scale:+.{column.digits}f}"


def unit(one: Statement) -> str:
    """Of a factor or a difference."""
    if one.kind == "times":
        return "times"
    column = METHOD_COLUMNS[one.metric]
    return "points" if column.unit == "%" else column.unit


def _measured(relation: Relation) -> str:
    one, error = relation.statement, relation.error
    if relation.held is None:
        return relation.missing
    plus = "" if math.isnan(error) else f" ± {formatted(one, error).lstrip('+')}"
    return f"{formatted(one, relation.value)}{plus} {unit(one)}"


def grid(found: Sequence[Relation]) -> list[list[str]]:
    """A line per relation under a heading: what is claimed, ours, the paper's, whether it is held."""
    lines = [["", "here", *(f"paper, {name}" for name in PAPER_NAMES.values()), "is it so?"]]
    for relation in found:
        one = relation.statement
        paper = [
            formatted(one, relation.paper[data]) if data in relation.paper else "–" for data in PAPER_NAMES
        ]
        lines.append([one.text, _measured(relation), *paper, relation.verdict])
    return lines


def _as_text(found: Sequence[Relation]) -> str:
    lines = []
    for text, here, *paper, verdict in grid(found)[1:]:
        beside = ", ".join(f"{n} {p}" for n, p in zip(PAPER_NAMES.values(), paper, strict=True) if p != "–")
        lines.append(f"{verdict}: {text}: {here}{f' (paper: {beside})' if beside else ''}")
    return "\n".join(lines) + "\n"


def _as_markdown(found: Sequence[Relation]) -> str:
    lines = [f"| {' | '.join(line)} |" for line in grid(found)]
    return "\n".join([lines[0], "| --- | ---: | ---: | ---: | --- |", *lines[1:]]) + "\n"


def _as_json(found: Sequence[Relation]) -> str:
    return json_text(
        [
            {
                "text": one.statement.text,
                "kind": one.statement.kind,
                "metric": one.statement.metric,
                "before": one.statement.before,
                "after": one.statement.after,
                "bound": one.statement.bound,
                "held": one.held,
                "clear": one.clear,
                "value": one.value,
                "se": one.error,
                "paper": dict(one.paper),
                "missing": one.missing,
            }
            for one in found
        ]
    )


RELATION_FORMATS: dict[TableFormat, Callable[[Sequence[Relation]], str]] = {
    "text": _as_text,
    "markdown": _as_markdown,
    "json": _as_json,
}
