"""What commands tell: names whole, numbers in one place, what to do next."""

from __future__ import annotations

import io
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rich.table import Table

from helpers_runs import tiny
from helpers_segments import straight_road
from helpers_store import fill
from symphony.cli import main
from symphony.cli.shared import print_metrics, print_table
from symphony.cli.train import last_words
from symphony.config import ValidationConfig
from symphony.errors import ConfigError
from symphony.recipes import train
from symphony.training.logging import Tracker


@pytest.mark.parametrize("width", [20, 80, 300])
def test_tables_never_break_a_name(width: int) -> None:
    name, title = "runs/" + "long_name_" * 9, "/path/" + "of_a_store_" * 12
    table = Table("agent", "number", title=title)
    table.add_row(name, "1.0")
    file = io.StringIO()
    console = Console(file=file, width=width)
    print_table(table, console)
    lines = file.getvalue().splitlines()
    assert sum(name in line for line in lines) == 1
    assert sum(title in line for line in lines) == 1
    assert console.width == width


def test_help_is_not_broken_where_its_source_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "600")
    assert main(["evaluate", "--help"]) == 0
    told = capsys.readouterr().out
    assert "along the route of the log) or the agent itself" in told
    assert "must come in the log to be driven; 0: no limit." in told


def test_numbers_are_told_where_there_are_some(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    row: dict[str, Any] = dict.fromkeys(("offroad_time", "ade", "min_sade", "curvature_jsd"), 0.0)
    row |= {"agent": "runs/bc", "collision_rate": 12.5, "collision_crossing": 12.5, "standing": math.nan}
    row |= {"my:jerk": 1.5, "my:jerk_se": 0.5}
    row |= {"interactive": 2, "rollouts": 4, "segments": 2, "groups": 2, "seed": 0}
    print_metrics([row])
    short = capsys.readouterr().out.splitlines()
    assert "bc: my:jerk 1.5000 ± 0.5000" in short  # was asked for
    assert len(short) == 8  # with the table's lines, and one of what it is of
    print_metrics([row], details=True)
    told = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert {"collision crossing 12.5", "standing –"} <= set(told)


def test_doctor_simulates_and_says_what_is_there(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["doctor", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["simulation"]["rollouts"] == 2
    assert found["packages"]["torch"]
    assert set(found["extras"]) == {"sumo", "argoverse2", "ray", "video", "gym"}
    assert "bc_ts_h" in found["agents"]["included"]


def test_training_ends_with_what_to_know(tmp_path: Path) -> None:
    fill(tmp_path / "store", [straight_road(4, seed=k, steps=8) for k in range(2)])
    config = tiny("bc", tmp_path / "store", tmp_path / "runs")
    lines = dict(line.split(maxsplit=1) for line in last_words(train(config), config))
    assert lines["checkpoint"].startswith(f"step-{config.steps:012d}: the last one; nothing was validated")
    validation = ValidationConfig(data=tmp_path / "store", segments=2, rollouts=1)
    config = replace(config, out=tmp_path / "validated", validation=validation)
    lines = dict(line.split(maxsplit=1) for line in last_words(train(config), config))
    assert f"% on segments of {tmp_path / 'store'} (at most 2)" in lines["checkpoint"]


def test_weights_and_biases_reads_its_own_variables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import wandb

    told: dict[str, Any] = {}
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setattr(wandb, "init", lambda **given: told.update(given))
    for project in ("symphony", "mine"):
        Tracker(tmp_path, {}, "offline").close()
        assert told["project"] == project
        assert not {"group", "tags"} & told.keys()  # else its own variables would not be looked at
        monkeypatch.setenv("WANDB_PROJECT", "mine")


def test_a_run_that_goes_on_is_the_same_at_weights_and_biases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import wandb

    told: list[dict[str, Any]] = []
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setattr(wandb, "init", lambda **given: told.append(given))
    for after in (0, 3, 0):
        Tracker(tmp_path, {}, "offline", after=after).close()
    assert [given["resume"] for given in told] == [None, "allow", None]
    assert told[0]["id"] == told[1]["id"] != told[2]["id"]
    (tmp_path / "wandb-id").write_text("../other\n")
    Tracker(tmp_path, {}, "offline", after=3).close()
    assert re.fullmatch(r"[0-9a-f]{8}", told[3]["id"])


def test_without_a_key_there_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import wandb

    def init(**given: Any) -> None:
        raise wandb.errors.UsageError("No API key configured.\nUse `wandb login` to log in.")

    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setattr(wandb, "init", init)
    with pytest.raises(ConfigError, match=r"^Weights & Biases: No API key .*log in\. .*--wandb offline$"):
        Tracker(tmp_path, {}, "online")
