"""Names of kept evaluations: one for each way to evaluate."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from helpers_table import make_record
from symphony.config import EvaluateConfig
from symphony.evaluation.records import evaluation_name

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


def test_names_differ_with_everything_that_changes_results() -> None:
    same = {"batch", "device", "workers", "engine"}
    assert {field.name for field in dataclasses.fields(EvaluateConfig)} == CHANGES.keys() | same
    base = make_record(search="tree", trees=1, branches=16, rule="best")
    others = [base | {"config": base["config"] | {name: value}} for name, value in CHANGES.items()]
    others.append(base | {"data": {"name": "test", "checksum": "cd" * 32}})
    others.append(base | {"run": {"named": True, "checkpoint": 50}})
    names = [evaluation_name(record) for record in (base, *others)]
    assert len(set(names)) == len(names)
    for change in {"batch": 3}, {"device": "cuda"}, {"workers": 2}, {"engine": "ray"}:
        assert evaluation_name(others[0] | {"config": others[0]["config"] | change}) == names[1]


@given(st.text(max_size=80))
def test_names_are_file_names_whatever_the_store_is_called(store: str) -> None:
    name = evaluation_name(make_record() | {"data": {"name": store, "checksum": "ab" * 32}})
    assert re.fullmatch(r"[A-Za-z0-9._-]+", name)
    assert len(name) < 200


def test_long_names_are_cut_and_differ_all_the_same() -> None:
    """An evaluation of hours was lost where its name was too long for a file."""
    paths = [f"measures.of.comfort.{part}:{part}_of_all_agents" for part in "abcdefgh"]
    names = {evaluation_name(make_record(metric=[*paths, last])) for last in ("x:y", "x:z")}
    assert len(names) == 2
    assert max(map(len, names)) <= 200
