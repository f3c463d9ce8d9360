"""The harness of `make kills` (see tests/tools/kills.py): that it kills, goes on, and notices what differs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks /proc for CPU times")
if sys.platform.startswith("linux"):
    from kills import Target, compared, torment
    from kills_targets import timeless


def busy() -> None:
    sum(range(1_000_000))


def careful(out: Path) -> None:
    """Counts to five in files that are whole or not there."""
    out.mkdir(exist_ok=True)
    for k in range(len(list(out.glob("[0-9]"))), 5):
        busy()
        (out / "draft").write_text(str(k))
        (out / "draft").replace(out / str(k))


def careless(out: Path) -> None:
    """Counts to five, and begins anew whatever there is."""
    out.mkdir(exist_ok=True)
    for k in range(5):
        busy()
        with (out / "all").open("a") as file:
            file.write(str(k))


def left(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.iterdir()}


@pytest.mark.parametrize(("work", "good"), [(careful, True), (careless, False)])
def test_what_is_lost_or_comes_twice_is_found(
    work: Callable[[Path], None], good: bool, tmp_path: Path
) -> None:
    counts = torment(Target(work, left), tmp_path, 6, seed=0)
    assert counts.kills >= 6
    assert counts.finished >= 1
    assert (counts.failed == []) == good


def test_work_that_fails_is_told(tmp_path: Path) -> None:
    def fail(out: Path) -> None:
        raise ZeroDivisionError

    assert torment(Target(fail, left), tmp_path, 1, seed=0).failed == ["undisturbed: status 1"]


def test_files_are_compared_but_for_times() -> None:
    assert compared({"a": b"1", "b": b"2"}, {"a": b"1", "b": b"3", "c": b""}) == ["b differs", "c differs"]
    assert timeless({"a": [{"seconds": 3, "b": 1}], "out": "x"}) == {"a": [{"b": 1}]}
