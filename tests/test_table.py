"""Kept evaluations, the paper's tables made of them, and the figure of curvature."""

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
from helpers_table import METHODS, full_table, make_entry, make_record, row_of
from symphony.cli import main
from symphony.config import AgentConfig, EvaluateConfig, TrainConfig
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError
from symphony.evaluation import evaluate
from symphony.evaluation.formats import FORMATS
from symphony.evaluation.paper import METRICS, paper_figures
from symphony.evaluation.records import evaluation_name, kept_evaluations
from symphony.evaluation.table import (
    ABSENT,
    COLUMNS,
    ROWS,
    SETTINGS,
    Comparison,
    Entry,
    compare,
    family,
    method_name,
)
from symphony.metrics import jensen_shannon
from symphony.recipes import train
from symphony.render import plot_curvature

NUMBERS = st.floats(0, 100)


# --- what is in a table ---


@settings(max_examples=50)
@given(st.lists(NUMBERS, min_size=1, max_size=6))
def test_cells_are_mean_and_standard_error_over_seeds(values: list[float]) -> None:
    comparison = compare([make_entry("bc", k, ade=value) for k, value in enumerate(values)], "main")
    row = row_of(comparison, "bc")
    cell = row.cells["ade"]
    assert row.seeds == tuple(range(len(values)))
    assert cell.mean == pytest.approx(np.mean(values))
    if len(values) == 1:
        assert math.isnan(cell.error)
        assert f"| BC | 1 | 1.00 | 1.00 | {values[0]:.2f} | 1.00 |" in FORMATS["markdown"](comparison)
    else:
        assert cell.error == pytest.approx(np.std(values, ddof=1) / np.sqrt(len(values)))


@given(st.permutations(full_table(2)))
@settings(max_examples=4)
def test_the_order_of_runs_does_not_matter(entries: list[Entry]) -> None:
    for format_, write in FORMATS.items():
        assert write(compare(entries, "main", "womd")) == write(compare(full_table(2), "main", "womd")), (
            format_
        )


@settings(max_examples=50)
@given(st.dictionaries(st.sampled_from(METHODS), st.tuples(*[NUMBERS] * 5), min_size=1))
def test_the_lowest_value_of_each_family_is_the_best(table: dict[str, tuple[float, ...]]) -> None:
    entries = [make_entry(method, **dict(zip(METRICS, row, strict=True))) for method, row in table.items()]
    comparison = compare(entries, "main")
    for number, column in enumerate(COLUMNS):
        for name in ("bc", "mgail"):
            mine = {method: row[number] for method, row in table.items() if family(method) == name}
            best = {method for method in mine if row_of(comparison, method).cells[column.key].best}
            if len(mine) < 2:
                assert not best
            else:
                assert min(mine, key=mine.__getitem__) in best
                assert len({column.shown(mine[method]) for method in best}) == 1
                worse = [value for method, value in mine.items() if method not in best]
                assert all(value > min(mine.values()) for value in worse)
        assert not row_of(comparison, "playback").cells[column.key].best


def test_rows_are_those_of_the_paper_and_missing_methods_are_missing() -> None:
    assert [row.method for row in compare(full_table(), "main").rows] == list(ROWS)
    assert [method_name(method) for method in ROWS] == [
        "Playback",
        "Constant velocity",
        "BC",
        "BC+H",
        "BC+TS",
        "BC+TS+H",
        "MGAIL",
        "MGAIL+H",
        "MGAIL+TS",
        "MGAIL+TS+H",
    ]
    some = compare(full_table(2, ("mgail_ts", "bc_h")), "main", "proprietary")
    assert [row.method for row in some.rows] == ["playback", "constant_velocity", "bc_h", "mgail_ts"]
    for write in FORMATS.values():
        assert "BC+TS+H" not in write(some).replace(" + ", "+").replace("MGAIL+TS+H", "")


def test_playback_has_no_distance_to_itself() -> None:
    cells = row_of(compare(full_table(), "main"), "playback").cells
    assert [cells[key].mean for key in METRICS[:2]] == [0.5, 0.25]
    assert all(math.isnan(cells[key].mean) for key in METRICS[2:])


def test_a_mean_over_something_unknown_is_unknown_and_never_the_best() -> None:
    entries = [make_entry("bc", 0, ade=1.0), make_entry("bc", 1), make_entry("bc_h", 0), make_entry("bc_ts")]
    entries[1].record["ade"] = None  # type: ignore[index]
    comparison = compare(entries, "main")
    cell = row_of(comparison, "bc").cells["ade"]
    assert math.isnan(cell.mean)
    assert not cell.best
    assert row_of(comparison, "bc_h").cells["ade"].best
    assert json.loads(FORMATS["json"](comparison))["rows"][2]["ade"]["mean"] is None


