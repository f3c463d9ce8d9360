"""Routes on hand-made maps."""

from __future__ import annotations

import dataclasses
import functools
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_roadgraph import (
    crossing,
    drive,
    fork,
    merge,
    moved_road,
    parallel,
    pocket,
    roundabout,
    tree,
    turned,
)
from helpers_segments import make_road
from symphony.roadgraph import (
    LaneGraph,
    feasible_routes,
    ground_truth_routes,
    route_errors,
    route_polyline,
    routes,
)
from symphony.roadgraph.routes import MAX_LANES


def named(name, *lanes):
    return tuple(name[k] for k in lanes)


def follows(graph, route, changes=0):
    """Whether each lane leads to the next one, with so many changes of lane at most."""
    jumps = sum(b not in graph.successors[a] for a, b in pairwise(route))
    return jumps <= changes


def test_crossing_has_three_routes_from_each_arm():
    road, name = crossing()
    graph = LaneGraph(road)
    for k in range(4):
        found = routes(graph, [(name[f"in{k}"], 10.0)])
        expected = {
            named(name, f"in{k}", f"left{k}", f"out{(k + 3) % 4}"),
            named(name, f"in{k}", f"ahead{k}", f"out{(k + 2) % 4}"),
            named(name, f"in{k}", f"right{k}", f"out{(k + 1) % 4}"),
        }
        assert set(found) == expected
        assert found == sorted(found)


def test_horizon_counts_from_the_vehicle():
    road, name = crossing()
    graph = LaneGraph(road)
    assert routes(graph, [(name["in0"], 10.0)], horizon=50) == [(name["in0"],)]
    assert len(routes(graph, [(name["in0"], 10.0)], horizon=51)) == 3
    assert len(routes(graph, [(name["in0"], 20.0)], horizon=50)) == 3


def test_fork_merge_and_end():
    road, name = fork()
    found = routes(LaneGraph(road), [(name["stem"], 0.0)])
    assert found == [named(name, "stem", "up"), named(name, "stem", "on")]
    road, name = merge()
    assert routes(LaneGraph(road), [(name["b"], 0.0)]) == [named(name, "b", "c")]
    assert routes(LaneGraph(road), [(name["c"], 0.0)], horizon=1e6) == [named(name, "c")]
    assert routes(LaneGraph(road), []) == []


def test_roundabout_ends_by_the_horizon():
    road, name = roundabout()
    graph = LaneGraph(road)
    found = routes(graph, [(name["entry0"], 0.0)], horizon=200)
    assert len(set(found)) == len(found) > 4
    for route in found:
        assert follows(graph, route)
        reach = graph.length[list(route)].sum()
        assert reach >= 200 or not graph.successors[route[-1]]
        assert reach - graph.length[route[-1]] < 200
    # Round and round: some route passes one lane twice.
    assert any(len(set(route)) < len(route) for route in routes(graph, [(name["entry0"], 0.0)], horizon=400))


def test_limit_keeps_every_near_branch():
    road, name = tree(8)
    graph = LaneGraph(road)
    everything = routes(graph, [(name["r"], 0.0)], limit=1000)
    assert len(everything) == 256
    found = routes(graph, [(name["r"], 0.0)], limit=100)
    assert len(found) == len(set(found)) == 100
    assert set(found) <= set(everything)
    assert {route[:7] for route in found} == {route[:7] for route in everything}
    assert len(routes(graph, [(name["r"], 0.0)], limit=1)) == 1
    with pytest.raises(ValueError, match="limit"):
        routes(graph, [(name["r"], 0.0)], limit=0)


def test_routes_do_not_depend_on_the_order_of_connections():
    road, name = tree(5)
    graph = LaneGraph(road)
    shuffled = np.random.default_rng(0).permutation(road.successors)
    other = LaneGraph(dataclasses.replace(road, successors=shuffled))
    assert routes(graph, [(name["r"], 0.0)], limit=20) == routes(other, [(name["r"], 0.0)], limit=20)


def test_pocket_is_reached_by_a_change():
    road, name = pocket()
    graph = LaneGraph(road)
    plain = named(name, "first", "second", "third", "on")
    turn = named(name, "first", "second", "pocket", "turn")
    assert routes(graph, [(name["first"], 0.0)]) == [plain, turn]
    assert routes(graph, [(name["first"], 0.0)], lane_change=False) == [plain]
    assert routes(graph, [(name["first"], 0.0)], limit=1) == [plain]
    assert routes(graph, [(name["first"], 0.0)], horizon=100) == [named(name, "first", "second")]


