"""The paper's tables made of kept evaluations, which of these count, and the figure of curvature."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from helpers_segments import CHARACTERS, crossing, straight_road
from helpers_store import fill
from helpers_table import full_table, make_entry, make_record, make_run, row_of
from symphony.agents.choice import FOLDER
from symphony.cli import main
from symphony.config import METHODS, EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.evaluation import evaluate
from symphony.evaluation.records import evaluation_name, find_runs, keep_evaluation, kept_evaluations
from symphony.evaluation.table import COLUMNS, METRICS, ROWS, collect, compare, paper_figures, table_text
from symphony.files import json_text
from symphony.metrics import jensen_shannon
from symphony.render import plot_curvature

NUMBERS = st.floats(0, 100)


@given(st.lists(NUMBERS, min_size=1, max_size=6))
def test_cells_are_mean_and_standard_error_over_seeds(values: list[float]) -> None:
    row = row_of(compare([make_entry("bc", k, ade=value) for k, value in enumerate(values)], "main"), "bc")
    assert (row["seeds"], row["ade"]["mean"]) == (list(range(len(values))), pytest.approx(np.mean(values)))
    error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else math.nan
    assert row["ade"]["se"] == pytest.approx(error, nan_ok=True)


@given(st.permutations(full_table(2)))
@settings(max_examples=4)
def test_the_order_of_runs_does_not_matter(entries: list[Any]) -> None:
    assert json_text(compare(entries, "main")) == json_text(compare(full_table(2), "main"))


def test_rows_are_those_of_the_paper_and_missing_methods_are_missing() -> None:
    rows = compare(full_table(methods=ROWS[2:]), "main")["rows"]
    assert [row["method"] for row in rows] == list(ROWS)
    names = "BC BC+H BC+TS BC+TS+H MGAIL MGAIL+H MGAIL+TS MGAIL+TS+H BC+RL BC+RL+H"
    assert " ".join(row["name"] for row in rows[2:]) == names
    assert [rows[0][key]["mean"] for key in METRICS[:2]] == [0.5, 0.25]
    assert all(math.isnan(rows[0][key]["mean"]) for key in METRICS[2:])  # playback has no distance to itself
    some = compare(full_table(2, ("mgail_ts", "bc_h")), "main", "proprietary")
    assert [row["method"] for row in some["rows"]] == ["playback", "constant_velocity", "bc_h", "mgail_ts"]


def test_a_mean_over_something_unknown_is_unknown() -> None:
    entries = [make_entry("bc", 0, ade=1.0), make_entry("bc", 1)]
    entries[1].record["ade"] = None  # type: ignore[index]
    found = compare(entries, "main")
    assert math.isnan(row_of(found, "bc")["ade"]["mean"])
    assert json.loads(json_text(found))["rows"][2]["ade"]["mean"] is None


def test_methods_that_met_other_traffic_are_not_compared() -> None:
    for name, value in {"others": "idm", "open_traffic": True, "radius": 40.0, "interactive": 8}.items():
        entries = [make_entry("bc", 0), make_entry("bc_h", 0)]
        entries[1].record["config"] |= {name: value}
        with pytest.raises(ConfigError, match=rf"other traffic \({name}\)"):
            compare(entries, "main")


def test_whole_segments_stand_beside_their_first_seconds_only_where_these_are_all() -> None:
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
    ("main", "proprietary"): 5 * "bc_ts_h " + "mgail_ts_h mgail_ts_h mgail_h mgail_h mgail_h",
    ("main", "womd"): "bc_ts_h bc_ts bc_ts_h bc_ts_h bc mgail_ts mgail_ts mgail_h mgail_h mgail_ts_h",
    ("long", "proprietary"): "bc_ts bc_ts_h bc_ts_h bc_ts_h bc" + 5 * " mgail_ts_h",
    ("many", "proprietary"): "bc_ts bc_ts_h bc_ts_h bc_h bc_ts_h" + 5 * " mgail_ts_h",
}
"""What the paper prints in bold: of each family, by metric."""


@pytest.mark.parametrize(("setting", "dataset"), BOLD)
def test_the_paper_s_bold_figures_are_the_lowest_of_ours(setting: Any, dataset: Any) -> None:
    best, figures = [], paper_figures(setting, dataset)
    for family, key in itertools.product(("bc", "mgail"), METRICS):
        means = {method: figures[method][key][0] for method in figures if method.startswith(family)}
        best += [method for method, mean in means.items() if mean == min(means.values())]
    assert best == BOLD[setting, dataset].split()


def test_the_paper_s_figures_are_in_our_units() -> None:
    figures = paper_figures("main", "womd")
    assert figures["bc"]["curvature_jsd"] == pytest.approx((0.00132, 0.00028))
    assert figures["playback"]["collision_rate"][0] == 3.04
    assert math.isnan(figures["playback"]["ade"][0])
    assert set(figures) == {"playback", *METHODS}
    with pytest.raises(ConfigError, match="no figures for setting 'long' on womd"):
        compare(full_table(1), "long", "womd")


def expected(table: dict[str, Any]) -> dict[str, list[tuple[float, ...]]]:
    """Return the numbers in every cell."""
    found: dict[str, list[tuple[float, ...]]] = {}
    for row, key in itertools.product(table["rows"], table["columns"]):
        for cell in (row[key], *([row["paper"].get(key, {})] if table["paper"] else [])):
            known = [cell[name] for name in ("mean", "se") if not math.isnan(cell.get(name, math.nan))]
            found.setdefault(row["name"], []).append(tuple(float(COLUMNS[key].shown(number)) for number in known))
    return found


@pytest.mark.parametrize("dataset", [None, "proprietary"])
@pytest.mark.parametrize("seeds", [1, 3])
def test_the_text_reads_back(seeds: int, dataset: Any) -> None:
    table = compare(full_table(seeds), "main", dataset)
    lines = [re.split(r" *\| *", line.strip("| ")) for line in table_text(table).splitlines() if "|" in line]
    assert len({len(line) for line in lines}) == 1

    cells = {name: [tuple(map(float, re.findall(r"\d+\.\d+", one))) for one in rest] for name, _, *rest in lines[2:]}
    assert cells == expected(table)
    assert [line[1] for line in lines[4:]] == [str(seeds)] * 8


def test_evaluate_keeps_what_it_found_and_table_and_figure_find_it(tmp_path, monkeypatch, capsys):
    store = tmp_path / "test"
    fill(store, [straight_road(4, seed=1, steps=5), crossing(4, seed=1, steps=5)])
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    run, file, drawn = (tmp_path / name for name in ("bc", "numbers.json", "rollouts.gif"))
    small = "--agent.hidden 8 --agent.num-points 12 --states 16 --wandb disabled"
    assert main(f"train bc --data {store} --out {run} --steps 2 --seed 4 {small}".split()) == 0
    command = ["evaluate", str(run), "--data", str(store), "--rollouts", "2"]
    assert main([*command, "--no-keep", "--json", str(file), "--figure", str(drawn)]) == 0
    with Image.open(drawn) as film:
        assert film.n_frames == 5
    assert not (run / "evaluations").exists()
    (run / "evaluations").write_text("")  # in the way: numbers and figure are not lost for it
    drawn.unlink()
    assert (main([*command, "--figure", str(drawn)]), drawn.exists()) == (1, True)
    (run / "evaluations").unlink()
    for _ in range(2):
        assert main(command) == 0
    ((name, record),) = kept_evaluations(run).items()
    other = json.loads(file.read_text())
    assert record | {"cost": 0} == other | {"cost": 0}
    assert other["cost"]["simulation"] > 0
    assert name == evaluation_name(record)
    assert record["ade"] == evaluate(str(run), store, EvaluateConfig(rollouts=2)).numbers()["ade"]
    assert (record["playback"]["ade"], len(record["per_segment"])) == (0, 2)
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
    # Baselines leave nothing behind.
    for agent in ("playback", "constant_velocity"):
        assert main(["evaluate", agent, *command[2:]]) == 0
    assert not list(Path().iterdir())


@given(st.lists(st.integers(0, 50), min_size=41, max_size=41).filter(any), st.integers(2, 9))
@settings(max_examples=4)
def test_bars_are_shares_of_all_visits(tmp_path_factory: Any, counts: list[int], times: int) -> None:
    policy, log = np.array(counts), np.array(counts[::-1]) * times
    (axes,) = plot_curvature({"BC": (policy, log)}, tmp_path_factory.mktemp("figure") / "curvature.svg").axes
    drawn = {patch.get_gid(): patch.get_data() for patch in axes.patches}
    assert drawn["policy"].values == pytest.approx(policy / policy.sum())
    assert drawn["log"].values == pytest.approx(drawn["policy"].values[::-1])
    centres = (drawn["log"].edges[1:] + drawn["log"].edges[:-1]) / 2
    assert centres == pytest.approx(np.linspace(-1, 1, 41))
    left, right = axes.get_xlim()
    assert left < centres[policy > 0].min() < centres[policy > 0].max() + 1e-9 < right
    assert axes.get_ylim()[1] > max(part.values.max() for part in drawn.values())


CHANGES: dict[str, Any] = {
    "rollouts": 8, "search": "backtrack", "score": "rule", "trees": 2, "branches": 8,
    "rule": "systematic", "logged_goals": True, "seed": 1, "duration": 20, "interactive": 8, "prune_every": 2,
    "temperature": 0.6, "threshold": 2.0, "goals": "branch", "metric": ["my.metrics:jerk"], "pace": 0.5,
    "radius": 50.0, "open_traffic": True, "others": "idm",
}  # fmt: skip
TREE = {"search": "tree", "trees": 1, "branches": 16, "rule": "best"}


def test_names_differ_with_everything_that_changes_results() -> None:
    same = {"batch", "device", "workers", "engine", "compile"}
    assert {field.name for field in dataclasses.fields(EvaluateConfig)} == CHANGES.keys() | same
    base = make_record(**TREE)
    others = [base | {"config": base["config"] | {name: value}} for name, value in CHANGES.items()]
    others.append(base | {"data": {"name": "test", "checksum": "cd" * 32}})
    others.append(base | {"run": {"named": True, "checkpoint": 50}})
    names = [evaluation_name(record) for record in (base, *others)]
    assert len(set(names)) == len(names)
    changes = {"batch": 3, "device": "cuda", "workers": 2, "engine": "ray", "compile": "yes"}
    assert evaluation_name(others[0] | {"config": others[0]["config"] | changes}) == names[1]
    # Included agents keep evaluations by such names.
    kept = kept_evaluations(FOLDER / "bc_ts_h")
    assert [evaluation_name(record) for record in kept.values()] == list(kept)


@given(st.text(CHARACTERS + "/", max_size=80), st.integers(0, 9))
def test_names_are_file_names_and_differ_however_long_they_are(store: str, paths: int) -> None:
    """An evaluation of hours was lost where its name was too long for a file."""
    metric = [f"measures.of.comfort.{part}:{part}_of_all_agents" for part in range(paths)]
    records = (make_record(metric=[*metric, k], trees=1, branches=2, rule=f"{store}.py:R") for k in ("x:y", "x:z"))
    names = {evaluation_name(record | {"data": {"name": store, "checksum": "ab" * 32}}) for record in records}
    assert len(names) == 2
    assert all(re.fullmatch(r"[A-Za-z0-9._-]{1,200}", name) for name in names)


def test_settings_tell_runs_apart(tmp_path: Path) -> None:
    """An evaluation in another setting than its run's own does not count."""
    eight: dict[str, Any] = {"agent": {"interactive": 8}}
    kinds: dict[Any, list[dict[str, Any]]] = {
        "main": [{}, {"duration": 0}, {"duration": 10}, {"agent": {}}], "long": [{"duration": 20}], "many": [eight],
        "strange": [{"duration": 15}, {"duration": 20} | eight],
    }  # fmt: skip
    for setting, configs in kinds.items():
        for k, config in enumerate(configs):
            agents = config.get("agent", {}).get("interactive", 2)
            record = make_record(interactive=agents, duration=config.get("duration", 0))
            make_run(tmp_path / f"{setting}-{k}", "bc", k, record, **config)
    make_run(tmp_path / "new", "bc", 9)
    make_run(tmp_path / "other", "bc", 8, make_record(interactive=8), make_record(duration=20))
    for setting in ("main", "long", "many"):
        entries, left_out = collect([tmp_path], setting)
        names = [f"{setting}-{k}" for k in range(len(kinds[setting]))]
        assert [entry.folder.name for entry in entries] == names
        assert len(entries) + sum(map(len, left_out.values())) == 10
    assert any("not evaluated" in reason for reason in collect([tmp_path], "main")[1])
    keep_evaluation(str(tmp_path / "other"), make_record(duration=10))
    assert len(collect([tmp_path / "other"], "main")[0]) == 1


