"""The harnesses of `make fuzz` and `make kills` notice what they are for; skipped tests are counted."""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from helpers_skips import by_kind, grown
from symphony.data.sources import readers

LINUX = sys.platform.startswith("linux")
pytestmark = pytest.mark.skipif(not LINUX, reason="memory is limited on Linux only")
if LINUX:
    import fuzz
    import kills
    from fuzz import BAD, Counts, attempt, inputs, run
    from fuzz_mutations import Target
    from fuzz_targets import TARGETS
    from kills import torment
    from kills_targets import files

INPUTS = 8
NAMES = [*readers(), "test_area", "store", "checkpoint", "submission", "rollouts"]


def skip_without_its_package(name: str) -> None:
    if name == "argoverse2" and importlib.util.find_spec("pyarrow") is None:
        pytest.skip("pyarrow is not installed")


@pytest.mark.parametrize("name", NAMES)
def test_nothing_but_errors_of_ours(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In this process: no limits, but quick; the limits are for the long runs."""
    skip_without_its_package(name)
    monkeypatch.setattr(os, "fsync", lambda _: None)
    assert set(TARGETS) == set(NAMES)
    assert attempt(TARGETS[name], dict(TARGETS[name].good()), tmp_path / "good") == ("accepted", "")
    counts = Counts()
    for number in range(INPUTS):
        files = inputs(name, 1, number)
        counts.add(*attempt(TARGETS[name], files, tmp_path / str(number)))
        assert number or inputs(name, 1, 0) == files != inputs(name, 2, 0)
    assert counts.found == []
    assert counts.outcomes["refused"] > INPUTS / 10


@pytest.mark.parametrize(("which", "number"), [
    ("argoverse2", 3613),  # Arrow ended the process when it was asked for the size of a damaged column
    ("rollouts", 1700),  # settings that are infinite
    ("rollouts", 40),  # facts that are nested 100 000 deep
])  # fmt: skip
def test_what_was_found_stays_mended(which: str, number: int, tmp_path: Path) -> None:
    skip_without_its_package(which)
    assert attempt(TARGETS[which], inputs(which, 7, number), tmp_path)[0] in {"accepted", "refused"}


def misbehaves(folder: Path, file: str) -> tuple[str, str]:
    """Does what a byte says."""
    way = (folder / file).read_bytes()[0] % 6
    if way == 0:
        raise KeyError("lanes")
    if way == 1:
        time.sleep(60)
    if way == 2:
        np.ones(1 << 29)
    if way == 3:
        os.abort()
    return ("absurd", "a speed") if way == 4 else ("refused", "")


def test_whatever_goes_wrong_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "WAIT", 1.0)
    monkeypatch.setattr(fuzz, "inputs", lambda name, seed, number: {"a": bytes([number % 6])})
    monkeypatch.setitem(TARGETS, "bad", Target(lambda: {"a": b"5"}, lambda rng, files: files, misbehaves))
    counts = Counts()
    run("bad", counts, 4)
    run("bad", counts, 9)
    assert counts.outcomes == {"foreign": 2, "hang": 2, "memory": 2, "crash": 1, "absurd": 1, "refused": 1}
    assert {kind for kind, *_ in counts.found} == set(BAD)


def count(out: Path, careful: bool) -> None:
    """Count to five in files that are whole or not there, or begin again whatever there is."""
    out.mkdir(exist_ok=True)
    for k in range(len(list(out.glob("[0-9].json"))) if careful else 0, 5):
        sum(range(1_000_000))
        (out / "draft").write_text(f'{{"k": {k}, "seconds": {id(out)}}}')
        (out / "draft").replace(out / f"{k}.json")
        if not careful:
            with (out / "all").open("a") as file:
                file.write(str(k))


@pytest.mark.parametrize("good", [True, False])
def test_what_is_lost_or_comes_twice(good: bool, tmp_path: Path) -> None:
    counts = torment(kills.Target(partial(count, careful=good), files), tmp_path, 3, seed=0)
    assert counts.kills >= 3
    assert counts.finished >= 1
    assert (counts.failed == []) == good


def test_more_than_are_written_down_are_told() -> None:
    counts = by_kind(["Skipped: no CUDA device"] * 3 + ["Skipped: lazy"])
    assert (counts, grown(counts, "3 a card\n1 Skipped: lazy\n")) == ({"a card": 3, "Skipped: lazy": 1}, [])
    told = [line.partition(", ")[0] for line in grown(counts, "2 a card\n")]
    assert told == [f"{found} tests skipped for want of {why}" for why, found in counts.items()]
