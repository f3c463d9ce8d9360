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

from helpers_roadgraph import crossing, drive, graph_of, merge, moved_road, parallel, pocket, roundabout, tree, turned
from helpers_segments import make_road
from symphony.roadgraph import LaneGraph, Route, blend, route_line, route_lines, routes
from symphony.roadgraph import ground_truth_routes as ground_truth
from symphony.roadgraph.paths import arc_lengths, at, beside, distinct, sharpest
from symphony.roadgraph.routes import MAX_LANES, change_length, ends_inside, resampled, route_errors

SPACING = 1.0


def lanes_of(found):
    return [route.lanes for route in found]


def follows(graph, lanes):
    """Whether each lane leads to the next one."""
    return all(b in graph.successors[a] for a, b in pairwise(lanes))


def lines_of(graph, found, along=0.0):
    """Return lines of routes that all begin at one distance along their first lanes."""
    return [resampled(route_line(graph, route, along), SPACING) for route in found]


def ground_truth_routes(graph, found, log, valid):
    return ground_truth(lines_of(graph, found), log, valid)


def test_crossing_has_three_routes_from_each_arm():
    graph, name = graph_of(crossing())
    for k in range(4):
        found = routes(graph, [(name[f"in{k}"], 10.0)])
        ways = enumerate(("right", "ahead", "left"), start=1)
        expected = {(name[f"in{k}"], name[f"{way}{k}"], name[f"out{(k + to) % 4}"]) for to, way in ways}
        assert (set(lanes_of(found)), found) == (expected, sorted(found))


def test_roundabout_ends_by_the_horizon():
    graph, name = graph_of(roundabout())
    found = lanes_of(routes(graph, [(name["entry0"], 0.0)], horizon=200))
    assert len(set(found)) == len(found) > 4
    for route in found:
        assert follows(graph, route)
        reach = graph.length[list(route)].sum()
        assert reach >= 200 or not graph.successors[route[-1]]
        assert reach - graph.length[route[-1]] < 200
    longer = lanes_of(routes(graph, [(name["entry0"], 0.0)], horizon=400))
    assert any(len(set(route)) < len(route) for route in longer)


def test_limit_keeps_every_near_branch():
    graph, name = graph_of(tree(8))
    everything = lanes_of(routes(graph, [(name["r"], 0.0)], limit=1000))
    assert len(everything) == 256
    found = lanes_of(routes(graph, [(name["r"], 0.0)], limit=100))
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


def test_pocket_is_reached_by_a_change_where_it_begins():
    graph, name = graph_of(pocket())
    plain = Route((name["first"], name["second"], name["third"], name["on"]))
    turn = Route((name["first"], name["second"], name["third"], name["pocket"], name["turn"]), 3, 0.0, 0.0)
    assert routes(graph, [(name["first"], 0.0)]) == [plain, turn]
    assert routes(graph, [(name["first"], 0.0)], limit=1) == [plain]
    assert lanes_of(routes(graph, [(name["first"], 0.0)], horizon=100)) == [(name["first"], name["second"])]
    line = route_line(graph, turn)
    # Up to the pocket on the lane, in the pocket after the length of a change.
    away = [abs(y) for x, y in line if x <= 100] + [abs(y - 3.5) for x, y in line if 120 <= x <= 150]
    assert max(away) < 1e-6


def test_parallel_lanes_offer_one_change_not_one_per_piece():
    graph, name = graph_of(parallel())
    for own, other in ("ab", "ba"):
        found = routes(graph, [(name[f"{own}0"], 5.0)])
        mine, others = ([name[f"{side}{k}"] for k in range(3)] for side in (own, other))
        assert found == [Route(tuple(mine)), Route((mine[0], *others), 1, 5.0, 5.0)]
    assert len(routes(graph, [(name["a0"], 5.0), (name["b0"], 5.0)])) == 2