def test_whole_logs_count_by_how_long_they_are(tmp_path: Path) -> None:
    horizons = {"waymo": (9.0, 0), "town": (10.0, 0), "long": (20.0, 0)}
    horizons["part"] = 20.0, 20  # trained on the whole of the segments, whatever that is
    for seed, (name, (seconds, duration)) in enumerate(horizons.items()):
        make_run(tmp_path / name, "bc", seed, make_record(duration=duration) | {"horizon": seconds})
    found = {name: collect([tmp_path], name)[0] for name in ("main", "long", "many")}
    names = {name: [entry.folder.name for entry in entries] for name, entries in found.items()}
    assert names == {"main": ["town", "waymo"], "long": ["long"], "many": []}
    assert "only evaluated in other ways" in collect([tmp_path], "long")[1]
    assert "rollouts last 9 or 10 s" in compare(found["main"], "main")["notes"]
    assert "rollouts last" not in table_text(compare(found["long"], "long"))


def test_runs_are_found_below_folders_each_once(tmp_path: Path) -> None:
    one, two = make_run(tmp_path / "a" / "one", "bc"), make_run(tmp_path / "a" / "deeper" / "two", "bc", 1)
    make_run(one / "checkpoints" / "inner", "bc")
    assert sorted(find_runs([tmp_path, one, tmp_path / "a", two])) == sorted([one, two])
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "empty", tmp_path / "absent"):
        with pytest.raises(ConfigError, match="holds no run"):
            find_runs([one, folder])


