"""A small part of `make fuzz` (see tests/tools/fuzz.py), and that it notices what it is for."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from symphony.data.sources import readers

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="memory is limited on Linux only"
)
if sys.platform.startswith("linux"):
    import fuzz
    import fuzz_targets
    from fuzz import BAD, Counts, attempt, from_json, inputs, run, to_json
    from fuzz_base import Target
    from fuzz_targets import TARGETS

NEEDS = {"argoverse2": "pyarrow"}
INPUTS = 12


NAMES = ["womd", "commonroad", "argoverse2", "interaction", "test_area", "scenarionet"]
NAMES += ["store", "checkpoint", "configuration", "submission", "rollouts"]


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    package = NEEDS.get(request.param)
    if package is not None and importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    return str(request.param)


def test_every_target_is_tested() -> None:
    assert set(TARGETS) == set(NAMES)
    assert set(readers()) <= set(TARGETS)


def test_good_files_are_good(name: str, tmp_path: Path) -> None:
    assert attempt(TARGETS[name], dict(TARGETS[name].good()), tmp_path) == ("accepted", "")


def test_nothing_but_errors_of_ours(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In this process: no limits, but quick; the limits are for the long runs."""
    monkeypatch.setattr(os, "fsync", lambda _: None)
    counts = Counts()
    for number in range(INPUTS):
        (folder := tmp_path / str(number)).mkdir()
        counts.add(number, *attempt(TARGETS[name], inputs(name, 1, number), folder))
    assert counts.found == []
    assert counts.outcomes["refused"] > INPUTS / 10


def test_inputs_are_the_same_whenever_they_are_asked_for(name: str) -> None:
    assert inputs(name, 3, 17) == inputs(name, 3, 17)
    assert any(inputs(name, 3, k) != inputs(name, 4, k) for k in range(3))


@pytest.mark.parametrize(
    ("which", "number"),
    [
        ("argoverse2", 3613),  # Arrow ended the process when it was asked for the size of a damaged column
        ("rollouts", 1700),  # settings that are infinite
        ("rollouts", 40),  # facts that are nested 100 000 deep
    ],
)
def test_what_was_found_stays_mended(which: str, number: int, tmp_path: Path) -> None:
    if which in NEEDS:
        pytest.importorskip(NEEDS[which])
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
    monkeypatch.setattr(fuzz, "SECONDS", 1)
    monkeypatch.setattr(fuzz, "WAIT", 1)
    monkeypatch.setattr(fuzz, "inputs", lambda name, seed, number: {"a": bytes([number % 6])})
    monkeypatch.setitem(TARGETS, "bad", Target(lambda: {"a": b"5"}, lambda rng, files: files, misbehaves))
    counts = Counts()
    run("bad", counts, 4)
    run("bad", counts, 9)
    expected = {"foreign": 2, "hang": 2, "memory": 2, "crash": 1, "absurd": 1, "refused": 1}
    assert counts.outcomes == {**dict.fromkeys(fuzz.OUTCOMES, 0), **expected}
    assert (counts.inputs, counts.bad) == (9, 8)
    assert {kind for _, kind, _ in counts.found} == set(BAD)
    again = from_json(to_json({"bad": counts}))["bad"]
    assert dataclasses.replace(again, found=[tuple(each) for each in again.found]) == counts


def test_absurd_segments_are_known(tmp_path: Path) -> None:
    from helpers_segments import straight_road

    good = straight_road()
    assert fuzz_targets.absurd(good) == ""
    fast = good.replace(velocity=good.velocity * np.float32(1e6))
    assert "speed" in fuzz_targets.absurd(fast)
