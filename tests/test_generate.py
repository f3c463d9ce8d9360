"""Generated sets: plans, resuming, and the measures of driving."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers_segments import turned
from helpers_store import fill
from symphony.cli import main
from symphony.data import generate as generation
from symphony.data.builtin import builtin_store
from symphony.data.generate import (
    BARREN,
    BLOCK,
    MAX_SEED,
    PRESETS,
    SPLITS,
    Harvest,
    Plan,
    Split,
    Task,
    generate,
)
from symphony.data.segment import RunSegment
from symphony.data.selection import interactive_agents
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError
from symphony.evaluation.logs import measure, shortfalls

needs_sumo = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None,
    reason="SUMO is not installed (pip install 'symphony-traffic[sumo]')",
)
seeds = st.integers(0, MAX_SEED)
numbers = st.integers(0, BLOCK - 1)


@pytest.fixture(scope="module")
def segments() -> list[RunSegment]:
    """Some of the built-in run segments, on several maps."""
    return list(SegmentStore(builtin_store("train")))[:12]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch, segments: list[RunSegment]) -> None:
    """Networks that give one to three segments each in no time; each seventh fails and each fifth gives none."""

    def give(task: Task) -> Harvest:
        if task.seed % 7 == 3:
            return Harvest(task, [], error="netconvert failed", seconds=0.5)
        count = 0 if task.seed % 5 == 2 else 1 + task.seed % 3
        names = [f"{task.name}-{k}" for k in range(count)]
        made = [segments[(task.seed + k) % len(segments)].replace(segment_id=n) for k, n in enumerate(names)]
        return Harvest(task, made, accepted=count + 1, reasons=Counter(overlap=2), seconds=0.25)

    monkeypatch.setattr(generation, "harvest", give)
    monkeypatch.setattr(generation, "sumo_version", lambda: "0.0")


@given(seeds, seeds, st.sampled_from(SPLITS), st.sampled_from(SPLITS), numbers, numbers)
def test_networks_of_other_splits_seeds_and_numbers_are_others(
    a: int, b: int, split_a: Split, split_b: Split, i: int, j: int
) -> None:
    first, second = next(Plan(1, a, split_a).networks(i)), next(Plan(1, b, split_b).networks(j))
    assert (first.seed == second.seed) == ((a, split_a, i) == (b, split_b, j))
    # Below 2^32, each seed is one word of NumPy's seed sequence: no two of them mix to the same stream.
    assert 1_000_000 <= first.seed < 2**32


def test_bad_plans_name_the_field() -> None:
    bad = {"segments": 0, "seed": MAX_SEED + 1, "split": "dev", "kinds": (), "duration": 15, "interactive": 1}
    for field, value in [*bad.items(), ("kinds", ("village",))]:
        given: dict[str, Any] = {"segments": 5, field: value}
        with pytest.raises(ConfigError, match=field.rstrip("s")):
            Plan(**given)


@pytest.mark.usefixtures("fake")
def test_an_interrupted_store_is_continued_to_the_same_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = Plan(23, seed=4)
    whole = generate(plan, tmp_path / "whole")
    want = SegmentStore(tmp_path / "whole")
    assert len(want) == 23
    assert whole.complete
    assert whole.failed

    class StoppedError(Exception):
        pass

    real, left = StoreWriter.append, [0]

    def append(self: StoreWriter, *args: Any, **options: Any) -> int:
        if left[0] == 0:
            raise StoppedError
        left[0] -= 1
        return real(self, *args, **options)

    # Each attempt is stopped a few segments further on, within a network or between two.
    monkeypatch.setattr(StoreWriter, "append", append)
    attempts = 0
    while True:
        left[0], attempts = 1 + attempts % 4, attempts + 1
        try:
            state = generate(plan, tmp_path / "broken")
            break
        except StoppedError:
            assert not SegmentStore(tmp_path / "broken").report["generation"]["complete"]
    assert attempts > 6
    store = SegmentStore(tmp_path / "broken")
    assert store.ids == want.ids
    assert store.checksum() == want.checksum()
    assert state == whole
    assert [store.tags(i) for i in range(23)] == [want.tags(i) for i in range(23)]
    monkeypatch.setattr(generation, "harvest", None)  # a finished one is left as it is
    assert generate(plan, tmp_path / "broken", workers=3) == state


@pytest.mark.usefixtures("fake")
def test_other_arguments_and_stores_of_another_origin_are_refused(
    tmp_path: Path, segments: list[RunSegment]
) -> None:
    generate(Plan(3), tmp_path / "mine")
    for field, value in {"segments": 10, "seed": 1, "split": "test", "kinds": ("grid",)}.items():
        with pytest.raises(ConfigError, match=f"made with {field}"):
            generate(dataclasses.replace(Plan(3), **{field: value}), tmp_path / "mine")
    fill(tmp_path / "other", segments[:1])
    with pytest.raises(DataError, match="not generated"):
        generate(Plan(3), tmp_path / "other")
    assert len(SegmentStore(tmp_path / "other")) == 1


@pytest.mark.usefixtures("fake")
def test_networks_in_vain_come_to_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(generation, "harvest", lambda task: Harvest(task, [], reasons=Counter(overlap=3)))
    with pytest.raises(DataError, match=rf"{BARREN} networks(.|\n)*{3 * BARREN} x overlap"):
        generate(Plan(3), tmp_path)


ARGUMENTS = ["--count", "10", "--seed", "11"]


@needs_sumo
def test_a_killed_run_is_continued_and_workers_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "symphony.cli", "data", "generate", "--out", str(out), *ARGUMENTS]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        index = out / "segments.idx"
        while process.poll() is None and not (index.exists() and index.stat().st_size):
            time.sleep(0.002)
    finally:
        process.kill()
        process.wait()
    some = len(SegmentStore(out))
    assert 0 < some < 10
    if os.name == "posix":
        assert process.returncode == -signal.SIGKILL
    assert main([*command[3:], "--workers", "2", "--json", str(tmp_path / "killed.json")]) == 0
    assert "checksum" in capsys.readouterr().out
    plan = Plan(10, seed=11)
    state = generate(plan, tmp_path / "whole")
    store, whole = SegmentStore(out), SegmentStore(tmp_path / "whole")
    assert store.checksum() == whole.checksum()
    assert store.ids == whole.ids
    written = json.loads((tmp_path / "killed.json").read_text())["stores"]["train"]
    assert written["checksum"] == whole.checksum()
    assert written["generation"]["reasons"] == state.reasons
    assert main([*command[3:], "--interactive", "3"]) == 1
    assert "interactive 2, not 3" in capsys.readouterr().err


@pytest.mark.usefixtures("fake")
def test_a_preset_makes_three_stores_and_warns_of_other_checksums(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plans: dict[Split, Plan] = {split: Plan(4, split=split) for split in SPLITS}
    monkeypatch.setattr("symphony.data.sources.sumo.sumo_version", lambda: "0.0")
    small = generation.Preset(plans, dict.fromkeys(SPLITS, "0" * 64))
    monkeypatch.setitem(PRESETS, "town-small", small)
    command = ["data", "generate", "--out", str(tmp_path), "--preset", "town-small"]
    assert main(command) == 0
    assert capsys.readouterr().err.count("made with SUMO 0.0") == 3
    sums: dict[Split, str] = {split: SegmentStore(tmp_path / split).checksum() for split in SPLITS}
    monkeypatch.setitem(PRESETS, "town-small", generation.Preset(plans, sums))
    assert main(command) == 0
    assert "warning" not in capsys.readouterr().err


def test_built_in_set_meets_the_targets(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path, file = builtin_store("test"), tmp_path / "quality.json"
    assert main(["data", "quality", str(path), "--json", str(file)]) == 0
    assert "collision rate" in capsys.readouterr().out
    quality = json.loads(file.read_text())
    assert quality == measure(SegmentStore(path))
    assert shortfalls(quality) == []
    assert quality["segments"] == len(SegmentStore(path))
    assert quality["fit_error"]["mean"] < 0.1


@pytest.fixture
def altered(tmp_path: Path, segments: list[RunSegment]) -> Any:
    """Measures of one segment after a change."""

    def alter(**changes: Any) -> dict[str, Any]:
        place = tmp_path / f"s{len(list(tmp_path.iterdir()))}"
        return measure(fill(place, [segments[0].replace(**changes)]))

    return alter


def test_faults_are_found(altered: Any, segments: list[RunSegment]) -> None:
    segment = segments[0]
    ego, partner = interactive_agents(segment, 2)
    plain = altered()
    assert (plain["collision_rate"], plain["offroad_time"]) == (0, 0)
    # The partner where the ego is, for one step, and both of them beside the road for half the time.
    position = segment.position.copy()
    position[partner, 20] = position[ego, 20]
    assert altered(position=position)["collision_rate"] == 100
    position = segment.position.copy()
    edge = segment.road.boundary[0][:, :2]
    along = (edge[1] - edge[0]) / np.linalg.norm(edge[1] - edge[0])
    beside = (edge[0] + edge[1]) / 2 + np.array([along[1], -along[0]])
    position[np.ix_([ego, partner], np.arange(26, 51), [0, 1])] = beside
    moved = altered(position=position)
    assert moved["offroad_time"] == 50
    assert moved["fit_error"]["mean"] > 1
    assert any("offroad_time" in text for text in shortfalls(moved))
    velocity = segment.velocity * 2
    assert altered(velocity=velocity)["speed"]["mean"] == pytest.approx(2 * plain["speed"]["mean"], abs=2e-4)


def test_measures_do_not_depend_on_which_way_north_is(altered: Any, segments: list[RunSegment]) -> None:
    other = turned(segments[0], np.pi / 2)
    names = ("position", "velocity", "heading", "signal_point", "road")
    found = altered(**{name: getattr(other, name) for name in names})
    for name, value in altered().items():
        assert found[name] == pytest.approx(value, abs=0.02), name
