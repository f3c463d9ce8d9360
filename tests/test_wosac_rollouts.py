"""Rollouts for the WOSAC score: of WOMD scenarios as a submission, of any run segment for its score."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers_agents import small
from helpers_segments import crossing, hide, straight_road
from helpers_store import fill
from helpers_wosac import womd_record
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import WosacSettings
from symphony.data.resample import resample, wrap
from symphony.data.segment import AgentType, RunSegment, SignalState, validate
from symphony.data.sources import womd_pb2 as pb
from symphony.data.sources.tfrecord import write_records
from symphony.data.sources.womd import scenario_to_segment
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.wosac.evaluate import evaluate_wosac
from symphony.wosac.records import parse_scenario, read_scenario_payloads, scenario_arrays
from symphony.wosac.rollouts import STATES, RolloutArrays
from symphony.wosac.scorer import SimulatedRollouts, StepFeatures, WosacScenario, compute_features, score
from symphony.wosac.segments import log_playback, wosac_scenario, wosac_window
from symphony.wosac.simulate import between_decisions, constant_velocity, history_only, wosac_rollouts
from symphony.wosac.submission_check import check_submission, required_agents
from symphony.wosac.table import read_wosac, wosac_grid

AGENT = "pretrained:bc_ts_h"
PLAIN = WosacSettings(search="none")
SEARCH = WosacSettings(search="tree", branches=2)
META = (
    *("--account-name", "somebody@example.org", "--unique-method-name", "made"),
    *(
        "--uses-lidar-data",
        "False",
        "--uses-camera-data",
        "False",
        "--uses-public-model-pretraining",
        "False",
    ),
    *("--num-model-parameters", "200K", "--acknowledge-complies-with-closed-loop-requirement", "True"),
)


def mixed_record(name: str = "0123456789abcdef") -> pb.Scenario:
    """Three vehicles, a pedestrian, and a vehicle that is not there at step 10."""
    record = womd_record(name, tracks=5)
    record.tracks[0].object_type = AgentType.PEDESTRIAN
    record.tracks[1].states[10].valid = False
    return record


def mixed_segment() -> RunSegment:
    return validate(scenario_to_segment(mixed_record()))


@cache
def driven(settings: WosacSettings) -> RolloutArrays:
    """Rollouts of the mixed segment, which several tests look at."""
    return wosac_rollouts(small(), mixed_segment(), settings)


def same(a: RolloutArrays, b: RolloutArrays) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("object_id", *STATES))


def scored(scenario: WosacScenario, rollouts: RolloutArrays) -> dict[str, float]:
    return score(scenario, SimulatedRollouts.of(**vars(rollouts))).to_dict()


def write(path: Path, *records: pb.Scenario) -> Path:
    write_records(path, [record.SerializeToString() for record in records])
    return path


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.2, 0.25, 0.4]))
def test_states_between_decisions_are_those_of_resampling(seed: int, dt: float) -> None:
    segment = straight_road(num_agents=2, steps=round(8 / dt) + 1, dt=dt)
    rng = np.random.default_rng(seed)
    shape = segment.position.shape[:2]
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
def test_vehicles_are_driven_and_others_keep_their_velocity(settings: WosacSettings) -> None:
    segment = mixed_segment()
    found, steady = driven(settings), constant_velocity(segment)
    assert found.object_id.tolist() == [100, 102, 103, 104]
    for name in STATES:
        array = getattr(found, name)
        assert array.shape == (32, 4, 80)
        np.testing.assert_array_equal(array[:, 0], getattr(steady, name)[:, 0])
    # Every rollout is one of its own.
    assert len(np.unique(found.x[:, 1:, -1], axis=0)) == 32
    assert (found.z == found.z[:1, :, :1]).all()
    other = wosac_rollouts(small(), segment, replace(settings, seed=1))
    assert not np.isin(other.x[:, 1:, -1], found.x[:, 1:, -1]).any()
    # They begin where the log was last seen: 0.1 s at speeds between 10 and 15 m/s further on.
    now = segment.position[[2, 3, 4], 10, 0] + segment.origin[0]
    assert (np.abs(found.x[:, 1:, 0] - now - 1.2) < 1).all()


def test_trees_are_independent_however_many_are_searched_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("symphony.wosac.simulate.AT_ONCE", 12 * 2 * 3)
    found = wosac_rollouts(small(), mixed_segment(), replace(SEARCH, horizon=2.0))
    assert found.x.shape == (32, 4, 20)
    assert len(np.unique(found.x[:, 1:, -1], axis=0)) == 32


def test_constant_velocity() -> None:
    segment = mixed_segment()
    found = constant_velocity(segment)
    step = np.arange(1, 81) * 0.1
    # Track 3: 13 m/s along x and 0.5 along y.
    np.testing.assert_allclose(
        found.x[5, 2] - segment.origin[0] - segment.position[3, 10, 0], 13 * step, atol=1e-5
    )
    np.testing.assert_allclose(
        found.y[5, 2] - segment.origin[1] - segment.position[3, 10, 1], 0.5 * step, atol=1e-5
    )
    np.testing.assert_allclose(found.heading[:, 2], 0.03, atol=1e-6)


def test_lights_keep_the_latest_state_seen() -> None:
    segment = mixed_segment()
    state = np.full((1, 91), SignalState.GO, np.uint8)
    state[0, 4], state[0, 5:11] = SignalState.STOP, SignalState.UNKNOWN
    start = validate(history_only(segment.replace(signal_state=state), 0.2))
    assert start.num_steps == 41
    assert (start.signal_state == SignalState.STOP).all()


def test_playback_and_other_steps_are_refused() -> None:
    with pytest.raises(ConfigError, match="playback"):
        wosac_rollouts(load_agent("playback"), mixed_segment())
    with pytest.raises(DataError, match=r"steps of 0\.2 s"):
        wosac_rollouts(load_agent(AGENT), straight_road())
    with pytest.raises(DataError, match="no agent"):
        constant_velocity(mixed_segment().replace(valid=np.zeros((5, 91), bool)))
    with pytest.raises(ConfigError, match="score"):
        WosacSettings(score="flags")  # type: ignore[arg-type]


@pytest.mark.parametrize("agent", [AGENT, "constant_velocity"])
def test_submission_is_valid(agent: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, out = (
        write(tmp_path / "made.tfrecord", mixed_record(), womd_record("bbbb")),
        tmp_path / "out.tar.gz",
    )
    assert (
        main(["wosac", "submit", agent, "--data", str(data), "--out", str(out), "--search", "none", *META])
        == 0
    )
    assert main(["wosac", "validate", str(out), "--scenario", str(data)]) == 0
    assert "2 scenarios in 2 shards, all well" in capsys.readouterr().out


def test_submission_that_cannot_be_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, out = write(tmp_path / "made.tfrecord", mixed_record()), tmp_path / "out.tar.gz"
    common = ["--data", str(data), "--out", str(out), *META]
    assert main(["wosac", "submit", "playback", *common]) != 0
    assert "playback" in capsys.readouterr().err
    assert main(["wosac", "submit", AGENT, *common, "--shards", "2"]) != 0
    assert "don't fill 2 shards" in capsys.readouterr().err
    assert not out.exists()


def test_scenario_of_a_segment_is_that_of_its_record() -> None:
    check_scenario_of(mixed_record())


def check_scenario_of(record: pb.Scenario) -> None:
    segment = validate(scenario_to_segment(record))
    expected = WosacScenario.of(**scenario_arrays(record))
    rollouts = constant_velocity(segment)
    found = scored(wosac_scenario(segment), rollouts)
    assert found == pytest.approx(scored(expected, rollouts), abs=1e-6)
    window = wosac_window(segment)
    assert np.array_equal(window.position, segment.position)


@pytest.mark.samples
def test_scenario_of_a_real_segment_and_its_submission(samples: Path, tmp_path: Path) -> None:
    file, out = samples / "womd" / "motion_data_one_scenario.tfrecord", tmp_path / "out.tar.gz"
    ((_, number, payload),) = read_scenario_payloads([file])
    check_scenario_of(parse_scenario(payload, file, number))
    assert (
        main(["wosac", "submit", AGENT, "--data", str(file), "--out", str(out), "--search", "none", *META])
        == 0
    )
    assert check_submission(out, required_agents(file)).count == 0


def test_what_is_scored() -> None:
    segment = straight_road(num_agents=4)
    assert len(segment.predict) == 0
    assert wosac_scenario(segment).evaluated.tolist() == sorted(segment.agent_id)
    # An agent that comes later is not.
    hidden = hide(segment, 3, slice(0, 6))
    assert wosac_scenario(hidden).evaluated.tolist() == sorted(segment.agent_id[:3])
    marked = segment.replace(predict=np.array([2], np.int32))
    assert wosac_scenario(marked).evaluated.tolist() == sorted(segment.agent_id[[segment.ego, 2]])


def test_lights_of_a_segment() -> None:
    segment = crossing()
    scenario, window = wosac_scenario(segment), wosac_window(segment)
    table = np.zeros((12, 91), np.uint8)
    row = {int(lane): k for k, lane in enumerate(segment.road.lane_id[segment.signal_lane])}
    table[[row[int(lane)] for lane in scenario.signal_lane], scenario.signal_step] = scenario.signal_state
    assert np.array_equal(table, window.signal_state)
    # 5 Hz to 10 Hz: each state holds until the next.
    assert np.array_equal(table[:, ::2], segment.signal_state[:, :46])


def test_the_log_of_steady_traffic_is_constant_velocity() -> None:
    segment = straight_road(num_agents=4, steps=46)
    window, scenario = wosac_window(segment), wosac_scenario(segment)
    log, steady = log_playback(window), constant_velocity(window)
    np.testing.assert_allclose(log.x, steady.x, atol=1e-4)
    assert scored(scenario, log)["min_ade"] == 0
    assert scored(scenario, log)["metametric"] > 0.7


def test_a_world_with_a_far_origin_is_scored_as_one_about_its_own() -> None:
    """Scores are in float32, which at 4 000 km, as in UTM coordinates, has steps of a quarter of a metre."""
    segment, found = crossing(num_agents=3), []
    for origin in ((0.0, 0.0, 0.0), (664_430.0, 3_998_210.0, 600.0)):
        moved = segment.replace(origin=np.array(origin))
        window = validate(wosac_window(moved))
        found.append(scored(wosac_scenario(moved), constant_velocity(window)))
    assert found[0] == found[1]
    near = segment.replace(origin=np.array([7000.0, -3000.0, 20.0]))
    assert wosac_window(near).origin.tolist() == near.origin.tolist()


def test_lost_agents_are_nobodys_obstacle() -> None:
    segment = straight_road(num_agents=4)
    lost = hide(segment, 3, slice(20, None))
    window = wosac_window(lost)
    away = log_playback(window).x[0, 3] > 9e4
    assert np.array_equal(away, ~window.valid[3, 11:])
    assert scored(wosac_scenario(lost), log_playback(window))["simulated_collision_rate"] == 0


def test_short_logs_have_a_shorter_history() -> None:
    segment = straight_road(steps=43)  # 8.4 s
    window = validate(wosac_window(segment))
    assert window.num_steps == 91
    assert not window.valid[:, :6].any()
    assert window.valid[:, 6:].all()
    np.testing.assert_allclose(window.position[:, 10], segment.position[:, 2], atol=1e-5)
    # What is not known goes back at the first velocity: no jump at the first step that is.
    np.testing.assert_allclose(np.diff(window.position[..., :2], 2, axis=1), 0, atol=1e-4)
    assert scored(wosac_scenario(segment), constant_velocity(window))["min_ade"] < 0.01
    with pytest.raises(DataError, match=r"has 7\.8 s, the score needs 8"):
        wosac_window(straight_road(steps=40))


def test_a_shorter_horizon_is_the_beginning_of_the_whole() -> None:
    segment = resample(crossing(num_agents=4), 0.1)
    agent, short = small(), replace(PLAIN, horizon=3.5)
    whole, part = (wosac_scenario(segment), wosac_scenario(segment, short.future))
    window = wosac_window(segment, short.future)
    assert (window.num_steps, part.steps, part.future) == (46, 46, 35)
    long = wosac_rollouts(agent, wosac_window(segment), PLAIN)
    cut = RolloutArrays(long.object_id, *(getattr(long, name)[..., :35] for name in STATES))
    assert same(wosac_rollouts(agent, window, short), cut)
    first, second = (
        compute_features(scenario, SimulatedRollouts.of(**vars(rollouts)))
        for scenario, rollouts in ((whole, long), (part, cut))
    )
    for name in StepFeatures.__dataclass_fields__:
        if name != "average_displacement_error":
            # The last two steps lack the neighbours that accelerations are made of.
            pairs = (
                (getattr(a, name)[..., :33], getattr(b, name)[..., :33])
                for a, b in ((first.log, second.log), (first.simulated, second.simulated))
            )
            assert all(torch.equal(a, b) for a, b in pairs), name
    with pytest.raises(DataError, match=r"field x: has shape \(32, 4, 80\), expected \(32, 4, 35\)"):
        score(part, SimulatedRollouts.of(**vars(long)))


def test_a_short_horizon_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fill(tmp_path / "store", [straight_road(steps=31)])  # 6 s
    command = ["wosac", "evaluate", "random", "--data", str(tmp_path / "store")]
    assert main(command) == 1
    assert "has 6 s, the score needs 8" in capsys.readouterr().err
    out = tmp_path / "short.json"
    assert main([*command, "--horizon", "5", "--json", str(out)]) == 0
    record = read_wosac(out)
    assert record["how"]["horizon"] == 5
    assert main(["wosac", "table", str(out)]) == 0
    assert "WOSAC 2025 over 5 s (the challenge has 8): 1 run segments" in capsys.readouterr().out
    other = record | {"how": {"search": "none"}}
    with pytest.raises(ConfigError, match="years or horizons"):
        wosac_grid([record, other])
    submit = ["wosac", "submit", AGENT, "--data", "x", "--out", "y.tar.gz", *META, "--horizon", "5"]
    assert main(submit) != 0
    assert "a submission has 8 s" in capsys.readouterr().err
    for wrong in (0.5, 8.1, 2.55, math.nan):
        with pytest.raises(ConfigError, match="horizon is 1 to 8 s"):
            WosacSettings(horizon=wrong)


def test_evaluation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = [straight_road(2, seed=k, group=f"recording {k // 2}") for k in range(3)]
    store, out = tmp_path / "store", tmp_path / "scores.json"
    fill(store, found)
    command = ["wosac", "evaluate", AGENT, "--data", str(store), "--search", "none", "--json", str(out)]
    assert main([*command, "--horizon", "2"]) == 0
    assert "WOSAC 2025, 3 run segments, 2 recordings" in capsys.readouterr().out
    record = json.loads(out.read_text())
    assert list(record["agents"]) == ["playback", "constant_velocity", "random", AGENT]
    assert record["how"] == {"search": "none", "seed": 0, "logged_goals": False, "horizon": 2.0}
    for numbers in record["agents"].values():
        each = [one["metametric"] for one in numbers["segments"].values()]
        assert numbers["metametric"] == pytest.approx(np.mean(each))
        assert numbers["metametric_se"] >= 0
    steady = record["agents"]["constant_velocity"]["segments"][found[1].segment_id]
    assert steady == pytest.approx(
        scored(wosac_scenario(found[1], 20), constant_velocity(wosac_window(found[1], 20), future=20))
    )
    # One recording has no error; a part of the store can be named.
    assert main([*command, "--segments", "2", "--config", "2024"]) == 0
    record = json.loads(out.read_text())
    assert record["config"] == "2024"
    assert list(record["agents"][AGENT]["segments"]) == [found[2].segment_id]
    assert record["agents"][AGENT]["metametric_se"] is None


def test_evaluation_of_nothing_is_refused(tmp_path: Path) -> None:
    fill(tmp_path / "store", [straight_road()])
    store = SegmentStore(tmp_path / "store")
    with pytest.raises(DataError, match="no run segments"):
        evaluate_wosac(load_agent(AGENT), store, [], PLAIN)
    with pytest.raises(ConfigError, match="config must be one of"):
        evaluate_wosac(load_agent(AGENT), store, [0], PLAIN, "2023")
