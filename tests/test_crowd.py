"""Traffic in which everyone reacts: who is driven, how agents enter and leave, and what the others do meanwhile."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs.utils import step_mdp

from helpers_agents import make_agent
from helpers_segments import LANE_WIDTH, crossing, hide, make_road, make_segment, turned
from helpers_store import brief, stored
from symphony import keys
from symphony.agents import load_agent
from symphony.config import EvaluateConfig
from symphony.data.segment import AgentType
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv, scene
from symphony.envs.observation import ObservationConfig
from symphony.envs.scene import SceneBatch, collate, map_edge
from symphony.errors import ConfigError
from symphony.evaluation import evaluate
from symphony.learning.demonstrations import SceneDataset
from symphony.roadgraph import LaneGraph
from symphony.rollouts import background
from symphony.rollouts.control import given_goals
from symphony.rollouts.crowd import Crowd, CrowdDataset, crowd_dataset
from symphony.rollouts.driving import simulation
from symphony.saved.rollouts import world_of
from symphony.saved.saving import save_simulation

tiny = cache(lambda: make_agent(search={"branches": 4, "test_branches": 4}))
DT, END = 0.2, 200.0
ALL = Crowd(128, everyone=True, open_traffic=True)


def row(cars, steps=31, name="row"):
    """Cars (first place, speed, lane) on a one-way road of three lanes to x = 200, who are in the log while on it."""
    start, speed, lane = (np.array(part, float)[:, None] for part in zip(*cars, strict=True))
    x, xs = start + speed * DT * np.arange(steps), np.arange(0.0, END + 1, 2.0)
    lines = [np.stack([xs, np.full_like(xs, k * LANE_WIDTH)], -1) for k in range(3)]
    pairs = np.array([[0, 1], [1, 2]])
    parts = (x, lane * LANE_WIDTH + 0 * x), (speed + 0 * x, 0 * x)
    position, velocity = (np.stack(each, -1) for each in parts)
    road = make_road(lines, left=pairs, right=pairs[:, ::-1])
    found = make_segment(road, position, 0 * x, velocity, segment_id=name)
    for a, there in enumerate((x >= 0) & (x <= END)):
        found = hide(found, a, ~there)
    return found


FLOW = row([(60, 10, 0), (100, 10, 0), (185, 12, 1), (-30, 12, 2), (-55, 12, 0), (120, 0, 2), (20, 5, 1)])
"""Agent 2 leaves, 3 and 4 enter, 5 waits in its lane."""


def crowded(segment, crowd=ALL, *, routes=True):
    graph = LaneGraph(segment.road)
    (driven, rest), edge = crowd.choose(segment, graph), map_edge(graph) if crowd.open_traffic else None
    background = np.arange(len(driven) + len(rest)) >= len(driven)
    return scene(segment, [*driven, *rest], graph if routes else None, edge=edge, background=background)


class Playback(DrivingEnv):
    """Driven agents go where the log has them next; without one straight on."""

    def _moved(self, tensordict, state, size):
        at, b = tensordict.get(keys.STEP).squeeze(-1), tensordict.get(keys.SCENE).squeeze(-1)
        index = self.scenes.interactive[b]
        step = (at + 1).clamp(max=self.scenes.log_state.shape[1] - 1)
        log = self.scenes.log_state[b[..., None], step[..., None], index]
        there = self.scenes.log_valid[b[..., None], step[..., None], index]
        speed = log[..., 3:].norm(dim=-1, keepdim=True)
        way = torch.stack([state[..., 2].cos(), state[..., 2].sin()], -1)
        straight = torch.cat([state[..., :2] + state[..., 3:] * self.dt * way, state[..., 2:]], -1)
        return torch.where(there[..., None], torch.cat([log[..., :3], speed], -1), straight)


def course(env, steps):
    """States of an environment whose actions mean nothing."""
    found = [env.start(torch.arange(len(env.scenes)))]
    for _ in range(steps):
        action = torch.full(found[-1].get(keys.VALID).shape, 73)
        found.append(step_mdp(env.step(found[-1].set(keys.ACTION, action))))
    return found


def looking(scenes):
    return Playback(scenes, None, ObservationConfig.nothing())


def test_everyone_who_plays_back_the_log_changes_nothing():
    env, zero = looking(crowded(FLOW)), torch.zeros(1, dtype=torch.int64)
    assert sorted(env.scenes.interactive[0].tolist()) == list(range(FLOW.num_agents))
    for t, now in enumerate(course(env, 30)):
        found, seen = env.objects(zero, zero + t, now.get(keys.STATE), now.get(keys.VALID)), FLOW.valid[:, t]
        assert found.valid[0].tolist() == seen.tolist(), t
        assert np.allclose(found.state[0, seen, :2], FLOW.position[seen, t, :2], atol=1e-4)
        assert not now.get(keys.COLLISION).any()


def test_who_leaves_changes_nobody_elsewhere():
    scenes = crowded(FLOW)
    # Without exits and outline nobody leaves; a side of zeros keeps the traffic open.
    fields = {name: getattr(scenes, name) for name in SceneBatch.__annotations__}
    fields |= {"exits": scenes.exits[:, :0], "hull": torch.zeros(1, 1, 3)}
    others = scenes.interactive[0] != 2
    ways = [course(looking(one), 30) for one in (scenes, SceneBatch(**fields, batch_size=[1]))]
    assert [bool(way[-1][keys.VALID][0, ~others]) for way in ways] == [False, True]
    for a, b in zip(*ways, strict=True):
        for key in (keys.STATE, keys.COLLISION, keys.VALID):
            assert torch.equal(a[key][:, others], b[key][:, others])


def test_who_has_left_is_neither_hit_nor_counted_and_never_comes_back():
    scenes = crowded(FLOW, routes=False)
    found = simulation(load_agent("constant_velocity"), scenes, EvaluateConfig(rollouts=1)).rollouts
    counted, x = found.counted[0, 0].numpy(), found.state[0, 0, 1:, :, 0].numpy()
    assert (counted == (x <= END)).all(1).any()
    assert all((np.diff(np.flatnonzero(column)) == 1).all() for column in counted.T)
    assert not found.collision[~found.counted].any()


def test_the_edge_is_where_lanes_end_not_where_one_joins_another():
    xs = np.arange(0.0, 101.0, 2.0)
    main = [np.stack([xs + k, 0 * xs], -1) for k in (0, 100)]
    lines = [*main, np.stack([xs, 0 * xs - LANE_WIDTH], -1)]
    road = make_road(lines, successors=[(0, 1)], left=[(2, 0)], right=[(0, 2)])
    assert np.allclose(map_edge(LaneGraph(road)).exits, [[200, 0, 1, 0]])
    # Nor is there one where there are no lanes, and traffic is open all the same.
    assert map_edge(LaneGraph(make_road([lines[0][:1]]))).hull.tolist() == [[0, 0, 0]]


@settings(max_examples=3)
@given(st.integers(0, 10_000), st.integers(1, 3))
def test_nobody_enters_into_another(seed, lanes):
    rng = np.random.default_rng(seed)
    there = [(x, rng.uniform(0, 4), rng.integers(lanes)) for x in rng.uniform(0, 60, 6)]
    come = [(-rng.uniform(0, 60), rng.uniform(3, 15), rng.integers(lanes)) for _ in range(8)]
    way = course(looking(crowded(row([(150, 5, 0), *there, *come], steps=41), routes=False)), 40)
    for before, now in pairwise(way):
        assert not (now[keys.COLLISION].squeeze(-1) & now[keys.VALID] & ~before[keys.VALID]).any()


def test_one_that_finds_no_room_waits_until_there_is():
    """A car stands where another is to enter; it drives on after a while."""
    segment = row([(100, 5, 0), (3, 0, 0), (-12, 10, 0)], steps=31)
    position, velocity = segment.position.copy(), segment.velocity.copy()
    position[1, 15:, 0], velocity[1, 15:, 0] = 3 + 8 * DT * np.arange(16), 8
    scenes = crowded(segment.replace(position=position, velocity=velocity))
    late = scenes.interactive[0].tolist().index(2)
    entered = [bool(now[keys.VALID][0, late]) for now in course(looking(scenes), 30)]
    assert int(scenes.enter[0, late]) < 12
    assert entered.index(True) > 15
    assert entered == sorted(entered)


CARS = [(60, 10, 0), (85, 10, 0), (190, 12, 1), (-6, 12, 2), (120, 0, 2)]
ROWS = [row(CARS[: 3 + k], steps=8, name=f"row-{k}") for k in range(3)]
store = stored(lambda: [*ROWS, crossing(4, steps=8)], opened=True)


def test_traffic_drawn_from_a_store_is_as_open_as_that_at_hand(store):
    data, closed = CrowdDataset(store, Crowd(3, open_traffic=True)), SceneDataset(store, 2).scenes([0])
    # An environment may also be given open scenes after closed ones.
    for before in (data, closed):
        at_hand, drawn = looking(data.scenes([0])), looking(before)
        assert (keys.WAITING in drawn.state_spec.keys(True)) == (before is data)
        drawn.scenes = data.scenes([0])
        assert drawn.state_spec[keys.WAITING].shape == at_hand.state_spec[keys.WAITING].shape
        for one, other in zip(course(drawn, 10), course(at_hand, 10), strict=True):
            assert all(torch.equal(one[key], other[key]) for key in (keys.VALID, keys.WAITING, keys.STATE))


def test_routes_begin_where_an_agent_comes_in():
    """Before it was logged on no lane."""
    x, time = np.arange(0, 202, 2.0), DT * np.arange(51)
    places = np.stack([50 + 10 * time, -60 + 10 * time])
    position, velocity = (np.stack([part, 0 * places], -1) for part in (places, np.full_like(places, 10.0)))
    across = np.where(places < [[-99], [10]], 2.0, 0.0)  # nor is it while it comes across
    scenes = crowded(make_segment(make_road([np.stack([x, 0 * x], -1)]), position, across, velocity))
    assert int(scenes.enter[0, 1]) > 0
    assert (scenes.route_logged >= 0).all()
    assert scenes.route_count[0, 1, 0] > 1


@pytest.mark.parametrize(("search", "others"), [("none", "idm"), ("tree", "log"), ("tree", "learned")])
def test_batch_and_padding_change_nothing(store, search, others, tmp_path):
    driven = "all" if others == "log" else 2
    config = EvaluateConfig(rollouts=4, search=search, interactive=driven, others=others, seed=3)
    # Real streets bend, so that the last bit of an angle counts.
    seen = SegmentStore(brief(tmp_path / "bends", [10, 11, 12, 4], 36)) if others == "idm" else store
    dataset = crowd_dataset(seen, tiny(), config)
    together = simulation(tiny(), dataset.scenes(range(4)), config)
    assert len({int(n) for n in dataset.scenes(range(4)).interactive_valid.sum(1)}) > 1
    for b in (0, 3):
        alone = simulation(tiny(), dataset.scenes([b]), config)
        count = alone.rollouts.counted.shape[-1]
        for one, many in zip(alone.rollouts, together.rollouts, strict=True):
            assert torch.equal(one[0], many[b, :, :, :count])
        assert torch.equal(alone.goal[0], together.goal[b, :, :count])


def test_fewer_agents_than_asked_for(store):
    config = EvaluateConfig(rollouts=2, interactive=8, search="none")
    assert sorted(evaluate(tiny(), store, config).metrics.segments) == sorted(store.ids)
    # Of those who move and are there at the first step, everyone.
    data = crowd_dataset(store, tiny(), config)
    assert [int(data.scene(i).interactive.shape[1]) for i in range(4)] == [3, 3, 3, 4]


def test_who_is_driven_is_a_matter_of_choice():
    kinds = FLOW.agent_type.copy()
    kinds[6] = AgentType.PEDESTRIAN
    segment, graph = FLOW.replace(agent_type=kinds), LaneGraph(FLOW.road)
    driven = ALL.choose(segment, graph)[0].tolist()
    # The ego and its partner, the others that move, who stands in a lane, then who comes, by time; nobody on foot.
    assert (sorted(driven[:3]), driven[3:]) == ([0, 1, 2], [5, 3, 4])
    near = replace(ALL, radius=70.0).choose(segment, graph)[0]
    away = np.linalg.norm(segment.position[..., :2] - segment.position[0, :, :2], axis=-1)
    close = (segment.valid & segment.valid[0] & (away <= 70)).any(1)
    assert set(near[2:].tolist()) == set(driven[2:]) & set(np.flatnonzero(close).tolist())
    named = replace(ALL, also=(int(segment.agent_id[5]),)).choose(segment, graph)[0]
    assert sorted(named.tolist()) == sorted(driven)
    few, rest = Crowd(2, open_traffic=True, background=True).choose(segment, graph)
    assert few.tolist() == driven[:2]
    assert sorted([*few, *rest]) == sorted(driven)


@pytest.mark.parametrize("others", ["constant_velocity", "idm", "learned"])
def test_others_are_driven_but_not_evaluated(store, others, tmp_path):
    """The log against itself is at no distance, whatever drives the rest."""
    config = EvaluateConfig(rollouts=2, search="none", interactive=2, others=others)
    assert evaluate("playback", brief(tmp_path / "brief", [0]), config).numbers()["curvature_jsd"] == 0
    folder = save_simulation(tmp_path / "sim", tiny(), crowd_dataset(store, tiny(), config, [2]), config)
    saved = folder[0]
    assert saved.evaluated.tolist() == [0, 1]
    assert set(saved.drivers[2:]) == {f"background:{others}"}
    assert folder.about.drivers["others"] == others
    kept = replace(config, rollouts=4, search="tree", rule="replace", threshold=np.inf)  # nothing is bad
    found = evaluate(tiny(), store, kept).metrics.segments
    counts = {name: one.sums["agent_collision_rate"][1] for name, one in found.items()}
    assert counts == dict.fromkeys(store.ids, 2 * 4)


def test_what_is_saved_shows_who_is_there(store, tmp_path):
    def kept(agent, **changes):
        config = EvaluateConfig(interactive="all", **changes)
        data = crowd_dataset(store, agent, config, [2])
        return save_simulation(tmp_path / agent.name, agent, data, config)[0]

    saved = kept(load_agent("constant_velocity"), rollouts=1, search="none")
    # At constant speed all is as logged, entering and leaving included.
    assert (world_of(saved, 0).valid == saved.segment.valid).all()
    assert not saved.segment.valid.all()
    saved = kept(tiny(), rollouts=2, branches=4)
    trees, steps = saved.trees, np.arange(saved.steps)
    assert not trees.there.all()
    for k in range(saved.rollouts):
        history = trees.slots[0, steps // trees.prune_every, k]
        np.testing.assert_array_equal(trees.there[0, history, steps], saved.counted[k])


def test_the_baseline_is_the_planner_for_everyone(store):
    """Driven agents follow the route of the log by the rule, the ego and others alike."""
    config = EvaluateConfig(rollouts=1, interactive=2)
    scenes = crowd_dataset(store, load_agent("idm"), config).scenes([2])
    driven = simulation(load_agent("idm"), scenes, config).rollouts.state
    scenes.background = scenes.interactive_valid
    ruled = simulation(load_agent("constant_velocity"), scenes, replace(config, others="idm")).rollouts.state
    assert torch.equal(driven, ruled)


def test_a_goal_is_a_route_over_its_lane_or_past_its_point():
    segment = crossing(4, seed=1)
    scenes, name = scene(segment, [0, 1], LaneGraph(segment.road)), segment.agent_id.tolist()

    def asked(*goals, **how):
        return given_goals(list(goals), [segment], scenes, **how)

    for m in range(3):
        route = int(asked(f"{name[0]}=lane:{108 + m}")[0, 0])
        points, ends = scenes.whole_route(0, 0, route).numpy(), segment.road.lanes[8 + m][[0, -1], :2]
        assert max(np.linalg.norm(points - end, axis=-1).min() for end in ends) < 3.5
        x, y = segment.road.lanes[4 + (2, 3, 1)[m]][-20, :2].tolist()
        assert int(asked(f"{name[0]}={x},{y}")[0, 0]) == route
    chosen = asked(f"{name[1]}=lane:112")
    for agent in (tiny(), load_agent("idm")):
        goal = simulation(agent, scenes, EvaluateConfig(rollouts=2, search="none"), given=chosen).goal
        assert (goal[..., 1] == chosen[0, 1]).all()
    for bad in ("7", "7=", "x=1,2", "7=1", "7=a,b", "7=lane:99", "12345=lane:100", "7=9e9,0", "--7=1,2"):
        with pytest.raises(ConfigError, match="goal"):
            asked(bad)
    with pytest.raises(ConfigError, match="already has another goal"):
        asked(f"{name[0]}=lane:108", f"{name[0]}=lane:110")
    with pytest.raises(ConfigError, match="planner drives"):
        asked(f"{name[0]}=lane:108", planned=True)


def test_speed_limits_of_drivers_are_those_of_the_nearest_lane_however_far_from_the_origin() -> None:
    road = crossing(6).road
    segment = crossing(6).replace(road=replace(road, speed_limit=np.arange(1, 1 + len(road.lanes), dtype=np.float32)))
    places = torch.cartesian_prod(*2 * [torch.linspace(-60, 60, 61)])[None, None]
    limits = []
    for shift in ((0.0, 0.0), (16384.0, -8192.0)):
        scenes = collate([scene(moved := turned(segment, 0.0, shift), [0, 1], LaneGraph(moved.road))])
        limits.append(background._limits(scenes, places + torch.tensor(shift), 9.0))
    assert (limits[0] != limits[1]).float().mean() < 0.002  # by rounding of the places