def test_each_way_to_simulate_has_a_row_and_its_cost(tmp_path: Path) -> None:
    forest = make_record(**TREE | {"trees": 16, "branches": 4}) | {"cost": {"simulation": 24.0}}
    tree, without = make_record(**TREE, goals="branch"), make_record()
    make_run(tmp_path / "ts", "bc_ts", 0, forest, tree)
    make_run(tmp_path / "bc", "bc", 0, without)
    table = compare(collect([tmp_path], "main")[0], "main")
    cost = {row["name"]: row["cost"]["mean"] for row in table["rows"][2:]}
    assert cost == {"BC": 1.5, "BC+TS tree-16x4-best": 6.0, "BC+TS tree-1x16-best-goals=branch": 1.5}
    assert all(name in table_text(table) for name in cost)
    for patterns, wanted in (
        (["*-1x16-*", "*-none-*"], {"bc_ts": tree, "bc": without}),
        (["*-none-*", "*-16x4-*"], {"bc_ts": forest, "bc": without}),
        ([evaluation_name(tree)], {"bc_ts": tree}),
    ):
        found = {entry.method: entry.record for entry in collect([tmp_path], "main", patterns)[0]}
        assert found == wanted
    entries, left_out = collect([tmp_path], "main", ["*-oracle-*"])
    assert not entries
    assert list(map(len, left_out.values())) == [2]


