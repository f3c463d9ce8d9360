"""The paper's relations, rows for each way of simulation and columns on request, all from kept evaluations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_table import make_entry, make_record, make_run, row_of
from symphony.cli import main
from symphony.config import Method, TableColumns
from symphony.errors import ConfigError, DataError
from symphony.evaluation.formats import FORMATS
from symphony.evaluation.paper import paper_figures
from symphony.evaluation.relations import (
    RELATION_FORMATS,
    STATEMENTS,
    Relation,
    grid,
    paired_lines,
    relations,
)
from symphony.evaluation.table import ASKED, COLUMNS, Entry, collect, compare
from symphony.metrics.intervals import clustered_mean

METHODS = get_args(Method)
RATES = ("collision_rate", "offroad_time", "ade", "min_sade")
SEGMENTS = 12


def filled(
    record: dict[str, Any], means: dict[str, float], parts: float = 0.0, seed: int = 0
) -> dict[str, Any]:
    """A record whose segments scatter around the given means; noise is that of the segment, not of the method."""
    noise = np.random.default_rng(seed).uniform(0.5, 1.5, SEGMENTS)
    noise /= noise.mean()
    rows = [
        {"segment": f"s{k}", "group": f"g{k // 2}"} | {key: mean * n for key, mean in means.items()}
        for k, n in enumerate(noise)
    ]
    record |= means | {"per_segment": rows, "segments": len(rows)}
    record["curvature"] |= {"parts": {f"g{k}": parts + 0.001 * k for k in range(SEGMENTS // 2)}}
    return record


def entry(method: str, seed: int = 0, parts: float = 0.0, **means: float) -> Entry:
    found = make_entry(method, seed)
    filled(found.record, dict.fromkeys(RATES, 1.0) | means, parts)  # type: ignore[arg-type]
    return found


def of(found: list[Relation], metric: str, before: str, after: str) -> Relation:
    (one,) = (
        r
        for r in found
        if (r.statement.metric, r.statement.before, r.statement.after) == (metric, before, after)
    )
    return one


@settings(max_examples=30)
@given(st.floats(0.1, 90), st.floats(0.01, 90), st.floats(0.01, 90))
def test_factors_are_held_from_their_bound_on(before: float, after: float, other: float) -> None:
    entries = [entry("bc", collision_rate=before)]
    entries += [entry("bc_ts_h", seed, collision_rate=rate) for seed, rate in enumerate((after, other))]
    found = of(relations(entries), "collision_rate", "bc", "bc_ts_h")
    assert found.value == pytest.approx(before / np.mean([after, other]))
    assert found.held == (found.value >= 9.3)
    # What is hard is as much harder in one as in the other: paired, the factor has no error.
    assert found.error == pytest.approx(0.0, abs=1e-9)


@settings(max_examples=30)
@given(st.floats(1, 9), st.floats(1, 9))
def test_differences_are_held_by_their_sign(before: float, after: float) -> None:
    found = relations([entry("bc_h", min_sade=before), entry("bc_ts_h", min_sade=after)])
    one = of(found, "min_sade", "bc_h", "bc_ts_h")
    assert one.value == pytest.approx(after - before)
    assert one.held == (after <= before)
    assert one.held is not None
    assert one.clear == (abs(one.value) > 2 * one.error)


@pytest.mark.parametrize(("shift", "held"), [(0.01, True), (0.0001, False), (-0.01, False)])
def test_divergences_must_differ_by_more_than_sampling(shift: float, held: bool) -> None:
    rng = np.random.default_rng(0)
    entries = [entry("bc"), entry("bc_ts")]
    for one, mean in zip(entries, (0.0, shift), strict=True):
        noise = rng.normal(0, 0.001, 40)
        parts = mean + noise - noise.mean()
        one.record["curvature"]["parts"] = {f"g{k}": part for k, part in enumerate(parts)}
    found = of(relations(entries), "curvature_jsd", "bc", "bc_ts")
    assert found.held is held
    assert found.value == pytest.approx(shift)
    assert found.error == pytest.approx(0.001 * np.sqrt(2 / 40), rel=0.4)


def test_divergences_that_a_single_recording_makes_have_no_error_and_are_not_compared() -> None:
    """Without it there is no turn left, so the jackknife has no number for it, and the same one for all others."""
    entries = [entry("bc"), entry("bc_ts")]
    for one, value in zip(entries, (0.01, 0.02), strict=True):
        one.record["curvature"]["parts"] = {"a": None, "b": value, "c": value}
    found = of(relations(entries), "curvature_jsd", "bc", "bc_ts")
    assert found.held is None


def test_what_stays_the_same_does_not_fall() -> None:
    found = relations([entry(method, collision_rate=3.0) for method in ("bc", "bc_ts", "mgail")])
    assert of(found, "collision_rate", "bc", "bc_ts").held is False
    assert of(found, "collision_rate", "bc", "mgail").held is False


def test_who_stands_is_compared_with_the_log() -> None:
    entries = [
        entry("bc", standing=16.0, standing_log=12.0),
        entry("mgail", standing=60.0, standing_log=12.0),
    ]
    found = relations(entries)
    assert of(found, "standing", "", "bc").held
    assert of(found, "standing", "", "mgail").held is False
    assert of(found, "standing", "", "mgail").value == pytest.approx(48.0)


def test_what_cannot_be_said_is_not_said() -> None:
    found = relations([entry("bc", 0), entry("bc_ts", 0, collision_rate=0.0)])
    assert of(found, "collision_rate", "bc", "bc_ts").held
    assert of(found, "collision_rate", "bc", "bc_ts").value == np.inf
    absent = of(found, "collision_rate", "bc", "mgail")
    assert absent.held is None
    assert "MGAIL" in absent.missing
    assert of(found, "standing", "", "bc").missing.endswith("evaluate again")
    old = [make_entry(method) for method in ("bc", "bc_ts")]
    for one in old:
        one.record["per_segment"] = []  # type: ignore[index]
    with pytest.raises(ConfigError, match="share no run segment"):
        relations(old)
    del old[0].record["per_segment"]  # type: ignore[attr-defined]
    with pytest.raises(DataError, match="per_segment"):
        relations(old)


def test_paired_differences_are_over_what_both_have_and_over_recordings() -> None:
    rng, names = np.random.default_rng(0), [f"segment-{k}" for k in range(12)]

    def shifted(method: str, seed: int, shift: float) -> Entry:
        found = make_entry(method, seed)
        found.record["per_segment"] = [  # type: ignore[index]
            {"segment": name, "group": f"group-{k // 3}"}
            | {column.key: base[k] + shift for column in COLUMNS[:4]}
            for k, name in enumerate(names)
        ]
        return found

    base = rng.normal(size=12)
    (line,) = paired_lines([shifted("bc", 0, 0.0), shifted("bc", 1, 1.0), shifted("bc_h", 0, 2.5)], "bc")
    # Seeds are averaged first, and a shift that is the same everywhere has no error.
    numbers = "collision +2.00 ± 0.00 %, off-road +2.00 ± 0.00 %, ADE +2.00 ± 0.00 m, minSADE +2.00 ± 0.00 m"
    assert line == f"BC+H less BC: {numbers} (12 segments of 4 groups)"
    fewer = shifted("bc_h", 0, 2.5)
    fewer.record["per_segment"].pop()
    assert "11 segments" in paired_lines([shifted("bc", 0, 0.0), fewer], "bc")[0]
    wrong = shifted("bc_h", 1, 0.0)
    wrong.record["per_segment"][3]["ade"] = "far"
    with pytest.raises(DataError, match="ade"):
        paired_lines([shifted("bc", 0, 0.0), wrong], "bc")
    with pytest.raises(ConfigError, match="not among the methods"):
        paired_lines([shifted("bc", 0, 0.0)], "mgail")


@given(st.lists(st.floats(-5, 5), min_size=2, max_size=30))
def test_errors_over_groups_of_one_are_the_usual_ones(values: list[float]) -> None:
    numbers = np.array(values)
    mean, error = clustered_mean(numbers, np.arange(len(numbers)))
    assert mean == pytest.approx(numbers.mean())
    assert error == pytest.approx(numbers.std(ddof=1) / np.sqrt(len(numbers)), abs=1e-12)
    # Copies within a group tell nothing new.
    twice = clustered_mean(np.repeat(numbers, 2), np.repeat(np.arange(len(numbers)), 2))
    assert twice == pytest.approx((mean, error), abs=1e-9)


def test_the_paper_s_own_figures_have_the_paper_s_relations() -> None:
    """Up to rounding: the paper's factors themselves are given to one digit."""
    figures = paper_figures("main", "proprietary")
    entries = []
    for method in METHODS:
        means = {key: mean for key, (mean, _) in figures[method].items()}
        parts = means.pop("curvature_jsd")
        one = entry(method, parts=parts, **means)
        entries.append(one)
    found = [one for one in relations(entries) if one.statement.metric != "standing"]
    for one in found:
        times = one.statement.kind == "times"
        assert one.held or (times and one.value > one.statement.bound - 0.06), one
        assert one.paper["proprietary"] == pytest.approx(one.value)


