"""The included planners, by hand-made scenes: whom IDM follows, where it stops, and that the log is played back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import LineString, Point

from helpers_segments import CAR, LANE_WIDTH, crossing, hide, make_road, make_segment, ring, straight_road
from symphony.agents import load_agent
from symphony.config import EvaluateConfig
from symphony.data.segment import RunSegment, SignalState
from symphony.envs.scene import scene
from symphony.planners.driver import EgoPlanners
from symphony.planners.included import RouteLine
from symphony.planners.interface import planner_maker
from symphony.roadgraph import LaneGraph
from symphony.rollouts.driving import Simulation, simulation

LENGTH = CAR[0]
LIMIT = 14.0
"""Of hand-made roads, m/s."""


def driven(segment: RunSegment, planner: str = "idm") -> Simulation:
    """The ego by a planner, everyone else as logged."""
    scenes = scene(segment, [segment.ego], LaneGraph(segment.road))
    egos = EgoPlanners(planner, planner_maker(planner), [segment])
    return simulation(load_agent("playback"), scenes, EvaluateConfig(rollouts=1), egos=egos)


def states(segment: RunSegment, planner: str = "idm") -> Any:
    """[T + 1, 4] of the ego in a run that did not fail."""
    found = driven(segment, planner)
    assert found.failed == ({},)
    return found.rollouts.state[0, 0, :, 0].numpy()


def in_a_row(speeds: list[float], starts: list[float], steps: int = 131, lane: Any = 0) -> RunSegment:
    """Cars at constant speeds on a straight road of two lanes, by default all on the first one."""
    speed, start = np.asarray(speeds, float)[:, None], np.asarray(starts, float)[:, None]
    x = start + speed * 0.2 * np.arange(steps)
    y = np.broadcast_to(LANE_WIDTH * np.reshape(lane, (-1, 1)), x.shape)
    line = np.arange(0.0, 1000.0, 2.0)
    road = make_road([np.stack([line, np.full_like(line, k * LANE_WIDTH)], -1) for k in (0, 1)])
    velocity = np.stack([speed + 0 * x, 0 * x], -1)
    return make_segment(road, np.stack([x, y], -1), 0 * x, velocity)


@pytest.mark.parametrize("speed", [3.0, 14.0])
def test_idm_stops_behind_a_standing_car(speed: float) -> None:
    found = states(in_a_row([speed, 0], [20, 130]))
    gap = 130 - found[:, 0] - LENGTH
    assert gap.min() > 1.5
    assert gap[-1] < 3.0
    assert found[-1, 3] < 0.1
    assert np.diff(found[:, 3]).min() > -0.2 * 6
    np.testing.assert_allclose(found[:, 1:3], 0, atol=1e-4)


def test_idm_keeps_its_place_where_steps_are_long() -> None:
    """Steps of more metres than are looked at around the last place."""
    found = states(in_a_row([14, 0], [20, 180], steps=31).replace(dt=2.0))
    assert np.diff(found[:, 0]).max() > 20
    assert (180 - found[:, 0] - LENGTH).min() > 0
    assert found[-1, 3] < 0.5


def test_idm_follows_at_its_headway() -> None:
    """Where nothing changes any more, s = (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    leader = 8.0
    found = states(in_a_row([12, leader], [20, 60], steps=201))
    gap = 60 + leader * 40 - found[-1, 0] - LENGTH
    assert found[-1, 3] == pytest.approx(leader, abs=0.05)
    assert gap == pytest.approx((2 + 1.5 * leader) / np.sqrt(1 - (leader / LIMIT) ** 4), abs=0.3)


@pytest.mark.parametrize(("aside", "gap"), [(-0.4, 15.0), (0.4, 25.0), (0.0, 40.0)])
def test_idm_stops_behind_a_standing_car_where_its_route_comes_by_twice(gap: float, aside: float) -> None:
    segment = ring(gap, aside=aside)
    assert (scene(segment, [0], LaneGraph(segment.road)).route_count.max() * 3 > 2 * np.pi * 15).item()
    found = states(segment)
    turned = np.arctan2(found[:, 0], -found[:, 1])
    ahead = (0.2 + gap / 15 - turned) * 15.0
    assert ahead.min() > LENGTH + 1.0
    assert ahead[-1] < LENGTH + 5.0
    assert found[-1, 3] < 0.5


def test_a_car_in_the_next_lane_or_behind_is_nobody_to_follow() -> None:
    alone = states(in_a_row([10], [60], steps=91))
    assert alone[-1, 3] == pytest.approx(LIMIT, abs=0.2)
    assert alone[:, 3].max() <= LIMIT + 1e-3
    others = states(in_a_row([10, 0, 0], [60, 100, 30], lane=(0, 1, 0), steps=91))
    np.testing.assert_allclose(alone, others, atol=1e-5)


def test_idm_keeps_its_lane_in_turns() -> None:
    segment = crossing(1, steps=91, seed=1).replace(
        signal_lane=np.zeros(0, np.int32),
        signal_point=np.zeros((0, 3), np.float32),
        signal_state=np.zeros((0, 91), np.uint8),
    )
    found = states(segment)
    logged = LineString(segment.position[0, :, :2])
    inside = [xy for xy in found[:, :2] if logged.project(Point(xy)) < logged.length - 0.1]
    assert len(inside) > 45
    assert max(logged.distance(Point(xy)) for xy in inside) < 0.5
    turned = np.diff(np.unwrap(found[:, 2])) / 0.2
    assert np.abs(turned * found[1:, 3]).max() < 4.0


def at_a_light(mine: SignalState, others: SignalState) -> RunSegment:
    """A car 12 m before a crossing, its own light in one state, those of the same approach's turns in another."""
    segment = crossing(2, steps=61, seed=0).replace(ego=1)
    path = LineString(segment.position[1, :, :2])
    state = np.full_like(segment.signal_state, others)
    leads = [path.distance(Point(segment.road.lanes[int(lane)][6, :2])) < 0.3 for lane in segment.signal_lane]
    assert sum(leads) == 1
    state[leads] = mine
    return segment.replace(signal_state=state)


def test_idm_stops_at_its_own_red_light_alone() -> None:
    red, free = at_a_light(SignalState.STOP, SignalState.GO), at_a_light(SignalState.GO, SignalState.STOP)
    path = states(red)
    stop = np.linalg.norm(red.signal_point[:, :2] - path[-1, :2], axis=-1).min()
    assert path[-1, 3] < 0.1
    assert 0.5 * LENGTH < stop < 0.5 * LENGTH + 4
    assert states(free)[-1, 3] > 3


def test_off_the_lanes_the_run_fails() -> None:
    segment = in_a_row([10], [20])
    found = driven(segment.replace(position=segment.position + np.float32([0, 200, 0])))
    assert "on no lane" in found.failed[0][0]
    assert not found.rollouts.counted.any()


@pytest.mark.parametrize("segment", [straight_road(3), crossing(4, seed=2)], ids=["straight", "crossing"])
def test_log_playback_reproduces_the_log(segment: RunSegment) -> None:
    found = states(segment, "log")
    np.testing.assert_allclose(found[:, :2], segment.position[0, :, :2], atol=1e-4)
    np.testing.assert_allclose(found[:, 2], segment.heading[0], atol=1e-4)
    speed = np.hypot(*segment.velocity[0].T)
    np.testing.assert_allclose(found[:, 3], speed, atol=1e-4)


def test_holes_of_the_log_are_filled_and_its_end_is_told() -> None:
    whole = straight_road(3, steps=21)
    found = driven(hide(hide(whole, 0, slice(8, 10)), 0, slice(16, 21)), "log")
    assert "step 15: ValueError: the log of the ego ends at step 15" in found.failed[0][0]
    assert found.rollouts.counted[0, 0].all(-1).tolist() == [True] * 15 + [False] * 5
    path = found.rollouts.state[0, 0, :16, 0].numpy()
    np.testing.assert_allclose(path[:, :2], whole.position[0, :16, :2], atol=0.1)
    np.testing.assert_allclose(path[[7, 10], :2], whole.position[0, [7, 10], :2], atol=1e-4)


@given(
    st.lists(st.tuples(st.floats(2, 20), st.floats(-0.8, 0.8)), min_size=1, max_size=6),
    st.floats(-10, 60),
    st.floats(-1.5, 1.5),
)
def test_a_place_beside_a_route_is_found_again(
    pieces: list[tuple[float, float]], station: float, side: float
) -> None:
    """The distance to the left of a place beside the line is what shapely measures."""
    steps, turns = np.array(pieces).T
    heading = np.cumsum(turns)
    points = np.concatenate(
        [np.zeros((1, 2)), np.cumsum(steps[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1), 0)]
    )
    route = RouteLine(points)
    here = route.at(station)
    assert route.project(here[None])[1][0] == pytest.approx(0, abs=1e-6)
    _, _, direction = route.project(here[None])
    place = here + side * np.array([-direction[0, 1], direction[0, 0]])
    aside = route.project(place[None])[1][0]
    assert abs(aside) == pytest.approx(LineString(route.points).distance(Point(place)), abs=1e-6)
    assert aside == pytest.approx(0, abs=1e-6) or np.sign(aside) == np.sign(side)
