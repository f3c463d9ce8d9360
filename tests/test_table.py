"""The paper's tables made of kept evaluations, and the figure of curvature."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_segments import crossing, straight_road
from helpers_table import METHODS, full_table, make_entry, row_of
from symphony.cli import main
from symphony.config import AgentConfig, EvaluateConfig, TrainConfig
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError
from symphony.evaluation import evaluate
from symphony.evaluation.records import evaluation_name, kept_evaluations
from symphony.evaluation.table import (
    COLUMNS,
    METRICS,
    ROWS,
    Entry,
    compare,
    paper_figures,
    table_text,
)
from symphony.files import json_text
from symphony.metrics import jensen_shannon
from symphony.recipes import train
from symphony.render import plot_curvature

NUMBERS = st.floats(0, 100)

# --- what is in a table ---


@settings(max_examples=20)
@given(st.lists(NUMBERS, min_size=1, max_size=6))
def test_cells_are_mean_and_standard_error_over_seeds(values: list[float]) -> None:
    row = row_of(compare([make_entry("bc", k, ade=value) for k, value in enumerate(values)], "main"), "bc")
    assert row["seeds"] == list(range(len(values)))
    assert row["ade"]["mean"] == pytest.approx(np.mean(values))
    error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else math.nan
    assert row["ade"]["se"] == pytest.approx(error, nan_ok=True)


@given(st.permutations(full_table(2)))
@settings(max_examples=4)
def test_the_order_of_runs_does_not_matter(entries: list[Entry]) -> None:
    assert json_text(compare(entries, "main")) == json_text(compare(full_table(2), "main"))


@settings(max_examples=20)
@given(st.dictionaries(st.sampled_from(METHODS), st.tuples(*[NUMBERS] * 5), min_size=1))
def test_the_lowest_value_of_each_family_is_the_best(table: dict[str, tuple[float, ...]]) -> None:
    entries = [make_entry(method, **dict(zip(METRICS, row, strict=True))) for method, row in table.items()]
    found = compare(entries, "main")
    for number, key in enumerate(METRICS):
        for name in ("bc", "mgail"):
            mine = {
                method: COLUMNS[key].shown(row[number])
                for method, row in table.items()
                if method.startswith(name)
            }
            best = {method for method in mine if row_of(found, method)[key]["best"]}
            least = min(mine.values(), key=float) if len(mine) > 1 else None
            assert best == {method for method, shown in mine.items() if shown == least}
        assert not row_of(found, "playback")[key]["best"]


def test_rows_are_those_of_the_paper_and_missing_methods_are_missing() -> None:
    rows = compare(full_table(), "main")["rows"]
    assert [row["method"] for row in rows] == list(ROWS)
    assert " ".join(row["name"] for row in rows[2:]) == (
        "BC BC+H BC+TS BC+TS+H MGAIL MGAIL+H MGAIL+TS MGAIL+TS+H"
    )
    some = compare(full_table(2, ("mgail_ts", "bc_h")), "main", "proprietary")
    assert [row["method"] for row in some["rows"]] == ["playback", "constant_velocity", "bc_h", "mgail_ts"]


def test_playback_has_no_distance_to_itself() -> None:
    row = row_of(compare(full_table(), "main"), "playback")
    assert [row[key]["mean"] for key in METRICS[:2]] == [0.5, 0.25]
    assert all(math.isnan(row[key]["mean"]) for key in METRICS[2:])


def test_a_mean_over_something_unknown_is_unknown_and_never_the_best() -> None:
    entries = [make_entry("bc", 0, ade=1.0), make_entry("bc", 1), make_entry("bc_h", 0), make_entry("bc_ts")]
    entries[1].record["ade"] = None  # type: ignore[index]
    found = compare(entries, "main")
    assert math.isnan(row_of(found, "bc")["ade"]["mean"])
    assert not row_of(found, "bc")["ade"]["best"]
    assert row_of(found, "bc_h")["ade"]["best"]
    assert json.loads(json_text(found))["rows"][2]["ade"]["mean"] is None


@pytest.mark.parametrize(
    ("name", "value"), [("others", "idm"), ("open_traffic", True), ("radius", 40.0), ("interactive", 8)]
)
def test_methods_that_met_other_traffic_are_not_compared(name: str, value: Any) -> None:
    entries = [make_entry("bc", 0), make_entry("bc_h", 0)]
    entries[1].record["config"][name] = value
    with pytest.raises(ConfigError, match=rf"other traffic \({name}\)"):
        compare(entries, "main")


def test_whole_segments_stand_beside_their_first_seconds_only_where_these_are_all() -> None:
    """An agent without a duration of its own is simulated to the end of each segment, which may last 20 s."""
    entries = [make_entry("bc"), make_entry("bc_h")]
    entries[1].record["config"]["duration"] = 10
    compare(entries, "main")
    entries[1].record["constant_velocity"]["ade"] /= 3
    with pytest.raises(ConfigError, match=r"\(duration\)"):
        compare(entries, "main")


def test_metrics_of_a_user_s_own_are_columns_where_all_evaluations_have_them() -> None:
    path = "my.metrics:jerk"
    entries = [make_entry(method, seed) for method in ("bc", "bc_h") for seed in (0, 1)]
    for number, entry in enumerate(entries):
        entry.record["config"]["metric"] = [path]
        entry.record[path] = float(number)  # type: ignore[index]
    found = compare(entries, "main")
    assert found["columns"][-2:] == [path, "cost"]
    assert re.search(r"\| +jerk \| +CPU s/segment \|", table_text(found))
    assert [row_of(found, method)[path]["mean"] for method in ("bc", "bc_h")] == [0.5, 2.5]
    for entry in entries[:2]:
        entry.record["config"]["metric"] = []
    assert path not in compare(entries, "main")["columns"]


BOLD = {
    ("main", "proprietary"): (
        ("bc_ts_h", "bc_ts_h", "bc_ts_h", "bc_ts_h", "bc_ts_h"),
        ("mgail_ts_h", "mgail_ts_h", "mgail_h", "mgail_h", "mgail_h"),
    ),
    ("main", "womd"): (
        ("bc_ts_h", "bc_ts", "bc_ts_h", "bc_ts_h", "bc"),
        ("mgail_ts", "mgail_ts", "mgail_h", "mgail_h", "mgail_ts_h"),
    ),
    ("long", "proprietary"): (("bc_ts", "bc_ts_h", "bc_ts_h", "bc_ts_h", "bc"), ("mgail_ts_h",) * 5),
    ("many", "proprietary"): (("bc_ts", "bc_ts_h", "bc_ts_h", "bc_h", "bc_ts_h"), ("mgail_ts_h",) * 5),
}
"""What the paper prints in bold, by metric."""


@pytest.mark.parametrize(("setting", "dataset"), BOLD)
def test_the_paper_s_bold_figures_are_what_we_call_best(setting: Any, dataset: Any) -> None:
    rows = compare(full_table(1), setting, dataset)["rows"]
    for number, key in enumerate(METRICS):
        best = [row["method"] for row in rows[2:] if row["paper"][key]["best"]]
        assert best == [part[number] for part in BOLD[setting, dataset]]


def test_the_paper_s_figures_are_in_our_units() -> None:
    figures = paper_figures("main", "womd")
    assert figures["bc"]["curvature_jsd"] == pytest.approx((0.00132, 0.00028))
    assert figures["playback"]["collision_rate"][0] == 3.04
    assert math.isnan(figures["playback"]["ade"][0])
    assert set(figures) == set(ROWS) - {"constant_velocity"}
    with pytest.raises(ConfigError, match="no figures for setting 'long' on womd"):
        compare(full_table(1), "long", "womd")


# --- formats ---


def numbers_of(text: str) -> tuple[float, ...]:
    return tuple(float(number) for number in re.findall(r"\d+\.\d+", text))


def expected(table: dict[str, Any]) -> dict[str, list[tuple[bool, tuple[float, ...]]]]:
    """Of every cell: whether it is bold, and the numbers in it."""
    found: dict[str, list[tuple[bool, tuple[float, ...]]]] = {}
    for row in table["rows"]:
        cells = found.setdefault(row["name"], [])
        for key in table["columns"]:
            for cell in (row[key], *([row["paper"].get(key, {})] if table["paper"] else [])):
                numbers = [cell.get(name, math.nan) for name in ("mean", "se")]
                held = [float(COLUMNS[key].shown(number)) for number in numbers if not math.isnan(number)]
                cells.append((cell.get("best", False), tuple(held)))
    return found


@pytest.mark.parametrize("dataset", [None, "proprietary"])
@pytest.mark.parametrize("seeds", [1, 3])
def test_the_text_reads_back(seeds: int, dataset: Any) -> None:
    table = compare(full_table(seeds), "main", dataset)
    lines = [re.split(r" *\| *", line.strip("| ")) for line in table_text(table).splitlines() if "|" in line]
    assert len({len(line) for line in lines}) == 1
    read = {name: [("**" in c, numbers_of(c)) for c in cells] for name, _, *cells in lines[2:]}
    assert read == expected(table)
    assert [line[1] for line in lines[4:]] == [str(seeds)] * 8


def test_json_reads_back_whole() -> None:
    table = compare(full_table(3), "many", "proprietary")
    read = json.loads(json_text(table))
    assert (read["setting"], read["interactive"], read["duration"]) == ("many", 8, 10)
    assert read["rows"][2:] == table["rows"][2:]  # those of baselines have no error


# --- the commands ---


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A tiny run, and a store to evaluate it on."""
    folder = tmp_path_factory.mktemp("table")
    store = folder / "test"
    with StoreWriter(store) as writer:
        writer.append(straight_road(4, seed=1, steps=8))
        writer.append(crossing(4, seed=1, steps=8))
    agent, out = AgentConfig(hidden=8, num_points=10), folder / "bc"
    config = TrainConfig(method="bc", data=store, out=out, steps=2, agent=agent, states=8, wandb="disabled")
    return train(config), store


