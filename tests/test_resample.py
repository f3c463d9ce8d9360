"""Tracks at other times, smoothed and made even; one odd thing is left out, counted, and loses nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from helpers_convert import FakeReader
from helpers_segments import crossing, hide, segments, straight_road, turned
from symphony.data.convert import convert, info
from symphony.data.odd import LATE_EGO, NO_SIZE, THIN, WILD, from_ego, mended
from symphony.data.resample import LOST, REPEATED, UNEVEN, evened, hold_lights, mirrored, resample, smooth
from symphony.data.segment import RunSegment, SignalState, content_hash, validate
from symphony.data.sources.base import Item, time_step
from symphony.data.sources.interaction_tracks import Rows, stepped
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError

PER_STEP = ("position", "heading", "velocity", "valid", "signal_state")


@given(segments(), st.integers(1, 4))
def test_whole_multiples_pick_and_keep_everything_else(log: RunSegment, every: int) -> None:
    picked = log.valid[:, ::every]
    assume(picked.shape[1] >= 2 and picked[log.ego].any())
    new = resample(log, log.dt * every)
    same = {name: getattr(log, name) for name in (*PER_STEP, "dt", "current_step")}
    assert content_hash(new.replace(**same)) == content_hash(log)
    np.testing.assert_array_equal(new.valid, picked)


@given(segments(), st.floats(0.15, 3))
def test_any_ratio_gives_a_valid_segment_of_the_same_span(log: RunSegment, ratio: float) -> None:
    dt = log.dt * ratio
    before = np.floor(np.arange(int((log.num_steps - 1) / ratio + 1e-6) + 1) * ratio + 1e-6).astype(int)
    assume(len(before) >= 2 and log.valid[log.ego, 0])
    new = resample(log, dt)
    assert new.num_steps == len(before)
    assert not (new.valid & ~log.valid[:, before]).any()
    assert (new.num_steps - 1) * dt <= (log.num_steps - 1) * log.dt * (1 + 1e-5)
    assert new.num_steps * dt > (log.num_steps - 1) * log.dt
    assert new.current_step * dt <= log.current_step * log.dt + 1e-4


@given(segments())
def test_mirrored_twice_a_segment_is_as_it_was(log: RunSegment) -> None:
    once = validate(mirrored(log.replace(goal=[3.0, 4.0])))
    assert (once.goal, once.road.left_neighbors.tolist()) == ([3.0, -4.0], log.road.right_neighbors.tolist())
    twice = mirrored(once)
    assert twice.segment_id == f"{log.segment_id}-mirrored-mirrored"
    assert content_hash(twice.replace(segment_id=log.segment_id)) == content_hash(log.replace(goal=[3.0, 4.0]))


def test_interpolation_is_exact_for_uniform_motion() -> None:
    log = straight_road(4, steps=51, dt=0.1)
    new = resample(log, 0.15)
    time = np.arange(new.num_steps) * 0.15
    expected = log.position[:, :1, :2] + log.velocity[:, :1] * time[:, None]
    np.testing.assert_allclose(new.position[..., :2], expected, atol=1e-4)
    np.testing.assert_allclose(new.velocity - log.velocity[:, :1], 0, atol=1e-5)


def test_between_a_valid_and_an_invalid_step_nothing_is_made_up() -> None:
    log = hide(straight_road(2, steps=11, dt=0.1), 1, slice(4, 6))
    new = resample(log, 0.05)
    np.testing.assert_array_equal(np.flatnonzero(~new.valid[1]), np.arange(7, 12))
    assert not new.position[1, 7:12].any()


@given(arrays(np.uint8, (12, 7), elements=st.integers(0, 8)))
@settings(max_examples=15, deadline=None)
def test_held_lights_are_never_unknown_if_they_were_ever_known(state: NDArray[np.uint8]) -> None:
    log = crossing(2, steps=7, dt=0.2).replace(signal_state=state)
    held = hold_lights(log)
    for before, after in zip(state.tolist(), held.signal_state.tolist(), strict=True):
        known = [value for value in before if value]
        for step, value in enumerate(after):
            past = [seen for seen in before[: step + 1] if seen]
            assert value == (past[-1] if past else known[0] if known else SignalState.UNKNOWN)
    assert held.signal_state.dtype == log.signal_state.dtype
    assert content_hash(hold_lights(held)) == content_hash(held)
    assert content_hash(held.replace(signal_state=state)) == content_hash(log)


def noisy(log: RunSegment, sigma: float, seed: int = 0) -> RunSegment:
    noise = np.random.default_rng(seed).normal(0, sigma, (*log.valid.shape, 2)).astype(np.float32)
    position = log.position.copy()
    position[..., :2] += noise * log.valid[..., None]
    return log.replace(position=position)


def test_uniform_motion_with_gaps_stays_as_it_is() -> None:
    log = hide(hide(straight_road(4, steps=91, dt=0.1), 1, slice(30, 44)), 2, slice(0, 50))
    new = validate(smooth(log, 0.4))
    np.testing.assert_array_equal(new.valid, log.valid)
    for name in ("position", "velocity", "heading"):
        np.testing.assert_allclose(getattr(new, name), getattr(log, name), atol=2e-4)
    assert not new.position[~log.valid].any()


@settings(max_examples=25, deadline=None)
@given(st.floats(-3, 3), st.floats(-500, 500), st.integers(0, 99))
def test_smoothing_commutes_with_turning_and_shifting(angle: float, shift: float, seed: int) -> None:
    log = hide(noisy(crossing(3, steps=31, dt=0.1, seed=seed), 0.1, seed), 1, slice(8, 13))
    one, other = turned(smooth(log, 0.3), angle, shift), smooth(turned(log, angle, shift), 0.3)
    np.testing.assert_allclose(one.position, other.position, atol=5e-3)
    np.testing.assert_allclose(one.velocity, other.velocity, atol=5e-3)
    np.testing.assert_allclose(np.cos(one.heading - other.heading), 1, atol=1e-4)


def along_x(speed: NDArray[Any], heading: float) -> RunSegment:
    log = straight_road(1, steps=len(speed), dt=0.1)
    position = np.zeros((1, len(speed), 3), np.float32)
    position[0, :, 0] = np.cumsum(speed) * 0.1
    velocity = np.stack([speed, np.zeros_like(speed)], -1)[None].astype(np.float32)
    return log.replace(position=position, velocity=velocity, heading=np.full_like(log.heading, heading))


def test_the_heading_follows_the_motion_only_when_moving() -> None:
    # Backwards it keeps facing the same way, after two turns it stays on the logged branch.
    whole = 4 * np.pi
    for speed, heading, expected in ((5.0, 0.2, 0.0), (0.5, 0.2, 0.2), (-5.0, 0.1, 0.0), (5.0, whole, whole)):
        found = smooth(along_x(np.full(40, speed), heading), 0.3)
        np.testing.assert_allclose(found.heading, expected, atol=1e-5)
    starting = smooth(along_x(np.linspace(0, 6, 60), 0.2), 0.3)
    assert np.abs(np.diff(starting.heading)).max() < 0.05


@pytest.mark.parametrize("every", [0.5, 1, 2.5, 3])
def test_a_light_seen_between_new_steps_is_not_lost(every: float) -> None:
    """Against a plain loop: the latest known state since the new step before, if it is unknown now."""
    rng = np.random.default_rng(int(every))
    segment = crossing(steps=31)
    state = rng.integers(0, 9, segment.signal_state.shape) * (rng.random(segment.signal_state.shape) < 0.3)
    found = resample(segment.replace(signal_state=state.astype(np.uint8)), every * segment.dt)
    for light, row in enumerate(state):
        for k in range(found.num_steps):
            now = int(every * k)
            known = [x for x in row[max(min(int(every * (k - 1)) + 1, now), 0) : now + 1] if x]
            assert found.signal_state[light, k] == (known[-1] if known else 0)


def test_absurd_steps_are_refused_before_there_is_room_for_them() -> None:
    log = straight_road(steps=91, dt=0.1)
    for dt in (1e-9, 0.004, 6.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="dt must be"):
            resample(log, dt)
    with pytest.raises(ConfigError, match="sigma"):
        smooth(log, 1e9)
    with pytest.raises(DataError, match="steps"):
        resample(straight_road(3, steps=900, dt=1.0), 0.03)


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


@settings(max_examples=30)
@given(st.integers(2, 80), st.integers(1, 9))
def test_lost_frames_are_filled_in_between(first: int, count: int) -> None:
    kept = np.delete(np.arange(91), np.arange(first, min(first + count, 90)))
    found = evened(seen_at(TENTH[kept]), TENTH[kept])
    assert (time_step(TENTH[kept], "times"), found.num_steps) == (0.1, 91)
    assert [time_step(kept / rate, "times") * rate for rate in (15, 29.97, 30)] == pytest.approx([1, 1, 1], rel=1e-9)
    assert found.odd == {LOST: f"{91 - len(kept)} of 91"}
    np.testing.assert_array_equal(found.position[:, kept], scene().position[:, kept])
    assert found.valid.all()
    np.testing.assert_allclose(found.position, scene().position, atol=0.3)  # m, of a car that accelerates
    validate(found)


def test_a_long_gap_stays_open() -> None:
    kept = np.delete(np.arange(91), np.arange(40, 55))
    lights = {"signal_lane": np.zeros(1, np.int32), "signal_point": np.zeros((1, 3), np.float32)}
    green = np.full((1, len(kept)), SignalState.GO, np.uint8)
    found = validate(evened(seen_at(TENTH[kept]).replace(**lights, signal_state=green), TENTH[kept]))
    np.testing.assert_array_equal(found.valid, np.broadcast_to(np.isin(np.arange(91), kept), (3, 91)))
    assert not np.append(found.signal_state[:, 40:55], found.position[:, 40:55]).any()


@settings(max_examples=30)
@given(st.integers(0, 2**16))
def test_uneven_times_are_brought_to_even_ones(seed: int) -> None:
    times = np.sort(np.random.default_rng(seed).uniform(-0.03, 0.03, 91) + TENTH)
    times = np.clip(times - times[0], 0, 9)
    early = int(np.abs(times - TENTH + 0.005).argmin())  # by less than a tenth of a step
    found, whole = evened(seen_at(times).replace(current_step=early), times), scene()
    assert (found.num_steps in {90, 91}, found.current_step) == (True, early)
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
    assert (found.time.tolist(), start) == (frames.tolist(), 5000)


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


class Lame(FakeReader):
    """One of its agents has no size where the line says so, and in the last line the ego comes late."""

    def _read(self, path: Path) -> Iterator[Item]:
        for number, item in enumerate(super()._read(path)):
            size = item.size.copy()
            size[-1, 0] = 0 if number in {1, 2} else size[-1, 0]
            yield hide(item, 0, slice(0, 2)) if number == 3 else replace(item, size=size)


@pytest.mark.parametrize("workers", [1, 2])
def test_it_is_counted_by_kind_with_an_example(workers: int, tmp_path: Path) -> None:
    (tmp_path / "a.scene").write_text("straight 1\nstraight 2\nstraight 3\nstraight 4")
    report = convert(Lame(), [tmp_path], tmp_path / "out", workers=workers)
    assert (report.converted, report.odd) == (4, {NO_SIZE: 2, LATE_EGO: 1})
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
