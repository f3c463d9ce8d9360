"""One odd thing loses nothing else: it is left out, counted once by kind with an example, and the rest goes on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers_convert import FakeReader
from helpers_segments import hide, straight_road
from symphony.data.convert import convert, info
from symphony.data.odd import LATE_EGO, NO_SIZE, THIN, WILD, from_ego, mended
from symphony.data.resample import LOST, REPEATED, UNEVEN, evened
from symphony.data.segment import RunSegment, SignalState, validate
from symphony.data.sources.base import Item, time_step
from symphony.data.sources.interaction_tracks import Rows, stepped
from symphony.data.store import SegmentStore
from symphony.errors import DataError

TENTH = 0.1 * np.arange(91)


def scene(**changes: Any) -> RunSegment:
    return straight_road(3, dt=0.1, steps=91).replace(**changes)


def seen_at(times: NDArray[np.float64]) -> RunSegment:
    """The cars of a straight road, at the moments given; they keep their speed between steps of 0.1 s."""
    whole = scene()
    index = np.minimum(np.floor(times / 0.1 + 1e-9).astype(int), 89)
    share = (times / 0.1 - index).astype(np.float32)
    found = {name: getattr(whole, name)[:, index] for name in ("velocity", "valid", "signal_state")}
    for name, part in (("position", share[:, None]), ("heading", share)):
        array = getattr(whole, name)
        found[name] = array[:, index] * (1 - part) + array[:, index + 1] * part
    return whole.replace(**found)


# Times


@settings(max_examples=30)
@given(st.integers(2, 80), st.integers(1, 9))
def test_lost_frames_are_filled_in_between(first: int, count: int) -> None:
    kept = np.delete(np.arange(91), np.arange(first, min(first + count, 90)))
    found = evened(seen_at(TENTH[kept]), TENTH[kept])
    assert time_step(TENTH[kept], "times") == 0.1
    assert found.num_steps == 91
    assert found.odd == {LOST: f"{91 - len(kept)} of 91"}
    whole = scene()
    np.testing.assert_array_equal(found.position[:, kept], whole.position[:, kept])
    assert found.valid.all()
    np.testing.assert_allclose(found.position, whole.position, atol=0.3)  # m, of a car that accelerates
    validate(found)


def test_a_long_gap_stays_open() -> None:
    kept = np.delete(np.arange(91), np.arange(40, 55))
    lights = {"signal_lane": np.zeros(1, np.int32), "signal_point": np.zeros((1, 3), np.float32)}
    green = np.full((1, len(kept)), SignalState.GO, np.uint8)
    found = validate(evened(seen_at(TENTH[kept]).replace(**lights, signal_state=green), TENTH[kept]))
    np.testing.assert_array_equal(found.valid, np.broadcast_to(np.isin(np.arange(91), kept), (3, 91)))
    assert not found.signal_state[0, 40:55].any()


@settings(max_examples=30)
@given(st.integers(0, 2**16))
def test_uneven_times_are_brought_to_even_ones(seed: int) -> None:
    times = np.sort(np.random.default_rng(seed).uniform(-0.03, 0.03, 91) + TENTH)
    times = np.clip(times - times[0], 0, 9)
    found, whole = evened(seen_at(times), times), scene()
    assert found.num_steps in {90, 91}
    assert set(found.odd) <= {UNEVEN, LOST}
    # Within a tenth of a step at the highest speed, and what a straight line misses between two frames.
    far = 0.01 * np.hypot(*np.moveaxis(whole.velocity, -1, 0)).max() + 0.05
    np.testing.assert_allclose(found.position, whole.position[:, : found.num_steps], atol=far)


def test_a_frame_that_comes_twice_counts_once() -> None:
    times = np.insert(TENTH, 40, TENTH[39])
    found = evened(seen_at(times), times)
    assert found.odd == {REPEATED: "1 of 92"}
    np.testing.assert_array_equal(found.position, scene().position)


def test_times_without_a_step_are_refused() -> None:
    for times in ([0, 1, 5, 6, 20], [0, 0.1, 0.2, 50.0, 50.1, 50.2], [0, 0, 0, 0], [3, 2, 1, 0]):
        with pytest.raises(DataError, match="uneven"):
            time_step(np.array(times, np.float64), "times")


@pytest.mark.parametrize("rate", [10, 12.5, 25, 29.97, 30, 50, 100])
@pytest.mark.parametrize("whole", [True, False])
def test_rates_of_recordings(rate: float, whole: bool) -> None:
    frames = np.delete(np.arange(int(12 * rate)), np.arange(30, 35))  # five are lost
    times = np.round(5000 + 1000 * frames / rate, 0 if whole else 3)
    empty = np.zeros(len(times), np.int64)
    rows = Rows(empty, times, empty, empty, np.zeros((len(times), 7)), np.zeros((len(times), 2), bool))
    found, dt, start = stepped(rows)
    assert dt == pytest.approx(1 / rate, rel=2e-4 if whole else 1e-6)
    assert found.time.tolist() == frames.tolist()
    assert start == 5000


# Agents and states


def sized(agent: int, sides: tuple[float, float, float]) -> RunSegment:
    size = scene().size.copy()
    size[agent] = sides
    return scene(size=size)


def test_boxes_without_a_size() -> None:
    whole = scene()
    for sides in ((0, 0, 0), (np.nan,) * 3, (200, 1, 1)):
        found = validate(mended(sized(1, sides)))
        assert found.odd == {NO_SIZE: f"agent {whole.agent_id[1]}"}
        assert found.agent_id.tolist() == [whole.agent_id[k] for k in (0, 2)]
        with pytest.raises(DataError):  # the ego's
            validate(mended(sized(0, sides)))
    found = validate(mended(sized(1, (0.04, 0.04, 0.8))))
    assert found.odd == {THIN: f"agent {whole.agent_id[1]}"}
    np.testing.assert_array_equal(found.size[1], np.float32([0.05, 0.05, 0.8]))
    assert validate(mended(sized(2, (4, 2, np.nan)))).size[2, 2] == 0


@given(st.integers(0, 90), st.sampled_from([3000.0, 1e5, np.nan, np.inf]))
def test_a_wild_state_costs_itself_alone(step: int, away: float) -> None:
    position = scene().position.copy()
    position[1, step, 0] += away
    found = validate(mended(scene(position=position)))
    expected = np.ones((3, 91), bool)
    expected[1, step] = False
    np.testing.assert_array_equal(found.valid, expected)
    assert list(found.odd) == [WILD]


def test_an_ego_that_comes_late() -> None:
    late = hide(scene(current_step=10), 0, slice(0, 3))
    found = validate(from_ego(late))
    assert found.odd == {LATE_EGO: "3 of 91"}
    assert (found.num_steps, found.current_step) == (88, 7)
    np.testing.assert_array_equal(found.position, late.position[:, 3:])
    for unchanged in (scene(), hide(scene(), 0, slice(0, 20)), hide(scene(), 0, slice(5, 90))):
        assert from_ego(unchanged) is unchanged
    # Who has left by then is gone.
    assert from_ego(hide(late, 1, slice(2, 91))).num_agents == 2


# The report


class Lame(FakeReader):
    """One of its agents has no size where the line says so, and in the last line the ego comes late."""

    def _read(self, path: Path) -> Iterator[Item]:
        for number, item in enumerate(super()._read(path)):
            assert isinstance(item, RunSegment)
            size = item.size.copy()
            size[-1, 0] = 0 if number in {1, 2} else size[-1, 0]
            yield hide(item, 0, slice(0, 2)) if number == 3 else replace(item, size=size)


@pytest.mark.parametrize("workers", [1, 2])
def test_it_is_counted_by_kind_with_an_example(workers: int, tmp_path: Path) -> None:
    (tmp_path / "a.scene").write_text("straight 1\nstraight 2\nstraight 3\nstraight 4")
    report = convert(Lame(), [tmp_path], tmp_path / "out", workers=workers)
    assert report.converted == 4
    assert report.odd == {NO_SIZE: 2, LATE_EGO: 1}
    assert set(report.odd_examples) == set(report.odd)
    assert report.odd_examples[NO_SIZE].startswith("straight-2: agent ")
    assert report.odd_examples[LATE_EGO] == "straight-4: 2 of 91"
    found = info(tmp_path / "out")
    assert (found["odd"], found["odd_examples"]) == (report.odd, report.odd_examples)
    assert list(SegmentStore(tmp_path / "out").tags(1)["odd"]) == [NO_SIZE]
    strict = convert(Lame(), [tmp_path], tmp_path / "strict", workers=workers, strict=True)
    assert (strict.converted, strict.odd) == (1, {})
    assert [skip.segment for skip in strict.skipped] == ["straight-2", "straight-3", "straight-4"]
    assert strict.settings["strict"] is True
