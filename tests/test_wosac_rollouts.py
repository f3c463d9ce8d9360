"""Rollouts for the WOSAC score: of WOMD scenarios as a submission, of any run segment for its score."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers_agents import small
from helpers_segments import crossing, hide, straight_road
from helpers_wosac import womd_record
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import WosacSettings
from symphony.data.resample import resample, wrap
from symphony.data.segment import AgentType, RunSegment, SignalState, validate
from symphony.data.sources import womd_pb2 as pb
from symphony.data.sources.tfrecord import write_records
from symphony.data.sources.womd import scenario_to_segment
from symphony.errors import ConfigError, DataError
from symphony.rollouts.driving import simulation
from symphony.wosac.records import logged_scenario, parse_scenario, read_scenarios
from symphony.wosac.scorer import SimulatedRollouts, compute_features, score
from symphony.wosac.scorer.scenario import STATES
from symphony.wosac.segments import log_playback, wosac_scenario, wosac_window
from symphony.wosac.simulate import (
    between_decisions,
    constant_velocity,
    future_log,
    history_only,
    wosac_rollouts,
)
from symphony.wosac.submission import check_submission, required_agents

AGENT = "pretrained:bc_ts_h"
PLAIN = WosacSettings(search="none")
SEARCH = WosacSettings(search="tree", branches=2)
NO = ("uses-lidar-data", "uses-camera-data", "uses-public-model-pretraining")
TEXTS = {"account-name": "somebody@example.org", "unique-method-name": "made", "num-model-parameters": "200K"}
YES = {"acknowledge-complies-with-closed-loop-requirement": "True"}
ANSWERS = {**TEXTS, **dict.fromkeys(NO, "False"), **YES}
META = [word for name, answer in ANSWERS.items() for word in (f"--{name}", answer)]


def mixed_record(name: str = "0123456789abcdef") -> pb.Scenario:
    """Three vehicles, a pedestrian, and a vehicle that is not there at step 10."""
    record = womd_record(name, tracks=5)
    record.tracks[0].object_type = AgentType.PEDESTRIAN
    record.tracks[1].states[10].valid = False
    return record


def mixed_segment() -> RunSegment:
    return validate(scenario_to_segment(mixed_record()))


def same(a: SimulatedRollouts, b: SimulatedRollouts) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("object_id", *STATES))


def write(path: Path, *records: pb.Scenario) -> Path:
    write_records(path, [record.SerializeToString() for record in records])
    return path


# --- simulation ---


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.2, 0.25, 0.4]))
def test_states_between_decisions_are_those_of_resampling(seed: int, dt: float) -> None:
    segment, rng = straight_road(num_agents=2, steps=round(8 / dt) + 1, dt=dt), np.random.default_rng(seed)
    shape = segment.heading.shape
    segment = segment.replace(
        position=rng.normal(0, 30, (*shape, 3)).astype(np.float32),
        heading=rng.uniform(-10, 10, shape).astype(np.float32),
    )
    states = np.concatenate([segment.position[..., :2], segment.heading[..., None]], -1).astype(np.float64)
    found = between_decisions(states.swapaxes(0, 1)[None], dt)[0]
    expected = segment if dt == 0.1 else resample(segment, 0.1)
    np.testing.assert_allclose(found[..., :2], expected.position[:, 1:, :2], atol=1e-4)
    np.testing.assert_allclose(wrap(found[..., 2] - expected.heading[:, 1:]), 0, atol=1e-4)
    assert (np.abs(found[..., 2]) <= np.pi).all()


@pytest.mark.parametrize("settings", [PLAIN, SEARCH], ids=["none", "tree"])
def test_nothing_of_the_future_is_used(settings: WosacSettings) -> None:
    agent, segment, settings = small(), mixed_segment(), replace(settings, horizon=2.0)
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
    moved = segment.replace(velocity=0.5 * segment.velocity)
    assert not same(found, wosac_rollouts(agent, moved, settings))


@pytest.mark.parametrize("settings", [PLAIN, SEARCH], ids=["none", "tree"])
def test_vehicles_are_driven_and_people_walk_on(
    settings: WosacSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Trees are independent, however many are searched at a time.
    monkeypatch.setattr("symphony.wosac.simulate.AT_ONCE", 12 * 2 * 3)
    segment, settings = mixed_segment(), replace(settings, horizon=3.0)
    found = wosac_rollouts(small(), segment, settings)
    assert found.object_id.tolist() == [100, 102, 103, 104]
    assert all(getattr(found, name).shape == (32, 4, 30) for name in STATES)
    start, steady = segment.origin[0] + segment.position[0, 10, 0], constant_velocity(segment, 30).x[:, 0]
    assert (np.abs((found.x[:, 0] - start) / (steady - start) - 1) < 0.5).all()
    # Every rollout is one of its own.
    assert len(np.unique(found.x[:, :, -1], axis=0)) == 32
    assert (found.z == found.z[:1, :, :1]).all()
    other = wosac_rollouts(small(), segment, replace(settings, seed=1))
    assert not np.isin(other.x[:, 1:, -1], found.x[:, 1:, -1]).any()
    # They begin where the log was last seen: 0.1 s at speeds between 10 and 15 m/s further on.
    now = segment.position[[2, 3, 4], 10, 0] + segment.origin[0]
    assert (np.abs(found.x[:, 1:, 0] - now - 1.2) < 1).all()


def test_who_stands_stays_and_is_in_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    segment = mixed_segment()
    velocity, position = segment.velocity.copy(), segment.position.copy()
    position[2], velocity[2] = position[2, 10], 0.1
    seen = []

    def spied(agent: Any, scenes: Any, config: Any) -> Any:
        seen.append(scenes)
        return simulation(agent, scenes, config)

    monkeypatch.setattr("symphony.wosac.simulate.simulation", spied)
    red = np.full_like(segment.signal_state, SignalState.STOP)
    still = segment.replace(position=position, velocity=velocity, signal_state=red)
    found = wosac_rollouts(small(), still, replace(PLAIN, horizon=2.0))
    assert np.ptp(found.x[:, 1], axis=-1).max() == 0
    assert np.ptp(found.x[:, 2:], axis=-1).min() > 5
    (scenes,) = seen
    assert int(scenes.interactive_valid.sum()) == 2
    # The others see it where it stands.
    standing = int((scenes.log_state[0, 0, :, 0] - position[2, 10, 0]).abs().argmin())
    np.testing.assert_allclose(scenes.log_state[0, :, standing, 0], position[2, 10, 0], atol=1e-4)


def test_goals_of_the_log_are_those_that_were_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    segment = wosac_window(crossing(num_agents=3))
    start, log = history_only(segment, 0.2), future_log(segment)
    assert np.array_equal(start.position[:, 0], log.position[:, 0])
    assert np.array_equal(start.agent_id, log.agent_id)
    seen: list[Any] = []

    def stop(agent: Any, scenes: Any, config: Any) -> Any:
        seen.append((scenes, config))
        raise DataError("enough")

    monkeypatch.setattr("symphony.wosac.simulate.simulation", stop)
    for logged in (False, True):
        with pytest.raises(DataError, match="enough"):
            wosac_rollouts(load_agent(AGENT), segment, replace(PLAIN, logged_goals=logged))
    (sampled, before), (followed, config) = seen
    assert (before.logged_goals, config.logged_goals) == (False, True)
    assert np.array_equal(sampled.route_point, followed.route_point)
    for k in range(3):
        # The logged route passes near every logged position; so did the vehicle.
        route = followed.whole_route(0, k, int(followed.route_logged[0, k])).numpy()
        away = np.linalg.norm(log.position[k, ::10, None, :2] - route[None], axis=-1).min(1)
        assert away.max() < 3


def test_lights_keep_the_latest_state_seen() -> None:
    segment = mixed_segment()
    state = np.full((1, 91), SignalState.GO, np.uint8)
    state[0, 4], state[0, 5:11] = SignalState.STOP, SignalState.UNKNOWN
    start = validate(history_only(segment.replace(signal_state=state), 0.2))
    assert start.num_steps == 41
    assert (start.signal_state == SignalState.STOP).all()


def test_playback_and_other_steps_are_refused() -> None:
    with pytest.raises(ConfigError, match="playback"):
        wosac_rollouts(load_agent("playback"), mixed_segment(), PLAIN)
    with pytest.raises(DataError, match=r"steps of 0\.2 s"):
        wosac_rollouts(load_agent(AGENT), straight_road(), PLAIN)
    with pytest.raises(DataError, match="no agent"):
        constant_velocity(mixed_segment().replace(valid=np.zeros((5, 91), bool)))


# --- submissions ---


def test_submission_is_valid(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, out = (
        write(tmp_path / "made.tfrecord", mixed_record(), womd_record("bbbb")),
        tmp_path / "out.tar.gz",
    )
    common = ["--data", str(data), "--out", str(out), "--search", "none", *META]
    assert main(["wosac", "submit", "constant_velocity", *common]) == 0
    assert main(["wosac", "validate", str(out), "--scenario", str(data)]) == 0
    assert "2 scenarios in 2 shards, all well" in capsys.readouterr().out


def test_submission_that_cannot_be_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, out = write(tmp_path / "made.tfrecord", mixed_record()), tmp_path / "out.tar.gz"
    for agent, more, text in (
        ("playback", (), "playback"),
        (AGENT, ("--shards", "2"), "don't fill 2 shards"),
        (AGENT, ("--logged-goals",), "must not know the log"),
        (AGENT, ("--horizon", "5"), "a submission has 8 s"),
    ):
        assert main(["wosac", "submit", agent, "--data", str(data), "--out", str(out), *META, *more]) != 0
        assert text in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.samples
def test_a_real_scenario_and_its_submission(samples: Path, tmp_path: Path) -> None:
    file, out = samples / "womd" / "motion_data_one_scenario.tfrecord", tmp_path / "out.tar.gz"
    ((_, number, payload),) = read_scenarios(file)
    check_scenario_of(parse_scenario(payload, file, number))
    command = ["wosac", "submit", AGENT, "--data", str(file), "--out", str(out), "--search", "none", *META]
    assert main(command) == 0
    assert not check_submission(out, required_agents(file)).problems


# --- run segments as scenarios ---


def test_scenario_of_a_segment_is_that_of_its_record() -> None:
    check_scenario_of(mixed_record())


def check_scenario_of(record: pb.Scenario) -> None:
    segment = validate(scenario_to_segment(record))
    window, rollouts = wosac_window(segment), constant_velocity(segment)
    found, expected = (score(one, rollouts) for one in (wosac_scenario(window), logged_scenario(record)))
    assert found == pytest.approx(expected, abs=1e-6)
    assert np.array_equal(window.position, segment.position)


def test_what_is_scored() -> None:
    segment = straight_road(num_agents=4)

    def scored(one: RunSegment) -> list[int]:
        return [int(name) for name in wosac_scenario(wosac_window(one)).evaluated]

    assert len(segment.predict) == 0
    assert scored(segment) == sorted(segment.agent_id)
    # An agent that comes later is not.
    assert scored(hide(segment, 3, slice(0, 6))) == sorted(segment.agent_id[:3])
    marked = segment.replace(predict=np.array([2], np.int32))
    assert scored(marked) == sorted(segment.agent_id[[segment.ego, 2]])


def test_lights_of_a_segment() -> None:
    segment = crossing()
    window = wosac_window(segment)
    scenario = wosac_scenario(window)
    table = np.zeros((12, 91), np.uint8)
    row = {int(lane): k for k, lane in enumerate(segment.road.lane_id[segment.signal_lane])}
    table[[row[int(lane)] for lane in scenario.signal_lane], scenario.signal_step] = scenario.signal_state
    assert np.array_equal(table, window.signal_state)
    # 5 Hz to 10 Hz: each state holds until the next.
    assert np.array_equal(table[:, ::2], segment.signal_state[:, :46])


def test_a_world_with_a_far_origin_is_scored_as_one_about_its_own() -> None:
    """Scores are in float32, which at 4 000 km, as in UTM coordinates, has steps of a quarter of a metre."""
    segment, found = crossing(num_agents=3), []
    for origin in ((0.0, 0.0, 0.0), (664_430.0, 3_998_210.0, 600.0)):
        window = validate(wosac_window(segment.replace(origin=np.array(origin))))
        found.append(score(wosac_scenario(window), constant_velocity(window)))
    assert found[0] == found[1]
    near = segment.replace(origin=np.array([7000.0, -3000.0, 20.0]))
    assert wosac_window(near).origin.tolist() == near.origin.tolist()


def test_lost_agents_are_nobodys_obstacle_in_the_log() -> None:
    window = wosac_window(hide(straight_road(num_agents=4), 3, slice(20, None)))
    log = log_playback(window)
    assert np.array_equal(log.x[0, 3] > 9e4, ~window.valid[3, 11:])
    found = score(wosac_scenario(window), log)
    assert (found["simulated_collision_rate"], found["min_ade"]) == (0, 0)
    assert found["metametric"] > 0.7


def test_short_logs_have_a_shorter_history() -> None:
    segment = straight_road(steps=43)  # 8.4 s
    window = validate(wosac_window(segment))
    assert window.num_steps == 91
    assert not window.valid[:, :6].any()
    assert window.valid[:, 6:].all()
    np.testing.assert_allclose(window.position[:, 10], segment.position[:, 2], atol=1e-5)
    # What is not known goes back at the first velocity: no jump at the first step that is.
    np.testing.assert_allclose(np.diff(window.position[..., :2], 2, axis=1), 0, atol=1e-4)
    assert score(wosac_scenario(window), constant_velocity(window))["min_ade"] < 0.01
    with pytest.raises(DataError, match=r"has 7\.8 s, the score needs 8"):
        wosac_window(straight_road(steps=40))


def test_a_shorter_horizon_is_the_beginning_of_the_whole() -> None:
    segment = resample(crossing(num_agents=4), 0.1)
    agent, short = small(), replace(PLAIN, horizon=3.5)
    window, whole = wosac_window(segment, short.future), wosac_window(segment)
    assert window.num_steps == 46
    long = wosac_rollouts(agent, whole, PLAIN)
    cut = SimulatedRollouts(long.object_id, *(getattr(long, name)[..., :35] for name in STATES))
    assert same(wosac_rollouts(agent, window, short), cut)
    first, second = (
        compute_features(wosac_scenario(one), rollouts) for one, rollouts in ((whole, long), (window, cut))
    )
    for name in first.log.keys() - {"average_displacement_error"}:
        for a, b in ((first.log, second.log), (first.simulated, second.simulated)):
            # The last two steps lack the neighbours that accelerations are made of.
            assert torch.equal(a[name][..., :33], b[name][..., :33]), name
    with pytest.raises(DataError, match=r"field x: has shape \(32, 4, 80\), expected \(32, 4, 35\)"):
        score(wosac_scenario(window), long)
