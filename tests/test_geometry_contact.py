"""When moving boxes meet, against many small steps of shapely, and by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from symphony.geometry import box_corners, contact_share, meeting_time, pose_at
from symphony.metrics import collisions

CAR = torch.tensor([4.0, 2.0], dtype=torch.float64)
FINE = 2000


def pose(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def share_of(one: tuple[Tensor, Tensor, Tensor], two: tuple[Tensor, Tensor, Tensor]) -> float:
    """Of boxes with two poses [2, 3] each, and their sizes."""
    parts = [part for poses, size in (one, two) for part in (poses[:, :2], poses[:, 2], size)]
    return float(contact_share(*parts))


def moved(first: tuple[float, ...], last: tuple[float, ...], size: Tensor = CAR) -> tuple[Tensor, Tensor]:
    return torch.stack([pose(*first), pose(*last)]), size


@pytest.mark.parametrize(
    ("one", "two", "expected"),
    [
        # Fronts 12 m apart, closing by 24 m in the step.
        (moved((0, 0, 0), (12, 0, 0)), moved((16, 0.5, math.pi), (4, 0.5, math.pi)), 0.5),
        # A pedestrian of half a metre, passed over whole: from 2 + 0.25 m before to as much behind.
        (moved((0, 0, 0), (9, 0, 0)), moved((4.5, 0, 0), (4.5, 0, 0), pose(0.5, 0.5)), 0.25),
        # Flanks touch and slide.
        (moved((0, 0, 0), (12, 0, 0)), moved((12, 2, 0), (0, 2, 0)), math.inf),
        (moved((0, 0, 0), (12, 0, 0)), moved((12, 1.99, 0), (0, 1.99, 0)), 8 / 24),
        # Overlapping before and after, only before, only after.
        (moved((0, 0, 0), (1, 0, 0)), moved((2, 0, 0), (3, 0, 0)), 0.0),
        (moved((0, 0, 0), (1, 0, 0)), moved((2, 0, 0), (9, 0, 0)), math.inf),
        (moved((0, 0, 0), (0, 0, 0)), moved((6, 0, 0), (3, 0, 0)), 2 / 3),
        # One that turns by half a turn is where it was, and meets nobody beside it.
        (moved((0, 0, 0), (0, 0, math.pi)), moved((0, 2.5, 0), (0, 2.5, 0)), math.inf),
        # A quarter turn brings the corner of a long box to the other.
        (moved((0, 0, 0), (0, 0, math.pi / 2)), moved((0, 2.05, 0), (0, 2.05, 0), pose(0.1, 0.1)), None),
    ],
)
def test_contacts_by_hand(
    one: tuple[Tensor, Tensor], two: tuple[Tensor, Tensor], expected: float | None
) -> None:
    found = share_of(one, two)
    if expected is None:
        # The front bumper's nearest corner, at 26.6 degrees and 2.236 m, comes within 0.05 m of x = 0 at y = 2.
        assert 0.5 < found < 0.7
    else:
        assert found == pytest.approx(expected, abs=1e-12)
    assert share_of(two, one) == pytest.approx(found, abs=1e-12)


numbers = st.floats(-6, 6)
poses = st.tuples(numbers, numbers, st.floats(-4, 4))
sizes = st.tuples(st.floats(0.4, 6), st.floats(0.4, 3))


@settings(max_examples=60)
@given(poses, poses, poses, poses, sizes, sizes, st.floats(0, 0.4))
def test_a_contact_is_where_many_small_steps_find_one(
    a: tuple[float, ...],
    b: tuple[float, ...],
    c: tuple[float, ...],
    d: tuple[float, ...],
    size_one: tuple[float, float],
    size_two: tuple[float, float],
    turn: float,
) -> None:
    one = moved(a, (b[0], b[1], a[2] + turn), pose(*size_one))
    two = moved(c, (d[0], d[1], c[2] - turn), pose(*size_two))
    found = share_of(one, two)
    times = np.linspace(0, 1, FINE + 1)
    shapes = []
    for ends, size in (one, two):
        centers, headings = pose_at(
            ends[None, :, :2].expand(FINE + 1, 2, 2),
            ends[None, :, 2].expand(FINE + 1, 2),
            torch.from_numpy(times),
        )
        shapes.append(shapely.polygons(box_corners(centers, headings, size.expand(FINE + 1, 2)).numpy()))
    apart = shapely.distance(*shapes)
    deep = shapely.area(shapely.intersection(*shapes)) > 1e-9
    if deep[0]:
        # In contact from the beginning, or parting.
        assert found == (0 if deep[-1] else math.inf)
        return
    # Turning boxes are found within a centimetre, which a step here may be, too.
    speed = sum(float((ends[1, :2] - ends[0, :2]).norm()) + 4 * turn for ends, _ in (one, two))
    slack = 0.01 + speed / FINE
    if found < math.inf:
        k = int(found * FINE)
        assert apart[max(k - 1, 0) : k + 3].min() <= slack
        assert (
            apart[: max(k - 1, 0)].min(initial=math.inf) > 0
            or not deep[: max(k - 1, 0)].any()
            or (shapely.area(shapely.intersection(*shapes))[: max(k - 1, 0)].max() < 6 * slack)
        )
    elif deep.any():
        # What is missed is a graze.
        assert shapely.area(shapely.intersection(*shapes)).max() < 6 * slack


@settings(max_examples=40)
@given(poses, poses, sizes, sizes, st.tuples(numbers, numbers))
def test_boxes_that_do_not_turn_meet_when_they_would(
    a: tuple[float, ...],
    b: tuple[float, ...],
    size_one: tuple[float, float],
    size_two: tuple[float, float],
    speed: tuple[float, float],
) -> None:
    """The time to a meeting, if it is less than one step, is the share of that step."""
    one, two = (
        moved(a, a, pose(*size_one)),
        moved(b, (b[0] + speed[0], b[1] + speed[1], b[2]), pose(*size_two)),
    )
    way, gain = pose(*b[:2]) - pose(*a[:2]), pose(*speed)
    time = float(meeting_time(way, gain, pose(a[2])[0], one[1], pose(b[2])[0], two[1]))
    found = share_of(one, two)
    if 0 < time < 1 - 1e-9:
        assert found == pytest.approx(time, abs=1e-9)
    elif time > 1 + 1e-9:
        assert found == math.inf


def test_who_appears_is_met_where_it_appears() -> None:
    """An agent that was elsewhere before it was seen does not sweep over the scene."""
    position = torch.zeros(1, 2, 3, 2)
    position[0, 1, :, 0] = torch.tensor([-50.0, 50.0, 4.2])
    valid = torch.tensor([[[True, True, True], [False, True, True]]])
    size = torch.tensor([[[4.0, 2.0]]]).expand(1, 2, 2)
    found = collisions(position, torch.zeros(1, 2, 3), size, valid, torch.tensor([[0]]))
    assert found.tolist() == [[[False, False]]]
    position[0, 1, 2, 0] = 3.9
    found = collisions(position, torch.zeros(1, 2, 3), size, valid, torch.tensor([[0]]))
    assert found.tolist() == [[[False, True]]]


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_between_states_nothing_is_lost_that_states_show(seed: int) -> None:
    rng = np.random.default_rng(seed)
    position = torch.tensor(rng.uniform(0, 30, (2, 6, 1, 2)) + rng.normal(0, 2, (2, 6, 5, 2)))
    heading = torch.tensor(rng.uniform(-7, 7, (2, 6, 5)))
    size, valid = torch.tensor(rng.uniform(0.4, 5, (2, 6, 2))), torch.tensor(rng.random((2, 6, 5)) < 0.8)
    subject = torch.tensor([[0, 1, 2], [3, 4, -1]])
    at_states = collisions(position, heading, size, valid, subject, at_states=True)
    between = collisions(position, heading, size, valid, subject)
    assert (between | ~at_states[..., 1:]).all()
