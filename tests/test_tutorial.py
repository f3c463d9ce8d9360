"""The notebook: its cells run, one after the other, and leave nothing behind in it."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "tutorial.ipynb"


def cells() -> list[str]:
    found = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in found["cells"] if cell["cell_type"] == "code"]


def test_every_cell_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Small: the sizes that the first cell sets are others here."""
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {"__name__": "tutorial"}
    for number, cell in enumerate(cells()):
        # As in a notebook, where it fails is told by its cell.
        exec(compile(ast.parse(cell), f"cell {number}", "exec"), space)  # noqa: S102
        if number == 0:
            assert {"segments", "rollouts"} <= space.keys()
            space |= {"segments": 1, "rollouts": 2}
    assert (tmp_path / "out/tutorial/rollouts.png").stat().st_size > 10_000
    shown = capsys.readouterr().out
    assert "runs                     2.00" in shown
    assert "failed_runs              0.00" in shown


def test_it_is_kept_without_output() -> None:
    found = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    for cell in found["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None