def test_two_evaluations_of_one_row_and_seed_need_a_choice(tmp_path: Path) -> None:
    run = make_run(tmp_path / "one", "bc_h", 3, make_record(), make_record(seed=3))
    with pytest.raises(ConfigError, match=r"BC\+H with seed 3 was simulated twice as none.*--evaluation"):
        collect([run], "main")
    assert len(collect([run], "main", ["*-seed3"])[0]) == 1
    make_run(tmp_path / "two", "bc_h", 3, make_record(seed=3))
    with pytest.raises(ConfigError, match=r"two runs of BC\+H with seed 3.*one.*two"):
        collect([tmp_path], "main", ["*-seed3"])


def test_rows_must_be_comparable() -> None:
    entries, others = full_table(2), full_table(2)
    others[-1].record["data"]["checksum"] = "cd" * 32
    with pytest.raises(ConfigError, match="different run segments"):
        compare(others, "main")
    entries[-1].record["config"]["rollouts"] = 4
    with pytest.raises(ConfigError, match=r"seeds of MGAIL\+TS\+H evaluated in different ways"):
        compare(entries, "main")
    entries[-2].record["config"]["rollouts"] = 4
    assert any("4 rollouts: MGAIL+TS+H" in note for note in compare(entries, "main")["notes"])
    with pytest.raises(DataError, match="ade"):
        compare([make_entry("bc", ade="much")], "main")  # type: ignore[arg-type]


WRONG = {"{": "not valid JSON", "[]": "not a JSON object", "{}": "format"}
for wrong, why in (({"format": 99}, "format 99"), ({"run": None}, "field run"), ({"segments": 0.5}, "field seg")):
    WRONG[json.dumps(make_record() | wrong)] = why


@pytest.mark.parametrize("text", WRONG, ids=WRONG.values())
def test_damaged_evaluations_are_named(tmp_path: Path, text: str) -> None:
    run = make_run(tmp_path / "bc", "bc", 0, make_record())
    (run / "evaluations" / "bad.json").write_text(text)
    with pytest.raises(DataError, match=rf"bad\.json.*{WRONG[text]}"):
        collect([run], "main")