@pytest.mark.parametrize(
    ("name", "value"), [("others", "idm"), ("open_traffic", True), ("radius", 40.0), ("interactive", 8)]
)
def test_methods_that_met_other_traffic_are_not_compared(name: str, value: Any) -> None:
    entries = [make_entry("bc", 0), make_entry("bc_h", 0)]
    compare(entries, "main")
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
        entry.record["config"]["metric"] = [path]  # type: ignore[index]
        entry.record[path] = float(number)  # type: ignore[index]
    comparison = compare(entries, "main")
    assert [column.title for column in comparison.columns][-2:] == ["jerk", "CPU"]
    assert row_of(comparison, "bc").cells[path].mean == 0.5
    assert row_of(comparison, "bc_h").cells[path].mean == 2.5
    assert not row_of(comparison, "bc").cells[path].best, "nobody said whether low is good"
    assert math.isnan(row_of(comparison, "playback").cells[path].mean)
    assert "jerk" in FORMATS["markdown"](comparison)
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
    table = FORMATS["latex"](compare([entry], "main")).partition(r"\begin{tabular}")[2]
    assert r"time\_gap" in table
    assert r"logged\_goals" in table
    assert not re.search(r"(?<!\\)[_%#$]", table.replace(r"$\times 10^{-3}$", ""))


# --- the paper's own figures ---

