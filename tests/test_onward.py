"""Past the end of the log: lights, who enters and who stays, what becomes of those that collide, what is judged."""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_agents import small
from helpers_segments import LANE_WIDTH, crossing, hide, make_road, make_segment, straight_road
from helpers_store import fill
from symphony import cli, keys
from symphony.agents import load_agent
from symphony.config.evaluation import EvaluateConfig, SimulateConfig
from symphony.data.segment import AMBER, GREEN, AgentType, SignalState, content_hash, validate
from symphony.envs import DrivingEnv, scene
from symphony.envs.observation import ObservationConfig
from symphony.envs.scene import map_edge
from symphony.errors import ConfigError, DataError
from symphony.evaluation import evaluate
from symphony.evaluation.report import report
from symphony.geometry import boxes_overlap
from symphony.roadgraph import LaneGraph
from symphony.rollouts.crowd import crowd_dataset
from symphony.rollouts.driving import simulation
from symphony.rollouts.lights import USUAL, _planned, continued, cycle
from symphony.rollouts.onward import PRIOR, Onward, entrances, entry_rates
from symphony.saved.folder import load_rollouts
from symphony.saved.rollouts import world_of
from symphony.saved.saving import save_simulation

DT, DRIVER = 0.2, load_agent("constant_velocity")


def after(state, steps, timing=()):
    """How the lights of a crossing [12, T] go on."""
    segment = crossing(2, state.shape[1], signal_state=state)
    return continued(segment, LaneGraph(segment.road), steps, timing)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.integers(6, 20), st.integers(1, 60))
def test_lights_of_a_known_period_go_on_with_it(seed, period, more):
    rng = np.random.default_rng(seed)
    once = rng.integers(4, 7, (12, period)).astype(np.uint8)
    whole, logged = np.tile(once, (1, 13)), 2 * period + int(rng.integers(3))
    assert np.array_equal(after(whole[:, :logged], logged + more), whole[:, : logged + more])
    # Where no change comes twice no period is made up.
    assert cycle(np.eye(period, dtype=np.uint8)) is None


@settings(max_examples=25, deadline=None)
@given(st.integers(11, 60), st.sampled_from([(), (8.0, 3.0, 1.0), (5.0, 0.0, 0.0)]), st.integers(-1, 3))
def test_other_lights_take_turns_and_never_meet(logged, timing, arrow):
    state = crossing(2, logged).signal_state
    state[arrow][state[arrow] == SignalState.GO] = SignalState.ARROW_GO
    if arrow < 0:  # nobody has green; some are not known, or flash
        state[:] = SignalState.STOP
        state[0], state[1], state[2, 5:] = SignalState.UNKNOWN, SignalState.FLASHING_STOP, SignalState.UNKNOWN
    green, amber, _ = timing or USUAL
    found = after(state, logged + round(4 * sum(timing or USUAL) / DT), timing)
    assert np.array_equal(found[:, :logged], state)
    past, goes = found[:, logged:], np.isin(found[:, logged:], (*GREEN, *AMBER))
    along = np.repeat([True, False, True, False], 3)
    assert not (goes[along].any(0) & goes[~along].any(0)).any()
    assert np.isin(past, GREEN).any(1).tolist() == [arrow >= 0] * 2 + [True] * 10
    for row in past:
        begins = np.flatnonzero(np.isin(row[1:], GREEN) & ~np.isin(row[:-1], GREEN)) + 1
        for begin in begins[:1]:
            change, end = (begin + round(seconds / DT) for seconds in (green, green + amber))
            assert np.isin(row[begin:change], GREEN).all()
            assert np.isin(row[change:end], AMBER).all()
            assert not np.isin(row[end : end + 1], (*GREEN, *AMBER)).any()
    # After a red for all some are green at once, as long as others.
    assert arrow >= 0 or np.isin(past[:, : round(green / DT)], GREEN).all(1).any()
    # An arrow stays one, as does what is not known or flashes.
    assert (past[arrow] < SignalState.STOP).all() == (state[arrow] < SignalState.STOP).any()
    assert arrow >= 0 or (past[:2] == state[:2, :1]).all()


@given(st.lists(st.floats(-math.pi, math.pi), min_size=2, max_size=8))
def test_streams_that_cross_have_no_phase_together(directions):
    axis, state = np.array(directions), np.full((len(directions), 20), SignalState.STOP, np.uint8)
    goes = np.isin(_planned(state, axis, 2000, DT, USUAL), (*GREEN, *AMBER))
    turn = np.abs(axis[:, None] - axis) % math.pi
    together = (goes[:, None] & goes).any(-1)
    assert (np.minimum(turn, math.pi - turn)[together] <= math.pi / 3 + 1e-6).all()
    assert goes.any(-1).all()