def test_a_neighbour_that_has_ended_or_leads_elsewhere_is_no_lane_to_change_to():
    lane = np.array([[0.0, 0.0], [200.0, 0.0]])
    for other, offered in (
        ([[0.0, 3.5], [200.0, 3.5]], True),
        ([[0.0, 3.5], [80.0, 3.5]], False),  # it has ended behind the vehicle
        ([[150.0, 3.5], [400.0, 3.5]], True),  # it begins later on
        ([[0.0, 9.0], [200.0, 9.0]], False),  # it is two lanes away
        ([[90.0, 0.0], [140.0, 90.0]], False),  # it leads elsewhere
    ):
        graph = LaneGraph(make_road([lane, np.array(other)], left=[(0, 1)]))
        found = routes(graph, [(0, 100.0)])
        assert len(found) == 1 + offered
        if offered:
            assert found[1].begins == max(100.0, other[0][0])


@pytest.mark.parametrize("degrees", [0, 73])
@pytest.mark.parametrize("movement", ["left0", "ahead0", "right0", "left2"])
def test_ground_truth_is_the_route_that_was_driven(movement, degrees):
    road, name = crossing()
    graph, arm = LaneGraph(moved_road(road, degrees, [100, 50])), movement[-1]
    found = routes(graph, [(name[f"in{arm}"], 30.0)])
    (truth,) = [k for k, route in enumerate(found) if name[movement] in route.lanes]
    plain = LaneGraph(road)
    position, _ = drive(*(plain.lines[k] for k in found[truth].lanes))
    noise = np.random.default_rng(0).normal(0, 0.5, position.shape)
    log = turned(position[20:70] + noise[20:70], degrees) + np.array([100, 50])
    valid = np.ones(50, bool)
    valid[40:] = False
    log[40:] = 0
    assert np.flatnonzero(ground_truth_routes(graph, found, log, valid)).tolist() == [truth]


def test_ground_truth_ties_and_empty_logs():
    graph, name = graph_of(crossing())
    found = routes(graph, [(name["in0"], 0.0)])
    log = np.stack((np.full(5, 2.0), np.linspace(-60, -50, 5)), -1)
    assert len(found) > 1
    assert ground_truth_routes(graph, found, log, np.ones(5, bool)).all()
    assert ground_truth_routes(graph, found, log, np.zeros(5, bool)).all()
    with pytest.raises(ValueError, match="no routes"):
        ground_truth_routes(graph, [], log, np.ones(5, bool))


def test_route_errors_agree_with_shapely():
    graph, name = graph_of(crossing())
    lines = lines_of(graph, routes(graph, [(name["in1"], 0.0)]))
    log = np.random.default_rng(1).uniform(-40, 40, (20, 2))
    expected = [shapely.distance(shapely.LineString(line), shapely.points(log)).mean() for line in lines]
    np.testing.assert_allclose(route_errors(lines, log), expected, atol=1e-6)


lengths, curves = st.floats(10.0, 60.0), st.floats(-1 / 25, 1 / 25)


def curved(curvature, length=150.0, aside=0.0):
    """Return a line of constant curvature, moved to its left."""
    heading = curvature * np.arange(0.0, length, 1.0)
    points = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], -1), 0)
    return points + aside * np.stack([-np.sin(heading), np.cos(heading)], -1)


@given(curves, st.floats(-4.0, 4.0), st.floats(0.0, 60.0), lengths)
def test_a_blend_leads_forward_onto_the_line_without_a_kink(curvature, aside, place, length):
    line, point = curved(curvature), curved(curvature, aside=aside)[round(place)]
    way = blend(line, point, length)
    np.testing.assert_allclose(way[0], point)
    stations = np.array([beside(line, here)[0] for here in way])
    away = np.array([beside(line, here)[1] for here in way])
    assert (np.diff(stations) > 0).all()
    assert (np.diff(away) < 0.02).all()
    assert away[stations > stations[0] + length + 0.1].max(initial=0.0) < 1e-6
    # 1.5 d / length is the steepest of it, and a line of radius r turns by 3 / (r - d) where it is that much inside.
    bound = 6.0 * abs(aside) / length**2 * 3.0 + 3.0 * abs(curvature) / (1 - 4.5 * abs(curvature)) + 0.08
    assert sharpest(way) < bound


