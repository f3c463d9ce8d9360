"""Which runs and evaluations count in a table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from helpers_table import full_table, make_entry, make_record, make_run
from symphony.errors import ConfigError, DataError
from symphony.evaluation.records import evaluation_name, find_runs, keep_evaluation
from symphony.evaluation.table import collect, compare


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
    def evaluated(name: str, seconds: float, **changes: Any) -> None:
        make_run(
            tmp_path / name,
            "bc",
            len(list(tmp_path.iterdir())),
            make_record(**changes) | {"horizon": seconds},
        )

    evaluated("waymo", 9.0)
    evaluated("town", 10.0)
    evaluated("long", 20.0)
    evaluated("part", 20.0, duration=20)  # trained on the whole of the segments, whatever that is
    found = {
        name: [entry.folder.name for entry in collect([tmp_path], name)[0]]
        for name in ("main", "long", "many")
    }
    assert found == {"main": ["town", "waymo"], "long": ["long"], "many": []}
    notes = {n: compare(collect([tmp_path], n)[0], n).notes for n in ("main", "long")}
    assert "rollouts last 9 or 10 s" in notes["main"]
    assert not [note for note in notes["long"] if "rollouts last" in note]


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


def test_several_evaluations_need_a_choice(tmp_path: Path) -> None:
    without, tree = make_record(), make_record(search="tree", trees=1, branches=16, rule="best")
    run = make_run(tmp_path / "ts", "bc_ts", 0, without, tree)
    make_run(tmp_path / "bc", "bc", 0, without)
    with pytest.raises(ConfigError) as error:
        collect([tmp_path], "main")
    for word in (str(run), evaluation_name(without), evaluation_name(tree), "--evaluation"):
        assert word in str(error.value)
    for patterns, wanted in (
        (["*-tree-*", "*-none-*"], {"bc_ts": tree, "bc": without}),
        (["*-none-*", "*-tree-*"], {"bc_ts": without, "bc": without}),
        (["*-tree-1x16-*"], {"bc_ts": tree}),
        ([evaluation_name(tree)], {"bc_ts": tree}),
    ):
        found = {entry.method: entry.record for entry in collect([tmp_path], "main", patterns)[0]}
        assert found == wanted
    with pytest.raises(ConfigError, match="several ways"):
        collect([tmp_path], "main", ["test-*"])
    entries, left_out = collect([tmp_path], "main", ["*-oracle-*"])
    assert not entries
    assert list(map(len, left_out.values())) == [2]


def test_two_runs_of_one_method_and_seed_are_refused(tmp_path: Path) -> None:
    for name in ("one", "two"):
        make_run(tmp_path / name, "bc_h", 3, make_record())
    with pytest.raises(ConfigError, match=r"two runs of BC\+H with seed 3.*one.*two"):
        collect([tmp_path], "main")


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
    assert any("4 rollouts: MGAIL+TS+H" in note for note in compare(entries, "main").notes)
    with pytest.raises(ConfigError, match="no evaluated runs"):
        compare([], "main")
    with pytest.raises(DataError, match="ade"):
        compare([make_entry("bc", ade="much")], "main")  # type: ignore[arg-type]


def test_notes_say_what_differs_and_what_is_outdated(tmp_path: Path) -> None:
    for seed, steps in ((0, 5), (1, 6)):
        record = make_record(seed=seed)
        record["run"]["updates"] = 5
        search = {"rule": "best" if seed else "systematic"}
        run = make_run(tmp_path / f"bc-{seed}", "bc", seed, record, steps=steps, out=str(seed), search=search)
        (run / "checkpoints" / f"step-{steps:012d}").mkdir(parents=True)
    notes = "\n".join(compare(collect([tmp_path], "main")[0], "main").notes)
    assert "runs of BC differ in steps, search.rule\n" in notes
    assert notes.count("was evaluated after") == 1
    assert "bc-1 was evaluated after 5 updates and has 6 now" in notes
    assert "checkpoint" not in notes
    entries = [make_entry("bc", seed) for seed in (0, 1)]
    entries[1].record["run"] |= {"named": True, "checkpoint": 50}
    notes = "\n".join(compare(entries, "main").notes)
    assert "bc-1 was evaluated at its checkpoint 50, which it would not choose itself" in notes
    assert notes.count("checkpoint") == 1


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