def test_every_format_says_every_relation() -> None:
    found = relations([entry("bc"), entry("bc_ts_h", collision_rate=0.05)])
    text, markdown = (RELATION_FORMATS[name](found) for name in ("text", "markdown"))
    for one in found:
        assert one.statement.text in text
        assert one.statement.text in markdown
    assert len({line.count("|") for line in markdown.splitlines()}) == 1
    assert "held: BC to BC+TS+H: collision falls at least 9.3 times: 20.0 ± 0.0 times" in text
    read = json.loads(RELATION_FORMATS["json"](found))
    assert [one["held"] for one in read] == [one.held for one in found]
    assert len(grid(found)) == 1 + len(STATEMENTS)


# --- a row for each way, columns on request ---


def two_ways(folder: Path) -> Path:
    forest = make_record(search="tree", trees=16, branches=4, rule="best")
    forest["cost"] = {"simulation": 24.0}
    tree = make_record(search="tree", trees=1, branches=16, rule="best", goals="branch")
    for record in (forest, tree):
        filled(record, dict.fromkeys(RATES, 1.0))
    return make_run(folder, "bc_ts", 0, forest, tree)


def test_each_way_has_a_row_and_its_cost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = two_ways(tmp_path / "ts")
    make_run(tmp_path / "bc", "bc", 0, make_record())
    entries, _ = collect([tmp_path], "main", each=True)
    comparison = compare(entries, "main")
    cost = {row.way: row.cells["cost"].mean for row in comparison.rows if row.method == "bc_ts"}
    assert cost == {"tree-16x4-best": 2.0, "tree-1x16-best-goals=branch": 0.5}
    assert [
        row["way"] for row in json.loads(FORMATS["json"](comparison))["rows"] if row["method"] == "bc_ts"
    ] == [*cost]
    for write in FORMATS.values():
        assert all(way in write(comparison) for way in cost)
    some, _ = collect([tmp_path], "main", ["*-16x4-*", "*-none-*"], each=True)
    assert [entry.way for entry in some] == ["none", "tree-16x4-best"]
    assert main(["table", "--setting", "main", "--runs", str(tmp_path), "--each"]) == 0
    assert "tree-16x4-best" in capsys.readouterr().out
    make_run(tmp_path / "other", "bc_ts", 0, make_record(search="tree", trees=16, branches=4, rule="best"))
    with pytest.raises(ConfigError, match=rf"two runs of BC\+TS.*other.*{run.name}|{run.name}.*other"):
        collect([tmp_path], "main", each=True)


