"""The run segment schema: what it accepts, what it refuses and where it says the fault is."""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers_segments import random_segment, segments, straight_road
from symphony.data.odd import oddities
from symphony.data.segment import Polylines, RunSegment, content_hash, line_lengths, validate
from symphony.errors import DataError

ARRAYS = [
    name
    for name in (f.name for f in dataclasses.fields(RunSegment))
    if isinstance(getattr(random_segment(), name), np.ndarray)
]
ROAD_ARRAYS = [
    f.name
    for f in dataclasses.fields(random_segment().road)
    if isinstance(getattr(random_segment().road, f.name), np.ndarray)
]


def full() -> RunSegment:
    """No array is empty."""
    segment = random_segment(agents=4, steps=6, lanes=3, lights=2, marks=2)
    pairs = np.asarray([[0, 1]], np.int32)
    road = dataclasses.replace(
        segment.road,
        successors=pairs,
        left_neighbors=pairs,
        right_neighbors=pairs,
        boundary=Polylines.of([np.zeros((2, 2)), np.ones((3, 3))]),
    )
    some = np.asarray([1, 2], np.int32)
    return validate(segment.replace(road=road, interest=some, predict=some, file="log.bin"))


def put(array: NDArray[Any], value: Any) -> NDArray[Any]:
    """A copy whose last number is another."""
    copy = array.copy()
    copy.reshape(-1)[-1] = value
    return copy


def change_road(segment: RunSegment, **changes: Any) -> RunSegment:
    return segment.replace(road=dataclasses.replace(segment.road, **changes))


def refused(segment: RunSegment) -> DataError:
    with pytest.raises(DataError) as caught:
        validate(segment)
    assert caught.value.segment == segment.segment_id
    assert caught.value.file == segment.file
    return caught.value


@settings(max_examples=50, deadline=None)
@given(segments())
def test_made_segments_fit(segment: RunSegment) -> None:
    assert validate(segment) is segment


@pytest.mark.parametrize("name", [n for n in ARRAYS if n not in {"origin", "agent_id"}])
def test_every_array_has_one_dtype_and_shape(name: str) -> None:
    segment = full()
    array = getattr(segment, name)
    assert refused(segment.replace(**{name: array.astype(np.float64)})).field == name
    if name not in {"interest", "predict"}:
        longer = np.concatenate([array, array[-1:]])
        found = refused(segment.replace(**{name: longer})).field
        # A field that others are measured by: the first of them to disagree is named.
        assert found == (name if name != "signal_lane" else "signal_point")
    assert refused(segment.replace(**{name: array[None]})).field == name


@pytest.mark.parametrize("name", [n for n in ROAD_ARRAYS if n != "lane_id"])
def test_every_road_array_has_one_dtype_and_shape(name: str) -> None:
    segment = full()
    array = getattr(segment.road, name)
    assert refused(change_road(segment, **{name: array.astype(np.float64)})).field == f"road.{name}"
    assert refused(change_road(segment, **{name: array[None]})).field == f"road.{name}"


