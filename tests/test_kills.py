"""The harness of `make kills` (see tests/tools/kills.py): that it kills, goes on, and notices what differs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks /proc for CPU times")
if sys.platform.startswith("linux"):
    from kills import Target, torment
    from kills_targets import files


def count(out: Path, careful: bool) -> None:
    """Count to five in files that are whole or not there, or begin anew whatever there is."""
    out.mkdir(exist_ok=True)
    for k in range(len(list(out.glob("[0-9].json"))) if careful else 0, 5):
        sum(range(1_000_000))
        (out / "draft").write_text(f'{{"k": {k}, "seconds": {id(out)}}}')
        (out / "draft").replace(out / f"{k}.json")
        if not careful:
            with (out / "all").open("a") as file:
                file.write(str(k))


def careful(out: Path) -> None:
    count(out, True)


def careless(out: Path) -> None:
    count(out, False)


@pytest.mark.parametrize(("work", "good"), [(careful, True), (careless, False)])
def test_what_is_lost_or_comes_twice_is_found(
    work: Callable[[Path], None], good: bool, tmp_path: Path
) -> None:
    counts = torment(Target(work, files), tmp_path, 6, seed=0)
    assert counts.kills >= 6
    assert counts.finished >= 1
    assert (counts.failed == []) == good


def test_work_that_fails_is_told(tmp_path: Path) -> None:
    def fail(out: Path) -> None:
        raise ZeroDivisionError

    assert torment(Target(fail, files), tmp_path, 1, seed=0).failed == ["undisturbed: status 1"]
