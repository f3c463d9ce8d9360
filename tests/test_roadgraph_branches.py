"""Which branching regions trajectories visit."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from helpers_roadgraph import crossing, drive, fork, merge, moved_road, roundabout, straight, turned
from symphony.roadgraph import LaneGraph, visited_curvatures, visited_regions

MOVES = [(kind, k) for k in range(4) for kind in ("left", "ahead", "right")]
EXIT = {"left": 3, "ahead": 2, "right": 1}


def lanes_visited(graph, name, position, heading, valid=None):
    valid = np.ones(len(position), bool) if valid is None else valid
    found = visited_regions(graph, position, heading, valid)
    back = {k: lane for lane, k in name.items()}
    return sorted(back[k] for k in graph.regions.lane[found])


def movement(graph, name, kind, k, **options):
    lanes = (f"in{k}", f"{kind}{k}", f"out{(k + EXIT[kind]) % 4}")
    return drive(*(graph.lines[name[lane]] for lane in lanes), **options)


@pytest.mark.parametrize("offset", [-0.6, 0.0, 0.6])
@pytest.mark.parametrize("step", [0.5, 3.7])
def test_each_movement_visits_its_own_region_and_no_other(step, offset):
    road, name = crossing()
    graph = LaneGraph(road)
    for kind, k in MOVES:
        path = movement(graph, name, kind, k, step=step, offset=offset)
        assert lanes_visited(graph, name, *path) == [f"{kind}{k}"]


def test_one_that_ends_before_the_choice_shows_visits_nothing():
    road, name = crossing()
    graph = LaneGraph(road)
    position, heading = movement(graph, name, "left", 0, step=0.5)
    assert lanes_visited(graph, name, position[:120], heading[:120]) == []
    # 2 m into the junction a left turn of 12 m radius is 0.17 m off the lane that goes on.
    assert lanes_visited(graph, name, position[:124], heading[:124]) == []
    assert lanes_visited(graph, name, position[:132], heading[:132]) == ["left0"]


def test_one_that_starts_on_a_region_counts():
    road, name = crossing()
    graph = LaneGraph(road)
    for kind, k in MOVES:
        position, heading = movement(graph, name, kind, k, step=0.5)
        inside = slice(120 + 8, None)
        assert f"{kind}{k}" in lanes_visited(graph, name, position[inside], heading[inside])
        # Whatever else it may be on comes from other arms: one choice has one answer.
        found = visited_regions(
            graph, position[inside], heading[inside], np.ones(len(position[inside]), bool)
        )
        parents = graph.regions.parent[found]
        assert len(np.unique(parents)) == len(parents)


def test_one_that_joins_a_region_half_way_does_not_count():
    """Coming out of a yard it never made the choice."""
    road, name = fork()
    graph = LaneGraph(road)
    yard = straight((70, -8), (80, 0))
    position, heading = drive(yard, straight((80, 0), (115, 0)))
    assert lanes_visited(graph, name, position, heading) == []
    assert lanes_visited(graph, name, *drive(graph.lines[name["stem"]], graph.lines[name["on"]])) == ["on"]


def test_wrong_way_and_sideways_do_not_count():
    road, name = fork()
    graph = LaneGraph(road)
    position, heading = drive(graph.lines[name["stem"]], graph.lines[name["up"]])
    assert lanes_visited(graph, name, position, heading) == ["up"]
    assert lanes_visited(graph, name, position, heading + np.pi) == []
    assert lanes_visited(graph, name, position, heading + np.pi / 2) == []
    assert lanes_visited(graph, name, position[::-1], heading[::-1] + np.pi) == []


def test_merging_lanes_are_no_choice():
    road, name = merge()
    graph = LaneGraph(road)
    position, heading = drive(graph.lines[name["a"]], graph.lines[name["c"]])
    assert visited_regions(graph, position, heading, np.ones(len(position), bool)).shape == (0,)
    assert visited_curvatures(graph, position, heading, np.ones(len(position), bool)).shape == (0,)


def test_roundabout_visits_each_choice_on_the_way():
    road, name = roundabout()
    graph = LaneGraph(road)
    way = ("entry0", "between0", "stay1", "between1", "stay2", "between2", "exit3")
    path = drive(*(graph.lines[name[k]] for k in way))
    assert lanes_visited(graph, name, *path) == ["exit3", "stay1", "stay2"]


def test_invalid_states_are_bridged_and_never_read():
    road, name = crossing()
    graph = LaneGraph(road)
    position, heading = movement(graph, name, "left", 0, step=0.5)
    valid = np.ones(len(position), bool)
    valid[114:124] = False
    position[~valid], heading[~valid] = np.nan, np.nan
    assert lanes_visited(graph, name, position, heading, valid) == ["left0"]
    assert lanes_visited(graph, name, position, heading, np.zeros_like(valid)) == []


def random_batch(graph, name, seed=0, shape=(3, 4), steps=60):
    rng = np.random.default_rng(seed)
    position, heading = np.zeros((*shape, steps, 2)), np.zeros((*shape, steps))
    for i in np.ndindex(shape):
        kind, k = MOVES[rng.integers(12)]
        p, h = movement(graph, name, kind, k, step=rng.uniform(0.5, 2.5), offset=rng.normal(0, 0.3))
        first = rng.integers(0, len(p) - 5)
        take = np.clip(np.arange(first, first + steps), None, len(p) - 1)
        position[i], heading[i] = p[take], h[take]
    return position, heading, rng.random((*shape, steps)) < 0.9


@pytest.mark.parametrize("part", [0, 1])
def test_a_valid_state_that_is_not_finite_is_refused(part):
    road, _ = crossing()
    path = [np.zeros((5, 2)), np.zeros(5)]
    path[part][3] = np.nan
    with pytest.raises(ValueError, match="must be finite"):
        visited_regions(LaneGraph(road), *path, np.ones(5, bool))


def test_trajectories_that_share_a_history_or_stand_equal_each_alone(monkeypatch):
    road, name = crossing()
    graph = LaneGraph(road)
    position, heading, valid = random_batch(graph, name, shape=(4,))
    history = (p[[0, 0, 0, 1, 2, 3, 3]].copy() for p in (position, heading, valid))
    position, heading, valid = history
    position[1, 30:], heading[1, 30:] = position[3, 30:], heading[3, 30:]
    heading[2, 30:] += np.pi  # in the same places, the other way
    position[4, 20:], heading[4, 20:] = position[4, 20], heading[4, 20]
    position[5] = position[6, ::-1]
    looked, near = [], type(graph.region_index).near
    monkeypatch.setattr(
        type(graph.region_index),
        "near",
        lambda index, points, reach: looked.append(points) or near(index, points, reach),
    )
    together = visited_regions(graph, position, heading, valid)
    assert together.any()
    assert len(looked[0]) == len(np.unique(position[valid], axis=0)) < valid.sum()
    for i in range(len(valid)):
        np.testing.assert_array_equal(together[i], visited_regions(graph, position[i], heading[i], valid[i]))


def test_who_stops_at_any_state_hides_no_choice_of_who_goes_on():
    road, name = crossing()
    graph = LaneGraph(road)
    position, heading = movement(graph, name, "left", 0, step=7.0)  # comes to no entry itself
    steps = np.arange(len(position))
    until = np.minimum(steps, steps[:, None])  # the last goes on to its end
    found = visited_regions(graph, position[until], heading[until], np.ones(until.shape, bool))
    assert found[-1].sum() == 1
    for k, one in enumerate(until):
        alone = visited_regions(graph, position[one], heading[one], np.ones(len(one), bool))
        np.testing.assert_array_equal(found[k], alone)


def test_batch_equals_one_at_a_time():
    road, name = crossing()
    graph = LaneGraph(road)
    position, heading, valid = random_batch(graph, name)
    together = visited_regions(graph, position, heading, valid)
    assert together.shape == (3, 4, 12)
    assert together.any()
    for i in np.ndindex(3, 4):
        np.testing.assert_array_equal(together[i], visited_regions(graph, position[i], heading[i], valid[i]))
    curvature = visited_curvatures(graph, position, heading, valid)
    assert sorted(curvature) == sorted(np.broadcast_to(graph.regions.curvature, together.shape)[together])


def test_rigid_motion_changes_nothing():
    road, name = crossing()
    graph, there = LaneGraph(road), LaneGraph(moved_road(road, 111, [50, 20]))
    position, heading, valid = random_batch(graph, name, seed=1)
    here = visited_regions(graph, position, heading, valid)
    moved = visited_regions(
        there, turned(position, 111) + np.array([50, 20]), heading + np.radians(111), valid
    )
    np.testing.assert_array_equal(here, moved)


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
    road, _ = make()
    graph = LaneGraph(road)
    rng = np.random.default_rng(5)
    hits = 0
    for _ in range(20):
        # A loose walk along the lanes, and now and then none.
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
    assert hits > 20