def extended(segment, steps, **how):
    return validate(Onward(**how).extended(segment, LaneGraph(segment.road), steps))


def test_rates_are_those_of_the_log_and_shrink_to_their_mean():
    segment = straight_road(6)
    graph, seconds, came = LaneGraph(segment.road), 50 * DT, np.array([0, 1, 0])
    flow = np.linalg.norm(segment.velocity[:3, 0] + segment.velocity[3:, 0], axis=-1) * seconds / graph.length
    # Agent 1 in lane 1 is first seen later; where all are there throughout, the flow on the lanes counts.
    for log, count in ((hide(segment, 1, slice(0, 1)), came), (segment, flow)):
        mean = (count.sum() + 0.5) / (3 * seconds)
        assert np.allclose(entry_rates(log, graph), (count + PRIOR * mean) / (seconds + PRIOR), rtol=1e-3)
    xs = np.arange(0.0, 101.0, 2.0)
    lines = [np.stack([xs + x, 0 * xs - y], -1) for x, y in ((0, 0), (100, 0), (100, 3.5))]
    pocket = LaneGraph(make_road(lines, successors=[(0, 1)], left=[(2, 1)], right=[(1, 2)]))
    assert [entrances(each).tolist() for each in (graph, pocket)] == [[0, 1, 2], [0]]


def test_as_many_want_to_enter_as_the_rate_says_and_a_longer_time_keeps_who_did():
    segment, rate, steps = straight_road(6), 0.4, 651
    segment.velocity[:] *= np.array([0, 1, 1, 1, 1, 3])[:, None, None]  # one stands, one is faster than it may
    entries = [extended(segment, steps, inflow=rate, seed=seed) for seed in range(4)]
    tries, count = 4 * 3 * (steps - 51), sum(one.num_agents - 6 for one in entries)
    assert abs(count - tries * rate * DT) < 4 * np.sqrt(tries * rate * DT * (1 - rate * DT))
    assert len({content_hash(one) for one in entries}) == 4
    shorter, whole = extended(segment, 301, inflow=rate), entries[0]
    assert 6 < shorter.num_agents < whole.num_agents
    assert np.array_equal(shorter.position, whole.position[: shorter.num_agents, :301])
    rows, later = np.arange(6, whole.num_agents), whole.valid[6:]
    assert later.sum(1).tolist() == later[:, 51:].sum(1).tolist() == [1] * len(rows)
    # Sizes and speeds are those of the log, and everyone begins in its lane.
    place, speed = (part[rows, later.argmax(1)] for part in (whole.position, whole.velocity))
    assert np.allclose(place[:, [0, 2]], 0.5 * whole.size[rows][:, [0, 2]])
    assert set(place[:, 1]) == {0.0, 3.5, 7.0}
    logged = np.linalg.norm(segment.velocity[:, 0], axis=-1)
    assert np.isclose(speed[:, :1], np.minimum(logged[logged > 0], 14), atol=1e-4).any(1).all()


def test_with_rate_0_nobody_enters_and_within_the_log_nothing_changes(tmp_path):
    segment = straight_road(6)
    store, how = fill(tmp_path / "store", [segment, crossing(4)]), {"interactive": "all", "duration": 6}
    with pytest.raises(ConfigError, match="three lengths"):
        SimulateConfig(**how, lights=(np.inf, 3, 2))
    pair = EvaluateConfig(**how), SimulateConfig(**how, inflow=1.0, lights=(5, 3, 2))
    one, two = (crowd_dataset(store, DRIVER, config).scenes([0, 1]) for config in pair)
    assert all(torch.equal(one.get(name), two.get(name)) for name in one.keys())  # noqa: SIM118
    longer = crowd_dataset(store, DRIVER, replace(pair[1], duration=20))
    copy = pickle.loads(pickle.dumps(longer))  # noqa: S301
    assert content_hash(copy.segment(0)) == content_hash(longer.segment(0))
    assert longer.segment(0).num_agents > 6
    # Who stood all along stays, others are seen no more.
    segment.position[2:4], segment.velocity[2:4] = segment.position[2:4, :1], 0
    segment.position[4, 45:], segment.velocity[4, 45:] = segment.position[4, 45], 0
    segment.agent_type[3] = AgentType.PEDESTRIAN
    segment = hide(segment, 5, slice(0, -1))  # seen once, as it drives by
    found = extended(hide(segment, 3, slice(40, None)), 80, inflow=0)
    assert (found.num_agents, found.num_steps, found.logged, found.log_steps) == (6, 80, 51, 51)
    assert found.valid[:, -1].tolist() == [False, False, True, False, False, False]
    assert np.array_equal(found.position[2, -1], segment.position[2, 0])