@pytest.mark.parametrize("name", ["size", "position", "heading", "velocity", "signal_point", "origin"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_are_finite(name: str, value: float) -> None:
    segment = full()
    assert refused(segment.replace(**{name: put(getattr(segment, name), value)})).field == name


@pytest.mark.parametrize("name", ["lanes", "boundary", "marks"])
def test_polylines_are_checked(name: str) -> None:
    segment = full()
    lines = getattr(segment.road, name)

    def fault(points: NDArray[Any], offsets: NDArray[Any]) -> None:
        assert refused(change_road(segment, **{name: Polylines(points, offsets)})).field == f"road.{name}"

    fault(put(lines.points, np.nan), lines.offsets)
    fault(lines.points, lines.offsets + 1)
    fault(lines.points, put(lines.offsets, lines.offsets[-1] - 1))
    fault(lines.points, put(lines.offsets, lines.offsets[-1] + 1))
    fault(lines.points[:, :2], lines.offsets)
    fault(lines.points.astype(np.float64), lines.offsets)
    fault(lines.points, np.sort(lines.offsets)[[0, 0, *range(1, len(lines.offsets))]])  # a line of no points


@pytest.mark.parametrize("value", [-1, 99])
@pytest.mark.parametrize("name", ["signal_lane", "interest", "predict", "agent_type", "signal_state"])
def test_indices_and_codes_stay_inside(name: str, value: int) -> None:
    segment = full()
    array = getattr(segment, name)
    if array.dtype == np.uint8:
        value = 99
    assert refused(segment.replace(**{name: put(array, value)})).field == name


@pytest.mark.parametrize(
    "name", ["successors", "left_neighbors", "right_neighbors", "lane_type", "mark_type"]
)
def test_road_indices_and_codes_stay_inside(name: str) -> None:
    segment = full()
    changed = put(getattr(segment.road, name), 99)
    assert refused(change_road(segment, **{name: changed})).field == f"road.{name}"


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"segment_id": "a/b"}, "segment_id"),
        ({"segment_id": ""}, "segment_id"),
        ({"dt": 0.0}, "dt"),
        ({"dt": float("nan")}, "dt"),
        ({"dt": -0.1}, "dt"),
        ({"ego": -1}, "ego"),
        ({"ego": 4}, "ego"),
        ({"current_step": 6}, "current_step"),
        ({"current_step": -1}, "current_step"),
        ({"agent_id": np.zeros(4, np.int64)}, "agent_id"),
        ({"size": np.zeros((4, 3), np.float32)}, "size"),
        ({"size": np.full((4, 3), 100, np.float32)}, "size"),
        ({"position": np.full((4, 6, 3), 20_001, np.float32)}, "position"),
        ({"valid": np.zeros((4, 6), bool)}, "ego"),
        ({"valid": np.ones(6, bool)}, "valid"),
        ({"origin": np.zeros(2)}, "origin"),
    ],
)
def test_faults_are_named(changes: dict[str, Any], field: str) -> None:
    assert refused(full().replace(**changes)).field == field


# --- polylines ---------------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 4), max_size=5), st.sampled_from([2, 3]))
def test_polylines_hold_their_lines(counts: list[int], columns: int) -> None:
    rng = np.random.default_rng(0)
    given_lines = [rng.normal(size=(n, columns)).astype(np.float32) for n in counts if n]
    lines = Polylines.of(given_lines)
    assert len(lines) == len(given_lines)
    assert lines.points.dtype == np.float32
    assert lines.points.shape[1] == 3
    assert lines.offsets.dtype == np.int64
    for k, line in enumerate(given_lines):
        assert np.array_equal(lines[k][:, :columns], line)
        assert np.array_equal(lines.points[lines.line_index == k], lines[k])
        assert not lines[k][:, columns:].any()
    for past in (len(lines), -1):
        with pytest.raises(IndexError):
            lines[past]


# --- content hash ------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(segments())
def test_equal_content_gives_equal_hashes(segment: RunSegment) -> None:
    copy = segment.replace(
        position=np.asfortranarray(segment.position.copy()), heading=segment.heading.copy()
    )
    assert content_hash(copy) == content_hash(segment)
    assert len(content_hash(segment)) == hashlib.sha256().digest_size * 2


@pytest.mark.parametrize("name", ARRAYS)
def test_any_number_changes_the_hash(name: str) -> None:
    segment = full()
    array = getattr(segment, name)
    changed = ~array if array.dtype == bool else array + 1
    assert content_hash(segment.replace(**{name: changed})) != content_hash(segment)
    if array.dtype != bool:
        assert content_hash(segment.replace(**{name: array.astype(">f8")})) != content_hash(segment)
    assert content_hash(segment.replace(**{name: array.reshape(-1, 1)})) != content_hash(segment)


# --- the scenes other tests use ----------------------------------------------------------------------------


