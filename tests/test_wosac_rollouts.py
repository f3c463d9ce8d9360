"""Rollouts for the WOSAC score: of WOMD scenarios as a submission, of any run segment or store for its score."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers_agents import small
from helpers_segments import crossing, hide, straight_road
from helpers_sources import write_records
from helpers_store import fill
from helpers_wosac import womd_record
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import EvaluateConfig, WosacSettings
from symphony.data.resample import resample, wrap
from symphony.data.segment import AgentType, SignalState, validate
from symphony.data.sources.womd import scenario_to_segment
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError, SymphonyError
from symphony.evaluation.table import WOSAC, Entry, compare
from symphony.rollouts.driving import simulation
from symphony.wosac import constant_velocity, evaluate_wosac, log_playback, wosac_rollouts, wosac_window
from symphony.wosac.evaluate import simulated_how, wosac_scenario
from symphony.wosac.records import logged_scenario, parse_scenario, read_scenarios
from symphony.wosac.scorer import SimulatedRollouts, compute_features, score
from symphony.wosac.scorer.scenario import STATES
from symphony.wosac.simulate import AHEAD, COURSE, PACE, future_log, history_only, standing, walks
from symphony.wosac.simulate import between_decisions as between
from symphony.wosac.submission import check_submission, required_agents
from symphony.wosac.table import COLUMNS, wosac_table

AGENT = "pretrained:bc_ts_h"
BASELINES = ["log playback", "constant velocity", "intelligent driver model"]
RANDOM = "random"
PLAIN = WosacSettings(search="none")
SEARCH = WosacSettings(search="tree", branches=2)
TOLD = """
--account-name somebody@example.org --unique-method-name made --num-model-parameters 200K --uses-lidar-data False
--uses-camera-data False --uses-public-model-pretraining False
--acknowledge-complies-with-closed-loop-requirement True
"""


def mixed_record(name="0123456789abcdef"):
    """Three vehicles, a pedestrian, and a vehicle that is not there at step 10."""
    record = womd_record(name, tracks=5)
    record.tracks[0].object_type = AgentType.PEDESTRIAN
    record.tracks[1].states[10].valid = False
    return record


def mixed_segment():
    return validate(scenario_to_segment(mixed_record()))


def same(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("object_id", *STATES))


def submitted(data, out, *more):
    return main(["wosac", "submit", *more, "--data", str(data), "--out", str(out), *TOLD.split()])


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.2, 0.25, 0.4]))
def test_states_between_decisions_are_those_of_resampling(seed, dt):
    segment, rng = straight_road(num_agents=2, steps=round(8 / dt) + 1, dt=dt), np.random.default_rng(seed)
    position = rng.normal(0, 30, segment.position.shape).astype(np.float32)
    heading = rng.uniform(-10, 10, segment.heading.shape).astype(np.float32)
    segment = segment.replace(position=position, heading=heading)
    states = np.concatenate([position[..., :2], heading[..., None]], -1).astype(np.float64)
    found = between(states.swapaxes(0, 1)[None], dt)[0]
    expected = segment if dt == 0.1 else resample(segment, 0.1)
    np.testing.assert_allclose(found[..., :2], expected.position[:, 1:, :2], atol=1e-4)
    np.testing.assert_allclose(wrap(found[..., 2] - expected.heading[:, 1:]), 0, atol=1e-4)
    assert (np.abs(found[..., 2]) <= np.pi).all()


@pytest.mark.parametrize("settings", [PLAIN, SEARCH], ids=["none", "tree"])
def test_nothing_of_the_future_is_used(settings):
    agent, segment, settings = small(), mixed_segment(), replace(settings, horizon=1.0)
    later = np.arange(segment.num_steps) > 10
    other = segment.replace(
        position=np.where(later[:, None], segment.position + 7, segment.position),
        heading=np.where(later, segment.heading + 1, segment.heading),
        velocity=np.where(later[:, None], -segment.velocity, segment.velocity),
        valid=segment.valid & ~later,
        signal_state=np.where(later, SignalState.STOP, segment.signal_state).astype(np.uint8),
    )
    found = wosac_rollouts(agent, segment, settings)
    assert same(found, wosac_rollouts(agent, other, settings))
    # The present is used.
    assert not same(found, wosac_rollouts(agent, segment.replace(velocity=0.5 * segment.velocity), settings))


@pytest.mark.parametrize("settings", [PLAIN, SEARCH], ids=["none", "tree"])
def test_vehicles_are_driven_and_people_walk_on(settings, monkeypatch):
    # Trees are independent, however many are searched at a time.
    monkeypatch.setattr("symphony.wosac.simulate.AT_ONCE", 12 * 2 * 3)
    segment, settings = mixed_segment(), replace(settings, horizon=1.0)
    found = wosac_rollouts(small(), segment, settings)
    assert found.object_id.tolist() == [100, 102, 103, 104]
    assert all(getattr(found, name).shape == (32, 4, 10) for name in STATES)
    start, steady = segment.origin[0] + segment.position[0, 10, 0], constant_velocity(segment, 10)
    assert (np.abs((found.x[:, 0] - start) / (steady.x[:, 0] - start) - 1) < 0.5).all()
    assert same(wosac_rollouts(load_agent("constant_velocity"), segment, replace(PLAIN, horizon=1.0)), steady)
    # Every rollout is one of its own.
    assert len(np.unique(found.x[:, :, -1], axis=0)) == 32
    assert (found.z == found.z[:1, :, :1]).all()
    other = wosac_rollouts(small(), segment, replace(settings, seed=1))
    assert not np.isin(other.x[:, 1:, -1], found.x[:, 1:, -1]).any()
    # They begin where the log was last seen: 0.1 s at speeds between 10 and 15 m/s further on.
    now = segment.position[[2, 3, 4], 10, 0] + segment.origin[0]
    assert (np.abs(found.x[:, 1:, 0] - now - 1.2) < 1).all()


@pytest.fixture
def seen(monkeypatch):
    """Record what is simulated: scenes and configurations."""
    found = []

    def spied(agent, scenes, config):
        found.append((scenes, config))
        return simulation(agent, scenes, config)

    monkeypatch.setattr("symphony.wosac.simulate.simulation", spied)
    return found


def test_who_stands_stays_and_is_in_the_way(seen):
    segment = mixed_segment()
    velocity, position = segment.velocity.copy(), segment.position.copy()
    position[2], velocity[2] = position[2, 10], 0.1
    red = np.full_like(segment.signal_state, SignalState.STOP)
    still = segment.replace(position=position, velocity=velocity, signal_state=red)
    found = wosac_rollouts(small(), still, replace(PLAIN, horizon=2.0))
    assert np.ptp(found.x[:, 1], axis=-1).max() == 0
    assert np.ptp(found.x[:, 2:], axis=-1).min() > 5
    ((scenes, _),) = seen
    assert int(scenes.interactive_valid.sum()) == 2
    # The others see it where it stands.
    assert float((scenes.log_state[0, ..., 0] - position[2, 10, 0]).abs().amin(-1).max()) < 1e-4


def test_goals_of_the_log_are_those_that_were_taken(seen):
    segment = wosac_window(crossing(num_agents=3), 40)
    log = future_log(segment)
    assert np.array_equal(history_only(segment, 0.2).position[:, 0], log.position[:, 0])
    for logged in (False, True):
        wosac_rollouts(small(), segment, replace(PLAIN, horizon=4.0, logged_goals=logged))
    (sampled, before), (followed, config) = seen
    assert (before.logged_goals, config.logged_goals) == (False, True)
    assert np.array_equal(sampled.route_point, followed.route_point)
    for k in range(3):
        # The logged route passes near every logged position; so did the vehicle.
        route = followed.whole_route(0, k, int(followed.route_logged[0, k])).numpy()
        away = np.linalg.norm(log.position[k, ::5, None, :2] - route[None], axis=-1).min(1)
        assert away.max() < 3


def test_lights_keep_the_latest_state_seen():
    segment = mixed_segment()
    state = np.full((1, 91), SignalState.GO, np.uint8)
    state[0, 4], state[0, 5:11] = SignalState.STOP, SignalState.UNKNOWN
    start = validate(history_only(segment.replace(signal_state=state), 0.2))
    assert (start.num_steps, np.unique(start.signal_state).tolist()) == (41, [SignalState.STOP])
    state[0, :11] = SignalState.UNKNOWN  # That there is a light at all is then seen later.
    assert len(validate(history_only(segment.replace(signal_state=state), 0.2)).signal_lane) == 0


def test_submission(tmp_path, capsys):
    data, out = tmp_path / "made.tfrecord", tmp_path / "out.tar.gz"
    write_records(data, [one.SerializeToString() for one in (mixed_record(), womd_record("bbbb"))])
    for more, text in (
        ((AGENT, "--shards", "3"), "don't fill 3 shards"),
        ((AGENT, "--logged-goals"), "knows no log"),
        ((AGENT, "--horizon", "5"), "a submission has 8 s"),
    ):
        assert submitted(data, out, *more) != 0
        assert text in capsys.readouterr().err
    assert not out.exists()
    assert submitted(data, out, "constant_velocity", "--search", "none") == 0
    report = check_submission(out, required_agents(data))
    assert (report.problems, len(report.scenarios), len(report.shards)) == ([], 2, 2)


def check_scenario_of(record):
    segment = validate(scenario_to_segment(record))
    window, rollouts = wosac_window(segment), constant_velocity(segment)
    found, expected = (score(one, rollouts) for one in (wosac_scenario(window), logged_scenario(record)))
    assert found == pytest.approx(expected, abs=1e-6)
    assert np.array_equal(window.position, segment.position)


def test_scenario_of_a_segment_is_that_of_its_record():
    check_scenario_of(mixed_record())


@pytest.mark.samples
def test_a_real_scenario(samples):
    file = samples / "womd" / "motion_data_one_scenario.tfrecord"
    ((_, number, payload),) = read_scenarios(file)
    check_scenario_of(parse_scenario(payload, file, number))


def test_what_is_scored():
    segment = straight_road(num_agents=4)
    marked = segment.replace(predict=np.array([2], np.int32))
    # An agent that comes later is not.
    late = hide(segment, 3, slice(0, 6))
    for one, rows in ((segment, [0, 1, 2, 3]), (late, [0, 1, 2]), (marked, [segment.ego, 2])):
        assert wosac_scenario(wosac_window(one)).evaluated.tolist() == sorted(segment.agent_id[rows])


def test_a_world_with_a_far_origin_is_scored_as_one_about_its_own():
    """Scores are in float32, which at 4 000 km, as in UTM coordinates, has steps of a quarter of a metre."""
    segment, found = crossing(3), []
    for origin in ((0.0, 0.0, 0.0), (664_430.0, 3_998_210.0, 600.0)):
        window = validate(wosac_window(segment.replace(origin=np.array(origin))))
        found.append(score(wosac_scenario(window), constant_velocity(window)))
    assert found[0] == found[1]
    near = segment.replace(origin=np.array([7000.0, -3000.0, 20.0]))
    assert wosac_window(near).origin.tolist() == near.origin.tolist()


def test_lost_agents_are_nobodys_obstacle_in_the_log():
    window = wosac_window(hide(straight_road(num_agents=4), 3, slice(20, None)))
    log = log_playback(window)
    assert np.array_equal(log.x[0, 3] > 9e4, ~window.valid[3, 11:])
    found = score(wosac_scenario(window), log)
    assert (found["simulated_collision_rate"], found["min_ade"]) == (0, 0)
    assert found["metametric"] > 0.7


def test_short_logs_have_a_shorter_history():
    segment = straight_road(steps=43)  # 8.4 s
    window = validate(wosac_window(segment))
    assert window.valid.tolist() == [[step >= 6 for step in range(91)]] * segment.num_agents
    np.testing.assert_allclose(window.position[:, 10], segment.position[:, 2], atol=1e-5)
    # What is not known goes back at the first velocity: no jump at the first step that is.
    np.testing.assert_allclose(np.diff(window.position[..., :2], 2, axis=1), 0, atol=1e-4)
    assert score(wosac_scenario(window), constant_velocity(window))["min_ade"] < 0.01
    with pytest.raises(DataError, match=r"has 7\.8 s, the score needs 8"):
        wosac_window(straight_road(steps=40))
    with pytest.raises(DataError, match="field current_step: is 0, needs 10"):
        constant_velocity(straight_road(steps=5, dt=0.1))


def test_a_shorter_horizon_is_the_beginning_of_the_whole():
    segment, short = resample(crossing(num_agents=4), 0.1), replace(PLAIN, horizon=3.5)
    window, whole = wosac_window(segment, short.future), wosac_window(segment)
    assert window.num_steps == 46
    long = wosac_rollouts(small(), whole, PLAIN)
    cut = SimulatedRollouts(long.object_id, *(getattr(long, name)[..., :35] for name in STATES))
    assert same(wosac_rollouts(small(), window, short), cut)
    first, second = (compute_features(wosac_scenario(one), by) for one, by in ((whole, long), (window, cut)))
    for name in first.log.keys() - {"average_displacement_error"}:
        for a, b in ((first.log, second.log), (first.simulated, second.simulated)):
            # The last two steps lack the neighbours that accelerations are made of.
            assert torch.equal(a[name][..., :33], b[name][..., :33]), name
    with pytest.raises(DataError, match=r"field x: has shape \(32, 4, 80\), expected \(32, 4, 35\)"):
        score(wosac_scenario(window), long)


def halted(window):
    """Let all agents stand where they are at the current step."""
    now, still = np.full(window.num_steps, window.current_step), np.zeros_like(window.velocity)
    return window.replace(position=window.position[:, now], heading=window.heading[:, now], velocity=still)


@pytest.mark.parametrize(("away", "aside", "state", "stays"), [
    (20.0, 0.0, SignalState.STOP, True), (20.0, 0.0, SignalState.UNKNOWN, True),
    (20.0, 0.0, SignalState.GO, False), (20.0, 0.0, SignalState.ARROW_GO, False),
    (20.0, 5.0, SignalState.GO, True),  # Another lane's.
    (-5.0, 0.0, SignalState.GO, True), (AHEAD + 1, 0.0, SignalState.GO, True),
])  # fmt: skip
def test_who_stands_goes_on_green(away, aside, state, stays):
    """The first agent sees a light at some distance ahead and to its left."""
    window = wosac_window(crossing(num_agents=3))
    now, angle, point = window.current_step, window.heading[0, 10], np.full_like(window.signal_point, 1e4)
    cos, sin = np.cos(angle), np.sin(angle)
    point[0, :2] = window.position[0, now, :2] + [away * cos - aside * sin, away * sin + aside * cos]
    window = window.replace(signal_point=point, signal_state=np.full_like(window.signal_state, state))
    assert not standing(window).any()
    later = halted(window)
    later.position[:, 11:] += 9  # What comes later is not known.
    assert standing(halted(window))[0] == standing(later)[0] == stays


def test_only_vehicles_that_have_stood_for_a_second_stand():
    window = halted(wosac_window(straight_road(num_agents=4)))
    kinds, position, valid = window.agent_type.copy(), window.position.copy(), window.valid.copy()
    kinds[1] = AgentType.PEDESTRIAN
    position[2, :3, 0] -= 1.0  # It has just come to a stand.
    valid[3, :10] = False  # Nobody knows what it did before.
    found = standing(window.replace(agent_type=kinds, position=position, valid=valid))
    assert found.tolist() == [True, False, False, True]


def test_past_the_edge_of_the_map_vehicles_keep_their_velocity():
    window = wosac_window(straight_road(num_agents=3))
    end, position = window.road.lanes[0][-1, 0], window.position.copy()
    position[..., 0] += (end - 40 - position[:, 10, 0])[:, None]
    position[2, :, 0] += 70.0  # It is past the edge already.
    window = window.replace(position=position)
    found = wosac_rollouts(small(), window, PLAIN)
    np.testing.assert_array_equal(found.x[:, 2], constant_velocity(window).x[:, 2])
    x = found.x[:, :2] - window.origin[0]
    steps = np.diff(np.stack([x, found.y[:, :2]], -1), axis=2)
    changes = np.abs(np.diff(steps, axis=2)).max(-1)
    gone = x[..., :-2] > end + 4.0  # A decision farther than the edge.
    assert 0.3 < gone.mean() < 0.7
    assert 10 * changes[gone].max() < 1e-2 < changes[~gone].max()
    along = np.stack([np.cos(found.heading), np.sin(found.heading)], -1)[:, :2, :-2]
    away = np.linalg.norm(steps[:, :, :-1], axis=-1, keepdims=True)
    np.testing.assert_allclose((steps[:, :, :-1] - along * away)[gone], 0, atol=1e-3)


def test_people_keep_their_velocity_but_for_pace_and_course_and_turn_as_they_did():
    window = wosac_window(straight_road(num_agents=3))
    rows, now, heading = np.array([0, 2]), window.current_step, window.heading.copy()
    found = walks(window, rows, 32, 80, 0)
    assert found.shape == (32, 2, 80, 3)
    start = np.broadcast_to(window.position[rows, now, None, :2], (32, 2, 1, 2))
    steps = np.diff(np.concatenate([start, found[..., :2]], 2), axis=2)
    np.testing.assert_allclose(steps, steps[:, :, :1].repeat(80, 2), atol=1e-5)  # Straight, at one speed.
    velocity, logged = steps[:, :, 0] / window.dt, window.velocity[rows, now]
    pace = np.linalg.norm(velocity, axis=-1) / np.linalg.norm(logged, axis=-1)
    assert 1 - PACE <= pace.min() < 1 < pace.max() <= 1 + PACE
    course = np.arctan2(velocity[..., 1], velocity[..., 0]) - np.arctan2(logged[:, 1], logged[:, 0])
    assert -COURSE - 1e-6 <= course.min() < 0 < course.max() <= COURSE + 1e-6
    assert len(np.unique(found[:, :, -1, 0])) == 64
    # One agent's way depends on nobody else's; another seed gives another.
    np.testing.assert_array_equal(walks(window, rows[1:], 32, 80, 0), found[:, 1:])
    assert not np.array_equal(walks(window, rows, 32, 80, 1), found)
    heading[0, now - 10 : now + 1] += 0.1 * (np.arange(11) % 2)
    turned = walks(window.replace(heading=heading), rows[:1], 4, 80, 0)[..., 2]
    np.testing.assert_allclose(np.abs(np.diff(turned, axis=-1)), 0.1, atol=1e-5)
    assert len(np.unique(turned[:, 0, -1])) == 4


def test_settings_are_those_of_the_evaluation():
    config = EvaluateConfig(search="tree", branches=3, rule="replace", threshold=1.0, goals="branch", seed=4)
    made = WosacSettings.of(config).config(32, 9)
    assert (made.rollouts, made.trees, made.seed) == (32, 32, 9)
    assert (made.branches, made.rule, made.threshold, made.goals) == (3, "replace", 1.0, "branch")
    # What is left open is the agent's own, and the record says what that is.
    how = simulated_how(load_agent(AGENT), WosacSettings.of(EvaluateConfig(search="tree")))
    assert {"rule": "replace", "goals": "branch"}.items() <= how.items()
    with pytest.raises(ConfigError, match="score is one of"):  # Who simulates must not know what is scored.
        WosacSettings.of(EvaluateConfig(score="flags"))


def test_evaluation(tmp_path):
    logs = [straight_road(2, seed=k, group=f"recording {k // 2}") for k in range(3)]
    store, out = tmp_path / "store", tmp_path / "scores.json"
    fill(store, logs)

    def record(*more):
        assert main(["wosac", "evaluate", AGENT, "--data", str(store), "--json", str(out), *more]) == 0
        return json.loads(out.read_text())

    found = record("--search", "none", "--horizon", "1")
    assert (found["objects"], found["hertz"]) == (6, [5.0])
    assert list(found["agents"]) == ["playback", "constant_velocity", "idm", "random", AGENT]
    assert found["how"] == {"search": "none", "seed": 0, "logged_goals": False, "horizon": 1.0, "pace": 0.25}
    for numbers in found["agents"].values():
        each = [one["metametric"] for one in numbers["segments"].values()]
        assert numbers["metametric"] == pytest.approx(np.mean(each))
        assert numbers["metametric_se"] >= 0
    window = wosac_window(logs[1], 10)
    steady = found["agents"]["constant_velocity"]["segments"][logs[1].segment_id]
    assert steady == pytest.approx(score(wosac_scenario(window), constant_velocity(window, future=10)))
    # One recording has no error; a part of the store can be named; baselines search for nothing.
    found = record("--search", "tree", "--branches", "2", "--horizon", "1", "--segments", "2", "--config", "2024")
    assert (found["config"], found["how"]["search"]) == ("2024", "tree")
    assert list(found["agents"][AGENT]["segments"]) == [logs[2].segment_id]
    assert found["agents"][AGENT]["metametric_se"] is None


def test_a_segment_that_cannot_be_scored_ends_no_others_whatever_the_workers(tmp_path):
    whole = [crossing(num_agents=2, seed=k) for k in range(2)]
    road, walking = whole[0].road, np.full_like(whole[0].agent_type, AgentType.PEDESTRIAN)
    bare = whole[0].replace(segment_id="bare", road=replace(road, boundary=road.boundary.of([])))
    walkers, short = whole[0].replace(segment_id="walkers", agent_type=walking), straight_road(2, steps=8)
    fill(tmp_path / "store", [bare, whole[0], walkers, short, whole[1]])
    agent, store, done = load_agent(RANDOM), SegmentStore(tmp_path / "store"), []

    def evaluated(items, seed=0, workers=1, **changes):
        settings = replace(PLAIN, workers=workers, seed=seed, horizon=2.0)
        changes |= {"baselines": False, "progress": lambda *at: done.append(at)}
        return evaluate_wosac(agent, store, items, settings, **changes)

    found = evaluated(range(5))
    assert found.segments == [whole[0].segment_id, whole[1].segment_id]
    assert [entry["segment"] for entry in found.record()["left_out"]] == ["bare", "walkers", short.segment_id]
    assert done == [(k, 5) for k in range(1, 6)]
    others = [evaluated([1, 4], workers=2), evaluated([1, 4], seed=1)]
    assert [found.numbers(RANDOM) == other.numbers(RANDOM) for other in others] == [True, False]
    for items, strict, text in ((range(5), True, "no road edge"), ([2, 0], False, "time_to_collision")):
        with pytest.raises(SymphonyError, match=text):
            evaluated(items, strict=strict)


def test_the_record_has_the_score_and_tables_have_its_columns(tmp_path, capsys, monkeypatch):
    usual = WosacSettings.of
    monkeypatch.setattr(WosacSettings, "of", lambda config: replace(usual(config), horizon=1.0))
    fill(tmp_path / "store", [straight_road(2, 16, seed=k, group=f"recording {k}") for k in range(2)])
    one, data = tmp_path / "one.json", str(tmp_path / "store")
    how = ("--json", str(one), "--rollouts", "2", "--metrics", "wosac")
    assert main(["evaluate", RANDOM, "--data", data, *how]) == 0
    record = json.loads(one.read_text())
    scores, whole = record["wosac"], record["wosac"]["agents"]
    for at, name in ((record, RANDOM), (record["playback"], "playback")):
        assert at["wosac_min_ade"] == whole[name]["min_ade"]
        assert at["wosac_metametric_se"] == whole[name]["metametric_se"]
    assert 0 < record["wosac_metametric"] < record["playback"]["wosac_metametric"] < 1
    # The table of runs has its columns where every run has them, of one year.
    kept = record | {"run": {"updates": 0, "named": False, "checkpoint": 0}}
    entries = [Entry(Path(m), {"method": m, "seed": 0}, m, kept) for m in ("bc", "bc_h")]
    assert set(WOSAC) <= set(compare(entries, "main")["columns"])
    other = {key: value for key, value in kept.items() if not key.startswith("wosac")}
    without = compare([entries[0], replace(entries[1], record=other)], "main")["columns"]
    assert not set(WOSAC) & set(without)
    year = kept | {"wosac": scores | {"config": "2024"}}
    with pytest.raises(ConfigError, match="WOSAC scores of 2024, 2025"):
        compare([entries[0], replace(entries[1], record=year)], "main")
    assert "pace 0.5" in wosac_table(scores | {"how": scores["how"] | {"pace": 0.5}})
    with pytest.raises(ConfigError, match="twice"):
        evaluate_wosac(load_agent("playback"), SegmentStore(tmp_path / "store"), [0, 0], WosacSettings())
    # The table of scores.
    for agents, drivers in ((whole, BASELINES), ({RANDOM: whole[RANDOM]}, [])):
        lines = wosac_table(scores | {"agents": agents}).splitlines()
        rows = [line.split("|")[1:] for line in lines if line[:2] == "| "]
        assert [row[0].strip() for row in rows] == ["", "---", *drivers, "random, no search"]
        for column, cell in zip(COLUMNS, rows[-1][1:], strict=False):
            value, error = column.scale * whole[RANDOM][column.key], 0.51 * 10**-column.digits
            assert float(cell.split(" ± ")[0]) == pytest.approx(value, abs=error)
