"""The counts on the page of what was done to break the package are those on record."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def script() -> Any:
    spec = importlib.util.spec_from_file_location("hardening_page", ROOT / "scripts" / "hardening_page.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tables_are_those_of_the_records(script: Any, tmp_path: Path) -> None:
    text = (ROOT / "docs" / "hardening.md").read_text(encoding="utf-8")
    copy = tmp_path / "page.md"
    copy.write_text(text, encoding="utf-8")
    assert script.main(["--records", str(ROOT / "results" / "hardening"), "--page", str(copy)]) == 0
    assert copy.read_text(encoding="utf-8") == text
    assert text.count("| --- |") >= 3


def test_runs_are_added_up(script: Any) -> None:
    runs = [
        {"a": {"outcomes": {"accepted": 1, "refused": 2, "hang": 1}}},
        {"a": {"outcomes": {"refused": 4}}},
    ]
    assert "| a | 8 | 1 | 6 | 1 |" in script.of_fuzz(runs)
    assert "| all | 8 | 1 | 6 | 1 |" in script.of_fuzz(runs)


def test_a_page_without_the_places_is_refused(script: Any, tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text("nothing")
    with pytest.raises(SystemExit, match="no place for fuzz"):
        script.main(["--records", str(ROOT / "results" / "hardening"), "--page", str(tmp_path / "page.md")])