def test_what_comes_later_changes_nothing_before(tmp_path):
    segments = [crossing(6, steps=11), hide(straight_road(6, steps=11), 4, slice(0, 5))]
    store, found = fill(tmp_path / "store", segments), []
    for seconds in (2, 3, 5):
        config = SimulateConfig(interactive="all", duration=seconds, rollouts=1, search="none", inflow=1.0)
        found.append(simulation(small(), crowd_dataset(store, small(), config).scenes([0, 1]), config))
    for short, long in pairwise(found):
        steps, agents = short.rollouts.state.shape[-3:-1]
        assert long.goal.shape[-1] > agents
        real = short.goal >= 0
        assert torch.equal(short.goal[real], long.goal[..., :agents][real])
        assert torch.equal(short.rollouts.state[..., :6, :], long.rollouts.state[:, :, :steps, :6])


@settings(max_examples=2, deadline=None)
@given(st.integers(0, 100), st.sampled_from([0.3, 1.0]))
def test_nobody_is_placed_into_another(seed, inflow):
    segment = extended(straight_road(6, seed=seed, steps=26), 76, inflow=inflow, seed=seed)
    scenes = scene(segment, list(range(segment.num_agents)), edge=map_edge(LaneGraph(segment.road)))
    found = simulation(DRIVER, scenes, SimulateConfig(rollouts=1)).rollouts
    there, state = found.counted[0, 0].numpy(), found.state[0, 0, 1:].numpy()
    came = [(int(there[:, n].argmax()), n) for n in np.flatnonzero(there.any(0) & ~there[0])]
    assert [step >= 25 for step, _ in came] == [True] * max(len(came), 1)
    size = scenes.box_size[0].numpy() + 0.9
    for step, n in came:
        others = np.flatnonzero(there[step] & (np.arange(len(size)) != n))
        own = np.full(len(others), n)
        boxes = [part for k in (own, others) for part in (state[step, k, :2], state[step, k, 2], size[k])]
        # Nor is anybody nearer ahead than it drives in a second.
        for seconds in (0, 0.25, 0.5, 0.75, 1):
            boxes[0] = state[step, own, :2] + np.array([seconds, 0], "f4") * state[step, own, 3:]
            assert not boxes_overlap(*map(torch.from_numpy, boxes)).any()
            boxes[2], boxes[5] = size[own] - 0.9, size[others] - 0.9
        assert not found.collision[0, 0, step : step + 9, n].any()


def pile_up():
    """Agent 1 drives into agent 2, which stands; agents 0 and 3 are out of the way."""
    road = make_road([np.stack([np.arange(0.0, 301, 2), np.full(151, k * LANE_WIDTH)], -1) for k in range(2)])
    time, zero, pace = np.arange(21) * DT, np.zeros((4, 21)), np.array([3.0, 10.0, 0, 0])[:, None]
    x = np.array([10.0, 50, 70, 150])[:, None] + pace * time
    y = np.array([LANE_WIDTH, 0, 0, 0])[:, None] + zero
    return make_segment(road, np.stack([x, y], -1), zero, np.stack([pace + zero, zero], -1))


@pytest.mark.parametrize("after", ["go-on", "stop", "remove", "respawn"])
def test_what_becomes_of_agents_that_collide(after):
    graph = LaneGraph((segment := pile_up()).road)
    scenes = scene(segment, [0, 1, 2, 3], graph, edge=map_edge(graph))
    env = DrivingEnv(scenes, None, ObservationConfig.nothing(), after_collision=after)
    now, seen = env.with_goals(env.start(torch.zeros(1, dtype=torch.int64))), []
    for _ in range(20):
        seen.append(now)
        now = env.step(now.set(keys.ACTION, torch.full((1, 4), 73)))["next"]
    read = (keys.COLLISION, keys.VALID, keys.STATE, keys.PROGRESS)
    hit, there, state, come = (torch.stack([one[key] for one in seen])[:, 0] for key in read)
    hit, first = hit.squeeze(-1), int(hit.any(1).int().argmax())
    assert (first > 0, hit[first].tolist()) == (True, [False, True, True, False])
    assert (there & ~hit)[:, [0, 3]].all()
    assert state[-1, 0, 0] > state[first, 0, 0]
    both, later = slice(1, 3), slice(first + 1, None)
    if after in ("go-on", "stop"):
        assert there.all()
        assert bool(hit[later, both].all()) == bool(not state[later, both, 3].any()) == (after == "stop")
        assert torch.equal(state[first, both, :3], state[-1, both, :3]) == (after == "stop")
    elif after == "remove":
        assert not there[later, both].any()
    else:
        back = int(there[later, 1].int().argmax())
        assert back > 0
        assert torch.equal(state[later][back, 1, :2], state[0, 1, :2])
        assert come[first, 1] > come[later][back, 1] == 0