@pytest.mark.parametrize("gap", [(0.0, 0.0), (1.2, 0.3), (-1.2, 0.0), (-1.0, 0.6), (0.4, -0.9)])
def test_lanes_that_do_not_meet_are_joined_without_a_jump(gap):
    before = np.stack([np.linspace(0.0, 50.0, 26), np.zeros(26)], -1)
    after = np.stack([np.linspace(50.0, 120.0, 36), np.zeros(36)], -1) + gap
    graph = LaneGraph(make_road([before, after], successors=[(0, 1)]))
    line = route_line(graph, Route((0, 1)))
    assert (np.diff(line[:, 0]) > 0).all()
    assert sharpest(line) < np.radians(20.0)
    np.testing.assert_allclose(line[-1], after[-1])


@pytest.mark.parametrize("gap", [0.01, 0.03, 1.0])
def test_a_ring_that_does_not_close_is_driven_around_again(gap):
    angle = np.linspace(0.0, 2.0 * np.pi - gap / 20.0, 125)[:, None]
    graph = LaneGraph(make_road([20.0 * np.concatenate([np.cos(angle), np.sin(angle)], -1)], [(0, 0)]))
    line = route_line(graph, routes(graph, [(0, 100.0)])[0], 100.0)
    assert np.hypot(*np.diff(line, axis=0).T).sum() > 250.0


@functools.cache
def maps():
    """Graphs with every kind of junction and of change, each with the lanes it is entered by."""
    entries = {
        crossing: "in0 in1", roundabout: "entry0 between1", pocket: "first second", parallel: "a0 b1", merge: "a b",
    }  # fmt: skip
    made = [(*make(), names.split()) for make, names in entries.items()]
    return [(road, [name[entry] for entry in names]) for road, name, names in made]


def own_sharpest(graph, lanes):
    """Return :func:`sharpest` of the lanes themselves, as if each began where the one before it ends."""
    parts, end = [graph.lines[lanes[0]]], graph.lines[lanes[0]][-1]
    for lane in lanes[1:]:
        line = graph.lines[lane] - graph.lines[lane][0] + end
        parts.append(line)
        end = line[-1]
    return sharpest(distinct(np.concatenate(parts)))


