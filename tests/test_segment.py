"""The run segment schema: what it accepts, what it refuses and where it says the fault is."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers_segments import hide, random_segment, segments, straight_road
from symphony.data.odd import oddities
from symphony.data.segment import Polylines, RunSegment, content_hash, line_lengths, validate
from symphony.errors import DataError


def full() -> RunSegment:
    """No array is empty."""
    segment = random_segment(agents=4, steps=6, lanes=3, lights=2, marks=2)
    pairs = np.asarray([[0, 1]], np.int32)
    links = dict.fromkeys(("successors", "left_neighbors", "right_neighbors"), pairs)
    boundary = Polylines.of([np.zeros((2, 2)), np.ones((3, 3))])
    road = dataclasses.replace(segment.road, boundary=boundary, **links)
    some = np.asarray([1, 2], np.int32)
    return validate(segment.replace(road=road, interest=some, predict=some, file="log.bin"))


FULL = full()
ARRAYS = [f.name for f in dataclasses.fields(FULL) if isinstance(getattr(FULL, f.name), np.ndarray)]
ROAD = [f.name for f in dataclasses.fields(FULL.road) if isinstance(getattr(FULL.road, f.name), np.ndarray)]
PLACES = ARRAYS + [f"road.{name}" for name in ROAD]


def held(name: str, segment: RunSegment = FULL) -> Any:
    """A field of a segment, or ``road.`` and one of its map."""
    return getattr(segment.road if "." in name else segment, name.removeprefix("road."))


def changed(name: str, value: Any, segment: RunSegment = FULL) -> RunSegment:
    if "." not in name:
        return segment.replace(**{name: value})
    return segment.replace(road=dataclasses.replace(segment.road, **{name.removeprefix("road."): value}))


def put(array: NDArray[Any], value: Any) -> NDArray[Any]:
    """A copy whose last number is another."""
    copy = array.copy()
    copy.reshape(-1)[-1] = value
    return copy


def refused(segment: RunSegment) -> str | None:
    with pytest.raises(DataError) as caught:
        validate(segment)
    assert (caught.value.segment, caught.value.file) == (segment.segment_id, segment.file or None)
    return caught.value.field


@settings(max_examples=10, deadline=None)
@given(segments())
def test_made_segments_fit_and_equal_content_gives_equal_hashes(segment: RunSegment) -> None:
    assert validate(segment) is segment
    copy = segment.replace(position=np.asfortranarray(segment.position.copy()))
    assert content_hash(copy) == content_hash(segment)


@pytest.mark.parametrize("name", PLACES)
def test_every_array_has_one_dtype_and_shape(name: str) -> None:
    array = held(name)
    assert refused(changed(name, array.astype(np.float64 if name != "origin" else np.float32))) == name
    if name != "agent_id":
        assert refused(changed(name, array[None])) == name
    if name not in {"agent_id", "interest", "predict"} and "." not in name:
        # A field that others are measured by: the first of them to disagree is named.
        found = refused(changed(name, np.concatenate([array, array[-1:]])))
        assert found == (name if name != "signal_lane" else "signal_point")


@pytest.mark.parametrize("name", ["size", "position", "heading", "velocity", "signal_point", "origin"])
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_numbers_are_finite(name: str, value: float) -> None:
    assert refused(changed(name, put(held(name), value))) == name


@pytest.mark.parametrize("name", [n for n in PLACES if held(n).dtype in (np.uint8, np.int32)])
def test_indices_and_codes_stay_inside(name: str) -> None:
    for value in (99, -1) if held(name).dtype == np.int32 else (99,):
        assert refused(changed(name, put(held(name), value))) == name


@pytest.mark.parametrize("name", ["road.lanes", "road.boundary", "road.marks"])
def test_polylines_are_checked(name: str) -> None:
    points, offsets = held(name).points, held(name).offsets
    for wrong in (put(points, np.nan), points[:, :2], points.astype(np.float64)):
        assert refused(changed(name, Polylines(wrong, offsets))) == name
    for wrong in (
        offsets + 1, put(offsets, offsets[-1] - 1), put(offsets, offsets[-1] + 1), offsets.astype(np.int32),
        offsets[[0, 0, *range(1, len(offsets))]],  # a line of no points
        np.array([0, 2**63 - 1, -2, len(points)], np.int64),  # once around: all differences are positive
    ):  # fmt: skip
        assert refused(changed(name, Polylines(points, wrong))) == name


def moved(position: NDArray[Any], metres: float) -> NDArray[Any]:
    copy = position.copy()
    copy[1, 3:, 0] += np.float32(metres)
    return copy


def shifted(name: str, metres: float) -> RunSegment:
    lines = held(name)
    return changed(name, Polylines(lines.points + np.float32(metres), lines.offsets))


def across(times: int) -> RunSegment:
    """Return the same mark, from one end of the map to the other, again and again."""
    marks = Polylines.of([np.array([[-15_000, 0], [15_000, 0]])] * times)
    road = dataclasses.replace(FULL.road, marks=marks, mark_type=np.ones(times, np.uint8))
    return FULL.replace(road=road)


@pytest.mark.parametrize(("name", "value"), [
    *(("segment_id", text) for text in ("a/b", "", "a\x1b[31m")),
    *(("dt", dt) for dt in (0.0, float("nan"), -0.1, 0.001)), *(("ego", ego) for ego in (-1, 4)),
    *(("current_step", step) for step in (6, -1)), ("agent_id", np.zeros(4, np.int64)),
    *(("size", np.full((4, 3), side, np.float32)) for side in (0, 101, 1e-3)),
    ("position", np.full((4, 6, 3), 20_001, np.float32)), ("velocity", FULL.velocity + np.float32(3e38)),
    ("heading", FULL.heading + np.float32(2e3)), ("valid", np.ones(6, bool)), ("valid", np.ones((4, 10_001), bool)),
    ("origin", FULL.origin + 1e30), ("group", "\ud800"), ("file", "x" * 300), ("source", "\udc80"),
    ("road.speed_limit", np.full(3, 1e6, np.float32)),
])  # fmt: skip
def test_faults_are_named(name: str, value: Any) -> None:
    assert refused(changed(name, value)) == name


def test_faults_of_more_than_one_field_are_named() -> None:
    assert (refused(FULL.replace(valid=np.zeros((4, 6), bool))), refused(across(170))) == ("ego", "road")
    jumping = straight_road(3, steps=8)
    assert refused(jumping.replace(position=moved(jumping.position, 5000))) == "position"
    for name, metres in (("road.lanes", 1e30), ("road.boundary", 30_000), ("road.marks", 1e6)):
        assert refused(shifted(name, metres)) == name


@given(st.lists(st.integers(0, 4), max_size=5), st.sampled_from([2, 3]))
def test_polylines_hold_their_lines(counts: list[int], columns: int) -> None:
    rng = np.random.default_rng(0)
    given_lines = [rng.normal(size=(n, columns)).astype(np.float32) for n in counts if n]
    lines = Polylines.of(given_lines)
    assert len(lines) == len(given_lines)
    assert (lines.points.dtype, lines.points.shape[1], lines.offsets.dtype) == (np.float32, 3, np.int64)
    for k, line in enumerate(given_lines):
        assert np.array_equal(lines[k][:, :columns], line)
        assert np.array_equal(lines.points[lines.line_index == k], lines[k])
        assert not lines[k][:, columns:].any()
    for past in (len(lines), -1):
        with pytest.raises(IndexError):
            lines[past]
    expected = [np.hypot(*np.diff(line[:, :2].astype(float), axis=0).T).sum() for line in given_lines]
    np.testing.assert_allclose(line_lengths(lines), expected)  # the gaps between them are no length


@pytest.mark.parametrize("name", PLACES)
def test_any_number_changes_the_hash(name: str) -> None:
    array = held(name)
    other = ~array if array.dtype == bool else array + 1
    for value in (other, array.astype(">f8"), array.reshape(-1, 1, 1)):
        assert content_hash(changed(name, value)) != content_hash(FULL)


def test_odd_values_are_named() -> None:
    segment = straight_road(3, steps=8)
    away = segment.replace(position=segment.position + np.float32(2000))
    lanes = segment.road.lanes
    far = Polylines(lanes.points + np.float32(2000), lanes.offsets)
    near = away.replace(road=dataclasses.replace(segment.road, lanes=far))
    assert oddities(segment) == oddities(validate(hide(near, 1, slice(2, 4)))) == []
    fast = segment.replace(velocity=segment.velocity + np.float32(80))
    small = segment.replace(size=segment.size * np.float32(0.1))
    jumping = segment.replace(position=moved(segment.position, 100))
    slow = segment.replace(velocity=segment.velocity * np.float32(0.28))
    swapped = segment.replace(velocity=segment.velocity[..., ::-1].copy())
    kinds = (fast, "faster"), (small, "under 0.2 m"), (jumping, "jumps"), (slow, "velocities"), (away, "away")
    for odd, word in (*kinds, (swapped, "velocities")):
        assert word in oddities(validate(odd))[0]
