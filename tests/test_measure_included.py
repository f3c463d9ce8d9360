"""The command that measures an included agent anew makes the records that the pages show."""

from __future__ import annotations

import json
import runpy
import sys
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import pytest
import tyro

from symphony.cli import app
from symphony.cli.evaluate import Evaluate
from symphony.config import EvaluateConfig

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def commands() -> dict[str, str]:
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        found = list(runpy.run_path(str(ROOT / "scripts" / "measure_included.py"))["commands"]("playback"))
    finally:
        sys.path.pop(0)
    assert len(dict(found)) == len(found)
    return dict(found)


def test_each_makes_a_record_that_is_there_with_its_settings(commands: dict[str, str]) -> None:
    assert len(commands) > 40
    settings = (tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff)
    for name, words in commands.items():
        record: dict[str, Any] = json.loads((ROOT / "results" / f"{name}.json").read_text())
        kind, *rest = words.split()
        # Its parser alone takes half the time of that of all commands.
        command: Any = (
            tyro.cli(Evaluate, args=rest, config=settings)
            if kind == "evaluate"
            else app.cli(args=[kind, *rest], config=settings)
        )
        if isinstance(command, Evaluate):
            known = (
                record["settings"]
                if command.planner
                else record["config"] | {name: record[name] for name in ("rollouts", "seed", "interactive")}
            )
            for field in fields(EvaluateConfig):
                value = getattr(command.config, field.name)
                if value != field.default and field.default is not MISSING:
                    assert value == known[field.name], f"{name}: {field.name}"
            assert (command.config.search == "none") == (known["search"] == "none"), name
            assert not command.segments or len(command.segments) == record["segments"], name
