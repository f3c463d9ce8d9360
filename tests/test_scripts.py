"""The scripts that compare methods: every run that they would train has settings that can be trained with."""

import argparse
import json
import runpy
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import pytest

from symphony.config import Method, TrainConfig, to_json

SCRIPTS = Path(__file__).parents[1] / "scripts"


def script(name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])
    return runpy.run_path(str(SCRIPTS / f"{name}.py"))


def test_a_sweep_changes_what_it_says_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sweep = script("sweep", monkeypatch)
    start = tmp_path / "regression"
    start.mkdir()
    trained = TrainConfig("mgail_h", tmp_path / "data", start, seed=7)
    (start / "config.json").write_text(to_json(trained))

    def plain(name: str) -> dict[str, Any]:
        config = sweep["settings"](start, name, tmp_path / "runs", tmp_path / "data", 100)
        assert config.seed == 7
        assert config.warm_start == start
        return {**asdict(config), "out": None}

    base = plain("base")
    for name, changes in sweep["VARIATIONS"].items():
        changed = plain(name)
        for part, values in changes.items():
            assert all(base[part][key] != value for key, value in values.items()), name
            assert changed[part] == {**base[part], **values}
        assert {key: changed[key] for key in changed if key not in changes} == {
            key: base[key] for key in base if key not in changes
        }


@pytest.mark.parametrize(("name", "results"), [("sweep", "sweep"), ("compare", "mgail")])
def test_the_tables_in_the_docs_are_printed_again(
    name: str, results: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tables = script(name, monkeypatch)
    folder = SCRIPTS.parent / "results" / results
    monkeypatch.setattr(sys, "argv", [f"{name}.py", "table", "--results", str(folder)])
    tables["main"]()
    printed = capsys.readouterr().out
    for path in folder.glob("*.json"):
        row = json.loads(path.read_text())
        assert f"| {row['method']} | {row.get('kind') or row['name']} |" in printed
        if name == "sweep":
            assert f"| {row['collision_rate']:.1f} |" in printed


@pytest.mark.parametrize("method", get_args(Method))
def test_searching_methods_start_from_those_without(
    method: Method, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compare = script("compare", monkeypatch)
    seen: list[argparse.Namespace] = []
    given = ["train", "--data", str(tmp_path / "data"), "--runs", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["compare.py", *given])
    compare["main"].__globals__["learn"] = seen.append
    compare["main"]()
    config = compare["settings"](seen[0], method, 3)
    without = method.replace("_ts", "")
    assert config.warm_start == (None if method == without else tmp_path / f"{without}-3")
    assert (config.method, config.seed, config.out) == (method, 3, tmp_path / f"{method}-3")


def test_paired_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    paired = script("compare", monkeypatch)["paired"]
    rows = [{"per_segment": {"ade": values}} for values in ("[1, 2, 3]", "[2, 4, 6]")]
    assert paired([(rows[0], rows[1])], "ade") == "+2.00 ± 0.58"
    assert paired([(rows[0], rows[1]), (rows[1], rows[0])], "ade") == "+0.00 ± 0.00"
