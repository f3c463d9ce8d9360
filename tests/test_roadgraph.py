"""Lane graph, lane assignment, branching regions and places along lines, on hand-made maps."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from helpers_roadgraph import arc, crossing, drive, fork, graph_of, make_road, roundabout
from helpers_segments import along
from symphony.errors import DataError
from symphony.geometry.polylines import NEAR, earliest_pass, stations_along
from symphony.roadgraph import LaneGraph, lane_of, starting_lanes, visited_curvatures, visited_regions


def test_regions_of_a_crossing():
    road, name = crossing()
    regions = LaneGraph(road).regions
    assert (len(regions), np.unique(regions.parent, return_counts=True)[1].tolist()) == (12, [3] * 4)
    by_lane = dict(zip(regions.lane.tolist(), range(12), strict=True))
    left, ahead, right = (by_lane[name[f"{k}1"]] for k in ("left", "ahead", "right"))
    assert regions.parent[left] == regions.parent[right] == name["in1"]
    assert regions.curvature[left] == pytest.approx(1 / 12, rel=0.05)
    assert regions.curvature[ahead] == pytest.approx(0, abs=1e-6)
    assert regions.curvature[right] == pytest.approx(-1 / 8, rel=0.05)
    np.testing.assert_allclose(regions.entry[left], [10, 2], atol=1e-5)
    assert abs(regions.entry_heading[ahead]) == pytest.approx(np.pi)


def test_a_lane_of_several_choices_counts_once():
    ends = np.array([[[0, 0], [50, 0]], [[0, 3], [50, 0]], [[50, 0], [90, 0]], [[50, 0], [90, 20]]], float)
    road, path = make_road(dict(zip("abcd", ends, strict=True)), ["ac", "ad", "bc", "bd"])[0], np.arange(90.0)
    driven = LaneGraph(road), np.stack([path, 0 * path], -1), 0 * path, path >= 0
    assert (visited_regions(*driven).sum(), visited_curvatures(*driven).tolist()) == (2, [0])


@settings(max_examples=25, deadline=None)
@given(st.floats(3, 100), st.floats(10, 170), st.sampled_from([-1, 1]), st.floats(-180, 180), st.floats(0.1, 0.4))
def test_curvature_of_an_arc_is_one_over_its_radius(radius, sweep, side, begin, spacing):
    line = arc((3, 4), radius, begin, begin + side * sweep, spacing=spacing)
    (curvature,) = LaneGraph(make_road({"a": line})[0]).curvature
    # The turn between pieces misses half a piece at either end.
    pieces = len(line) - 1
    assert curvature == pytest.approx(side / radius * (pieces - 1) / pieces, rel=1e-2, abs=1e-4)


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
    assert (a.successors, len(b.regions)) == (b.successors, 2)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_what_is_not_finite_is_on_no_lane_and_not_silently(number):
    graph = LaneGraph(crossing()[0])
    for vehicle in ([number, 0.0, 0.0], [0.0, 0.0, number]):
        states = np.array([[0.0, 0.0, 0.0], vehicle])
        with pytest.raises(ValueError, match="vehicle \\[1\\]"):
            lane_of(graph, states[:, :2], states[:, 2])
        with pytest.raises(ValueError, match="not finite"):
            starting_lanes(graph, np.array(vehicle[:2]), vehicle[2])
        path = np.zeros((5, 3))
        path[3] = vehicle
        with pytest.raises(ValueError, match="must be finite"):
            visited_regions(graph, path[:, :2], path[:, 2], np.ones(5, bool))


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


def test_starting_lanes_around_a_junction():
    graph, name = graph_of(crossing())
    assert starting_lanes(graph, [2, -30], np.pi / 2) == [(name["in0"], pytest.approx(40))]
    # Just before the junction the connectors are near, but the vehicle is alongside the approach.
    assert [k for k, _ in starting_lanes(graph, [2, -10.5], np.pi / 2)] == [name["in0"]]
    inside = starting_lanes(graph, [2, -8], np.pi / 2)
    assert {k for k, _ in inside} == {name["left0"], name["ahead0"], name["right0"]}
    assert inside[0][0] == name["ahead0"] == lane_of(graph, [2, -8], np.pi / 2)
    assert dict(inside)[name["ahead0"]] == pytest.approx(2)
    late = starting_lanes(graph, [2, 5], np.pi / 2)
    assert late[0][0] == name["ahead0"]
    assert all(graph.successors[k] == (name["out2"],) for k, _ in late)
    # Cutting into a turn, a vehicle may be nearer to another connector than to its own by a metre.
    wide = starting_lanes(graph, [1.5, -4.5], np.radians(110))
    assert {k for k, _ in wide} >= {name["left0"], name["ahead0"]}
    # A circuit leads into itself, and there is nothing else to be on at its seam.
    ring = LaneGraph(make_road({"a": arc((0, 0), 30, 0, 360)}, [("a", "a")])[0])
    assert (ring.successors, starting_lanes(ring, [30, 0], np.pi / 2)) == ([(0,)], [(0, 0)])


def movement(graph, name, kind, k, **options):
    end = (k + {"left": 3, "ahead": 2, "right": 1}[kind]) % 4
    return drive(*(graph.lines[name[lane]] for lane in (f"in{k}", f"{kind}{k}", f"out{end}")), **options)


def test_invalid_states_are_bridged_and_never_read():
    graph, name = graph_of(crossing())
    position, heading = movement(graph, name, "left", 0, step=0.5)
    valid = np.ones(len(position), bool)
    valid[114:124] = False
    position[~valid], heading[~valid] = np.nan, np.nan
    found = visited_regions(graph, position, heading, valid)
    assert graph.regions.lane[found].tolist() == [name["left0"]]
    assert not visited_regions(graph, position, heading, np.zeros_like(valid)).any()


def test_trajectories_that_share_a_history_or_stand_equal_each_alone():
    graph, name = graph_of(crossing())
    rng, paths = np.random.default_rng(0), []
    for kind, k in (("left", 0), ("right", 1), ("ahead", 2), ("left", 3)):
        path = movement(graph, name, kind, k, step=1.5, offset=rng.normal(0, 0.3))
        paths.append([part[20:80] for part in path])
    position, heading = (np.stack([paths[k][part] for k in (0, 0, 0, 1, 2, 3, 3)]) for part in (0, 1))
    valid = rng.random(heading.shape) < 0.9
    position[1, 30:], heading[1, 30:] = position[3, 30:], heading[3, 30:]
    heading[2, 30:] += np.pi  # in the same places, the other way
    position[4, 20:], heading[4, 20:] = position[4, 20], heading[4, 20]
    position[5] = position[6, ::-1]
    together = visited_regions(graph, position, heading, valid)
    assert together.any()
    for i in range(len(valid)):
        np.testing.assert_array_equal(together[i], visited_regions(graph, position[i], heading[i], valid[i]))


def brute_force(graph, position, heading, valid):
    """The definition, word by word, for one trajectory."""
    position, heading = position[valid], heading[valid]
    regions = graph.regions
    lines = [shapely.LineString(graph.lines[k]) for k in regions.lane]

    def turn(a, b):
        return abs((a - b + np.pi) % (2 * np.pi) - np.pi)

    def on(r, t):
        at = lines[r].project(shapely.Point(position[t]))
        near = lines[r].distance(shapely.Point(position[t])) < 2
        arcs = graph.arc[regions.lane[r]]
        piece = min(np.searchsorted(arcs, at, side="right") - 1, len(arcs) - 2)
        step = np.diff(graph.lines[regions.lane[r]], axis=0)[piece]
        return near and turn(np.arctan2(step[1], step[0]), heading[t]) <= np.pi / 4

    def comes_to(r, t):
        if t == 0 and on(r, 0):
            return True
        if t == len(position) - 1:
            return False
        path, entry = shapely.LineString(position[t : t + 2]), shapely.Point(regions.entry[r])
        late = path.project(entry) > path.length / 2
        return path.distance(entry) <= 2 and turn(regions.entry_heading[r], heading[t + late]) <= np.pi / 4

    def clearly(t, group):
        distance = {r: lines[r].distance(shapely.Point(position[t])) for r in group}
        near = min(group, key=distance.get)
        rest = min(d for r, d in distance.items() if r != near)
        return near if on(near, t) and rest >= distance[near] + 0.5 else None

    result = np.zeros(len(regions), bool)
    for parent in np.unique(regions.parent):
        group = np.flatnonzero(regions.parent == parent)
        coming, before, decision = False, False, None
        for t in range(len(position)):
            now = any(comes_to(r, t) for r in group)
            if now and not before:
                if decision is not None:
                    result[decision] = True
                coming, decision = True, None
            before = now
            if coming and (here := clearly(t, group)) is not None:
                decision = here
        if decision is not None:
            result[decision] = True
    return result


@pytest.mark.parametrize("make", [crossing, roundabout])
def test_agrees_with_the_definition(make):
    graph, _ = graph_of(make())
    rng, hits = np.random.default_rng(5), 0
    for _ in range(10):
        lane, path = rng.integers(len(graph)), []
        for _ in range(rng.integers(1, 9)):
            path.append(graph.lines[lane])
            after = graph.successors[lane]
            lane = rng.choice(after) if after and rng.random() < 0.9 else rng.integers(len(graph))
        position, heading = drive(*path, step=rng.uniform(0.5, 3), offset=rng.normal(0, 0.5))
        position = position + rng.normal(0, rng.choice([0, 0.3, 1]), position.shape)
        valid = rng.random(len(position)) < 0.9
        expected = brute_force(graph, position, heading, valid)
        np.testing.assert_array_equal(visited_regions(graph, position, heading, valid), expected)
        hits += expected.sum()
    assert hits > 10


def bend(turns: float, radius: float = 20.0, length: float = 189.0) -> NDArray[np.float64]:
    """A straight line, or one that goes around a circle of the given radius, in points 3 m apart."""
    arc = np.arange(0.0, length + 1e-9, 3.0)
    if not turns:
        return np.stack([arc, np.zeros_like(arc)], -1)
    return radius * np.stack([np.sin(arc / radius), 1.0 - np.cos(arc / radius)], -1)


@settings(max_examples=30, deadline=None)
@given(st.floats(12.0, 60.0), st.floats(0.0, 20.0), st.floats(0.0, 5.0), st.integers(0, 999), st.booleans())
def test_who_drives_around_a_block_gets_on(radius, speed, start, seed, hidden):
    # Up to two and a half times around: every place is passed again.
    line = bend(1.0, radius)
    arc = np.linalg.norm(np.diff(line, axis=0), axis=-1).sum()
    true = np.minimum(start + speed * 0.2 * np.arange(51), arc)
    rng = np.random.default_rng(seed)
    path, valid = along(line, true)[0] + rng.uniform(-0.3, 0.3, (51, 2)), np.ones(51, bool)
    if hidden:
        valid[[0, 7, 8, 30]] = False
        path[~valid] = np.nan
    found = stations_along(line[None], path[None], valid[None])[0]
    assert np.isnan(found[~valid]).all()
    assert np.abs(found - true)[valid].max() < 1.5


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), steps=st.integers(1, 30))
def test_on_lines_that_never_come_back_it_is_the_nearest_place(seed: int, steps: int) -> None:
    rng = np.random.default_rng(seed)
    line = np.stack([np.arange(0.0, 190.0, 3.0), 6.0 * np.sin(np.arange(64) / rng.uniform(8, 20))], -1)
    x = np.sort(rng.uniform(-10.0, 200.0, steps))
    path = np.stack([x, rng.uniform(-3.0, 3.0, steps) + np.interp(x, *line.T)], -1)
    found = stations_along(line[None], path[None], np.ones((1, steps), bool))[0]
    nearest = shapely.line_locate_point(shapely.LineString(line), shapely.points(path))
    np.testing.assert_allclose(found, nearest, atol=1e-6)


@pytest.mark.parametrize("turn", [0.3, 2.0])
def test_turning_the_world_padding_and_company_change_nothing(turn: float) -> None:
    line, straight = bend(1.0), bend(0.0)
    path, other = (along(each, np.arange(0.0, 160.0, 4.0))[0] for each in (line, straight))
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    valid = np.ones((1, len(path)), bool)
    alone = stations_along(line[None], path[None], valid)
    turned: Any = stations_along((line @ rotation.T)[None], (path @ rotation.T)[None], valid)
    np.testing.assert_allclose(turned, alone, atol=1e-9)
    padded = np.pad(line, ((0, 9), (0, 0)), "edge")
    np.testing.assert_allclose(stations_along(padded[None], path[None], valid), alone, atol=1e-12)
    both = stations_along(np.stack([line, straight]), np.stack([path, other + 1.0]), valid.repeat(2, 0))
    np.testing.assert_array_equal(both[:1], alone)


def test_a_point_that_is_not_finite_is_refused_by_its_place() -> None:
    path = np.zeros((2, 5, 2))
    path[1, 3, 0] = np.nan
    with pytest.raises(ValueError, match="path 1, step 3"):
        stations_along(np.stack([bend(0.0)] * 2), path, np.ones((2, 5), bool))


@given(arrays(float, st.tuples(st.integers(1, 4), st.integers(1, 12)), elements=st.integers(0, 6).map(float)))
def test_the_earliest_pass_is_a_dip_nearly_as_low_as_any(distance: NDArray[np.float64]) -> None:
    for row, found in zip(distance, earliest_pass(distance), strict=True):
        around = [np.inf, *row, np.inf]
        dips = [k for k in range(len(row)) if around[k] >= row[k] <= around[k + 2]]
        assert found == min(k for k in dips if row[k] <= min(row) + NEAR)
