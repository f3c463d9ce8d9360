"""Vehicles that stand and people who walk in whole traffic."""

from __future__ import annotations

import numpy as np
import pytest

from helpers_segments import crossing, straight_road
from symphony.data.segment import AgentType, RunSegment, SignalState
from symphony.wosac.bystanders import AHEAD, COURSE, PACE, standing, walks
from symphony.wosac.segments import wosac_window


def halted(segment: RunSegment) -> RunSegment:
    """The same with everyone where they are at the current step."""
    now = segment.current_step
    return segment.replace(
        position=np.repeat(segment.position[:, now, None], segment.num_steps, 1),
        heading=np.repeat(segment.heading[:, now, None], segment.num_steps, 1),
        velocity=np.zeros_like(segment.velocity),
    )


@pytest.mark.parametrize(("away", "aside", "state", "stays"), [
    (20.0, 0.0, SignalState.STOP, True),
    (20.0, 0.0, SignalState.GO, False),
    (20.0, 0.0, SignalState.ARROW_GO, False),
    (20.0, 0.0, SignalState.UNKNOWN, True),
    (20.0, 5.0, SignalState.GO, True),  # Another lane's.
    (-5.0, 0.0, SignalState.GO, True),
    (AHEAD + 1, 0.0, SignalState.GO, True),
])  # fmt: skip
def test_who_stands_goes_on_green(away: float, aside: float, state: SignalState, stays: bool) -> None:
    """The first agent sees a light so many metres ahead and to its left."""
    window = wosac_window(crossing(num_agents=3))
    now, angle, point = window.current_step, window.heading[0, 10], np.full_like(window.signal_point, 1e4)
    cos, sin = np.cos(angle), np.sin(angle)
    point[0, :2] = window.position[0, now, :2] + [away * cos - aside * sin, away * sin + aside * cos]
    window = window.replace(signal_point=point, signal_state=np.full_like(window.signal_state, state))
    assert not standing(window).any()
    assert standing(halted(window))[0] == stays
    # What comes later is not known.
    later = halted(window)
    later.position[:, 11:] += 9
    assert standing(later)[0] == stays


def test_only_vehicles_that_have_stood_for_a_second_stand() -> None:
    window = halted(wosac_window(straight_road(num_agents=4)))
    kinds, position, valid = window.agent_type.copy(), window.position.copy(), window.valid.copy()
    kinds[1] = AgentType.PEDESTRIAN
    position[2, :3, 0] -= 1.0  # It has just come to a stand.
    valid[3, :10] = False  # Nobody knows what it did before.
    found = standing(window.replace(agent_type=kinds, position=position, valid=valid))
    assert found.tolist() == [True, False, False, True]


def test_people_keep_their_velocity_but_for_pace_and_course_and_turn_as_they_did() -> None:
    window = wosac_window(straight_road(num_agents=3))
    rows, now, heading = np.array([0, 2]), window.current_step, window.heading.copy()
    found = walks(window, rows, 32, 80, 0)
    assert found.shape == (32, 2, 80, 3)
    start = np.broadcast_to(window.position[rows, now, None, :2], (32, 2, 1, 2))
    steps = np.diff(np.concatenate([start, found[..., :2]], 2), axis=2)
    np.testing.assert_allclose(steps, steps[:, :, :1].repeat(80, 2), atol=1e-5)  # Straight, at one speed.
    velocity, logged = steps[:, :, 0] / window.dt, window.velocity[rows, now]
    pace = np.linalg.norm(velocity, axis=-1) / np.linalg.norm(logged, axis=-1)
    assert 1 - PACE <= pace.min() < 1 < pace.max() <= 1 + PACE
    course = np.arctan2(velocity[..., 1], velocity[..., 0]) - np.arctan2(logged[:, 1], logged[:, 0])
    assert -COURSE - 1e-6 <= course.min() < 0 < course.max() <= COURSE + 1e-6
    assert len(np.unique(found[:, :, -1, 0])) == 64
    # One agent's way depends on nobody else's; another seed gives another.
    np.testing.assert_array_equal(walks(window, rows[1:], 32, 80, 0), found[:, 1:])
    assert not np.array_equal(walks(window, rows, 32, 80, 1), found)
    heading[0, now - 10 : now + 1] += 0.1 * (np.arange(11) % 2)
    turned = walks(window.replace(heading=heading), rows[:1], 4, 80, 0)[..., 2]
    np.testing.assert_allclose(np.abs(np.diff(turned, axis=-1)), 0.1, atol=1e-5)
    assert len(np.unique(turned[:, 0, -1])) == 4
