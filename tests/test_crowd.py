"""Everyone reacts: who is driven, how agents enter and leave, and what the others do meanwhile."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torchrl.envs.utils import step_mdp

from helpers_agents import make_agent
from helpers_segments import LANE_WIDTH, crossing, hide, make_road, make_segment, straight_road
from helpers_store import fill
from symphony import keys
from symphony.agents import Agent, load_agent
from symphony.config import EvaluateConfig
from symphony.data.builtin import builtin_store
from symphony.data.segment import AgentType, RunSegment
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv, scene
from symphony.envs.edge import map_edge
from symphony.envs.observation import ObservationConfig
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError
from symphony.evaluation import evaluate
from symphony.learning.demonstrations import SceneDataset
from symphony.roadgraph import LaneGraph
from symphony.rollouts.control import given_goals
from symphony.rollouts.crowd import Crowd, CrowdDataset, crowd_dataset
from symphony.rollouts.driving import simulation
from symphony.saved.rollouts import SavedRollouts, world_of
from symphony.saved.saving import save_simulation

DT = 0.2
END = 200.0
ALL = Crowd(128, everyone=True, open_traffic=True)


def row(cars: list[tuple[float, float, int]], steps: int = 31, name: str = "row") -> RunSegment:
    """Cars (first place, speed, lane) on a one-way road of three lanes to x = 200, who are in the log while on it."""
    time = DT * np.arange(steps)
    start, speed, lane = (np.array(part, float)[:, None] for part in zip(*cars, strict=True))
    x = start + speed * time
    xs = np.arange(0.0, END + 1, 2.0)
    lines = [np.stack([xs, np.full_like(xs, k * LANE_WIDTH)], -1) for k in range(3)]
    pairs = np.array([[0, 1], [1, 2]])
    position = np.stack([x, lane * LANE_WIDTH + 0 * x], -1)
    velocity = np.stack([speed + 0 * x, 0 * x], -1)
    road = make_road(lines, left=pairs, right=pairs[:, ::-1])
    found = make_segment(road, position, 0 * x, velocity, segment_id=name)
    for a, there in enumerate((x >= 0) & (x <= END)):
        for t in np.flatnonzero(~there):
            found = hide(found, a, slice(t, t + 1))
    return found


FLOW = row([(60, 10, 0), (100, 10, 0), (185, 12, 1), (-30, 12, 2), (-55, 12, 0), (120, 0, 2), (20, 5, 1)])
"""Agent 2 leaves, 3 and 4 enter, 5 waits in its lane."""


def tiny() -> Agent:
    """An untrained agent that follows routes and searches."""
    return make_agent(search={"branches": 4, "test_branches": 4})


def crowded(segment: RunSegment, crowd: Crowd = ALL, *, routes: bool = True) -> SceneBatch:
    graph = LaneGraph(segment.road)
    driven, background = crowd.choose(segment, graph)
    return scene(
        segment,
        [*driven, *background],
        graph if routes else None,
        edge=map_edge(graph) if crowd.open_traffic else None,
        background=np.arange(len(driven) + len(background)) >= len(driven),
    )


class Playback(DrivingEnv):
    """Driven agents go where the log has them next; without one straight on."""

    def _moved(self, tensordict: Any, state: Tensor, size: Tensor) -> Tensor:
        at, b = tensordict.get(keys.STEP).squeeze(-1), tensordict.get(keys.SCENE).squeeze(-1)
        index = self.scenes.interactive[b]
        step = (at + 1).clamp(max=self.scenes.log_state.shape[1] - 1)
        log = self.scenes.log_state[b[..., None], step[..., None], index]
        there = self.scenes.log_valid[b[..., None], step[..., None], index]
        speed = log[..., 3:].norm(dim=-1, keepdim=True)
        way = torch.stack([state[..., 2].cos(), state[..., 2].sin()], -1)
        straight = torch.cat([state[..., :2] + state[..., 3:] * self.dt * way, state[..., 2:]], -1)
        return torch.where(there[..., None], torch.cat([log[..., :3], speed], -1), straight)


def course(env: DrivingEnv, steps: int) -> list[Any]:
    """States of an environment whose actions mean nothing."""
    now = env.start(torch.arange(len(env.scenes)))
    found = [now]
    for _ in range(steps):
        action = torch.full(now.get(keys.VALID).shape, 73)
        now = step_mdp(env.step(now.set(keys.ACTION, action)))
        found.append(now)
    return found


def looking(scenes: SceneBatch) -> Playback:
    return Playback(scenes, None, ObservationConfig.nothing())


def test_everyone_who_plays_back_the_log_changes_nothing() -> None:
    env = looking(crowded(FLOW))
    assert sorted(env.scenes.interactive[0].tolist()) == list(range(FLOW.num_agents))
    zero = torch.zeros(1, dtype=torch.int64)
    for t, now in enumerate(course(env, 30)):
        found = env.objects(zero, zero + t, now.get(keys.STATE), now.get(keys.VALID))
        assert found.valid[0].tolist() == FLOW.valid[:, t].tolist(), t
        seen = FLOW.valid[:, t]
        assert np.allclose(found.state[0, seen, :2], FLOW.position[seen, t, :2], atol=1e-4)
        assert not now.get(keys.COLLISION).any()


def test_who_leaves_changes_nobody_elsewhere() -> None:
    scenes = crowded(FLOW)
    # Without exits and outline nobody leaves; a side of zeros keeps the traffic open.
    fields = {name: getattr(scenes, name) for name in SceneBatch.__annotations__}
    fields |= {"exits": scenes.exits[:, :0], "hull": torch.zeros(1, 1, 3)}
    gone = scenes.interactive[0].tolist().index(2)
    ways = [course(looking(one), 30) for one in (scenes, SceneBatch(**fields, batch_size=[1]))]
    assert [bool(way[-1][keys.VALID][0, gone]) for way in ways] == [False, True]
    others = torch.arange(len(FLOW.agent_id)) != gone
    for a, b in zip(*ways, strict=True):
        for key in (keys.STATE, keys.COLLISION, keys.VALID):
            assert torch.equal(a[key][:, others], b[key][:, others])


def test_who_has_left_is_neither_hit_nor_counted_and_never_comes_back() -> None:
    found = simulation(
        load_agent("constant_velocity"), crowded(FLOW, routes=False), EvaluateConfig(rollouts=1)
    )
    counted = found.rollouts.counted[0, 0].numpy()
    x = found.rollouts.state[0, 0, 1:, :, 0].numpy()
    assert (counted == (x <= END)).all(1).any()
    for n in range(counted.shape[1]):
        there = np.flatnonzero(counted[:, n])
        assert (np.diff(there) == 1).all()
    assert not found.rollouts.collision[~found.rollouts.counted].any()


def test_the_edge_is_where_lanes_end_not_where_one_joins_another() -> None:
    xs = np.arange(0.0, 101.0, 2.0)
    main = [np.stack([xs + k, 0 * xs], -1) for k in (0, 100)]
    lines = [*main, np.stack([xs, 0 * xs - LANE_WIDTH], -1)]
    road = make_road(lines, successors=[(0, 1)], left=[(2, 0)], right=[(0, 2)])
    assert np.allclose(map_edge(LaneGraph(road)).exits, [[200, 0, 1, 0]])


@settings(max_examples=6)
@given(st.integers(0, 10_000), st.integers(1, 3))
def test_nobody_enters_into_another(seed: int, lanes: int) -> None:
    rng = np.random.default_rng(seed)
    there = [(float(x), float(rng.uniform(0, 4)), int(rng.integers(lanes))) for x in rng.uniform(0, 60, 6)]
    come = [
        (float(-rng.uniform(0, 60)), float(rng.uniform(3, 15)), int(rng.integers(lanes))) for _ in range(8)
    ]
    env = looking(crowded(row([(150, 5, 0), *there, *come], steps=41), routes=False))
    before = None
    for now in course(env, 40):
        valid, hit = now[keys.VALID], now[keys.COLLISION].squeeze(-1)
        if before is not None:
            assert not (hit & valid & ~before).any()
        before = valid


def test_one_that_finds_no_room_waits_until_there_is() -> None:
    """A car stands where another is to enter; it drives on after a while."""
    segment = row([(100, 5, 0), (3, 0, 0), (-12, 10, 0)], steps=31)
    position, velocity = segment.position.copy(), segment.velocity.copy()
    position[1, 15:, 0] = 3 + 8 * DT * np.arange(16)
    velocity[1, 15:, 0] = 8
    segment = segment.replace(position=position, velocity=velocity)
    scenes = crowded(segment)
    late = scenes.interactive[0].tolist().index(2)
    entered = [bool(now[keys.VALID][0, late]) for now in course(looking(scenes), 30)]
    first = entered.index(True)
    assert int(scenes.enter[0, late]) < 12
    assert first > 15
    assert all(entered[first:])


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SegmentStore:
    path = tmp_path_factory.mktemp("crowd") / "store"
    fill(path, [row(cars(k), steps=8, name=f"row-{k}") for k in range(3)] + [crossing(4, steps=8)])
    return SegmentStore(path)


def cars(k: int) -> list[tuple[float, float, int]]:
    return [(60, 10, 0), (85, 10, 0), (190, 12, 1), (-6, 12, 2), (120, 0, 2)][: 3 + k]


def test_traffic_drawn_from_a_store_is_as_open_as_that_at_hand(store: SegmentStore) -> None:
    data = CrowdDataset(store, Crowd(3, open_traffic=True))
    at_hand, drawn = looking(data.scenes([0])), Playback(data, None, ObservationConfig.nothing())
    assert drawn.state_spec[keys.WAITING].shape == at_hand.state_spec[keys.WAITING].shape
    drawn.scenes = data.scenes([0])
    for one, other in zip(course(drawn, 10), course(at_hand, 10), strict=True):
        for key in (keys.VALID, keys.WAITING, keys.STATE):
            assert torch.equal(one.get(key), other.get(key))
    # An environment may also be given open scenes after closed ones.
    closed = DrivingEnv(SceneDataset(store, 2).scenes([0]), None, ObservationConfig.nothing())
    assert keys.WAITING not in closed.state_spec.keys(True)
    closed.scenes = data.scenes([0])
    assert keys.WAITING in closed.state_spec.keys(True)


def test_routes_begin_where_an_agent_comes_in() -> None:
    """Before it was logged on no lane."""
    x = np.arange(0, 202, 2.0)
    time = DT * np.arange(51)
    places = np.stack([50 + 10 * time, -60 + 10 * time])
    position = np.stack([places, 0 * places], -1)
    velocity = np.stack([np.full_like(places, 10.0), 0 * places], -1)
    segment = make_segment(make_road([np.stack([x, 0 * x], -1)]), position, 0 * places, velocity)
    scenes = crowded(segment)
    assert int(scenes.enter[0, 1]) > 0
    assert (scenes.route_logged >= 0).all()
    assert scenes.route_count[0, 1, 0] > 1


@pytest.mark.parametrize(("search", "others"), [("none", "idm"), ("tree", "log"), ("tree", "learned")])
def test_batch_and_padding_change_nothing(store: SegmentStore, search: Any, others: Any) -> None:
    config = EvaluateConfig(rollouts=4, search=search, interactive=2, others=others, seed=3)
    config = config if others != "log" else replace(config, interactive="all")
    dataset = crowd_dataset(store, tiny(), config)
    together = simulation(tiny(), dataset.scenes(range(4)), config)
    assert len({int(n) for n in dataset.scenes(range(4)).interactive_valid.sum(1)}) > 1
    for b in (0, 3):
        alone = simulation(tiny(), dataset.scenes([b]), config)
        count = alone.rollouts.counted.shape[-1]
        for one, many in zip(alone.rollouts, together.rollouts, strict=True):
            assert torch.equal(one[0], many[b, :, :, :count])
        assert torch.equal(alone.goal[0], together.goal[b, :, :count])


def test_fewer_agents_than_asked_for(store: SegmentStore) -> None:
    config = EvaluateConfig(rollouts=2, interactive=8, search="none")
    found = evaluate(tiny(), store, config)
    assert sorted(found.metrics.segments) == sorted(store.ids)
    data = crowd_dataset(store, tiny(), config)
    # Of those who move and are there at the first step, everyone.
    assert [int(data.scene(i).interactive.shape[1]) for i in range(4)] == [3, 3, 3, 4]


def test_who_is_driven_is_a_matter_of_choice() -> None:
    graph = LaneGraph(FLOW.road)
    kinds = FLOW.agent_type.copy()
    kinds[6] = AgentType.PEDESTRIAN
    segment = FLOW.replace(agent_type=kinds)
    driven, _ = ALL.choose(segment, graph)
    # The ego and its partner, the others that move, who stands in a lane, then who comes, by time; nobody on foot.
    assert sorted(driven[:3].tolist()) == [0, 1, 2]
    assert driven[3:].tolist() == [5, 3, 4]
    near = replace(ALL, radius=70.0).choose(segment, graph)[0]
    away = np.linalg.norm(segment.position[..., :2] - segment.position[0, :, :2], axis=-1)
    close = (segment.valid & segment.valid[0] & (away <= 70)).any(1)
    assert set(near[2:].tolist()) == set(driven[2:].tolist()) & set(np.flatnonzero(close).tolist())
    few, rest = Crowd(2, open_traffic=True, background=True).choose(segment, graph)
    assert few.tolist() == driven[:2].tolist()
    assert sorted([*few, *rest]) == sorted(driven)


@pytest.mark.parametrize("others", ["constant_velocity", "idm", "learned"])
def test_others_are_driven_but_not_evaluated(store: SegmentStore, others: Any, tmp_path: Path) -> None:
    """The log against itself is at no distance, whoever drives the rest, and goals are those of the evaluated."""
    config = EvaluateConfig(rollouts=2, search="none", interactive=2, others=others)
    assert evaluate("playback", builtin_store("test"), config, items=[0, 1]).numbers()["curvature_jsd"] == 0
    saved = save_simulation(tmp_path, tiny(), crowd_dataset(store, tiny(), config, [2]), config)[0]
    assert len(saved.agents) > 2
    assert saved.evaluated.tolist() == [0, 1]
    assert set(saved.drivers[2:]) == {f"background:{others}"}
    found = evaluate(tiny(), store, replace(config, rollouts=4, search="tree")).metrics.segments
    assert sorted(found) == sorted(store.ids)
    drawn = [int(segment.choice.drawn.sum()) for segment in found.values()]
    assert 0 < max(drawn) <= 2 * 4


@pytest.mark.parametrize("settings", [{"interactive": "all"}, {"interactive": 2, "others": "idm"}])
def test_the_same_seed_gives_the_same_bytes(store: SegmentStore, settings: Any, tmp_path: Path) -> None:
    def files(name: str, **more: Any) -> list[bytes]:
        config = EvaluateConfig(rollouts=2, branches=4, **{"seed": 5, **settings, **more})
        save_simulation(tmp_path / name, tiny(), crowd_dataset(store, tiny(), config), config)
        return [path.read_bytes() for path in sorted((tmp_path / name / "segments").iterdir())]

    assert files("a") == files("b", batch=1)
    assert files("a") != files("c", seed=6)


def test_what_is_saved_shows_who_is_there(store: SegmentStore, tmp_path: Path) -> None:
    def kept(agent: Agent, **changes: Any) -> SavedRollouts:
        config = EvaluateConfig(interactive="all", **changes)
        data = crowd_dataset(store, agent, config, [2])
        return save_simulation(tmp_path / agent.name, agent, data, config)[0]

    saved = kept(load_agent("constant_velocity"), rollouts=1, search="none")
    # At constant speed all is as logged, entering and leaving included.
    assert (world_of(saved, 0).valid == saved.segment.valid).all()
    assert not saved.segment.valid.all()
    saved = kept(tiny(), rollouts=2, branches=4)
    trees, steps = saved.trees, np.arange(saved.steps)
    assert trees is not None
    assert not trees.there.all()
    for k in range(saved.rollouts):
        history = trees.slots[0, steps // trees.prune_every, k]
        np.testing.assert_array_equal(trees.there[0, history, steps], saved.counted[k])


def test_the_baseline_is_the_planner_for_everyone(store: SegmentStore) -> None:
    config = EvaluateConfig(rollouts=1, interactive=2)
    found = evaluate("idm", store, config, baselines=True)
    assert {other.agent for other in found.baselines} == {"playback", "constant_velocity"}
    # Whoever is driven follows the route of the log by the rule, the ego and others alike.
    scenes = crowd_dataset(store, load_agent("idm"), config).scenes([2])
    driven = simulation(load_agent("idm"), scenes, config).rollouts.state
    scenes.background = scenes.interactive_valid
    ruled = simulation(load_agent("constant_velocity"), scenes, replace(config, others="idm")).rollouts.state
    assert torch.equal(driven, ruled)


def test_the_baseline_takes_a_given_route_and_no_other_rule() -> None:
    segment, idm = crossing(4, seed=1), load_agent("idm")
    scenes = scene(segment, [0, 1], LaneGraph(segment.road))

    def end(**given: Any) -> Tensor:
        return simulation(idm, scenes, EvaluateConfig(rollouts=1), **given).rollouts.state[0, 0, -1, :, :2]

    routes = [int(n) for n in scenes.route_count[0, 0].gt(1).nonzero()[:, 0]]
    ends = {route: end(given=torch.tensor([[route, -1]])) for route in routes}
    assert len(routes) > 1
    assert torch.equal(ends[int(scenes.route_logged[0, 0])], end())
    assert max(float((place[0] - end()[0]).norm()) for place in ends.values()) > 1.0
    with pytest.raises(ConfigError, match="among others that 'constant_velocity' drives"):
        simulation(idm, scenes, EvaluateConfig(rollouts=1, others="constant_velocity"))


def test_a_goal_is_a_route_over_its_lane_or_past_its_point() -> None:
    segment = crossing(4, seed=1)
    scenes = scene(segment, [0, 1], LaneGraph(segment.road))
    name = segment.agent_id.tolist()
    for m in range(3):
        lane = 8 + 3 * 0 + m
        route = int(given_goals([f"{name[0]}=lane:{100 + lane}"], [segment], scenes)[0, 0])
        points = scenes.whole_route(0, 0, route).numpy()
        ends = segment.road.lanes[lane][[0, -1], :2]
        assert max(np.linalg.norm(points - end, axis=-1).min() for end in ends) < 3.5
        x, y = segment.road.lanes[4 + (2, 3, 1)[m]][-20, :2].tolist()
        assert int(given_goals([f"{name[0]}={x},{y}"], [segment], scenes)[0, 0]) == route
    chosen = given_goals([f"{name[1]}=lane:112"], [segment], scenes)
    config = EvaluateConfig(rollouts=2, search="none")
    goal = simulation(tiny(), scenes, config, given=chosen).goal
    assert (goal[..., 1] == chosen[0, 1]).all()
    for bad in ("7", "7=", "x=1,2", "7=1", "7=a,b", "7=lane:99", "12345=lane:100", "7=9e9,0", "--7=1,2"):
        with pytest.raises(ConfigError, match="goal"):
            given_goals([bad], [segment], scenes)
    with pytest.raises(ConfigError, match="given another one"):
        given_goals([f"{name[0]}=lane:108", f"{name[0]}=lane:110"], [segment], scenes)
    with pytest.raises(ConfigError, match="planner drives"):
        given_goals([f"{name[0]}=lane:108"], [segment], scenes, planned=True)


def test_a_cold_draw_is_the_likeliest_action() -> None:
    segment = straight_road(4, steps=9)
    scenes = scene(segment, 3, LaneGraph(segment.road))

    def rollouts(temperature: float) -> Tensor:
        config = EvaluateConfig(rollouts=3, search="none", action_temperature=temperature, logged_goals=True)
        return simulation(tiny(), scenes, config).rollouts.state

    plain, cold, warm = (rollouts(temperature) for temperature in (1.0, 1e-7, 3.0))
    assert torch.equal(rollouts(1.0 + 1e-9), plain)
    assert (cold == cold[:, :1]).all()
    assert not (warm == warm[:, :1]).all()
    with pytest.raises(ConfigError, match="no discrete actions"):
        simulation(load_agent("constant_velocity"), scenes, EvaluateConfig(action_temperature=0.5))
