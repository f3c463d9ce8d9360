"""The report of saved rollouts, on scenes whose answers are known; the paper's relations from kept evaluations."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from helpers_saved import played, searched
from helpers_segments import LANE_WIDTH, crossing, crossing_road, make_road, make_segment, straight_road, turned
from helpers_store import brief, fill
from helpers_table import make_entry, make_record, make_run
from symphony.cli import main
from symphony.config import METHODS
from symphony.data.builtin import builtin_store
from symphony.data.convert import merge
from symphony.data.segment import AgentType, Polylines, RunSegment, SignalState
from symphony.data.sources.womd import WomdReader
from symphony.data.store import SegmentStore
from symphony.envs.scene import scene
from symphony.errors import ConfigError, DataError
from symphony.evaluation.contacts import HORIZON, time_to_collision
from symphony.evaluation.driving import Lanes, red_lights
from symphony.evaluation.report import Report, add_segment, report, total_numbers
from symphony.evaluation.table import Entry, paper_figures
from symphony.geometry import box_gap
from symphony.metrics.intervals import clustered_mean
from symphony.metrics.summary import WEIGHTED
from symphony.rollouts.driving import playback
from symphony.saved.folder import About, RolloutWriter, load_rollouts, save_rollouts
from symphony.saved.rollouts import SavedRollouts, saved_rollouts, world_of
from test_pretrained import load_script

ABOUT = About("made")
DT = 0.2


def test_who_keeps_left_is_judged_as_who_keeps_right(tmp_path):
    both = merge([brief(tmp_path / "store", (2, 4, 13, 21, 22), steps=51)], tmp_path / "both", mirror=True)
    words = f"simulate constant_velocity --data {both.path} --interactive 4 --rollouts 1 --out {tmp_path / 'sim'}"
    assert main(words.split()) == 0
    rows = {row["segment"]: row for row in report(load_rollouts(tmp_path / "sim")).rows}
    right, left = ([rows[name + end] for name in both.ids[:5]] for end in ("", "-mirrored"))
    for name in ("collision", "at_fault_collision", "red_lights", "offroad_time", "wrong_way_time", "progress"):
        found, mirrored = ([math.nan if row[name] is None else row[name] for row in side] for side in (right, left))
        assert found == pytest.approx(mirrored, rel=1e-3, abs=1e-3, nan_ok=True)
        assert np.nansum(found)


def driving(*ways: tuple[float, float, float, float], steps: int = 21, **changes: Any) -> RunSegment:
    """Cars at constant velocity: x, y, heading, speed at first; two lanes along +x, at y = 0 and above."""
    start, time = np.array(ways, float), np.arange(steps)[:, None] * DT
    direction = np.stack([np.cos(start[:, 2]), np.sin(start[:, 2])], -1)
    velocity = np.repeat((start[:, 3:] * direction)[:, None], steps, 1)
    x = np.arange(-100, 200, 2.0)
    lines = [np.stack([x, np.full_like(x, k * LANE_WIDTH)], -1) for k in range(2)]
    # Far away; left of its direction is the road.
    boundary = [np.array([[-500, -500], [500, -500], [500, 500], [-500, 500], [-500, -500.0]])]
    heading = np.repeat(start[:, 2:3], steps, 1)
    position = start[:, None, :2] + time * velocity
    return make_segment(make_road(lines, boundary=boundary), position, heading, velocity, DT, **changes)


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*[st.floats(-8, 8)] * 2, st.floats(-3, 3), st.floats(1, 12)),
    st.tuples(st.floats(5, 25), st.floats(-15, 15), st.floats(-3, 3), st.floats(0, 12)),
)
def test_time_to_collision_is_when_boxes_meet_that_go_on(one: Any, two: Any) -> None:
    segment = driving(one, two, steps=2)
    world = world_of(played(segment), 0)
    found = float(time_to_collision(world, np.array([0]))[0, 0])
    alone = world._replace(valid=world.valid & np.array([[True], [False]]))
    assert (time_to_collision(alone, np.array([0])) == math.inf).all()

    def gap(time: float) -> float:
        place = torch.from_numpy(world.position[:, 0] + time * world.velocity[:, 0])
        heading, size = torch.from_numpy(world.heading[:, 0]), torch.from_numpy(world.size)
        return float(box_gap(place[0], heading[0], size[0], place[1], heading[1], size[1]))

    away = world.position[1, 0] - world.position[0, 0]
    if away @ world.velocity[0, 0] <= 0:
        assert found == math.inf
        return
    if found > 0:
        assert all(gap(time) > -1e-5 for time in np.linspace(0, min(found, HORIZON), 50))
    if found < math.inf:
        assert gap(found) <= 1e-5


def test_a_known_profile_has_its_acceleration_jerk_and_lateral_acceleration() -> None:
    """Speed 5 - t^3 / 3: acceleration and jerk are its differences; 0.5 rad/s at 11.9 m/s on average: 5.95 m/s^2."""
    saved, time = played(driving((0, 0, 0, 10), steps=11), rollouts=2), np.arange(11) * DT
    saved.state[0, :, 0, 3] = speed = 5 - time**3 / 3
    saved.state[0, :, 0, 2] = 0
    saved.state[1, :, 0, 2] = (3 + 0.5 * time + np.pi) % (2 * np.pi) - np.pi
    saved.state[1, :, 0, 3] = 10 + time
    straight, turning = rows(saved)
    assert straight["max_braking"] == pytest.approx(-np.diff(speed).min() / DT, rel=1e-4)
    assert straight["max_jerk"] == pytest.approx(np.abs(np.diff(speed, 2)).max() / DT**2, rel=1e-3)
    zeros = straight["max_lateral_acceleration"], straight["max_acceleration"], turning["max_braking"]
    assert (*zeros, turning["max_jerk"]) == (0, 0, 0, pytest.approx(0, abs=1e-3))
    assert turning["max_lateral_acceleration"] == pytest.approx(5.95, rel=1e-4)


def rows(saved: SavedRollouts, evaluated: Any = "interactive") -> list[dict[str, Any]]:
    add_segment(found := Report("made", evaluated), saved)
    return found.rows


@pytest.mark.parametrize("lines", [[], [np.array([[-50, 0], [300, 0.0]])]])
def test_progress_is_along_the_route_and_relative_to_the_log(lines: list[Any]) -> None:
    segment = driving((0, 0, 0, 10), steps=11)
    saved, routes = played(segment, rollouts=4), Polylines.of(lines)
    saved.state[1, :, 0, 0] = 0.5 * saved.state[0, :, 0, 0]
    saved.state[2, :, 0, :2] = 0
    saved.state[3, :, 0, :2] = saved.state[0, :, 0, 1::-1]  # across the route, which is no progress along it
    ways = dataclasses.replace(saved, routes=routes, goal=np.full((4, 1), len(routes) - 1))
    found, known = rows(ways), 3 + len(lines)
    assert [row["progress"] for row in found[:known]] == pytest.approx([20, 10, 0, 0][:known], abs=1e-4)
    assert [row["progress_ratio"] for row in found[:3]] == pytest.approx([1, 0.5, 0], abs=1e-5)
    assert found[1]["log_distance"] == pytest.approx(0.5 * 2 * np.arange(1, 11).mean(), rel=1e-5)
    # Who drives as the log does gets on as far, also where the log has lost it for a part of the time.
    for known in (slice(0, 5), slice(3, 11)):
        valid = np.zeros_like(segment.valid)
        valid[:, known] = True
        row = rows(dataclasses.replace(ways, segment=segment.replace(valid=valid)))[0]
        assert row["progress"] == pytest.approx(20 if valid[0, 0] else 18, abs=1e-4)
        assert row["progress_ratio"] == pytest.approx(1)
    # Who was gone and came back to where it had begun drove both stretches, and is compared with the log up to then.
    ways.counted[0, 4, 0] = False
    ways.state[0, 6:, 0, :2] = ways.state[0, :5, 0, :2]
    row = rows(ways)[0]
    assert (row["progress"], row["progress_ratio"]) == pytest.approx((16, 0.4), abs=1e-4)
    both = played(driving((0, 0, 0, 10), (50, 0, 0, 10), steps=11), [0, 1])
    both.counted[0, :, 1] = False  # one that never comes is no agent that stands
    assert rows(both)[0]["progress"] == pytest.approx(20, abs=1e-4)
    both.counted[:] = False
    assert rows(both)[0]["progress"] is None


def red(states: Any = SignalState.STOP, others: Any = SignalState.GO, aside: float = 0) -> list[tuple[int, int]]:
    """Step and light of every red light that a car runs which comes from the south and goes straight on."""
    position = np.stack([np.full(31, 1.75 + aside), -20 + np.arange(31) * 1.2, np.zeros(31)], -1)[None].astype("f4")
    light, heading = np.full((12, 31), others, np.uint8), np.full((1, 31), np.pi / 2, np.float32)
    light[0] = states
    how = {"position": position, "heading": heading, "signal_state": light}
    segment = crossing(1, steps=31, seed=0).replace(**how)
    saved = played(segment)
    world, rest = world_of(saved, 0), world_of(later(saved, 4), 0)
    short = world._replace(valid=world.valid & (np.arange(31) < 6))  # a single state behind the stop point
    shown = (world, 0), (rest, 4), (short, 0)
    whole, rest, short = (red_lights(one, np.array([0]), Lanes(segment), k) for one, k in shown)
    np.testing.assert_array_equal([whole, whole], [rest._replace(step=rest.step + 4), short])
    return list(zip(whole.step.tolist(), whole.light.tolist(), strict=True))


def test_a_red_light_is_run_where_the_front_crosses_the_stop_point() -> None:
    # The front, 2.3 m ahead of the centre, crosses y = -12 after (20 - 2.3 - 12) / 1.2 steps.
    assert red() == red(aside=1.7) == red(SignalState.ARROW_STOP) == [(5, 0)]
    assert red(aside=1.8) == []
    early = np.where(np.arange(31) < 5, SignalState.STOP, SignalState.GO)
    for state in (SignalState.GO, SignalState.CAUTION, SignalState.FLASHING_STOP, SignalState.UNKNOWN, early):
        assert red(state) == []
    # Those of left and right, from the same stop point, are not this car's.
    assert red(SignalState.GO, SignalState.STOP) == []


@given(st.floats(2, 20), st.floats(0, 1), st.sampled_from([0.1, 0.2, 1.0]), st.floats(-0.5, 0.5), st.floats(0, 1))
@settings(max_examples=25)
@example(20, 0.6, 1.0, 0, 0)
@example(18, 0.0, 1.0, 0.5, 0)
def test_only_the_light_of_the_own_lane_counts(speed, phase, dt, aside, ahead) -> None:
    """Straight on beside a turning lane, whose stop point lies a little farther on."""
    road, step = crossing_road(200.0), speed * dt
    y = -30 - step + step * (np.arange(int(60 / step) + 4) + phase)
    position, heading = np.stack([np.full(len(y), 1.75 + aside), y], -1)[None], np.full((1, len(y)), np.pi / 2)
    points = np.stack([road.lanes[8][0], road.lanes[10][0] + [0, ahead, 0]]).astype(np.float32)
    how = {"signal_lane": np.array([8, 10], np.int32), "signal_point": points}
    for states, runs in (((SignalState.GO, SignalState.STOP), 0), ((SignalState.STOP, SignalState.GO), 1)):
        how["signal_state"] = np.repeat(np.array(states, np.uint8)[:, None], len(y), 1)
        segment = make_segment(road, position, heading, np.tile([0.0, speed], (1, len(y), 1)), dt, **how)
        found = red_lights(world_of(played(segment), 0), np.array([0]), Lanes(segment), 0)
        assert found.light.tolist() == [0] * runs


@pytest.mark.parametrize(("length", "before", "past"), [
    (4.5, 0.0, 1.0), (9.0, 0.0, 2.0), (12.0, 0.0, 4.0), (4.5, 3.0, 4.0), (18.0, 5.0, 0.3), (18.0, 5.0, -0.3),
])  # fmt: skip
@pytest.mark.parametrize("lane", [2.0, 30.0])
def test_who_stops_behind_a_red_stop_point_has_run_it(length, before, past, lane) -> None:
    """However long it is, and its lane, and however far ``before`` the lane the stop point lies."""
    road = make_road([[(a, 0), (b, 0)] for a, b in pairwise((-100, before, before + lane, 300))], [(0, 1), (1, 2)])
    x = np.minimum(-40.0 + 0.8 * np.arange(70), past - length / 2)
    lights: dict[str, Any] = {"signal_lane": np.array([1], np.int32), "signal_point": np.zeros((1, 3), np.float32)}
    lights["signal_state"] = np.full((1, len(x)), SignalState.STOP, np.uint8)
    lights["size"] = np.array([[length, 2.0, 1.6]], np.float32)
    place, speed = np.stack([x, 0 * x], -1)[None], np.tile([8.0, 0.0], (1, len(x), 1))
    segment = make_segment(road, place, np.zeros((1, len(x))), speed, 0.1, **lights)
    found = red_lights(world_of(played(segment), 0), np.array([0]), Lanes(segment), 0)
    assert len(found.light) == (past > 0)


@pytest.mark.parametrize("lane", [0, 1])
def test_what_happens_again_counts_again(lane) -> None:
    half = 20 * np.stack([np.cos(angle := np.linspace(0, np.pi, 60)), np.sin(angle)], -1)
    road = make_road([half, -half], [(0, 1), (1, 0)])
    turn = -0.5 + 0.08 * np.arange(231)  # three times past 0, where the light of either lane is
    place, way = (np.stack([np.cos(turn + t), np.sin(turn + t)], -1)[None] for t in (0, np.pi / 2))
    lights: dict[str, Any] = {"signal_lane": np.array([lane], np.int32), "signal_point": np.float32([[20, 0, 0]])}
    lights["signal_state"] = np.full((1, len(turn)), SignalState.STOP, np.uint8)
    segment = make_segment(road, 20 * place, turn[None] + np.pi / 2, 8 * way, 0.2, **lights)
    assert red_lights(world_of(played(segment), 0), np.array([0]), Lanes(segment), 0).light.tolist() == [0, 0, 0]
    saved = played(driving((0, 0, 0, 12), (10, 0, 0, 7)))
    saved.counted[0, 8:10, 0] = False  # while the boxes overlap
    assert rows(saved)[0]["collisions"] == 2


def test_where_a_map_has_no_edge_or_light_nothing_is_said_of_them() -> None:
    edged = straight_road(2, steps=11)
    bare = edged.replace(segment_id="bare", road=dataclasses.replace(edged.road, boundary=Polylines.of([])))
    found = Report("made", "interactive")
    for one in (edged, bare):
        add_segment(found, played(one))
    part = found.parts[0]
    assert (part["edged"], part["lit"], part["seconds"]) == pytest.approx((2.0, 0.0, 4.0))
    found.parts[1].update(part | {"edged": 0.0, "collisions": 3})
    past = found.past_log()["past_log"]
    assert (past["offroad_time"], past["red_lights"], past["red_lights_per_minute"]) == (None, None, None)
    assert (past["collisions"], past["collisions_per_minute"]) == (3, 45.0)


def test_failed_runs_and_groups_are_told_apart(tmp_path: Path) -> None:
    hit = driving((0, 0, 0, 12), (10, 0, 0, 7), segment_id="hit")
    free = driving((0, 0, 0, 7), (10, 0, 0, 7), segment_id="free")
    with RolloutWriter(tmp_path / "sim", ABOUT) as writer:
        writer.add(played(hit.replace(group="north"), rollouts=3, failed={2: "planner raised ValueError"}))
        writer.add(played(free.replace(group="south"), rollouts=2, failed={1: "planner raised ValueError"}))
        writer.fail("lost", 2, "no ego")
    totals = (found := report(load_rollouts(tmp_path / "sim"))).totals()
    assert (totals["runs"], totals["failed_runs"], totals["segments"], totals["groups"]) == (7, 4, 3, 2)
    assert (totals["collision_rate"], found.parts[0]["collisions"]) == (pytest.approx(100 * 2 / 3), 2)
    # Groups of 2 and 1 runs, all and none of which collided: without either of them the rate is 0 or 1.
    assert totals["collision_rate_se"] == pytest.approx(100 * np.sqrt(((2 / 3) ** 2 + (1 / 3) ** 2) / 2))
    assert [row["segment"] for row in found.worst()[:5]] == ["hit", "free", "lost", "lost", "hit"]
    assert found.plain()["collisions"] == [
        {"kind": "into leader", "other": "vehicle", "at_fault": True, "with_playback": True, "collisions": 2}
    ]
    assert (totals["offroad_time"], totals["max_jerk"]) == (0, pytest.approx(0, abs=1e-3))


def test_times_are_percent_of_what_was_driven() -> None:
    saved = played(driving((0, 0, 0, 7), (40, 0, 0, 7)), [0, 1], 2)
    saved.offroad[0, :5, 0] = True
    saved.counted[0, 10:, 1] = False  # its steps: 20 and 10
    found = rows(saved)
    assert [row["steps"] for row in found] == [30, 40]
    assert [row["offroad_time"] for row in found] == pytest.approx([100 * 5 / 30, 0])
    assert total_numbers(found)["offroad_time"] == pytest.approx(100 * 5 / 70)
    # What an agent that is not there is said to do does not count.
    saved.state[0, 11:, 1] = 99
    assert (rows(saved), found[0]["max_acceleration"]) == (found, pytest.approx(0, abs=1e-4))


def later(saved: SavedRollouts, start: int) -> SavedRollouts:
    parts = {name: getattr(saved, name)[:, start:] for name in ("state", "counted", "collision", "offroad")}
    return dataclasses.replace(saved, start=start, **parts)


@pytest.mark.parametrize(("logged", "aside", "light", "green", "start", "percent"), [
    (25, 9, 99, 0, 0, 40), (26, 9, 99, 0, 0, 0),  # 3 s at least, once the log has ended
    (25, None, 99, 0, 0, 40), (25, 0, 99, 0, 0, 0), (25, 2.2, 99, 0, 0, 0), (25, 2.5, 99, 0, 0, 40),
    (25, 9, 14, 0, 0, 0), (25, 9, 16, 0, 0, 40), (11, 9, 14, 30, 20, 0),
])  # fmt: skip
def test_who_stands_on_a_free_road_blocks_it(logged, aside, light, green, start, percent) -> None:
    """One ahead stands aside, or is not there any more; a light ahead of the front has been green for some steps."""
    segment = driving((0, 0, 0, 0), (8, aside or 0, 0, 0), steps=41, logged=logged)
    segment.valid[1] = aside is not None
    how: dict[str, Any] = {"signal_lane": np.zeros(1, np.int32)}
    how["signal_point"] = np.array([[0.5 * segment.size[0, 0] + light, 0, 0]], np.float32)
    how["signal_state"] = np.where(np.arange(41) < green, SignalState.GO, SignalState.STOP).astype(np.uint8)[None]
    assert rows(later(played(segment.replace(**how)), start))[0]["blocking_time"] == pytest.approx(percent)


def test_the_ego_alone_is_evaluated_on_request() -> None:
    segment = driving((-30, LANE_WIDTH, 0, 5), (0, 0, 0, 12), (10, 0, 0, 7))
    saved = played(segment, [0, 1])
    assert rows(saved)[0]["collision"]
    assert not rows(saved, "ego")[0]["collision"]
    with pytest.raises(DataError, match="ego was not driven"):
        rows(played(segment, [1]), "ego")
    # Through one another within a step, which no state shows; later they stand on each other.
    for again in (False, True):
        jumps = driving((0, 0, 0, 0), (0, 10, 0, 0))
        jumps.position[1, 5:, 1], jumps.position[1, 9:, 1] = -10, -10 * (not again)
        assert rows(played(jumps))[0].items() >= {"collisions": 1, "collision_at_states": again}.items()


def test_contacts_are_those_that_the_simulation_flagged() -> None:
    """For the included agent and for the log, no collision of the flags is missing or made up."""
    _, found = searched()
    for saved in [*found, played(straight_road(6), [0, 1]), played(crossing(4), [0, 2])]:
        add_segment(made := Report("made", "interactive"), saved)
        events = made.events[saved.segment.segment_id]
        for k in range(saved.rollouts):
            hit = {e.agent for e in events if e.rollout == k and e.kind == "collision"}
            assert hit == set(saved.agents[(saved.collision[k] & saved.counted[k]).any(0)].tolist())


@pytest.mark.parametrize("logs", ["included", pytest.param("real", marks=pytest.mark.samples)])
def test_logged_driving_breaks_no_rules(logs: str, request: Any, tmp_path: Path) -> None:
    folder, count = builtin_store("test"), 6
    if logs == "real":
        files = sorted((request.getfixturevalue("samples") / "real" / "womd").glob("*.tfrecord"))[:4]
        if not files:
            pytest.skip("no real WOMD scenarios among the samples")
        found = [item for file in files for item in WomdReader().read(file) if isinstance(item, RunSegment)]
        fill(folder := tmp_path / "store", found)
        count = len(found)
    store, told = SegmentStore(folder), Report("log", "interactive")
    for i in range(count):
        scenes = scene(store[i], 2)
        add_segment(told, saved_rollouts(store[i], scenes, playback(scenes)))
    totals = told.totals()
    for name in ("collision_rate", "red_light_rate", "wrong_way_time", "log_distance"):
        assert totals[name] == 0, name
    assert totals["progress_ratio"] == pytest.approx(1)
    assert totals["progress"] > 1


def test_moving_and_turning_the_world_changes_nothing() -> None:
    segment = driving((0, 0, 0, 12), (10, 0, 0, 7), (5, LANE_WIDTH, 0, 9))
    other = turned(segment, 0.7, np.array([150.0, -80], np.float32))
    one, two = (rows(played(each, [0, 1]))[0] for each in (segment, other))
    for name, value in one.items():
        assert two[name] == (pytest.approx(value, abs=2e-2) if isinstance(value, float) else value), name


def test_the_command_writes_page_numbers_and_table(tmp_path, capsys):
    types, sim = np.array([AgentType.VEHICLE, AgentType.CYCLIST], np.uint8), tmp_path / "sim"
    hit = driving((0, 0, 0, 12), (10, 0, 0, 7), segment_id="a&b <i>")
    free = driving((0, 0, 0, 7), (10, 0, 0, 7), segment_id="free", agent_type=types)
    save_rollouts(sim, ABOUT, [played(hit), played(free)])
    assert main(["report", str(sim)]) == 0
    assert re.search(r"max_jerk +0\.00 ", capsys.readouterr().out)
    found = json.loads((sim / "report.json").read_text())
    wanted = {"runs": 2, "failed_runs": 0, "collision_rate": 50.0, "at_fault_collision_rate": 50.0}
    assert found.items() >= wanted.items()
    assert found["progress"] == pytest.approx((12 * 4 + 7 * 4) / 2, rel=1e-4)
    assert found["max_jerk"] == pytest.approx(0, abs=1e-3)
    assert [row["segment"] for row in found["per_run"]] == ["a&b <i>", "free"]
    page = (sim / "report.html").read_text()
    # Two seconds before the first event, at 1.2 s, there was nothing yet.
    assert "view.html#segment=a%26b+%3Ci%3E&rollout=0&t=0&follow=ego" in page
    assert "<i>" not in page.split("<body>")[1].split("<script>")[0]
    assert not re.search("src=|http", page)
    assert (sim / "view.html").is_file()
    assert main(["report", str(sim), "--no-view", "--out", str(tmp_path / "other")]) == 0
    written = sorted(path.name for path in (tmp_path / "other").iterdir())
    assert written == ["report.csv", "report.html", "report.json"]
    assert main(["report", str(tmp_path / "nothing")]) == 1
    assert "not a folder of rollouts" in capsys.readouterr().err


SCRIPT = load_script("relations")
relations, paired_lines = SCRIPT.relations, SCRIPT.paired_lines
MEANS = dict.fromkeys(("collision_rate", "offroad_time", "ade", "min_sade"), 1.0)
SEGMENTS = 12


def filled(record: dict[str, Any], parts: float = 0.0, **means: float) -> dict[str, Any]:
    """A record whose segments scatter around the given means; noise is that of the segment, not of the method."""
    rng, means = np.random.default_rng(0), MEANS | means
    noise, steps = rng.uniform(0.5, 1.5, SEGMENTS), rng.integers(0, 20, SEGMENTS)
    means["collision_rate_at_states"] = means["collision_rate"]
    rows: list[dict[str, Any]] = [{"segment": f"s{k}", "group": f"g{k // 2}"} for k in range(SEGMENTS)]
    for key, mean in means.items():
        weight = steps if key in WEIGHTED else np.ones(SEGMENTS)
        for row, n, w in zip(rows, noise / np.average(noise, weights=weight), weight, strict=True):
            row |= {key: mean * n if w else None, f"{key}_weight": float(w)}
    record |= means | {"per_segment": rows, "segments": len(rows)}
    record["curvature"] |= {"parts": {f"g{k}": parts + 0.001 * k for k in range(SEGMENTS // 2)}}
    return record


def entry(method: str, seed: int = 0, parts: float = 0.0, **means: float) -> Entry:
    found = make_entry(method, seed)
    filled(found.record, parts, **means)  # type: ignore[arg-type]
    return found


def of(found: list[Any], metric: str, before: str, after: str) -> Any:
    (one,) = (r for r in found if (r["metric"], r["before"], r["after"]) == (metric, before, after))
    return one


@settings(max_examples=15)
@given(st.floats(0.1, 90), st.floats(0.01, 90), st.floats(0.01, 90))
def test_factors_are_held_from_their_bound_on(before: float, after: float, other: float) -> None:
    entries = [entry("bc", collision_rate=before)]
    entries += [entry("bc_ts_h", seed, collision_rate=rate) for seed, rate in enumerate((after, other))]
    found = of(relations(entries), "collision_rate", "bc", "bc_ts_h")
    assert found["value"] == pytest.approx(before / np.mean([after, other]))
    assert found["held"] == (found["value"] >= 9.3)
    # What is hard is as much harder in one as in the other: paired, the factor has no error.
    assert found["se"] == pytest.approx(0.0, abs=1e-9)


@settings(max_examples=15)
@given(st.floats(1, 9), st.floats(1, 9))
def test_differences_are_held_by_their_sign(before: float, after: float) -> None:
    one = of(relations([entry("bc_h", ade=before), entry("bc_ts_h", ade=after)]), "ade", "bc_h", "bc_ts_h")
    assert (one["value"], one["held"]) == (pytest.approx(after - before), after < before)
    assert one["clear"] == (abs(one["value"]) > 2 * one["se"])


@pytest.mark.parametrize(("shift", "shown"), [(0.01, "✓"), (0.0001, "≈"), (-0.01, "✗")])
def test_divergences_must_differ_by_more_than_sampling(shift: float, shown: str) -> None:
    rng, entries = np.random.default_rng(0), [entry("bc"), entry("bc_ts")]
    for one, mean in zip(entries, (0.0, shift), strict=True):
        values = mean + (noise := rng.normal(0, 0.001, 40)) - noise.mean()
        one.record["curvature"]["parts"] = {f"g{k}": part for k, part in enumerate(values)}
    found = of(relations(entries), "curvature_jsd", "bc", "bc_ts")
    assert (SCRIPT.mark(found), found["value"]) == (shown, pytest.approx(shift))
    assert found["se"] == pytest.approx(0.001 * np.sqrt(2 / 40), rel=0.4)
    # Without the single recording that makes it there is no turn left: no number, and the same one for all others.
    for one, value in zip(entries, (0.01, 0.02), strict=True):
        one.record["curvature"]["parts"] = {"a": None, "b": value, "c": value}
    assert of(relations(entries), "curvature_jsd", "bc", "bc_ts")["held"] is None


def test_what_cannot_be_said_is_not_said() -> None:
    level = relations([entry("bc"), entry("bc_ts")])
    assert of(level, "collision_rate", "bc", "bc_ts")["held"] is False  # what stays the same does not fall
    entries = [entry("bc", 0), entry("bc_ts", 0, collision_rate=0.0)]
    verdicts = [of(relations(entries), "collision_rate", "bc", after)["held"] for after in ("bc_ts", "mgail")]
    assert verdicts == [True, None]
    one = of(relations([entry("bc"), entry("bc_ts_h", collision_rate=0.0)]), "collision_rate", "bc", "bc_ts_h")
    assert (one["held"], one["value"], one["clear"]) == (True, np.inf, False)
    for one in entries:
        one.record["per_segment"] = []  # type: ignore[index]
    with pytest.raises(ConfigError, match="share no run segment"):
        relations(entries)
    del entries[0].record["per_segment"]  # type: ignore[attr-defined]
    with pytest.raises(DataError, match="per_segment"):
        relations(entries)


def test_paired_differences_are_over_what_both_have_and_over_recordings() -> None:
    def shifted(method: str, seed: int, shift: float) -> Entry:
        found = entry(method, seed)
        for row in found.record["per_segment"]:
            row |= {key: row[key] + shift for key in (*MEANS, "collision_rate_at_states") if row[key]}
        return found

    (line,) = paired_lines([shifted("bc", 0, 0.0), shifted("bc", 1, 1.0), shifted("bc_h", 0, 2.5)], "bc")
    # Seeds are averaged first, and a shift that is the same everywhere has no error.
    numbers = "collision +2.00 ± 0.00 %, off-road +2.00 ± 0.00 %, ADE +2.00 ± 0.00 m, minSADE +2.00 ± 0.00 m"
    assert line == f"BC+H less BC: {numbers} (12 segments of 6 groups)"
    fewer = shifted("bc_h", 0, 2.5)
    fewer.record["per_segment"].pop()
    assert "11 segments" in paired_lines([shifted("bc", 0, 0.0), fewer], "bc")[0]
    fewer.record["per_segment"][3]["ade"] = "far"
    with pytest.raises(DataError, match="ade"):
        paired_lines([shifted("bc", 0, 0.0), fewer], "bc")
    with pytest.raises(ConfigError, match="not among the methods"):
        paired_lines([shifted("bc", 0, 0.0)], "mgail")


@given(st.lists(st.floats(-5, 5), min_size=2, max_size=30))
def test_errors_over_groups_of_one_are_the_usual_ones(values: list[float]) -> None:
    numbers = np.array(values)
    mean, error = clustered_mean(numbers, np.arange(len(numbers)))
    assert mean == pytest.approx(numbers.mean())
    assert error == pytest.approx(numbers.std(ddof=1) / np.sqrt(len(numbers)), abs=1e-12)
    # Copies within a group tell nothing new.
    twice = clustered_mean(np.repeat(numbers, 2), np.repeat(np.arange(len(numbers)), 2))
    assert twice == pytest.approx((mean, error), abs=1e-9)
    # One group that holds nearly all still has an error: that of leaving out each in turn.
    member = np.minimum(np.arange(len(numbers)), 1)
    shift = abs(numbers[0] - numbers[1:].mean()) * np.array([len(numbers) - 1, 1]) / len(numbers)
    assert clustered_mean(numbers, member)[1] == pytest.approx(np.sqrt((shift**2).sum() / 2), abs=1e-9)


def test_the_paper_s_own_figures_have_the_paper_s_relations() -> None:
    """Up to rounding: the paper's factors themselves are given to one digit."""
    figures, entries = paper_figures("main", "proprietary"), []
    for method in METHODS:
        means = {key: mean for key, (mean, _) in figures[method].items()}
        entries.append(entry(method, parts=means.pop("curvature_jsd"), **means))
    for one in (found := relations(entries)):
        assert one["held"] in (None, True) or one["value"] > one["does"] - 0.06, one
        assert one["paper"]["proprietary"] == pytest.approx(one["value"])
    # Both data sets rise, one of them clearly; they disagree; both fall, neither clearly.
    steps = ("min_sade", "bc", "mgail"), ("collision_rate", "bc", "bc_h"), ("curvature_jsd", "mgail", "mgail_h")
    assert [of(found, *step)["does"] for step in steps] == ["rises", None, None]
    assert {one["does"] for one in relations([], "long")} == {9.3, 6.4, 2.2, "falls", "rises", None}


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path / "bc", "bc", 0, filled(make_record()))
    SCRIPT.main([str(run), "--json", str(tmp_path / "relations.json")])
    assert len(json.loads((tmp_path / "relations.json").read_text())) == 5 * len(SCRIPT.STEPS) + 3
    steps, factors = capsys.readouterr().out.strip().split("\n\n")
    assert (steps.count("\n"), steps.count("–")) == (2 + len(SCRIPT.STEPS) - 1, 5 * len(SCRIPT.STEPS))
    assert "| BC to BC+TS+H: collision falls at least 9.3 times " in factors
    make_run(tmp_path / "mgail", "mgail", 0, filled(make_record(), ade=3.0))
    SCRIPT.main([str(tmp_path), "--paired", "bc"])
    assert "MGAIL less BC" in capsys.readouterr().out
    make_run(tmp_path / "two", "bc", 1, filled(make_record(search="tree", trees=1, branches=16, rule="best")))
    with pytest.raises(ConfigError, match="BC was simulated in several ways"):
        SCRIPT.main([str(tmp_path)])