def test_parallel_lanes_offer_one_change_not_one_per_piece():
    road, name = parallel()
    graph = LaneGraph(road)
    a, b = named(name, "a0", "a1", "a2"), named(name, "b0", "b1", "b2")
    assert routes(graph, [(name["a0"], 5.0)]) == [a, b]
    assert routes(graph, [(name["b0"], 5.0)]) == [b, a]


def test_feasible_routes_inside_a_junction_start_on_every_connector():
    road, name = crossing()
    graph = LaneGraph(road)
    found = feasible_routes(graph, np.array([2.0, -8.0]), np.pi / 2)
    assert {route[0] for route in found} == {name["left0"], name["ahead0"], name["right0"]}
    assert found[0][0] == name["ahead0"]
    assert feasible_routes(graph, np.array([40.0, 40.0]), 0.0) == []


@pytest.mark.parametrize("degrees", [0, 73])
@pytest.mark.parametrize("movement", ["left0", "ahead0", "right0", "left2"])
def test_ground_truth_is_the_route_that_was_driven(movement, degrees):
    road, name = crossing()
    graph = LaneGraph(moved_road(road, degrees, [100, 50]))
    arm = movement[-1]
    found = routes(graph, [(name[f"in{arm}"], 30.0)])
    (truth,) = [k for k, route in enumerate(found) if name[movement] in route]
    plain = LaneGraph(road)
    position, _ = drive(*(plain.lines[k] for k in found[truth]))
    noise = np.random.default_rng(0).normal(0, 0.5, position.shape)
    log = turned(position[20:70] + noise[20:70], degrees) + np.array([100, 50])
    valid = np.ones(50, bool)
    valid[40:] = False
    log[40:] = 0
    assert np.flatnonzero(ground_truth_routes(graph, found, log, valid)).tolist() == [truth]


def test_ground_truth_ties_and_empty_logs():
    road, name = crossing()
    graph = LaneGraph(road)
    found = routes(graph, [(name["in0"], 0.0)])
    log = np.stack((np.full(5, 2.0), np.linspace(-60, -50, 5)), -1)
    assert len(found) > 1
    # The log ends before the routes part, so that each of them is as right as the others.
    assert ground_truth_routes(graph, found, log, np.ones(5, bool)).all()
    assert ground_truth_routes(graph, found, log, np.zeros(5, bool)).all()
    with pytest.raises(ValueError, match="no routes"):
        ground_truth_routes(graph, [], log, np.ones(5, bool))


def test_route_errors_agree_with_shapely():
    road, name = crossing()
    graph = LaneGraph(road)
    found = routes(graph, [(name["in1"], 0.0)])
    log = np.random.default_rng(1).uniform(-40, 40, (20, 2))
    valid = np.arange(20) % 3 > 0
    expected = []
    for route in found:
        line = shapely.LineString(np.concatenate([graph.lines[k] for k in route]))
        expected.append(shapely.distance(line, shapely.points(log[valid])).mean())
    np.testing.assert_allclose(route_errors(graph, found, log, valid), expected, atol=1e-6)


@pytest.mark.parametrize("spacing", [0.7, 2.0, 500.0])
def test_route_polyline(spacing):
    road, name = crossing()
    graph = LaneGraph(road)
    route = named(name, "in0", "left0", "out3")
    line = route_polyline(graph, route, spacing=spacing)
    exact = shapely.LineString(np.concatenate([graph.lines[k] for k in route]))
    assert shapely.distance(exact, shapely.points(line)).max() < 1e-6
    np.testing.assert_allclose(line[0], graph.lines[route[0]][0])
    np.testing.assert_allclose(line[-1], graph.lines[route[-1]][-1])
    gaps = np.hypot(*np.diff(line, axis=0).T)
    assert (gaps <= spacing + 1e-6).all()
    assert (gaps > 0).all()
    assert len(line) == int(np.ceil((exact.length - 1e-6) / spacing)) + 1


def test_route_polyline_window():
    road, name = crossing()
    graph = LaneGraph(road)
    route = named(name, "in0", "ahead0", "out2")
    line = route_polyline(graph, route, start=10, length=31)
    np.testing.assert_allclose(line[0], [2, -60])
    np.testing.assert_allclose(line[-1], [2, -29])
    assert len(line) == 17
    gone = route_polyline(graph, route, start=1e4)
    np.testing.assert_allclose(gone, [[2, 70], [2, 70]], atol=1e-5)
    with pytest.raises(ValueError, match="spacing"):
        route_polyline(graph, route, spacing=0)


