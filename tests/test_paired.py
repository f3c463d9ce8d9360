"""Columns of a user's own, and paired differences between methods with errors over recordings."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers_table import make_entry, make_record, row_of
from symphony.errors import ConfigError, DataError
from symphony.evaluation.comparison import compare
from symphony.evaluation.entries import Entry
from symphony.evaluation.formats import as_latex, as_markdown
from symphony.evaluation.paired import PAIRED, clustered_mean, differences


def test_paired_differences_are_over_what_both_have_and_over_recordings() -> None:
    rng, names = np.random.default_rng(0), [f"segment-{k}" for k in range(12)]

    def entry(method: str, seed: int, shift: float) -> Entry:
        found = make_entry(method, seed)
        found.record["per_segment"] = [  # type: ignore[index]
            {"segment": name, "group": f"group-{k // 3}"} | {column.key: base[k] + shift for column in PAIRED}
            for k, name in enumerate(names)
        ]
        return found

    base = rng.normal(size=12)
    (found,) = differences([entry("bc", 0, 0.0), entry("bc", 1, 1.0), entry("bc_h", 0, 2.5)], "bc")
    assert (found.method, found.base, found.segments, found.groups) == ("bc_h", "bc", 12, 4)
    for column in PAIRED:
        # Seeds are averaged first, and a shift that is the same everywhere has no error.
        assert found.means[column.key] == pytest.approx(2.0)
        assert found.errors[column.key] == pytest.approx(0.0, abs=1e-9)
    assert "12 segments of 4 groups" in found.text()
    fewer = entry("bc_h", 0, 2.5)
    fewer.record["per_segment"].pop()
    assert differences([entry("bc", 0, 0.0), fewer], "bc")[0].segments == 11
    wrong = entry("bc_h", 1, 0.0)
    wrong.record["per_segment"][3]["ade"] = "far"
    with pytest.raises(DataError, match="ade"):
        differences([entry("bc", 0, 0.0), wrong], "bc")
    with pytest.raises(ConfigError, match="not among the methods"):
        differences([entry("bc", 0, 0.0)], "mgail")


@given(st.lists(st.floats(-5, 5), min_size=2, max_size=30))
def test_errors_over_groups_of_one_are_the_usual_ones(values: list[float]) -> None:
    numbers = np.array(values)
    mean, error = clustered_mean(numbers, np.arange(len(numbers)))
    assert mean == pytest.approx(numbers.mean())
    assert error == pytest.approx(numbers.std(ddof=1) / np.sqrt(len(numbers)), abs=1e-12)
    # Copies within a group tell nothing new.
    twice = clustered_mean(np.repeat(numbers, 2), np.repeat(np.arange(len(numbers)), 2))
    assert twice == pytest.approx((mean, error), abs=1e-9)


def test_metrics_of_a_user_s_own_are_columns_where_all_evaluations_have_them() -> None:
    path = "my.metrics:jerk"
    entries = [make_entry(method, seed) for method in ("bc", "bc_h") for seed in (0, 1)]
    for number, entry in enumerate(entries):
        entry.record["config"]["metric"] = [path]  # type: ignore[index]
        entry.record[path] = float(number)  # type: ignore[index]
    comparison = compare(entries, "main")
    assert [column.title for column in comparison.columns][-2:] == ["jerk", "CPU"]
    assert row_of(comparison, "bc").cells[path].mean == 0.5
    assert row_of(comparison, "bc_h").cells[path].mean == 2.5
    assert not row_of(comparison, "bc").cells[path].best, "nobody said whether low is good"
    assert math.isnan(row_of(comparison, "playback").cells[path].mean)
    assert "jerk" in as_markdown(comparison)
    entries[0].record["config"]["metric"] = []  # type: ignore[index]
    for entry in entries[1:2]:
        entry.record["config"]["metric"] = []  # type: ignore[index]
    assert path not in {column.key for column in compare(entries, "main").columns}


def test_latex_has_no_bare_special_letters() -> None:
    path = "my.metrics:time_gap"
    record = make_record(search="tree", branches=16, rule="best", logged_goals=True, metric=[path]) | {
        path: 1.0
    }
    entry = Entry(Path("run"), {"method": "bc"}, "name", record, "tree-16-logged_goals")
    table = as_latex(compare([entry], "main")).partition(r"\begin{tabular}")[2]
    assert r"time\_gap" in table
    assert r"logged\_goals" in table
    assert not re.search(r"(?<!\\)[_%#$]", table.replace(r"$\times 10^{-3}$", ""))
