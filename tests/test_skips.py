"""Skipped tests are counted by what they lack, and may not become more."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from helpers_skips import KINDS, LIMITS, by_kind, grown

HERE = Path(__file__).parent


def test_more_than_are_written_down_are_told() -> None:
    counts = by_kind(["Skipped: no CUDA device"] * 3 + ["Skipped: lazy"])
    assert counts == {"a card": 3, "Skipped: lazy": 1}
    assert grown(counts, "3 a card\n1 Skipped: lazy\n") == []
    told = grown(counts, "2 a card\n")
    assert [line.partition(", ")[0] for line in told] == [
        "3 tests skipped for want of a card",
        "1 tests skipped for want of Skipped: lazy",
    ]


def test_what_is_written_down_is_known() -> None:
    assert grown(Counter(dict.fromkeys(KINDS, 10**6)), LIMITS.read_text())
    assert {line.split(" ", 1)[1] for line in LIMITS.read_text().splitlines()} <= KINDS.keys()


@pytest.mark.parametrize(("watched", "status"), [("", 0), ("1", 1)])
def test_an_unknown_skip_fails_where_it_is_watched(tmp_path: Path, watched: str, status: int) -> None:
    (tmp_path / "conftest.py").write_text((HERE / "conftest.py").read_text())
    (tmp_path / "test_it.py").write_text("import pytest\n\ndef test_it():\n    pytest.skip('lazy')\n")
    command = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, str(tmp_path)]
    env = os.environ | {"SYMPHONY_SKIPS": watched, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=env)
    assert done.returncode == status, done.stdout + done.stderr
    assert "1 Skipped: lazy" in done.stdout
