"""Which runs and evaluations count in a table, and what evaluations are called: a name for each way to evaluate."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_table import full_table, make_entry, make_record, make_run
from symphony.config import EvaluateConfig
from symphony.errors import ConfigError, DataError
from symphony.evaluation.records import evaluation_name, find_runs, keep_evaluation
from symphony.evaluation.table import collect, compare, table_text

CHANGES: dict[str, Any] = {
    "persona": "speed=.8",
    "rollouts": 8,
    "search": "backtrack",
    "score": "rule",
    "trees": 2,
    "branches": 8,
    "rule": "systematic",
    "logged_goals": True,
    "seed": 1,
    "duration": 20,
    "interactive": 8,
    "prune_every": 2,
    "temperature": 0.6,
    "threshold": 2.0,
    "goals": "branch",
    "metric": ["my.metrics:jerk"],
    "action_temperature": 0.5,
    "radius": 50.0,
    "open_traffic": True,
    "others": "idm",
}
TREE = {"search": "tree", "trees": 1, "branches": 16, "rule": "best"}


def test_names_differ_with_everything_that_changes_results() -> None:
    same = {"batch", "device", "workers", "engine"}
    assert {field.name for field in dataclasses.fields(EvaluateConfig)} == CHANGES.keys() | same
    base = make_record(**TREE)
    others = [base | {"config": base["config"] | {name: value}} for name, value in CHANGES.items()]
    others.append(base | {"data": {"name": "test", "checksum": "cd" * 32}})
    others.append(base | {"run": {"named": True, "checkpoint": 50}})
    names = [evaluation_name(record) for record in (base, *others)]
    assert len(set(names)) == len(names)
    changes = {"batch": 3, "device": "cuda", "workers": 2, "engine": "ray"}
    assert evaluation_name(others[0] | {"config": others[0]["config"] | changes}) == names[1]
    # Included agents keep evaluations by such names.
    replace = make_record(**TREE | {"rule": "replace", "prune_every": 2, "threshold": 1.0, "goals": "branch"})
    wanted = "test-abababababab-tree-1x16-replace-every2-2agents-16rollouts-seed0-threshold=1.0-goals=branch"
    assert evaluation_name(replace) == wanted


@settings(max_examples=20)
@given(st.text(max_size=80), st.integers(0, 9))
def test_names_are_file_names_and_differ_however_long_they_are(store: str, paths: int) -> None:
    """An evaluation of hours was lost where its name was too long for a file."""
    metric = [f"measures.of.comfort.{part}:{part}_of_all_agents" for part in range(paths)]
    records = (make_record(metric=[*metric, last]) for last in ("x:y", "x:z"))
    names = {evaluation_name(record | {"data": {"name": store, "checksum": "ab" * 32}}) for record in records}
    assert len(names) == 2
    assert all(re.fullmatch(r"[A-Za-z0-9._-]{1,200}", name) for name in names)


def test_settings_tell_runs_apart(tmp_path: Path) -> None:
    kinds: dict[str, list[dict[str, Any]]] = {
        "main": [{}, {"duration": 0}, {"duration": 10}, {"agent": {}}],
        "long": [{"duration": 20}],
        "many": [{"agent": {"interactive": 8}}],
    }
    strange = [{"duration": 15}, {"duration": 20, "agent": {"interactive": 8}}]
    for setting, configs in kinds.items():
        for k, config in enumerate(configs):
            agents = config.get("agent", {}).get("interactive", 2)
            record = make_record(interactive=agents, duration=config.get("duration", 0))
            make_run(tmp_path / "runs" / f"{setting}-{k}", "bc", k, record, **config)
    for k, config in enumerate(strange):
        make_run(tmp_path / "runs" / f"strange-{k}", "bc", k, make_record(), **config)
    make_run(tmp_path / "runs" / "new", "bc", 9)
    for setting, configs in kinds.items():
        entries, left_out = collect([tmp_path / "runs"], setting)  # type: ignore[arg-type]
        assert [entry.folder.name for entry in entries] == [f"{setting}-{k}" for k in range(len(configs))]
        assert len(entries) + sum(map(len, left_out.values())) == 9
    assert any("not evaluated" in reason for reason in collect([tmp_path / "runs"], "main")[1])


def test_runs_evaluated_in_another_setting_than_their_own_do_not_count(tmp_path: Path) -> None:
    run = make_run(tmp_path / "bc", "bc", 0, make_record(interactive=8), make_record(duration=20))
    assert collect([run], "main")[0] == []
    keep_evaluation(str(run), make_record(duration=10))
    assert len(collect([run], "main")[0]) == 1


def test_whole_logs_count_by_how_long_they_are(tmp_path: Path) -> None:
    horizons = {"waymo": (9.0, 0), "town": (10.0, 0), "long": (20.0, 0)}
    horizons["part"] = 20.0, 20  # trained on the whole of the segments, whatever that is
    for seed, (name, (seconds, duration)) in enumerate(horizons.items()):
        make_run(tmp_path / name, "bc", seed, make_record(duration=duration) | {"horizon": seconds})
    found = {name: collect([tmp_path], name)[0] for name in ("main", "long", "many")}
    names = {name: [entry.folder.name for entry in entries] for name, entries in found.items()}
    assert names == {"main": ["town", "waymo"], "long": ["long"], "many": []}
    assert "rollouts last 9 or 10 s" in compare(found["main"], "main")["notes"]
    assert "rollouts last" not in table_text(compare(found["long"], "long"))


def test_runs_are_found_below_folders_each_once(tmp_path: Path) -> None:
    one = make_run(tmp_path / "a" / "one", "bc")
    two = make_run(tmp_path / "a" / "deeper" / "two", "bc", 1)
    (one / "checkpoints" / "inner").mkdir(parents=True)
    (one / "checkpoints" / "inner" / "config.json").write_text("{}")
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
    with pytest.raises(ConfigError, match=r"twice as none.*one.*two"):
        collect([tmp_path], "main", ["*-seed3"])


def test_rows_must_be_comparable() -> None:
    entries = full_table(2)
    entries[-1].record["data"]["checksum"] = "cd" * 32
    with pytest.raises(ConfigError, match="different run segments"):
        compare(entries, "main")
    entries = full_table(2)
    entries[-1].record["config"]["rollouts"] = 4
    with pytest.raises(ConfigError, match=r"seeds of MGAIL\+TS\+H evaluated in different ways"):
        compare(entries, "main")
    entries[-2].record["config"]["rollouts"] = 4
    assert any("4 rollouts: MGAIL+TS+H" in note for note in compare(entries, "main")["notes"])
    with pytest.raises(ConfigError, match="no evaluated runs"):
        compare([], "main")
    with pytest.raises(DataError, match="ade"):
        compare([make_entry("bc", ade="much")], "main")  # type: ignore[arg-type]


def test_notes_say_what_differs_and_what_is_outdated(tmp_path: Path) -> None:
    for seed, steps in ((0, 5), (1, 6)):
        record = make_record(seed=seed)
        record["run"] |= {"updates": 5, "named": bool(seed), "checkpoint": 3}
        run = make_run(tmp_path / f"bc-{seed}", "bc", seed, record, steps=steps, out=str(seed))
        checkpoint = run / "checkpoints" / f"step-{steps:012d}"
        checkpoint.mkdir(parents=True)
        (checkpoint / "checkpoint.json").write_text("{}")
    notes = "\n".join(compare(collect([tmp_path], "main")[0], "main")["notes"])
    assert "runs of BC differ in steps\n" in notes
    assert notes.count("was evaluated after") == 1
    assert "bc-1 was evaluated after 5 updates and has 6 now" in notes
    assert notes.count("checkpoint") == 1
    assert "bc-1 was evaluated at checkpoint 3, not its own" in notes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "not a JSON object"),
        ("{}", "format"),
        (json.dumps(make_record() | {"format": 99}), "format 99"),
        (json.dumps(make_record() | {"run": None}), "field run"),
    ],
)
def test_damaged_evaluations_are_named(tmp_path: Path, text: str, message: str) -> None:
    run = make_run(tmp_path / "bc", "bc", 0, make_record())
    (run / "evaluations" / "bad.json").write_text(text)
    with pytest.raises(DataError, match=message) as error:
        collect([run], "main")
    assert "bad.json" in str(error.value)