ABSURD = {
    "dt": lambda s: s.replace(dt=0.001),
    "size": lambda s: s.replace(size=s.size * np.float32(1e-6)),
    "velocity": lambda s: s.replace(velocity=s.velocity + np.float32(3e38)),
    "heading": lambda s: s.replace(heading=s.heading + np.float32(2e3)),
    "position": lambda s: s.replace(position=_moved(s.position, 5000)),
    "origin": lambda s: s.replace(origin=s.origin + 1e30),
    "valid": lambda s: s.replace(valid=np.ones((s.num_agents, 10_001), bool)),
    "segment_id": lambda s: s.replace(segment_id="a\x1b[31m"),
    "group": lambda s: s.replace(group="\ud800"),
    "file": lambda s: s.replace(file="x" * 300),
    "source": lambda s: s.replace(source="\udc80"),
    "road.lanes": lambda s: _road(s, "lanes", 1e30),
    "road.boundary": lambda s: _road(s, "boundary", 30_000),
    "road.marks": lambda s: _road(s, "marks", 1e6),
    "road": lambda s: _many(s.replace(segment_id="many")),
    "road.speed_limit": lambda s: s.replace(
        road=dataclasses.replace(s.road, speed_limit=s.road.speed_limit * np.float32(1e6))
    ),
}


def _moved(position: NDArray[Any], metres: float) -> NDArray[Any]:
    moved = position.copy()
    moved[1, 3:, 0] += metres
    return moved


def _many(segment: RunSegment) -> RunSegment:
    """The same mark, from one end of the map to the other, again and again."""
    line = np.array([[-15_000, 0], [15_000, 0]])
    marks = Polylines.of([line] * 170)
    road = dataclasses.replace(segment.road, marks=marks, mark_type=np.ones(170, np.uint8))
    return segment.replace(road=road)


def _road(segment: RunSegment, name: str, metres: float) -> RunSegment:
    lines = getattr(segment.road, name)
    far = dataclasses.replace(lines, points=lines.points + np.float32(metres))
    return segment.replace(road=dataclasses.replace(segment.road, **{name: far}))


@pytest.mark.parametrize("field", ABSURD)
def test_absurd_values_are_refused(field: str) -> None:
    segment = validate(straight_road(3, steps=8))
    with pytest.raises(DataError) as caught:
        validate(ABSURD[field](segment))
    assert caught.value.field == field


@pytest.mark.parametrize("name", ["lanes", "boundary", "marks"])
def test_offsets_whose_differences_overflow_are_refused(name: str) -> None:
    segment = validate(random_segment(seed=3, lanes=3, marks=3))
    lines = getattr(segment.road, name)
    # Once around: all differences are positive.
    offsets = np.array([0, 2**63 - 1, -2, len(lines.points)], np.int64)
    assert (np.diff(offsets) >= 0).all()
    damaged = dataclasses.replace(segment.road, **{name: Polylines(lines.points, offsets)})
    with pytest.raises(DataError, match="offsets") as caught:
        validate(segment.replace(road=damaged))
    assert caught.value.field == f"road.{name}"


def test_odd_values_are_named() -> None:
    segment = straight_road(3, steps=8)
    assert oddities(segment) == []
    fast = segment.replace(velocity=segment.velocity + np.float32(80))
    small = segment.replace(size=segment.size * np.float32(0.1))
    jumping = segment.replace(position=_moved(segment.position, 100))
    for odd, word in ((fast, "faster"), (small, "under 0.2 m"), (jumping, "jumps")):
        (found,) = oddities(validate(odd))
        assert word in found


def test_gaps_between_lines_are_no_length() -> None:
    segment = random_segment(seed=3, lanes=3, marks=3)
    for lines in (segment.road.lanes, segment.road.boundary, segment.road.marks, Polylines.of([])):
        expected = sum(np.hypot(*np.diff(line[:, :2].astype(float), axis=0).T).sum() for line in lines)
        assert line_lengths(lines).sum() == pytest.approx(expected)
