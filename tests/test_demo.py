"""The demo, with fewer updates and rollouts than a newcomer gets."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from symphony.cli import main


def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["demo", "--out", str(tmp_path / "demo"), "--steps", "2", "--rollouts", "1"]
    assert main(command) == 0
    rows = json.loads((tmp_path / "demo" / "metrics.json").read_text())["rows"]
    assert [row["agent"] for row in rows] == ["log playback", "constant velocity", "BC"]
    assert all(row["segments"] == 24 for row in rows)
    assert rows[0]["ade"] == rows[0]["collision_rate"] == 0
    assert rows[1]["ade"] > 1
    assert (tmp_path / "demo" / "rollouts.png").stat().st_size > 50_000
    assert f"{rows[1]['ade']:.2f}" in capsys.readouterr().out
    assert main(command) == 0  # an earlier demo is replaced
