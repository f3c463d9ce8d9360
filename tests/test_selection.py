"""Who is interactive, and which segments are left out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_segments import crossing, hide, make_road, make_segment, straight_road
from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import interactive_agents, road_points, travel, usable
from symphony.errors import DataError


def scene(distances: list[float], speeds: list[float], **changes: Any) -> RunSegment:
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


def test_the_nearest_that_moves_is_the_partner() -> None:
    segment = scene([30, 5, 10, 20], [2, 0.3, 2, 2])
    assert interactive_agents(segment, 2).tolist() == [0, 3]
    assert interactive_agents(segment, 4).tolist() == [0, 3, 4, 1]
    assert interactive_agents(segment, 1).tolist() == [0]


def test_marks_of_the_source_come_first() -> None:
    segment = scene([30, 5, 10, 20], [2, 0.0, 2, 2])
    assert interactive_agents(segment.replace(interest=ints(0, 1)), 2).tolist() == [0, 1]
    assert interactive_agents(segment.replace(interest=ints(1), predict=ints(4)), 2).tolist() == [0, 1]
    assert interactive_agents(segment.replace(interest=ints(0), predict=ints(4)), 2).tolist() == [0, 4]
    # Yielding at a stop is interacting; being marked for prediction while parked is not.
    assert interactive_agents(segment.replace(interest=ints(2)), 2).tolist() == [0, 2]
    assert interactive_agents(segment.replace(predict=ints(2)), 2).tolist() == [0, 3]
    # After the partner, the nearest that move.
    assert interactive_agents(segment.replace(interest=ints(2)), 4).tolist() == [0, 2, 3, 4]


def test_only_vehicles_seen_at_the_first_step() -> None:
    segment = scene([5, 6, 7, 8], [2, 2, 2, 2])
    kinds = segment.agent_type.copy()
    kinds[1] = AgentType.PEDESTRIAN
    kinds[2] = AgentType.CYCLIST
    segment = hide(segment.replace(agent_type=kinds, interest=ints(1, 3)), 3, slice(0, 1))
    assert interactive_agents(segment, 2).tolist() == [0, 4]


def test_those_seen_throughout_are_preferred() -> None:
    segment = hide(scene([5, 6, 7], [2, 2, 2]), 1, slice(5, 6))
    assert interactive_agents(segment, 4).tolist() == [0, 2, 3, 1]


def test_travel_is_where_an_agent_got_not_how_much_it_shook() -> None:
    segment = scene([5, 6], [0, 2])
    shaken = segment.position.copy()
    shaken[1, :, 0] += np.tile([0, 0.9], 3)
    segment = hide(segment.replace(position=shaken), 2, slice(0, 2))
    np.testing.assert_allclose(travel(segment), [5, 0.9, 6], rtol=1e-5)


@settings(max_examples=30, deadline=None)
@given(st.randoms(use_true_random=False), st.integers(1, 8), st.sampled_from([straight_road, crossing]))
def test_the_order_of_agents_does_not_matter(random: Any, count: int, make: Any) -> None:
    segment = make(num_agents=9, seed=random.randrange(1000))
    chosen = interactive_agents(segment, count)
    assert len(set(chosen.tolist())) == count
    assert chosen[0] == segment.ego
    order = random.sample(range(9), 9)
    arrays = ("agent_id", "agent_type", "size", "position", "heading", "velocity", "valid")
    mixed = segment.replace(ego=order.index(0), **{name: getattr(segment, name)[order] for name in arrays})
    again = interactive_agents(mixed, count)
    assert mixed.agent_id[again].tolist() == segment.agent_id[chosen].tolist()


def test_too_few_are_refused() -> None:
    segment = scene([5, 6, 7], [2, 2, 0], file="log.xml")
    for check in (interactive_agents, usable):
        with pytest.raises(DataError, match="needs 4 interactive agents at its first step, has 3") as error:
            check(segment, 4)
        assert (error.value.field, error.value.segment, error.value.file) == ("agents", "made", "log.xml")
    with pytest.raises(DataError, match="has no ego"):
        interactive_agents(hide(segment, 0, slice(0, 1)), 2)


def test_crowds_are_refused() -> None:
    segment = scene([5.0 + k for k in range(258)], [2.0] * 258)
    with pytest.raises(DataError, match="257 playback agents, at most 256") as error:
        usable(segment, 2)
    assert error.value.field == "agents"
    usable(segment, 3)
    usable(hide(segment, 100, slice(None)), 2)  # never seen


def test_large_maps_are_refused_by_length_not_by_density() -> None:
    def with_lane(length: float, spacing: float) -> RunSegment:
        x = np.linspace(0, length, round(length / spacing) + 1)
        return scene([5], [2]).replace(road=make_road([np.stack([x, 0 * x], -1)]))

    assert road_points(with_lane(100, 0.1)) == road_points(with_lane(100, 50)) == 51
    usable(with_lane(19_990, 0.5), 2)
    with pytest.raises(DataError, match="at most 10000") as error:
        usable(with_lane(20_010, 50), 2)
    assert error.value.field == "road"
