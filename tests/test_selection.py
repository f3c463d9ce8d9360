"""Who is interactive and what two vehicles are to each other, on hand-made paths; which segments are left out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from helpers_segments import along, crossing, hide, make_road, make_segment, straight_road, turned
from symphony.data import selection as contexts
from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import Context, exclusion, interactive_agents, interactive_choice, relations
from symphony.errors import DataError

STEPS, DT = 51, 0.2
TIME = np.arange(STEPS) * DT
Paths = list[tuple[Any, Any]]

ARC = np.linspace(0, np.pi / 2, 20)
NORTH = np.asarray([[0.0, -200], [0, 200]])
EAST = np.asarray([[-200.0, 0], [200, 0]])
BESIDE = NORTH + np.asarray([3.5, 0])
"""The next lane to the right of NORTH."""
ONCOMING = NORTH[::-1] + np.asarray([-3.5, 0])
TURN_IN = np.asarray([(-100, 10), *zip(-10 + 10 * np.sin(ARC), 20 - 10 * np.cos(ARC), strict=True), (0, 200)])
"""From the west into NORTH, which it reaches at y = 20, 100.7 m on."""
OFF = zip(10 * np.cos(ARC) - 10, 10 * np.sin(ARC) - 20, strict=True)
TURN_OFF = np.asarray([(0, -200), *OFF, (-200, -10)])
PULL_OUT = np.asarray([*zip(4 * np.sin(ARC[7:]) - 4, -4 * np.cos(ARC[7:]), strict=True), (0, 200)])
CREEP = np.minimum(0.5 * TIME, 4)
CHANGE_LANE = np.asarray([[3.5, -200], [3.5, -30], [0, 0], [0, 200]])


def scene(paths: Paths, **changes: Any) -> RunSegment:
    """Vehicles on polylines; (polyline, metres from its start at each step), the ego first."""
    placed = [along(np.asarray(path, float), np.broadcast_to(driven, STEPS)) for path, driven in paths]
    position = np.stack([each[0] for each in placed])
    heading = np.stack([each[1] for each in placed])
    velocity = np.gradient(position, DT, axis=1)
    return make_segment(make_road([NORTH]), position, heading, velocity, DT, **changes)


def north(y: float, speed: float = 8.0) -> Any:
    """Metres driven on NORTH and what is parallel to it, from y."""
    return 200 + y + speed * TIME


BY_CONTEXT: dict[Context, dict[str, Paths]] = {
    # Each has the partner second; what follows is nearer, at first, and has less to do with the ego.
    Context.MERGE: {
        "turns in before": [(NORTH, north(-30)), (TURN_IN, 66.7 + 8 * TIME), (BESIDE, north(-28))],
        "turns in after": [(NORTH, north(-10)), (TURN_IN, 50.7 + 8 * TIME), (NORTH, north(-25))],
        "changes lane": [(NORTH, north(-60, 10)), (CHANGE_LANE, north(-42, 10)), (NORTH, north(-75, 10))],
        "pulls out": [(NORTH, north(-30)), (PULL_OUT, 8 * TIME), (BESIDE, north(-28))],
        "ego changes": [(CHANGE_LANE, north(-42, 10)), (NORTH, north(-60, 10)), (BESIDE, north(-57, 10))],
    },
    Context.CROSSING: {
        "crosses": [(NORTH, north(-40)), (EAST, north(-60)), (NORTH, north(-55)), (ONCOMING, north(20))],
        "from a stop": [(NORTH, north(-20)), (EAST, 191 + np.maximum(TIME - 3, 0) ** 2), (NORTH, north(-35))],
    },
    Context.LEADER: {
        "leads": [(NORTH, north(-60)), (NORTH, north(-44)), (BESIDE, north(-58))],
        "leads and turns off": [(NORTH, north(-60)), (TURN_OFF, north(-44, 6)), (BESIDE, north(-58))],
        "leads around a corner": [(TURN_OFF, north(-45)), (TURN_OFF, north(-25)), (BESIDE, north(-43))],
        "comes near": [(NORTH, north(-60, 10)), (NORTH, north(4.4, 6)), (BESIDE, north(-58))],
        "queue": [(NORTH, 180 + CREEP), (NORTH, 188 + 0.75 * CREEP), (BESIDE, north(-19, 0.5))],
    },
    Context.FOLLOWER: {
        "follows": [(NORTH, north(-40)), (NORTH, north(-56)), (BESIDE, north(-42))],
        "follows closer than it leads": [(NORTH, north(-40)), (NORTH, north(-52)), (NORTH, north(-20))],
    },
    Context.NEAREST: {
        "next lane": [(NORTH, north(-40)), (BESIDE, north(-30)), (NORTH, north(40))],
        "head on": [(NORTH, north(-40)), (NORTH[::-1], north(0))],
        "oncoming": [(NORTH, north(-40)), (ONCOMING, north(0))],
        "crosses long before": [(NORTH, north(-60)), (EAST, north(-8))],
        "comes near too late": [(NORTH, north(-60, 10)), (NORTH, north(7.6, 6))],
        "far ahead": [(NORTH, north(-60)), (NORTH, north(-20))],
    },
}
CASES = {name: (context, paths) for context, found in BY_CONTEXT.items() for name, paths in found.items()}


@pytest.mark.parametrize("case", CASES)
def test_the_context_is_what_happens(case: str) -> None:
    context, paths = CASES[case]
    choice = interactive_choice(scene(paths), 2)
    assert (choice.context, choice.agents.tolist()) == (context, [0, 1])


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from(sorted(CASES)), st.floats(-np.pi, np.pi),
    st.tuples(*[st.floats(-500, 500)] * 2), st.randoms(use_true_random=False),
)  # fmt: skip
def test_frame_and_order_do_not_matter(case: str, angle: float, shift: Any, random: Any) -> None:
    context, paths = CASES[case]
    segment = scene(paths)
    order = random.sample(range(len(paths)), len(paths))
    moved = turned(segment, angle, shift)
    arrays = {name: getattr(moved, name)[order] for name in ("agent_id", "position", "heading", "velocity")}
    again = hide(moved.replace(ego=order.index(0), **arrays), order.index(0), 15)  # nor does a gap
    choice = interactive_choice(again, 2)
    assert choice.context == context
    assert again.agent_id[choice.agents].tolist() == segment.agent_id[:2].tolist()


@settings(max_examples=30, deadline=None)
@given(*[st.floats(3, 25)] * 2, st.floats(np.deg2rad(40), np.deg2rad(140)), st.booleans(), st.floats(-8, 8))
def test_crossing_is_a_matter_of_time(speed, other_speed, angle, right, gap):
    """Whatever the speeds and the angle, two that pass one place within the limit cross."""
    # The place is as wide as half a step and half a metre of either: at an acute angle a slow one needs time for it.
    mine = (speed * DT / 2 + 0.5) / np.sin(angle)
    theirs = mine * abs(np.cos(angle)) + other_speed * DT / 2 + 0.5
    assume(abs(abs(gap) - contexts.CONFLICT_GAP) > mine / speed + theirs / other_speed + DT)
    # Both pass the place within the window, the first of them after a second.
    arrival, other_arrival = 1 + max(0.0, -gap), 1 + max(0.0, gap)
    heading = np.pi / 2 + (-angle if right else angle)
    way = np.asarray([np.cos(heading), np.sin(heading)])
    path = np.stack([-400 * way, 400 * way])
    paths = [(2 * NORTH, 400 + speed * (TIME - arrival)), (path, 400 + other_speed * (TIME - other_arrival))]
    segment = scene(paths)
    expected = Context.CROSSING if abs(gap) <= contexts.CONFLICT_GAP else Context.NEAREST
    assert interactive_choice(segment, 2).context == expected
    found = relations(segment, np.asarray([1])).crossing[0]
    if expected == Context.CROSSING:
        assert found <= abs(gap) + DT


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([crossing, straight_road]))
def test_relations_are_mutual(seed: int, make: Any) -> None:
    """Leading is following seen from the other; crossing has no sides."""
    segment = make(num_agents=5, seed=seed)
    for other in range(1, 5):
        here = relations(segment, np.asarray([other]))
        there = relations(segment.replace(ego=other), np.asarray([0]))
        for one, two in (("leader", "follower"), ("follower", "leader"), ("crossing", "crossing")):
            assert np.isfinite(getattr(here, one)[0]) == np.isfinite(getattr(there, two)[0])


@pytest.mark.parametrize("height", [0.0, 8.0])
def test_who_is_on_a_bridge_is_no_partner(height: float) -> None:
    """The ego passes below one that crosses and below one that drives ahead; its leader is 20 m ahead of both."""
    east, lift = np.column_stack([EAST, np.zeros(2)]), np.array([0, 0, height])
    road = make_road([east, east[:, [1, 0, 2]] + lift, east + lift])
    position = np.zeros((4, STEPS, 3)) + np.array([0, 0, 0.75])
    for agent, start in ((0, -40), (2, -20), (3, -30)):
        position[agent, :, 0] += start + 10 * TIME
    position[1, :, 1] += 10 * TIME - 50
    position[[1, 3], :, 2] += height
    heading = np.zeros((4, STEPS))
    heading[1] = np.pi / 2
    way = 10 * np.stack([np.cos(heading), np.sin(heading)], -1)
    size = np.array([[4.5, 2.0, 1.5]] * 4, np.float32)
    found = interactive_choice(make_segment(road, position, heading, way, DT, size=size), 2)
    assert (found.agents[1], found.context) == ((2, Context.LEADER) if height else (1, Context.CROSSING))


def test_a_partner_that_is_seen_throughout_goes_first() -> None:
    context, paths = CASES["crosses"]
    segment = hide(scene(paths), 1, slice(STEPS - 1, STEPS))
    choice = interactive_choice(segment, 2)
    assert (choice.context, choice.agents.tolist()) == (Context.FOLLOWER, [0, 2])
    alone = hide(scene(paths[:2]), 1, slice(STEPS - 1, STEPS))
    assert interactive_choice(alone, 2).context == context


def abreast(distances: list[float], speeds: list[float], **changes: Any) -> RunSegment:
    """The ego at x = 0 and others at given distances, all going along +y; 6 steps of 1 s."""
    x = np.asarray([0.0, *distances])
    v = np.asarray([1.0, *speeds])
    time = np.arange(6.0)
    position = np.stack([np.broadcast_to(x[:, None], (len(x), 6)), v[:, None] * time], -1)
    velocity = np.stack([np.zeros((len(x), 6)), np.broadcast_to(v[:, None], (len(x), 6))], -1)
    road = make_road([np.asarray([[0.0, -5], [0, 50]])])
    return make_segment(road, position, np.full((len(x), 6), np.pi / 2), velocity, 1.0, **changes)


def ints(*values: int) -> np.ndarray:
    return np.asarray(values, np.int32)


def test_the_nearest_vehicles_that_move_and_are_seen_come_first() -> None:
    segment = hide(abreast([30, 5, 10, 20], [2, 0.3, 2, 2]), 2, 4)  # parked, and out of sight once
    for count, chosen in ((1, [0]), (2, [0, 3]), (4, [0, 3, 4, 1])):
        assert interactive_agents(segment, count).tolist() == chosen
    with pytest.raises(DataError, match="has 4"):
        interactive_agents(segment, 5)
    kinds = segment.agent_type.copy()
    kinds[1:3] = AgentType.PEDESTRIAN, AgentType.CYCLIST
    late = hide(segment.replace(agent_type=kinds, interest=ints(1, 3)), 3, slice(0, 1))
    assert interactive_agents(late, 2).tolist() == [0, 4]
    gone = hide(abreast([5, 6, 7], [2, 2, 2]), 1, slice(5, 6))
    assert interactive_agents(gone, 4).tolist() == [0, 2, 3, 1]


def test_marks_of_the_source_come_first() -> None:
    segment = abreast([30, 5, 10, 20], [2, 0.0, 2, 2])
    assert interactive_agents(segment.replace(interest=ints(0, 1)), 2).tolist() == [0, 1]
    assert interactive_agents(segment.replace(interest=ints(1), predict=ints(4)), 2).tolist() == [0, 1]
    assert interactive_agents(segment.replace(interest=ints(0), predict=ints(4)), 2).tolist() == [0, 4]
    # Yielding at a stop is interacting; being marked for prediction while parked is not.
    assert interactive_agents(segment.replace(interest=ints(2)), 2).tolist() == [0, 2]
    assert interactive_agents(segment.replace(predict=ints(2)), 2).tolist() == [0, 3]
    # After the partner, the nearest that move.
    assert interactive_agents(segment.replace(interest=ints(2)), 4).tolist() == [0, 2, 3, 4]


@settings(max_examples=30, deadline=None)
@given(st.randoms(use_true_random=False), st.integers(1, 8), st.sampled_from([straight_road, crossing]))
def test_the_order_of_agents_does_not_matter(random: Any, count: int, make: Any) -> None:
    segment = make(num_agents=9, seed=random.randrange(1000))
    chosen = interactive_agents(segment, count)
    assert (len(set(chosen.tolist())), chosen[0]) == (count, segment.ego)
    order = random.sample(range(9), 9)
    arrays = ("agent_id", "agent_type", "size", "position", "heading", "velocity", "valid")
    mixed = segment.replace(ego=order.index(0), **{name: getattr(segment, name)[order] for name in arrays})
    again = interactive_agents(mixed, count)
    assert mixed.agent_id[again].tolist() == segment.agent_id[chosen].tolist()


def test_too_few_crowds_and_large_maps_are_left_out() -> None:
    def excluded(segment: RunSegment, count: int) -> str:
        kind, error = exclusion(segment, count) or ("", None)
        assert error is None or (error.segment, error.file) == (segment.segment_id, "log.xml")
        return kind

    def with_lane(length: float, spacing: float) -> RunSegment:
        x = np.linspace(0, length, round(length / spacing) + 1)
        return abreast([5], [2], file="log.xml").replace(road=make_road([np.stack([x, 0 * x], -1)]))

    few = abreast([5, 6, 7], [2, 2, 0], file="log.xml")
    assert (excluded(few, 4), excluded(few, 3)) == ("interactive_agents", "")
    with pytest.raises(DataError, match="ego is not seen"):
        interactive_agents(hide(few, 0, slice(0, 1)), 2)
    crowd = abreast([5.0 + k for k in range(258)], [2.0] * 258, file="log.xml")
    unseen = hide(crowd, 100, slice(None))
    assert [excluded(hide(crowd, 100, 0), 2), excluded(crowd, 3), excluded(unseen, 2)] == ["playback_agents", "", ""]
    # By its length, not by how densely it is drawn.
    assert contexts.road_points(with_lane(100, 0.1)) == contexts.road_points(with_lane(99, 50)) == 51
    found = [excluded(with_lane(*size), 2) for size in ((19_990, 0.5), (20_010, 50))]
    assert found == ["", "roadgraph_points"]