BOLD = {
    ("main", "proprietary"): (("bc_ts_h",) * 5, ("mgail_ts_h",) * 2 + ("mgail_h",) * 3),
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
    comparison = compare(full_table(1), setting, dataset)
    for number, key in enumerate(METRICS):
        best = [row.method for row in comparison.rows if row.method in METHODS and row.paper[key].best]
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


def expected(comparison: Comparison) -> dict[str, list[tuple[bool, tuple[float, ...]]]]:
    """Of every cell: whether it is bold, and the numbers in it."""
    found: dict[str, list[tuple[bool, tuple[float, ...]]]] = {}
    for row in comparison.rows:
        found[row.name] = []
        for column in comparison.columns:
            theirs = [] if comparison.dataset is None else [row.paper.get(column.key, ABSENT)]
            for cell in (row.cells[column.key], *theirs):
                if cell is not None:
                    held = [float(column.shown(v)) for v in (cell.mean, cell.error) if not math.isnan(v)]
                    found[row.name].append((cell.best, tuple(held)))
    return found


@pytest.mark.parametrize("dataset", [None, "proprietary"])
@pytest.mark.parametrize("seeds", [1, 3])
def test_markdown_and_latex_read_back(seeds: int, dataset: Any) -> None:
    comparison = compare(full_table(seeds), "main", dataset)
    wanted = expected(comparison)
    lines = [
        line.strip("| ").split(" | ") for line in FORMATS["markdown"](comparison).splitlines() if "|" in line
    ]
    assert len({len(line) for line in lines}) == 1
    assert {name: [("**" in c, numbers_of(c)) for c in cells] for name, _, *cells in lines[2:]} == wanted
    assert [line[1].strip() for line in lines[4:]] == [str(seeds)] * 8
    latex = FORMATS["latex"](comparison)
    body = [line[:-3].split(" & ") for line in latex.splitlines() if line.endswith(r"\\")]
    rows = {name: [(r"\textbf" in c, numbers_of(c)) for c in cells] for name, _, *cells in body[1:]}
    assert rows == wanted
    (columns,) = re.findall(r"\\begin\{tabular\}\{(\w+)\}", latex)
    assert len(columns) == len(body[-1])
    assert latex.count("{") == latex.count("}")
    assert not re.search(r"(?<!\\)%", latex.partition(r"\begin{tabular}")[2])


def test_json_reads_back_whole() -> None:
    comparison = compare(full_table(3), "many", "proprietary")
    read = json.loads(FORMATS["json"](comparison))
    assert (read["setting"], read["interactive"], read["duration"]) == ("many", *SETTINGS["many"])
    for row, found in zip(comparison.rows, read["rows"], strict=True):
        assert found["method"] == row.method
        assert tuple(found["seeds"]) == row.seeds
        for key in METRICS:
            cell = row.cells[key]
            assert tuple(found[key]["values"]) == cell.values
            assert found[key]["best"] is cell.best
            if not math.isnan(cell.error):
                assert (found[key]["mean"], found[key]["se"]) == (cell.mean, cell.error)
                if row.paper:
                    assert found["paper"][key]["mean"] == row.paper[key].mean


def test_text_marks_the_best_and_leaves_names_whole() -> None:
    comparison = compare(full_table(3), "main", "proprietary", ("split", "standing", "corrected", "goals"))
    text, wanted = FORMATS["text"](comparison), expected(comparison)
    starred = [numbers_of(found) for found in re.findall(r"([\d.±]+)\*", text)]
    assert sorted(starred) == sorted(held for row in wanted.values() for best, held in row if best)
    for name, cells in wanted.items():
        assert name in text
        assert all("±".join(f"{number:.2f}" for number in held) in text for _, held in cells if held)


# --- the commands ---


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A tiny run, and a store to evaluate it on."""
    folder = tmp_path_factory.mktemp("table")
    with StoreWriter(folder / "test") as writer:
        writer.append(straight_road(4, seed=1, steps=8))
        writer.append(crossing(4, seed=1, steps=8))
    small = AgentConfig(hidden=8, num_points=10)
    config = TrainConfig(
        method="bc",
        data=folder / "test",
        out=folder / "bc",
        steps=2,
        agent=small,
        states=8,
        wandb="disabled",
    )
    return train(config), folder / "test"


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
    assert record["data"]["checksum"] == SegmentStore(store).checksum()
    assert (record["run"]["method"], record["run"]["updates"]) == ("bc", 2)
    visited = [np.array(record["curvature"][part]) for part in ("policy", "log")]
    assert float(jensen_shannon(*visited)) == pytest.approx(record["curvature_jsd"], nan_ok=True)

    out = tmp_path / "out" / "table.json"
    assert (
        main(["table", "--setting", "main", "--runs", str(tmp_path), "--format", "json", "--out", str(out)])
        == 0
    )
    assert json.loads(out.read_text())["rows"][2]["ade"]["mean"] == record["ade"]
    capsys.readouterr()
    assert main(["table", "--setting", "main", "--runs", str(run), "--paper", "womd"]) == 0
    assert f"{record['ade']:.2f}" in capsys.readouterr().out
    picture = tmp_path / "out" / "curvature.png"
    assert main(["plot", "curvature", str(run), "--out", str(picture)]) == 0
    assert picture.stat().st_size > 5_000

    assert main([*command, "--seed", "5"]) == 0
    assert len(kept_evaluations(run)) == 2
    assert main(["table", "--setting", "main", "--runs", str(run)]) == 1
    assert main(["plot", "curvature", str(run), "--out", str(picture)]) == 1
    assert capsys.readouterr().err.count("choose one with --evaluation") == 2
    chosen = ["--evaluation", "*-seed5"]
    assert main(["table", "--setting", "main", "--runs", str(run), *chosen]) == 0
    assert main(["plot", "curvature", str(run), "--out", str(picture), *chosen]) == 0
    assert not list((run / "evaluations").glob(".*"))


def test_baselines_leave_nothing_behind(
    evaluated: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("playback", "constant_velocity"):
        assert main(["evaluate", name, "--data", str(evaluated[1]), "--rollouts", "1"]) == 0
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("args", "status"),
    [
        (["table", "--setting", "main"], 2),
        (["table", "--setting", "short", "--runs", "x"], 2),
        (["table", "--setting", "main", "--runs", "absent"], 1),
        (["plot", "curvature", "--out", "x.png"], 2),
        (["plot", "curvature", "absent", "--out", "x.png"], 1),
        (["plot", "curvature", "absent", "--out", "x.doc"], 1),
        (["plot", "curvature", "absent", "--out", "x.png", "--rollouts", "3"], 2),
        (["plot", "curvature", "absent", "--out", "x.png", "--data", "x", "--evaluation", "y"], 2),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else str(value),
)
def test_wrong_usage_is_said(
    args: list[str], status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(args) == status
    assert capsys.readouterr().err.strip()
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


@pytest.mark.parametrize("name", ["pretrained:mgail_ts_h", "runs/" + "a" * 60])
def test_titles_of_a_figure_are_not_cut_off(name: str, tmp_path: Path) -> None:
    panels = {f"MGAIL+TS+H ({name}): JSD 70.62 · 10⁻³{k}": (np.ones(21), np.ones(21)) for k in range(2)}
    for columns in (1, 2):
        figure = plot_curvature(panels, tmp_path / "curvature.png", columns=columns)
        boxes = [axes._left_title.get_window_extent() for axes in figure.axes]
        assert all(0 <= box.x0 < box.x1 <= figure.bbox.x1 for box in boxes)
        assert columns == 1 or boxes[0].x1 < boxes[1].x0


def test_figures_of_nothing_are_refused(tmp_path: Path) -> None:
    some, none = np.ones(21, int), np.zeros(21, int)
    for panels, message in (
        ({"BC": (some, none)}, "BC: no branching region"),
        ({"BC": (some, some), "BC+H": (np.ones(11), np.ones(11))}, "differ in their number"),
    ):
        with pytest.raises(DataError, match=message):
            plot_curvature(panels, tmp_path / "x.png")
    with pytest.raises(ConfigError, match="must end in"):
        plot_curvature({"BC": (some, some)}, tmp_path / "x.doc")
    assert not list(tmp_path.iterdir())