@pytest.mark.parametrize("size", [1e-7, 1e-38])
def test_lanes_of_next_to_no_length_in_a_circle(size):
    road, name = crossing()
    lines = [road.lanes[k][:, :2].copy() for k in range(len(road.lanes))]
    tiny = np.array([[0, 0], [size, 0]], np.float32)
    lines += [tiny, tiny[::-1]]
    a, b = len(lines) - 2, len(lines) - 1
    links = [*map(tuple, road.successors.tolist()), (name["in0"], a), (a, b), (b, a)]
    graph = LaneGraph(make_road(lines, links))
    found = routes(graph, [(name["in0"], 10.0)])
    assert max(map(len, found)) == MAX_LANES
    assert all(follows(graph, route) for route in found)
    ordinary = [route for route in found if a not in route]
    assert ordinary == routes(LaneGraph(road), [(name["in0"], 10.0)])


def test_going_around_the_block_first_is_not_the_way_of_the_log():
    # A street that leads back into itself, and on: 0 leads to 1 and, by the loop 2, to its own start.
    street = np.stack([np.linspace(0.0, 30.0, 16), np.zeros(16)], -1)
    onward = street + np.array([30.0, 0.0])
    angle = np.linspace(0.0, 2.0 * np.pi, 60)[:, None]
    loop = np.array([30.0, 0.0]) + 8.0 * np.concatenate([np.sin(angle), 1 - np.cos(angle)], -1)
    loop = np.concatenate([loop[:45], [[10.0, 20.0], [-10.0, 10.0], [-5.0, 0.0], [0.0, 0.0]]])
    graph = LaneGraph(make_road([street, onward, loop], successors=[(0, 1), (0, 2), (2, 0)]))
    found = routes(graph, [(0, 2.0)], horizon=250.0, lane_change=False)
    assert (0, 1) in found
    assert any(route[:3] == (0, 2, 0) and 1 in route for route in found)
    valid = np.ones(25, bool)
    direct = np.stack([np.linspace(2.0, 50.0, 25), np.full(25, 0.2)], -1)
    right = ground_truth_routes(graph, found, direct, valid)
    assert {found[k][:2] for k in np.flatnonzero(right)} == {(0, 1)}
    # Who goes around does not take the direct way, and as long as nobody has turned off, all are right.
    round_once = np.concatenate([street[1::2], loop[1::2], street[1::2], onward[::2]])
    right = ground_truth_routes(graph, found, round_once, np.ones(len(round_once), bool))
    assert {found[k][:4] for k in np.flatnonzero(right)} == {(0, 2, 0, 1)}
    assert ground_truth_routes(graph, found, direct[:10], valid[:10]).all()
    # Routes that can't be best are left out; those that can have the same errors.
    for path in (direct, direct[:10], round_once):
        there = np.ones(len(path), bool)
        errors, quick = (route_errors(graph, found, path, there, within=within) for within in (np.inf, 0.5))
        np.testing.assert_array_equal(quick[np.isfinite(quick)], errors[np.isfinite(quick)])
        assert (errors[np.isinf(quick)] > errors.min() + 0.5).all()
    assert np.isinf(route_errors(graph, found, direct, valid, within=0.5)).any()


@functools.cache
def two_blocks():
    """A graph with a street between two blocks; routes that come by it twice, of different lengths; longer ones."""
    street = np.stack([np.linspace(0.0, 30.0, 16), np.zeros(16)], -1)
    small = np.array([[30.0, 0], [35, 5], [30, 12], [0, 12], [-5, 5], [0, 0]])
    large = np.array([[30.0, 0], [40, -10], [30, -30], [0, -30], [-20, -12], [0, 0]])
    lanes = [street, small, large, street + np.array([30.0, 0.0])]
    graph = LaneGraph(make_road(lanes, successors=[(0, 1), (1, 0), (0, 2), (2, 0), (0, 3)]))
    found, longer = (
        routes(graph, [(0, 2.0)], horizon=metres, lane_change=False) for metres in (250.0, 400.0)
    )
    return graph, found, [way for way in longer if len(way) > 2]


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=15)
def test_the_error_of_a_route_does_not_depend_on_those_beside_it(seed, drives):
    graph, found, ways = two_blocks()
    rng = np.random.default_rng(seed)
    if drives:
        # Beyond the end of a route, and back to where it was.
        path = route_polyline(graph, ways[rng.integers(len(ways))], spacing=1.5)
        path = np.concatenate([path, path[:: rng.choice([-1, 2])]]) + rng.normal(0.0, 1.0, 2)
    else:
        # Also where no lane leads.
        path = rng.uniform([-25.0, -35.0], [65.0, 15.0], (rng.integers(2, 40), 2))
    there = np.ones(len(path), bool)
    alone = [route_errors(graph, [route], path, there)[0] for route in found]
    np.testing.assert_array_equal(route_errors(graph, found, path, there), alone)
