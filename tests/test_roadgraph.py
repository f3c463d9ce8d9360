"""Lane graph and lane assignment on hand-made maps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_roadgraph import arc, crossing, fork, make_road, merge, moved_road, roundabout, straight, turned
from symphony.errors import DataError
from symphony.roadgraph import LaneGraph, lane_of, starting_lanes


def middle(graph, lane):
    line = shapely.LineString(graph.lines[lane])
    a, b = (np.array(line.interpolate(f, normalized=True).coords[0]) for f in (0.5, 0.51))
    return a, np.arctan2(*(b - a)[::-1])


def test_crossing_connects_as_drawn():
    road, name = crossing()
    graph = LaneGraph(road)
    assert graph.successors[name["in0"]] == tuple(sorted(name[k] for k in ("left0", "ahead0", "right0")))
    assert graph.successors[name["out0"]] == ()
    assert graph.predecessors[name["out0"]] == tuple(sorted(name[k] for k in ("ahead2", "right3", "left1")))
    for a, after in enumerate(graph.successors):
        for b in after:
            assert a in graph.predecessors[b]
            np.testing.assert_allclose(graph.lines[a][-1], graph.lines[b][0], atol=1e-5)


def test_regions_of_a_crossing():
    road, name = crossing()
    regions = LaneGraph(road).regions
    assert len(regions) == 12
    # Of every choice there are three.
    assert np.unique(regions.parent, return_counts=True)[1].tolist() == [3] * 4
    by_lane = dict(zip(regions.lane.tolist(), range(12), strict=True))
    left, ahead, right = (by_lane[name[f"{k}1"]] for k in ("left", "ahead", "right"))
    assert regions.parent[left] == regions.parent[right] == name["in1"]
    assert regions.curvature[left] == pytest.approx(1 / 12, rel=0.05)
    assert regions.curvature[ahead] == pytest.approx(0, abs=1e-6)
    assert regions.curvature[right] == pytest.approx(-1 / 8, rel=0.05)
    np.testing.assert_allclose(regions.entry[left], [10, 2], atol=1e-5)
    assert abs(regions.entry_heading[ahead]) == pytest.approx(np.pi)


def test_merge_and_roundabout_regions():
    assert len(LaneGraph(merge()[0]).regions) == 0
    road, name = roundabout()
    regions = LaneGraph(road).regions
    assert sorted(regions.lane) == sorted(name[f"{k}{i}"] for k in ("stay", "exit") for i in range(4))


@settings(max_examples=25, deadline=None)
@given(
    st.floats(3, 100),
    st.floats(10, 170),
    st.booleans(),
    st.floats(-180, 180),
    st.sampled_from([0.1, 0.2, 0.4]),
)
def test_curvature_of_an_arc_is_one_over_its_radius(radius, sweep, clockwise, begin, spacing):
    line = arc((3, 4), radius, begin, begin + (-sweep if clockwise else sweep), spacing=spacing)
    (curvature,) = LaneGraph(make_road({"a": line})[0]).curvature
    # The turn between pieces misses half a piece at either end.
    pieces = len(line) - 1
    assert curvature == pytest.approx(
        (-1 if clockwise else 1) / radius * (pieces - 1) / pieces, rel=1e-2, abs=1e-4
    )


def test_curvature_of_an_s_bend_averages_out():
    bend = np.concatenate((arc((0, 0), 20, -90, 0), arc((40, 0), 20, 180, 90)[1:]))
    (curvature,) = LaneGraph(make_road({"a": bend})[0]).curvature
    assert abs(curvature) < 1e-3


def test_bike_lanes_are_left_out():
    road, name = fork()
    road = dataclasses.replace(road, lane_type=np.array([2, 3, 2], np.uint8))
    graph = LaneGraph(road)
    assert graph.successors[name["stem"]] == (name["on"],)
    assert len(graph.regions) == 0
    position, heading = middle(graph, name["up"])
    assert lane_of(graph, position, heading) == -1
    everything = LaneGraph(road, exclude=())
    assert len(everything.regions) == 2
    assert lane_of(everything, position, heading) == name["up"]


def test_bad_maps_name_the_field():
    road, _ = fork()
    with pytest.raises(DataError, match=r"road\.successors"):
        LaneGraph(dataclasses.replace(road, successors=np.array([[0, 3]], np.int32)))


def test_lanes_of_a_single_point_match_nothing():
    graph = LaneGraph(make_road({"a": [[1, 1], [1, 1]]})[0])
    assert not graph.usable.any()
    assert (graph.length, graph.curvature) == (0, 0)
    assert lane_of(graph, [1, 1], 0.0) == -1


def test_repeated_points_and_connections_change_nothing():
    road, name = fork()
    lines = {k: np.repeat(road.lanes[i][:, :2], 2, axis=0) for k, i in name.items()}
    doubled, _ = make_road(lines, [("stem", "up"), ("stem", "on"), ("stem", "up")])
    a, b = LaneGraph(road), LaneGraph(doubled)
    np.testing.assert_array_equal(a.curvature, b.curvature)
    np.testing.assert_array_equal(a.length, b.length)
    assert a.successors == b.successors
    assert len(b.regions) == 2


@pytest.mark.parametrize("make", [crossing, roundabout, fork, merge])
def test_every_lane_claims_its_own_middle(make):
    graph = LaneGraph(make()[0])
    places = [middle(graph, k) for k in range(len(graph))]
    position, heading = np.array([p for p, _ in places]), np.array([h for _, h in places])
    np.testing.assert_array_equal(lane_of(graph, position, heading), np.arange(len(graph)))
    np.testing.assert_array_equal(lane_of(graph, position, heading + 6 * np.pi), np.arange(len(graph)))


def test_wrong_way_and_far_away_have_no_lane():
    road, name = fork()
    graph = LaneGraph(road)
    assert lane_of(graph, [20, 2.9], 0.0) == name["stem"]
    assert lane_of(graph, [20, 3.1], 0.0) == -1
    assert lane_of(graph, [20, 0], np.pi) == -1
    assert lane_of(graph, [20, 0], np.radians(59)) == name["stem"]
    assert lane_of(graph, [20, 0], np.radians(61)) == -1
    assert starting_lanes(graph, [20, 0], np.pi) == []


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_what_is_not_finite_is_on_no_lane_and_not_silently(number):
    graph = LaneGraph(crossing()[0])
    for vehicle in ([number, 0.0, 0.0], [0.0, 0.0, number]):
        states = np.array([[0.0, 0.0, 0.0], vehicle])
        with pytest.raises(ValueError, match="vehicle \\[1\\]"):
            lane_of(graph, states[:, :2], states[:, 2])
        with pytest.raises(ValueError, match="not finite"):
            starting_lanes(graph, np.array(vehicle[:2]), vehicle[2])


def test_heading_decides_between_overlapping_lanes():
    lines = {"east": straight((-20, 0), (20, 0)), "slant": straight((-20, -10), (20, 10))}
    road, name = make_road(lines)
    graph = LaneGraph(road)
    assert lane_of(graph, [0, 0], 0.0) == name["east"]
    assert lane_of(graph, [0, 0], np.arctan2(10, 20)) == name["slant"]
    twin, _ = make_road({"a": lines["east"], "b": lines["east"]})
    assert lane_of(LaneGraph(twin), [0, 0.5], 0.0) == 0


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_assignment_agrees_with_shapely(seed):
    rng = np.random.default_rng(seed)
    graph = LaneGraph(crossing()[0])
    position, heading = rng.uniform(-25, 25, (3, 8, 2)), rng.uniform(-4, 4, (3, 8))
    found = lane_of(graph, position, heading)
    assert found.shape == (3, 8)
    lines = [shapely.LineString(line) for line in graph.lines]
    for i in np.ndindex(3, 8):
        point = shapely.Point(position[i])
        fits, unsure = {}, False
        for k, line in enumerate(lines):
            if line.distance(point) > 3:
                continue
            at = line.project(point)
            a, b = (np.array(line.interpolate(s).coords[0]) for s in (max(at - 1e-6, 0), at + 1e-6))
            turn = (np.arctan2(*(b - a)[::-1]) - heading[i] + np.pi) % (2 * np.pi) - np.pi
            # At a bend between two pieces the direction is that of one or the other.
            unsure |= abs(abs(turn) - np.pi / 3) < 0.1
            if abs(turn) <= np.pi / 3:
                fits[k] = line.distance(point)
        assert lane_of(graph, position[i], heading[i]) == found[i]
        if unsure:
            continue
        assert (found[i] >= 0) == bool(fits)
        assert not fits or fits[found[i]] <= min(fits.values()) + 0.25 + 1e-9


def test_assignment_is_invariant_under_rigid_motion():
    road, _ = crossing()
    rng = np.random.default_rng(0)
    position, heading = rng.uniform(-30, 30, (300, 2)), rng.uniform(-4, 4, 300)
    there = LaneGraph(moved_road(road, 37, [500, -200]))
    moved = turned(position, 37) + np.array([500, -200])
    here = lane_of(LaneGraph(road), position, heading)
    assert (here >= 0).sum() > 50
    assert (lane_of(there, moved, heading + np.radians(37)) == here).mean() > 0.99
    np.testing.assert_allclose(there.curvature, LaneGraph(road).curvature, atol=1e-5)


def test_starting_lanes_around_a_junction():
    road, name = crossing()
    graph = LaneGraph(road)
    assert starting_lanes(graph, [2, -30], np.pi / 2) == [(name["in0"], pytest.approx(40))]
    # Just before the junction the connectors are near, but the vehicle is alongside the approach.
    assert [k for k, _ in starting_lanes(graph, [2, -10.5], np.pi / 2)] == [name["in0"]]
    inside = starting_lanes(graph, [2, -8], np.pi / 2)
    assert {k for k, _ in inside} == {name["left0"], name["ahead0"], name["right0"]}
    assert inside[0][0] == name["ahead0"] == lane_of(graph, [2, -8], np.pi / 2)
    assert dict(inside)[name["ahead0"]] == pytest.approx(2)
    late = starting_lanes(graph, [2, 5], np.pi / 2)
    assert late[0][0] == name["ahead0"]
    # Only lanes that merge ahead are as near.
    assert all(graph.successors[k] == (name["out2"],) for k, _ in late)
    # Cutting into a turn, a vehicle may be nearer to another connector than to its own by a metre.
    wide = starting_lanes(graph, [1.5, -4.5], np.radians(110))
    assert {k for k, _ in wide} >= {name["left0"], name["ahead0"]}