def test_evaluate_keeps_what_it_found_and_table_and_figure_find_it(
    evaluated: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, store = tmp_path / "bc", evaluated[1]
    shutil.copytree(evaluated[0], run)
    file = tmp_path / "numbers.json"
    command = ["evaluate", str(run), "--data", str(store), "--rollouts", "2"]
    assert main([*command, "--no-keep", "--json", str(file)]) == 0
    assert not (run / "evaluations").exists()
    for _ in range(2):
        assert main(command) == 0
    ((name, record),) = kept_evaluations(run).items()
    other = json.loads(file.read_text())
    assert record | {"cost": 0} == other | {"cost": 0}
    assert other["cost"]["simulation"] > 0
    assert name == evaluation_name(record)
    found = evaluate(str(run), store, EvaluateConfig(rollouts=2))
    assert record["ade"] == found.numbers()["ade"]
    assert record["playback"]["ade"] == 0
    assert len(record["per_segment"]) == 2
    segments = SegmentStore(store)
    assert record["horizon"] == max((s.num_steps - 1) * s.dt for s in (segments[0], segments[1]))
    assert record["data"]["checksum"] == segments.checksum()
    assert (record["run"]["method"], record["run"]["updates"]) == ("bc", 2)
    visited = [np.array(record["curvature"][part]) for part in ("policy", "log")]
    assert float(jensen_shannon(*visited)) == pytest.approx(record["curvature_jsd"], nan_ok=True)

    table = ["table", "--setting", "main", "--runs", str(run)]
    out, picture = tmp_path / "out" / "table.json", tmp_path / "out" / "curvature.png"
    assert main([*table, "--format", "json", "--out", str(out)]) == 0
    assert json.loads(out.read_text())["rows"][2]["ade"]["mean"] == record["ade"]
    capsys.readouterr()
    assert main([*table, "--paper", "womd"]) == 0
    assert f"{record['ade']:.2f}" in capsys.readouterr().out
    figure = ["plot", "curvature", str(run), "--out", str(picture)]
    assert main(figure) == 0
    assert picture.stat().st_size > 5_000

    assert main([*command, "--seed", "5"]) == 0
    assert len(kept_evaluations(run)) == 2
    for again in (table, figure):
        assert main(again) == 1
        assert "--evaluation" in capsys.readouterr().err
        assert main([*again, "--evaluation", "*-seed5"]) == 0
    assert not list((run / "evaluations").glob(".*"))


def test_baselines_leave_nothing_behind(
    evaluated: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("playback", "constant_velocity"):
        assert main(["evaluate", name, "--data", str(evaluated[1]), "--rollouts", "1"]) == 0
    assert not list(tmp_path.iterdir())


# --- the figure ---


@given(st.lists(st.integers(0, 50), min_size=41, max_size=41).filter(any), st.integers(2, 9))
@settings(max_examples=4)
def test_bars_are_shares_of_all_visits(tmp_path_factory: Any, counts: list[int], times: int) -> None:
    path = tmp_path_factory.mktemp("figure") / "curvature.svg"
    policy, log = np.array(counts), np.array(counts[::-1]) * times
    (axes,) = plot_curvature({"BC": (policy, log)}, path).axes
    drawn = {patch.get_gid(): patch.get_data() for patch in axes.patches}
    assert drawn["policy"].values == pytest.approx(policy / policy.sum())
    assert drawn["log"].values == pytest.approx(drawn["policy"].values[::-1])
    centres = (drawn["log"].edges[1:] + drawn["log"].edges[:-1]) / 2
    assert centres == pytest.approx(np.linspace(-1, 1, 41))
    left, right = axes.get_xlim()
    assert left < centres[policy > 0].min()
    assert right > centres[policy > 0].max()
    assert axes.get_ylim()[1] > max(drawn["policy"].values.max(), drawn["log"].values.max())