def test_two_evaluations_of_one_way_need_a_choice(tmp_path: Path) -> None:
    make_run(tmp_path / "bc", "bc", 0, make_record(), make_record(seed=3))
    with pytest.raises(ConfigError, match=r"simulated twice as none.*--evaluation"):
        collect([tmp_path], "main", each=True)


@pytest.mark.parametrize("name", get_args(TableColumns))
def test_columns_on_request_are_there_where_records_have_them(name: TableColumns) -> None:
    new, old = make_entry("bc"), make_entry("bc_h")
    numbers = {"collision_with_playback": 0.25, "standing": 20.0, "standing_log": 10.0}
    numbers |= {column.key: 0.5 for column in ASKED["goals"]} | {"curvature_jsd_corrected": 0.5}
    new.record.update(numbers)  # type: ignore[attr-defined]
    comparison = compare([new, old], "main", asked=[name])
    for column in ASKED[name]:
        value = row_of(comparison, "bc").cells[column.key].mean
        assert value == numbers.get(column.key, 1.0 - 0.25)
        assert np.isnan(row_of(comparison, "bc_h").cells[column.key].mean)
        assert all(column.title in write(comparison) for key, write in FORMATS.items() if key != "json")
    assert {c.key for c in compare([new, old], "main").columns}.isdisjoint(c.key for c in ASKED[name])


def test_the_floor_stands_beside_the_divergence_where_all_have_it() -> None:
    entries = [make_entry("bc"), make_entry("bc_h")]
    entries[0].record["curvature_jsd_floor"] = 0.004  # type: ignore[index]
    assert "JSD floor" not in FORMATS["markdown"](compare(entries, "main"))
    entries[1].record["curvature_jsd_floor"] = 0.002  # type: ignore[index]
    keys = [column.key for column in compare(entries, "main").columns]
    assert keys[keys.index("curvature_jsd") + 1] == "curvature_jsd_floor"
    assert "4.00" in FORMATS["markdown"](compare(entries, "main"))


@pytest.mark.parametrize(
    ("extra", "status"),
    [
        (["--relations"], 0),
        (["--relations", "--format", "json"], 0),
        (["--relations", "--format", "latex"], 2),
        (["--relations", "--each"], 2),
        (["--columns", "split", "standing"], 0),
        (["--columns", "weather"], 2),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else str(value),
)
def test_the_command(
    extra: list[str], status: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_run(tmp_path / "bc", "bc", 0, filled(make_record(), dict.fromkeys(RATES, 1.0)))
    assert main(["table", "--setting", "main", "--runs", str(tmp_path), *extra]) == status
    printed = capsys.readouterr()
    if status:
        assert printed.err.strip()
    elif "json" in extra:
        assert len(json.loads(printed.out)) == len(STATEMENTS)
    else:
        assert ("not known" in printed.out) == ("--relations" in extra)