@given(st.integers(0, 9), st.floats(0.0, 0.95), st.floats(0.0, 40.0))
@settings(max_examples=25)
def test_routes_can_be_driven(which, share, speed):
    road, entries = maps()[which // 2]
    graph = LaneGraph(road)
    start = (entries[which % 2], share * float(graph.length[entries[which % 2]]))
    found = routes(graph, [start])
    kept, lines = route_lines(graph, found, dict([start]), spacing=3.0, length=400.0, speed=speed)
    assert kept
    for route, line in zip(kept, lines, strict=True):
        place = at(graph.lines[start[0]], graph.arc[start[0]], np.array([start[1]]))
        np.testing.assert_allclose(line[:1], place, atol=1e-6)
        parts = [part for part in (route.lanes[: route.change], route.lanes[route.change :]) if part]
        assert all(follows(graph, part) for part in parts)
        assert sharpest(line) <= max(own_sharpest(graph, part) for part in parts) + np.radians(30.0)
        # Every point lies within half a lane of some lane, also where it changes from one to the other.
        lanes = shapely.union_all([shapely.LineString(each) for each in graph.lines])
        assert shapely.distance(lanes, shapely.points(line)).max() < 1.8
        if route.change:
            way = graph.length[list(route.lanes[: route.change])].sum() + change_length(speed)
            over = arc_lengths(line) > arc_lengths(line)[0] + way
            after = shapely.union_all([shapely.LineString(graph.lines[k]) for k in parts[1]])
            assert shapely.distance(after, shapely.points(line[over])).max(initial=0.0) < 0.2
    # No two are the same within a metre, and of a standing vehicle all changes are 20 m long.
    for k, line in enumerate(lines):
        same = [other for other in lines[k + 1 :] if len(other) == len(line)]
        assert all(np.hypot(*(other - line).T).max() >= 1.0 for other in same)


def test_ways_within_a_metre_are_one_if_one_has_a_point_more():
    ways = [[0, 0], [50, 0]], [[0, 0], [25, 0.95], [50, 0]], [[50, 0], [149.98, 0]]
    graph = LaneGraph(make_road([np.array(way, float) for way in ways], successors=[(0, 2), (1, 2)]))
    found = [Route((0, 2)), Route((1, 2))]
    assert [len(resampled(route_line(graph, route), 3.0)) for route in found] == [51, 52]
    assert route_lines(graph, found, {0: 0.0, 1: 0.0}, spacing=3.0, length=400.0)[0] == found[:1]


def test_a_whole_number_of_pieces_has_no_last_one_that_rounding_made():
    lines = np.float32([[100, 100], [148 + 1e-5, 136 - 1e-5]]), np.float32([[100, 100], [148 + 1e-5, 136]])
    assert [len(resampled(np.float64(line), 3.0)) for line in lines] == [21, 21]


def test_a_lane_that_ends_inside_the_map_says_so():
    def line(*points):
        return np.array(points, float)

    straight = line([0, 0], [50, 0]), line([70, 0], [150, 0])
    gap = LaneGraph(make_road(list(straight)))
    assert ends_inside(gap, straight[0])
    assert not ends_inside(gap, straight[1])
    # Deep within the map nothing need lie ahead.
    ring = line([-100, -100], [100, -100], [100, 100], [-100, 100], [-100, -100])
    assert ends_inside(LaneGraph(make_road([line([-60, 0], [0, 0]), ring])), line([-60, 0], [0, 0]))


@pytest.mark.parametrize("size", [1e-7, 1e-38])
def test_lanes_of_next_to_no_length_in_a_circle(size):
    road, name = crossing()
    end = road.lanes[name["in0"]][-1, :2]
    lines = [road.lanes[k][:, :2] - end for k in range(len(road.lanes))]
    tiny = np.array([[0, 0], [size, 0]], np.float32)
    lines += [tiny, tiny[::-1]]
    a, b = len(lines) - 2, len(lines) - 1
    links = [*map(tuple, road.successors.tolist()), (name["in0"], a), (a, b), (b, a)]
    graph = LaneGraph(make_road(lines, links))
    found = routes(graph, [(name["in0"], 10.0)])
    assert max(map(len, lanes_of(found))) == MAX_LANES
    assert all(follows(graph, route.lanes) for route in found)
    ordinary = [route for route in found if a not in route.lanes]
    assert ordinary == routes(LaneGraph(road), [(name["in0"], 10.0)])


@given(st.floats(0, 20))
def test_a_link_across_what_the_map_lacks_leads_nowhere(gap):
    graph = LaneGraph(make_road([np.float32([[0, 0], [50, 0]]), np.float32([[50 + gap, 0], [99, 0]])], [(0, 1)]))
    assert len(graph.successors[0]) == len(graph.predecessors[1]) == (np.float32(50 + gap) <= 55)


def test_going_around_the_block_first_is_not_the_way_of_the_log():
    # A street that leads back into itself, and on: 0 leads to 1 and, by the loop 2, to its own start.
    street = np.stack([np.linspace(0.0, 30.0, 16), np.zeros(16)], -1)
    onward, angle = street + np.array([30.0, 0.0]), np.linspace(0.0, 2.0 * np.pi, 60)[:, None]
    loop = np.array([30.0, 0.0]) + 8.0 * np.concatenate([np.sin(angle), 1 - np.cos(angle)], -1)
    loop = np.concatenate([loop[:45], [[10.0, 20.0], [-10.0, 10.0], [-5.0, 0.0], [0.0, 0.0]]])
    graph = LaneGraph(make_road([street, onward, loop], successors=[(0, 1), (0, 2), (2, 0)]))
    found = routes(graph, [(0, 2.0)], horizon=250.0)
    assert (0, 1) in lanes_of(found)
    assert any(lanes[:3] == (0, 2, 0) and 1 in lanes for lanes in lanes_of(found))
    valid = np.ones(25, bool)
    direct = np.stack([np.linspace(2.0, 50.0, 25), np.full(25, 0.2)], -1)
    right = ground_truth_routes(graph, found, direct, valid)
    assert {found[k].lanes[:2] for k in np.flatnonzero(right)} == {(0, 1)}
    # Who goes around does not take the direct way, and as long as nobody has turned off, all are right.
    round_once = np.concatenate([street[1::2], loop[1::2], street[1::2], onward[::2]])
    right = ground_truth_routes(graph, found, round_once, np.ones(len(round_once), bool))
    assert {found[k].lanes[:4] for k in np.flatnonzero(right)} == {(0, 2, 0, 1)}
    assert ground_truth_routes(graph, found, direct[:10], valid[:10]).all()
