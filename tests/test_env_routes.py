"""Routes as the networks see them, goals as state, clearances, and open traffic."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest
import shapely
import torch
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from helpers_segments import CAR, LANE_WIDTH, crossing, hide, make_road, make_segment, straight_road
from symphony import DrivingEnv, ObservationConfig, keys
from symphony.agents import load_agent
from symphony.config.evaluation import SimulateConfig
from symphony.envs import CHOICE_FEATURES, ROUTE_FEATURES, Bicycle, Displacement, collate, scene
from symphony.envs import routes as module
from symphony.envs.objects import Objects, entering
from symphony.envs.routes import POINTS, SPACING, FollowedRoutes, route_ahead, route_choices, route_table
from symphony.envs.scene import leaving, map_edge
from symphony.errors import DataWarning
from symphony.geometry.boxes import box_gap
from symphony.geometry.polylines import stations_along
from symphony.learning.experts import KeptExperts, fit_experts
from symphony.roadgraph import LaneGraph
from symphony.roadgraph.paths import sharpest
from symphony.roadgraph.routes import change_length
from symphony.rollouts.driving import simulation
from symphony.rollouts.onward import Onward
from test_env import actions, run

SCALE = 20.0
EVERYTHING = ObservationConfig(num_objects=16, num_points=30, route=True, clearance=True)


def make_env(*segments, dynamics=None, config=EVERYTHING):
    return DrivingEnv(collate([scene(s, [0, 1], LaneGraph(s.road)) for s in segments]), dynamics, config)


def bend(straight=10, turn=1.6, radius=15.0):
    """A line of points 3 m apart: straight along +x, then a turn, then straight again."""
    count = max(2, round(abs(turn) * radius / SPACING))
    angle = np.concatenate([np.zeros(straight), np.linspace(0, turn, count), [turn] * 12])
    steps = SPACING * np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)])[:POINTS]


def one_route(line: NDArray[np.float64]) -> FollowedRoutes:
    return FollowedRoutes(torch.from_numpy(line), torch.tensor([[0]]), torch.tensor([[len(line)]]))


def see(x: float, y: float, heading: float, line: NDArray[np.float64]) -> torch.Tensor:
    """Return what an agent sees of a route when it has come to the point that is nearest."""
    state = torch.tensor([[[x, y, heading, 5.0]]], dtype=torch.float64)
    here = SPACING * np.hypot(*(line - [x, y]).T).argmin()
    window = one_route(line).window(torch.tensor([[here]], dtype=torch.float64))
    return route_ahead(state, window, SCALE)[0, 0]


def choices_of(state: torch.Tensor, *lines: NDArray[np.float64], change: float = np.inf) -> torch.Tensor:
    """Features [1, 1, G, F] of routes of one agent."""
    count = torch.tensor([[[len(line) for line in lines]]])
    routes = FollowedRoutes(torch.from_numpy(np.concatenate(lines)), count.cumsum(-1) - count, count)
    return route_choices(state, routes, torch.full(count.shape, change).double(), SCALE)[0]


lines = st.builds(bend, st.integers(2, 20), st.floats(-2.5, 2.5), st.floats(10, 60))
headings = st.floats(-6, 6)


@given(lines, st.floats(0, 0.999), st.floats(-3, 3), headings)
def test_seen_points_are_the_routes_points_ahead(line, where, offset, heading):
    k = int(where * len(line))
    place = line[k] + [0.0, offset]
    seen = see(*place, heading, line)
    ahead = seen[4:].reshape(-1, 3).numpy()
    exists = ahead[:, 2] == 1
    assert (ahead[~exists] == 0).all()
    back = complex(*place) + (ahead[exists, 0] + 1j * ahead[exists, 1]) * SCALE * np.exp(1j * heading)
    distance = np.hypot(*(line - place).T)
    first = min(int(distance.argmin()), len(line) - 2)
    rows = [first + a for a in module.AHEAD[1:] if first + a < len(line)]
    np.testing.assert_allclose(np.stack([back.real, back.imag], -1), line[rows], atol=1e-6)
    # All of them lie ahead along the route, but for the last point, which a vehicle past the end still sees.
    route = shapely.LineString(line)
    here = shapely.line_locate_point(route, shapely.Point(place))
    there = shapely.line_locate_point(route, shapely.points(line[rows]))
    assume(abs(here - SPACING * distance.argmin()) < SPACING)
    assert (there[rows != np.full(len(rows), len(line) - 1)] > here).all()


def test_without_a_route_all_features_are_zero():
    state, none = torch.randn(2, 3, 4), torch.zeros(2, 3, dtype=torch.int64)
    for point in (torch.zeros(0, 2), 1e6 * torch.randn(50, 2)):
        seen = route_ahead(state, FollowedRoutes(point, none, none).window(torch.zeros(2, 3)), SCALE)
        assert seen.shape == (2, 3, ROUTE_FEATURES)
        assert (seen == 0).all()
    # Of a single point there is no direction; two are enough.
    two = np.array([[0.0, 0.0], [3.0, 0.0]])
    assert (see(0.0, 0.0, 0.0, two[:1]) == 0).all()
    assert see(0.0, 0.0, 0.0, two)[:4].tolist() == [1.0, 0.0, 1.0, 0.0]
    env = make_env(crossing())
    assert (env.start(torch.tensor([0]))[keys.ROUTE] == 0).all()
    route = env.with_goals(env.start(torch.tensor([0])))[keys.ROUTE]
    assert (route[..., 0] == 1).all()
    assert (env.start(torch.tensor([0]))[keys.GOAL] == -1).all()


@given(st.integers(2, 40), st.integers(0, 2**31 - 1))
def test_what_else_is_in_the_table_changes_nothing(count, seed):
    rng = np.random.default_rng(seed)
    line = np.cumsum(SPACING * np.array([1.0, 0.0]) + rng.normal(0, 0.4, (count, 2)), 0)
    state = torch.from_numpy(np.concatenate([rng.normal(0, 20, 2), rng.normal(0, 2, 2)]))[None, None]
    # One route of one agent among others of a wider table.
    table = torch.from_numpy(rng.normal(0, 50, (2, 600, 2)))
    first, length = (torch.from_numpy(rng.integers(0, 100, (2, 2, 3))) for _ in range(2))
    table[1, 250 : 250 + count] = torch.from_numpy(line)
    first[1, 0, 2], length[1, 0, 2] = 250, count
    change = torch.from_numpy(rng.choice([0.0, 40.0, np.inf], (2, 2, 3)))
    routes = module.Routes(table, first, length, (first, length), change)
    found = routes.of(torch.tensor([1]), torch.tensor([[2, -1]]))
    points, exist = found.lines()
    assert torch.equal(points[0, 0, :count], torch.from_numpy(line))
    assert (points[0, 0, count:] == torch.from_numpy(line[-1])).all()
    assert exist.tolist() == [[count, 0]]
    progress = torch.from_numpy(rng.uniform(0, 3 * count, (1, 2)))
    for one, other in zip(found.window(progress), one_route(line).window(progress[:, :1]), strict=True):
        assert torch.equal(one[:, :1], other)
    place, moved = state[..., :2].expand(1, 2, 2), torch.from_numpy(rng.uniform(0, 3, (1, 2)))
    alone = one_route(line).progress(place[:, :1], progress[:, :1], moved[:, :1])
    assert torch.equal(found.progress(place, progress, moved)[:, :1], alone)
    features, mask = route_choices(state.expand(1, 2, 4), routes.among(torch.tensor([1])), change[1:], SCALE)
    assert features.shape == (1, 2, 3, CHOICE_FEATURES)
    assert torch.equal(mask, length[1:] > 1)
    assert torch.equal(features[0, 0, 2], choices_of(state, line, change=float(change[1, 0, 2]))[0, 0, 0])
    assert (features[length[1:] == 0] == 0).all()


@given(lines, st.integers(2, POINTS - 2), st.floats(-3.5, 3.5), headings)
def test_turns_say_where_a_route_bends(line, where, aside, heading):
    where = min(where, len(line) - 1)
    jumped = line + np.where(np.arange(len(line)) >= where, aside, 0.0)[:, None] * [0.0, 1.0]
    state = torch.tensor([[[*line[0], heading, 5.0]]], dtype=torch.float64)
    found = choices_of(state, line, jumped)[0, 0, :, 1 - POINTS : -1].numpy()
    for turns, points in zip(found, (line, jumped), strict=True):
        step = (points[1:] - points[:-1]) @ [1.0, 1j]
        expected = np.tanh(module.MAGNIFIED * np.sin(np.angle(step[1:] / step[:-1])))
        np.testing.assert_allclose(turns[: len(expected)], expected, atol=1e-6)
        assert (turns[len(expected) :] == 0).all()
    other = np.flatnonzero(np.abs(found[0] - found[1]) > 1e-6)
    assert set(other) <= {where - 2, where - 1}
    if abs(aside) > 1.0:
        assert len(other) > 0


@pytest.mark.parametrize("seed", range(4))
def test_the_logged_route_is_where_the_vehicle_drove(seed):
    segment = crossing(4, seed=seed, steps=61)
    graph, turns = LaneGraph(segment.road), []
    for agent in range(4):
        table = route_table(segment, graph, agent)
        path = shapely.points(segment.position[agent, :, :2].astype(float))
        drawn = [shapely.LineString(table.line(g)) for g in range(len(table.count))]
        away = [shapely.distance(line, path).mean() for line in drawn]
        # Chords of 3 m cut an arc of 10 m radius by at most 0.11 m.
        assert table.right[table.logged]
        assert away[table.logged] < 0.12
        assert away[table.logged] <= min(away) + 0.12
        if abs(segment.heading[agent, -1] - segment.heading[agent, 0]) > 1:
            turns.append(sorted(away)[1])
    assert min(turns) > 0.5


def test_a_vehicle_on_no_lane_has_no_route():
    off = straight_road(2)
    off.position[1, :2, 1] += 60  # where it begins
    table = route_table(off, LaneGraph(off.road), 1)
    assert table.points.shape == (0, 2)
    assert table.logged == -1
    env = make_env(off)
    start = env.with_goals(env.start(torch.tensor([0])))
    assert start[keys.GOAL][0, 1] == -1
    assert (start[keys.ROUTE][0, 1] == 0).all()
    assert start[keys.ROUTE][0, 0, 0] == 1
    assert not env.choices(start)[keys.ROUTES_MASK][0, 1].any()


@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_a_goal_stays_and_can_be_started_from(dynamics):
    env = make_env(straight_road(), crossing(), dynamics=dynamics)
    plan = actions(env, (2, 12))
    start = env.with_goals(env.start(torch.tensor([0, 1])), torch.tensor([[1, 0], [2, -1]]))
    whole = run(env, start, plan)
    assert (whole[keys.GOAL] == start[keys.GOAL][:, None]).all()
    middle = env.reset(whole[:, 4].exclude(keys.REWARD), set_state=True)
    assert (run(env, middle, plan[:, 5:]) == whole[:, 5:]).all()
    # What a state shows is a function of the simulation state alone.
    state = whole.select(*env.state_spec.keys(True, True))
    assert (env.at(state) == whole.exclude(keys.REWARD)).all()
    fresh = env.reset(whole[:, 4].clone().set("_reset", torch.tensor([[True], [False]])), set_state=False)
    assert fresh[keys.GOAL].tolist() == [[-1, -1], [2, -1]]


def test_the_gradient_of_what_is_seen_matches_finite_differences():
    line = bend(straight=4, turn=1.0, radius=20)
    point = torch.from_numpy(line)
    routes = FollowedRoutes(point, torch.zeros(1, 3, dtype=torch.int64), torch.tensor([[len(line)] * 3]))
    state = [[1.0, 0.7, 0.1, 5.0], [13.0, -1.5, 0.4, 2.0], [20.5, 2.0, 1.3, 0.0]]
    start = torch.tensor([state], dtype=torch.float64, requires_grad=True)
    seen = routes.window(torch.tensor([[1.0, 13.0, 20.0]], dtype=torch.float64))
    assert torch.autograd.gradcheck(lambda s: route_ahead(s, seen, SCALE), (start,))


def test_gaps_ahead_are_those_after_everyone_kept_speed_and_course():
    times = (0.5, 1.0, 2.0)
    config = ObservationConfig(num_objects=16, num_points=1, clearance=True, foresight=times)
    env = make_env(crossing(7), straight_road(5), config=config)
    out = run(env, env.start(torch.arange(2)[:, None].expand(2, 3)), actions(env, (2, 3, 8)))
    objects, mask, ahead = out[keys.OBJECTS], out[keys.OBJECTS_MASK], out[keys.GAP_AHEAD]
    assert ahead.shape == (*mask.shape, 3)
    assert (ahead[~mask] == 0).all()
    zero, size, speed = torch.zeros(()), torch.tensor(CAR[:2]), out[keys.OWN][..., :1] * 10
    heading = torch.atan2(objects[..., 3], objects[..., 2])
    for k, time in enumerate(times):
        own = torch.cat([speed, torch.zeros_like(speed)], -1)[..., None, :] * time
        there = objects[..., :2] * SCALE + objects[..., 4:6] * 10 * time
        expected = box_gap(own, zero, size, there, heading, objects[..., 8:10] * 5)
        torch.testing.assert_close(ahead[..., k][mask], expected[mask], atol=2e-3, rtol=0)


CROSSING = crossing(4)
CROSSING_ENV = make_env(CROSSING)
_EDGES = [line[:, :2].astype(float) for line in (CROSSING.road.boundary[k] for k in range(4))]
_AREA = shapely.Polygon(np.concatenate(_EDGES))


@settings(max_examples=25)
@given(st.floats(-40, 40), st.floats(-40, 40), st.floats(-4, 4))
def test_road_distances_are_those_of_centre_and_corners(x, y, heading):
    start = CROSSING_ENV.start(torch.tensor([0]))
    state = start[keys.STATE].clone()
    state[0, 0, :3] = torch.tensor([x, y, heading])
    seen = CROSSING_ENV.at(start.set(keys.STATE, state))
    length, width, _ = CAR
    local = [0, *(0.5 * complex(a * length, b * width) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1)))]
    places = complex(x, y) + np.array(local) * np.exp(1j * heading)
    points = shapely.points(places.real, places.imag)
    signed = shapely.distance(shapely.MultiLineString(_EDGES), points)
    signed[shapely.contains(_AREA, points)] *= -1
    # The environment simplifies the boundary by up to 0.02 m.
    np.testing.assert_allclose(seen[keys.ROAD][0, 0], signed, atol=0.03)
    assert seen[keys.OFFROAD][0, 0, 0] == (seen[keys.ROAD][0, 0, 0] > 0)


def test_tied_routes_are_drawn_evenly_and_by_segment_and_agent_alone():
    """The place of a route among the tied ones must not decide: the first are those that turn right."""
    graph, drawn = None, []
    for seed in range(60):
        segment = crossing(4, seed=seed, steps=3)
        graph = LaneGraph(segment.road)
        for agent in range(segment.num_agents):
            table = route_table(segment, graph, agent)
            if agent == 0:
                assert table.logged == route_table(segment, LaneGraph(segment.road), agent).logged
            tied = np.flatnonzero(table.right)
            if len(tied) > 1:
                drawn.append(tied.tolist().index(table.logged) / (len(tied) - 1))
    assert len(drawn) > 40
    assert abs(np.mean(drawn) - 0.5) < 4 * 0.5 / np.sqrt(len(drawn))


def loop(turns: float = 2.2, radius: float = 12.0) -> NDArray[np.float64]:
    """A straight line of points 3 m apart, then more than two rounds of a circle, then straight on."""
    angle = np.concatenate([np.zeros(8), np.arange(0, 2 * np.pi * turns, SPACING / radius)])
    angle = np.concatenate([angle, np.repeat(angle[-1], 60)])
    return np.cumsum(SPACING * np.stack([np.cos(angle), np.sin(angle)], -1), 0)


@given(st.floats(1.0, 8.0), st.floats(-2.5, 2.5), st.floats(0.5, 3.0))
@settings(max_examples=12)
def test_a_route_that_passes_itself_is_followed_in_order(speed, aside, dt):
    line = loop()
    stations = np.arange(0.0, SPACING * (len(line) - 2), min(speed * dt, 9.0))
    place = np.stack([np.interp(stations, SPACING * np.arange(len(line)), line[:, k]) for k in (0, 1)], -1)
    way = np.gradient(place, axis=0)
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    path = torch.from_numpy(place + aside * np.stack([-way[:, 1], way[:, 0]], -1))
    routes, come, found = one_route(line), torch.zeros(1, 1, dtype=torch.float64), []
    for before, here in zip(path[:1].repeat(2, 1).tolist() + path[1:-1].tolist(), path, strict=False):
        moved = (here - torch.tensor(before, dtype=torch.float64)).norm()[None, None]
        come = routes.progress(here[None, None], come, moved)
        found.append(float(come))
    # Chords cut a circle of 12 m radius by up to 0.1 m; beside it the way is as much longer or shorter.
    np.testing.assert_allclose(found, stations[: len(found)], atol=1.5)
    reference = stations_along(line[None], path.numpy()[None], np.ones((1, len(path)), bool))[0]
    # Where two chords meet, both are as near to what is outside of the bend.
    np.testing.assert_allclose(found, reference[: len(found)], atol=1.0)
    middle = len(found) // 2
    seen = routes.window(torch.tensor([[found[middle]]], dtype=torch.float64))
    first = round(found[middle] / SPACING) - int(seen.own)
    assert torch.equal(seen.points[0, 0, 0], torch.from_numpy(line[first]))


@given(st.floats(0.0, 150.0))
def test_a_route_is_followed_however_long_the_steps_are(moved):
    routes, place = one_route(np.stack([np.arange(0.0, 600.0, SPACING), np.zeros(200)], -1)), torch.zeros(1, 1)
    for step in range(4):
        here = torch.tensor([[[step * moved, 0.4]]])
        place = routes.progress(here, place, torch.tensor([[moved if step else 0.0]]))
        assert float(place) == pytest.approx(step * moved, abs=1e-3)


def test_an_agent_whose_routes_cannot_be_built_has_none(monkeypatch):
    segment = crossing(4)

    broken = Mock(side_effect=ValueError("no such line"))
    with monkeypatch.context() as patched:
        patched.setattr("symphony.envs.routes.route_lines", broken)
        with pytest.warns(DataWarning, match=f"agent {segment.agent_id[0]} can't be built: no such line"):
            batch = scene(segment, [0], LaneGraph(segment.road))
    assert batch.route_logged.tolist() == [[-1]]
    assert scene(segment, [0], LaneGraph(segment.road)).route_logged[0, 0] >= 0


@pytest.mark.parametrize("steps", [1, 2, 21])
def test_who_has_not_changed_lanes_took_no_route_that_does(steps):
    segment = straight_road(2, num_lanes=3, steps=21)
    table = route_table(segment.replace(valid=segment.valid & (np.arange(21) < steps)), LaneGraph(segment.road), 0)
    aside = np.array([np.ptp(table.line(g)[:, 1]) for g in range(len(table.count))])
    assert 30 * aside[table.right].max() < 3 < aside.max()
    assert np.array_equal(np.isfinite(table.change), aside > 3)
    # Routes are known to leave the lane where they do, and the nearer that is, the larger a feature.
    for begin, g in ((each, g) for g, each in enumerate(table.change) if each < np.inf):
        leaves = SPACING * (np.abs(np.diff(table.line(g)[:, 1])) > 0.02).argmax()
        assert begin - SPACING <= leaves <= begin + 2 * SPACING
    see = choices_of(torch.zeros(1, 1, 4).double(), table.line(0).astype(float), change=30.0)
    assert see[..., -1] == 0.5
    assert choices_of(torch.zeros(1, 1, 4).double(), table.line(0).astype(float))[..., -1] == 0


def test_who_drives_under_a_bridge_has_no_route_over_it_and_follows_nobody_there():
    segment = straight_road(2, num_lanes=1, steps=21)
    lane = segment.road.lanes[0]
    road = make_road([lane, lane + np.array([0.0, 0.5, 6.0], np.float32)])
    for height, aside in ((0.0, 0.0), (6.0, 0.5)):
        position = segment.position.copy()
        position[..., 1] += lane[0, 1] - position[0, 0, 1]
        position[..., 2] = np.array([[height], [6.0 - height]]) + 0.5 * segment.size[:, None, 2]
        made = segment.replace(position=position, road=road)
        table = route_table(made, LaneGraph(road), 0)
        assert len(table.count) == 1
        np.testing.assert_allclose(table.line(0)[:, 1], lane[0, 1] + aside, atol=1e-4)
        pair = collate([scene(each, [0], LaneGraph(road)) for each in (made, hide(made, 1, slice(1, None)))])
        assert torch.equal(*simulation(load_agent("idm"), pair, SimulateConfig(rollouts=1)).rollouts.state)


@pytest.mark.parametrize(("ahead", "aside", "speed", "its_speed", "enters"), [
    (5.6, 0.0, 0.0, 0.0, True),
    (5.4, 0.0, 0.0, 0.0, False),  # 0.9 m between them
    (9.0, 0.0, 10.0, 0.0, False),  # it would be there in half a second
    (9.0, 0.0, 10.0, 10.0, True),
    (-9.0, 0.0, 0.0, 9.0, False),  # who comes from behind
    (-9.0, 4.0, 0.0, 9.0, True),
    (13.0, 0.0, 9.0, 0.0, False),  # in a second
    (15.0, 0.0, 9.0, 0.0, True),
])  # fmt: skip
@pytest.mark.parametrize("angle", [0.0, 2.0])
def test_who_enters_would_meet_nobody_within_a_second(ahead, aside, speed, its_speed, enters, angle):
    forward = torch.tensor([np.cos(angle), np.sin(angle)])
    left = torch.tensor([-np.sin(angle), np.cos(angle)])
    rows = [
        torch.cat([place, torch.tensor([angle]), v * forward])
        for place, v in ((0 * forward, speed), (ahead * forward + aside * left, its_speed))
    ]
    size = torch.tensor([[[4.5, 2.0], [4.5, 2.0]]])
    objects = Objects(torch.stack(rows)[None].float(), torch.ones(1, 2, dtype=torch.bool), size)
    for index, slot in (([[0]], 0), ([[1, 0]], 1)):
        ready = torch.zeros(1, len(index[0]), dtype=torch.bool)
        ready[0, slot] = True
        assert entering(objects, torch.tensor(index), ready)[0, slot].item() == enters


@pytest.mark.parametrize("seed", range(3))
def test_on_a_device_the_same_enter(seed, monkeypatch):
    """There all are compared with all, as to look for those that are ready would wait for it."""
    rng = torch.Generator().manual_seed(seed)
    rows, agents, driven = 6, 9, 5
    state = torch.rand(rows, agents, 5, generator=rng) * torch.tensor([40.0, 12, 6, 12, 4])
    size = torch.tensor([4.5, 2.0]).expand(rows, agents, 2)
    valid = torch.rand(rows, agents, generator=rng) < 0.9
    objects = Objects(state, valid, size)
    index = torch.rand(rows, agents, generator=rng).argsort(-1)[:, :driven]
    ready = (torch.rand(rows, driven, generator=rng) < 0.6) & valid.gather(1, index)
    found = entering(objects, index, ready)
    assert 0 < found.sum() < ready.sum()
    monkeypatch.setattr("symphony.geometry.nearest.on_host", lambda _: False)
    assert torch.equal(entering(objects, index, ready), found)
    assert not entering(objects, index, torch.zeros_like(ready)).any()


def test_who_is_beyond_any_side_of_the_map_has_left():
    hull = torch.tensor([[[1.0, 0, 10], [-1, 0, 10], [0, 1, 10], [0, -1, 10], [0, 0, 0]]])
    after = torch.tensor([[[9.0, -9], [11, 0], [-11, 9], [0, 10.5], [3, -12]]])
    none = torch.zeros(1, 2, 4)
    assert leaving(torch.zeros_like(after), after, none, hull).tolist() == [[False, True, True, True, True]]
    exits, ahead = torch.tensor([[[0.0, 0, 1, 0]]]), torch.tensor([2.0, 0])
    before = torch.tensor([[[-1.0, 2.4], [-1, 2.6], [-1, -2.6], [1, 0]]])
    assert leaving(before, before + ahead, exits, hull[:, :0]).tolist() == [[True, False, False, False]]


def lanes_that_end(pieces):
    """A road of two lanes: that by which one comes ends after 60 m; what goes on past a bend begins beside it."""
    lines, links, beside, end, way = [], [], {1: [], -1: []}, 0j, 1 + 0j
    for side, turn in pieces:
        own, angle = end + way * np.arange(0, 61, 2), np.linspace(0, turn, 14)
        other = own + side * LANE_WIDTH * 1j * way
        bend = other[-1] + way * np.cumsum(1.5 * np.exp(1j * angle))
        k = len(lines)
        lines += [own, other, np.concatenate([other[-1:], bend])]
        links += [(k + 1, k + 2), (k + 2, k + 3)]
        beside[side].append((k, k + 1))
        beside[-side].append((k + 1, k))
        end, way = bend[-1], way * np.exp(1j * turn)
    flat = [np.stack([line.real, line.imag], -1) for line in lines]
    return make_road(flat, links[:-1], left=beside[1], right=beside[-1])


def test_a_route_ends_beside_a_lane_that_doubles_back():
    road, steps = lanes_that_end([(1, 0.0), (1, 0.0)]), 6
    broken = np.insert(road.lanes[1][:, :2], -1, [[40.0, LANE_WIDTH], [57.0, LANE_WIDTH]], 0)
    lines = [broken if k == 1 else road.lanes[k][:, :2] for k in range(len(road.lanes))]
    road = make_road(lines, [(1, 2), (2, 3)], left=[(0, 1)], right=[(1, 0)])
    segment = make_segment(
        road, np.full((1, steps, 2), [20.0, 0.0]), np.zeros((1, steps)), np.zeros((1, steps, 2)), 0.2
    )
    assert scene(segment, [0], LaneGraph(road)).route_point.isfinite().all()


@pytest.mark.parametrize(("aside", "speed", "found"), [(2.9, 0, True), (4, 8, True), (4, 1, False), (6.1, 8, False)])
def test_who_drives_beside_its_lane_is_on_it(aside, speed, found):
    segment = straight_road(num_agents=1, steps=3, num_lanes=1)
    segment.position[..., 1], segment.velocity[..., 0] = -aside, speed
    assert bool(len(route_table(segment, LaneGraph(segment.road), 0).count)) is found


def test_an_expert_that_goes_on_past_the_end_of_its_lane_is_not_left_there(tmp_path):
    road, x = lanes_that_end([(1, 0.0), (1, 0.0)]), np.arange(20.0, 155.0, 2.0)
    y = LANE_WIDTH * (((x - 30) / 25).clip(0, 1) + ((x - 105) / 30).clip(0, 1))
    path, heading = np.stack([x, y], -1), np.arctan2(np.gradient(y), np.gradient(x))
    velocity = 10 * np.stack([np.cos(heading), np.sin(heading)], -1)
    (expert,) = fit_experts(
        [make_segment(road, path[None], heading[None], velocity[None], 0.2)], Bicycle(), routes=True
    )
    (table,) = expert.routes
    assert table.line(table.logged)[-1, 0] < x[-1] < table.followed(table.logged)[-1, 0]
    assert np.abs(expert.progress[0].numpy() - (x - 20)).max() < 3
    kept = KeptExperts(tmp_path, "")
    kept.save("one", expert)
    (other,) = kept.load("one").routes
    assert np.array_equal(other.followed(table.logged), table.followed(table.logged))


@settings(max_examples=2)
@example([(-1, float(k == 2)) for k in range(9)], 0.0, 0.0)
@given(
    st.lists(st.tuples(st.sampled_from([-1, 1]), st.floats(-1.5, 1.5)), min_size=9, max_size=9),
    st.floats(0, 40), st.floats(0, 12),
)  # fmt: skip
def test_who_follows_a_route_has_road_ahead_however_often_lanes_end(pieces, x, speed):
    road, steps, dt = lanes_that_end(pieces), 6, 0.2
    place = np.full((2, steps, 2), [x, 0.0]) + speed * dt * np.arange(steps)[:, None] * [1.0, 0.0]
    place[1, :, 1] = pieces[0][0] * LANE_WIDTH
    graph, zero = LaneGraph(road), np.zeros((2, steps))
    log = make_segment(road, place, zero, np.stack([zero + speed, zero], -1), dt)
    segment = Onward(inflow=0.0).extended(log, graph, 151)
    scenes = scene(segment, [0, 1], graph, edge=map_edge(graph))
    lanes, end = [shapely.LineString(lane[:, :2]) for lane in road.lanes], road.lanes[len(road.lanes) - 1][-1, :2]
    area = shapely.union_all(lanes).buffer(LANE_WIDTH / 2 + 0.5)
    for _, n, g in (scenes.route_count > 1).nonzero().tolist():
        line, begin = scenes.whole_route(0, n, g).numpy().astype(float), int(scenes.route_first[0, n, g])
        chosen = scenes.route_point[0, begin : begin + int(scenes.route_count[0, n, g])].numpy()
        # Whoever drives as fast as it can in 30 s has 200 m ahead, or the end of the road.
        length, gap = SPACING * (len(line) - 1), np.hypot(*np.diff(line, axis=0).T)
        assert length > max(240, 1.1 * speed * 30 + 200) - 0.1 or np.hypot(*(line[-1] - end)) < 0.1
        assert 0 < gap.min() <= gap.max() < SPACING + 1e-3
        assert area.covers(shapely.LineString(line))
        assert sharpest(line) < np.radians(35)
        # What it was chosen by is what is followed, up to where the change begins.
        same = max(0, len(chosen) - 1 - int(np.ceil(change_length(speed) / SPACING)))
        assert np.array_equal(line[:same], chosen[:same])
    found = simulation(load_agent("idm"), scenes, SimulateConfig(rollouts=1)).rollouts
    there = found.counted[0, 0].numpy()
    assert shapely.distance(area, shapely.points(found.state[0, 0, 1:, :, :2].numpy()[there])).max() == 0
    assert there[:100].all()
