"""Paired differences between methods: per run segment, so that what makes segments hard cancels out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.errors import ConfigError, DataError
from symphony.evaluation.comparison import COLUMNS, Column
from symphony.evaluation.entries import Entry, method_name, number

PAIRED: tuple[Column, ...] = tuple(column for column in COLUMNS if column.key != "curvature_jsd")
"""What every run segment has a number of."""


@dataclass(frozen=True)
class Difference:
    """A method less another, averaged over run segments.

    Attributes:
        method: the one.
        base: the other.
        means: by metric.
        errors: standard errors over run segments, or over the recordings they are from.
        segments: that both were evaluated on.
        groups: recordings they are from; as many as segments where that is not known.
    """

    method: str
    base: str
    means: dict[str, float]
    errors: dict[str, float]
    segments: int
    groups: int

    def text(self) -> str:
        """In one line."""
        parts = [
            f"{column.title} {self.means[column.key]:+.{column.digits}f} ± "
            f"{self.errors[column.key]:.{column.digits}f} {column.unit}"
            for column in PAIRED
        ]
        names = f"{method_name(self.method)} less {method_name(self.base)}"
        return f"{names}: {', '.join(parts)} ({self.segments} segments of {self.groups} groups)"


def differences(entries: Sequence[Entry], base: str) -> list[Difference]:
    """Every method less one of them; seeds of a method are averaged first.

    Args:
        entries: evaluated runs on the same run segments.
        base: method that the others are compared with.

    Raises:
        ConfigError: the base is not among them, or they have no segments in common.
        DataError: an evaluation without rows of its segments.
    """
    methods = list(dict.fromkeys(entry.method for entry in entries))
    if base not in methods:
        raise ConfigError(f"'{base}' is not among the methods {', '.join(methods)}")
    keys = [column.key for column in PAIRED]
    tables = {method: mean_rows([e for e in entries if e.method == method], keys) for method in methods}
    return [_difference(method, base, tables[method], tables[base]) for method in methods if method != base]


Rows = dict[str, tuple[str, dict[str, float]]]
"""By the name of the segment: its group and its numbers."""


def mean_rows(entries: Sequence[Entry], metrics: Sequence[str]) -> Rows:
    """Numbers of every run segment that all evaluations have, averaged over these (over seeds).

    Raises:
        DataError: an evaluation without rows of its segments.
    """
    each = [_rows(entry, metrics) for entry in entries]
    shared = set.intersection(*(set(rows) for rows in each))
    return {
        name: (
            each[0][name][0],
            {key: float(np.mean([rows[name][1][key] for rows in each])) for key in metrics},
        )
        for name in sorted(shared)
    }


def _rows(entry: Entry, metrics: Sequence[str]) -> Rows:
    rows: Any = entry.record.get("per_segment")
    if not isinstance(rows, list):
        raise DataError("is missing", file=f"{entry.folder}: {entry.name}", field="per_segment")
    found: Rows = {}
    for row in rows:
        numbers = {key: number(entry, {key: None} | row, key) for key in metrics}
        found[str(row["segment"])] = str(row.get("group") or row["segment"]), numbers
    return found


def _difference(method: str, base: str, mine: Rows, other: Rows) -> Difference:
    shared = sorted(mine.keys() & other.keys())
    if not shared:
        raise ConfigError(f"{method_name(method)} and {method_name(base)} share no run segment")
    groups = np.unique([mine[name][0] for name in shared], return_inverse=True)[1]
    means, errors = {}, {}
    for column in PAIRED:
        away = np.array([mine[name][1][column.key] - other[name][1][column.key] for name in shared])
        means[column.key], errors[column.key] = clustered_mean(away, groups)
    return Difference(method, base, means, errors, len(shared), int(groups.max()) + 1)


def clustered_mean(values: NDArray[np.float64], groups: NDArray[np.int64]) -> tuple[float, float]:
    """Mean of finite values and its standard error, where values of one group are not independent.

    The error is that of a ratio of sums over groups (linearised); with groups of one value each it is the usual one.

    Args:
        values: [K].
        groups: [K] number of the group of each.
    """
    known = np.isfinite(values)
    values, groups = values[known], groups[known]
    if len(values) == 0:
        return math.nan, math.nan
    mean, number = float(values.mean()), len(np.unique(groups))
    if number < 2:
        return mean, math.nan
    sums = np.bincount(groups, values - mean)
    return mean, float(np.sqrt(number / (number - 1) * (sums**2).sum()) / len(values))