def test_wrong_settings_are_refused():
    for steps, why in ((3000, "log, at most 512"), (9000, "at most 219"), (10_001, "steps, at most 10000")):
        with pytest.raises(DataError, match=why):
            extended(straight_road(), steps, inflow=1.0)
    lights = (3.0, 1.0), (0.0, 3.0, 2.0), (3.0, float("nan"), 2.0)
    for wrong in ({"inflow": -0.1}, {"inflow": 2.0}, *({"lights": one} for one in lights)):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            SimulateConfig(**wrong)
    for after, why in (("remove", "'remove' needs open traffic"), ("explode", "after_collision is one of")):
        with pytest.raises(ConfigError, match=why):
            DrivingEnv(scene(pile_up(), [0, 1]), after_collision=after)


def test_rollouts_past_the_log_are_kept_and_judged_apart(tmp_path, capsys):
    store = fill(tmp_path / "store", [crossing(6, steps=21), pile_up()])
    config = SimulateConfig(interactive="all", duration=9, rollouts=2, inflow=0.5)
    dataset, sim = crowd_dataset(store, DRIVER, config), tmp_path / "sim"
    command = ["simulate", DRIVER.name, "--data", str(store.path), "--out", str(sim), "--interactive", "all"]
    assert cli.main([*command, "--duration", "9", "--rollouts", "2", "--inflow", "0.5"]) == 0
    for i, one in enumerate(load_rollouts(sim)):
        assert content_hash(one.segment) == content_hash(dataset.segment(i))
        assert (one.steps, one.segment.logged) == (45, 21)
        assert any(world_of(one, 0).valid[6:].any(1))
        assert not one.logged(one.agents)[:, 21:].any()
    # In batches of one the bytes are the same: everyone meets the same demand.
    again = save_simulation(tmp_path / "again", DRIVER, dataset, replace(config, batch=1))
    assert [entry.sha256 for entry in again.entries] == [entry.sha256 for entry in load_rollouts(sim).entries]
    parts, rows = (found := report(again)).past_log(), found.rows
    minutes = sum(row["steps"] for row in rows) * DT / 60
    logged = sum(one.counted[:, :20].sum() for one in again) * DT / 60
    assert [part["agent_minutes"] for part in parts.values()] == pytest.approx([logged, minutes - logged])
    assert sum(part["collisions"] for part in parts.values()) == sum(row["collisions"] for row in rows) > 0
    # What is compared with the log ends with it.
    assert all(row["logged_steps"] <= 6 * 20 for row in rows)
    assert cli.main(["report", str(sim)]) == 0
    assert "past log" in capsys.readouterr().out
    assert json.loads((sim / "report.json").read_text())["parts"] == parts
    assert "past its end" in (sim / "report.html").read_text()
    nobody = crowd_dataset(store, load_agent("playback"), config)  # who would drive those that enter
    assert nobody.segment(0).num_agents == 6
    short = replace(config, duration=4)
    within = save_simulation(tmp_path / "short", DRIVER, crowd_dataset(store, DRIVER, short), short)
    assert report(within).past_log() == {}
    with pytest.raises(ConfigError, match="past a log can't be compared"):
        evaluate(DRIVER, dataset, config)
    for closed in (EvaluateConfig(duration=9, interactive="all"), SimulateConfig(duration=9)):
        with pytest.raises(DataError, match="4 s, 9 are asked for"):
            crowd_dataset(store, DRIVER, closed).scenes([0])
    with pytest.raises(ConfigError, match="--inflow needs"):
        crowd_dataset(store, DRIVER, SimulateConfig(duration=9, open_traffic=True, inflow=1.0))
