"""Planners of every kind: functions, files, batches, other processes, slow ones; and what compares them."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import shutil
import signal
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from helpers_agents import small
from helpers_segments import crossing, hide, make_road, make_segment, straight_road
from helpers_store import fill, stored
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import EvaluateConfig
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError
from symphony.evaluation import planners as compared
from symphony.learning.demonstrations import SceneDataset
from symphony.planners.interface import Control, Pose, Scenario, Traffic, checked_plan, scenario_of
from symphony.planners.view import FunctionPlanner, Observation, lanes_of
from symphony.rollouts.crowd import crowd_dataset
from symphony.saved.folder import RolloutFolder, load_rollouts
from symphony.saved.saving import save_simulation

AGENT = "pretrained:bc_ts_h"
PROCESS = """
import json, os, sys, time
kind, said = sys.argv[1:]
if kind == "child" and os.fork() == 0:
    open(said, "a").write(f"{os.getpid()}\\n")
    time.sleep(100)
if kind == "env":
    open(said, "w").write(json.dumps(dict(os.environ)))
for line in sys.stdin:
    told = json.loads(line)
    step = told["plan"]["step"] if "plan" in told else None
    plan = json.dumps({} if step is None else {"step": step, "plan": [-1.0, 0.0]})
    if step is not None:
        assert len(told["plan"]["agents"]["x"]) == len(told["plan"]["agents"]["type"])
    while step == 2 and kind == "flood":
        sys.stdout.write("x" * 65536)
    if step == 2 and kind == "binary":
        sys.stdout.buffer.write(b"\\xff\\x00\\n")
        sys.stdout.flush()
    if step == 2 and kind == "debug":
        print([0.0, 0.0], flush=True)
    print(said if step == 2 and kind == "says" else plan, flush=True)
    if step == 2 and kind == "twice":
        print(plan, flush=True)
        time.sleep(0.1)
"""


def brakes(observation: Observation) -> Control:
    return Control(-1.0, 0.0)


class Together:
    """Brakes; all of a batch are asked at once."""

    asked: list[int] = []  # noqa: RUF012 - counted over all

    def reset(self, scenario: Scenario) -> None: ...

    def plan(self, traffic: Traffic) -> Any:
        raise AssertionError("asked alone")

    @classmethod
    def plan_batch(cls, planners: list[Any], traffics: list[Traffic]) -> Any:
        assert len(planners) == len(traffics)
        cls.asked.append(len(planners))
        return np.tile([-1.0, 0.0], (len(planners), 1))


store = stored(lambda: [crossing(4, steps=11), straight_road(4, steps=11)])


def run(store: Path, out: Path, planner: Any, agent: str = "", **settings: Any) -> RolloutFolder:
    known = load_agent(agent) if agent else small()
    count = 1 if known.policy is None else 2
    data = SceneDataset(SegmentStore(store), count, known.dynamics, routes=True, duration=2)
    how = {name: settings.pop(name) for name in ("planner_seconds", "drives") if name in settings}
    config = EvaluateConfig(**{"rollouts": 2, "search": "none", **settings})
    return save_simulation(out, known, data, config, planner=planner, **how)


def alone(store: Path, out: Path, planner: Any, **settings: Any) -> RolloutFolder:
    """One run of each segment beside log playback."""
    return run(store, out, planner, "playback", rollouts=1, **settings)


def process(tmp_path: Path, kind: str, said: str = "") -> str:
    (tmp_path / "process.py").write_text(PROCESS)
    return f"pipe:{sys.executable} {tmp_path}/process.py {kind} '{said or tmp_path / 'said'}'"


def test_equal_planners_of_every_kind_drive_alike(store: Path, tmp_path: Path) -> None:
    """A function, a function in a file, a batch and a process that plan the same lead to the same states."""
    (tmp_path / "beside.py").write_text("BRAKING = 1.0\n")
    (tmp_path / "my.py").write_text("from beside import BRAKING\nplan = lambda seen: (-BRAKING, 0.0)\n")
    kinds: dict[str, Any] = {"function": brakes, "file": f"{tmp_path}/my.py:plan", "batch": Together}
    kinds["process"] = process(tmp_path, "brakes")
    found = {name: run(store, tmp_path / name, planner) for name, planner in kinds.items()}
    first = np.stack([saved.state for saved in found["function"]])
    assert (np.diff(first[..., 0, 3], axis=2) <= 0).all()
    for name, folder in found.items():
        np.testing.assert_array_equal(np.stack([saved.state for saved in folder]), first, err_msg=name)
        assert not any(saved.failed for saved in folder)
    assert (max(Together.asked), found["function"].about.drivers["ego"]) == (4, f"{__name__}:brakes")
    assert found["file"].about.drivers["ego"] == kinds["file"]


@pytest.mark.parametrize(("kind", "said", "why"), [
    ("says", '{"step": 2, "plan": [NaN, 0.0]}', "step 2: .*not finite"),
    ("says", "[-1.0, 0.0]", 'step 2: ValueError: answered .* not {"step": 2, '),
    ("says", '{"error": "lost my way"}', "step 2: RuntimeError: lost my way"),
    ("says", "what?", "step 2: JSONDecodeError"), ("flood", "", "step 2: .*an answer of more than 1048576 bytes"),
    ("binary", "", "step 2: .*(UnicodeDecodeError|JSONDecodeError|more than one line)"),
    ("debug", "", "step 2: .*(more than one line for an answer|answered)"),
    ("twice", "", "step [23]: .*(more than one line for an answer|answered)"),
])  # fmt: skip
def test_what_a_process_says_wrong_fails_the_run(store, tmp_path, kind, said, why):
    for saved in alone(store, tmp_path / "sim", process(tmp_path, kind, said)):
        assert re.search(why, saved.failed[0]), saved.failed
        assert saved.counted[0].sum() in (2, 3)


def test_a_process_that_ends_fails_its_run_and_cannot_be_forked(store: Path, tmp_path: Path) -> None:
    folder = alone(store, tmp_path / "one", f"pipe:{sys.executable} -c pass")
    assert all("ended (status 0) without an answer" in saved.failed[0] for saved in folder)
    tree: dict[str, Any] = {"search": "tree", "branches": 4, "rule": "best", "prune_every": 4}
    with pytest.raises(ConfigError, match=r"a process can't be copied.*--search none"):
        run(store, tmp_path / "two", process(tmp_path, "brakes"), **tree)


def test_what_a_process_started_ends_with_it(store: Path, tmp_path: Path) -> None:
    def lives(number: int) -> bool:
        """Whether there is such a process, and it is no zombie that nobody has asked for."""
        stat = Path(f"/proc/{number}/stat")
        return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] != "Z"

    assert not any(saved.failed for saved in alone(store, tmp_path / "sim", process(tmp_path, "child")))
    children = [int(word) for word in (tmp_path / "said").read_text().split()]
    assert len(children) == 2
    late = time.monotonic() + 10
    while time.monotonic() < late and any(map(lives, children)):
        time.sleep(0.05)
    assert not any(map(lives, children))


def test_a_process_gets_a_small_environment(store, tmp_path, monkeypatch):
    for name in ("SECRET", "GIVEN", "ALSO", "PYTHONHASHSEED", "LANG"):
        monkeypatch.setenv(name, "1")
    monkeypatch.setenv("SYMPHONY_PLANNER_ENV", "GIVEN, ALSO")
    alone(store, tmp_path / "sim", process(tmp_path, "env"))
    found = json.loads((tmp_path / "said").read_text()).keys()
    assert {"GIVEN", "ALSO", "PATH", "PYTHONHASHSEED", "LANG"} <= found
    # LC_CTYPE is Python's own doing.
    others = found - {"GIVEN", "ALSO", "PATH", "HOME", "LANG", "LC_CTYPE"}
    assert all(name.startswith("PYTHON") for name in others), others


@pytest.mark.parametrize("how", ["busy", "sleeping", "stubborn", "deaf"])
def test_one_that_takes_too_long_fails_its_run(store: Path, tmp_path: Path, how: str) -> None:
    def slow(observation: Observation) -> tuple[float, float]:
        while observation.step == 3:
            try:
                if how != "busy":
                    time.sleep(60)
            except BaseException as error:
                if how == "deaf":
                    break
                if how != "stubborn" or not isinstance(error, Exception):
                    raise
        return 0.0, 0.0

    for saved in alone(store, tmp_path / "sim", slow, planner_seconds=0.5):
        late = f"step 3: TimeoutError: took more than 0.5 s ({Path(__file__).name}:"
        assert saved.failed[0].startswith(late)
        assert saved.counted[0].sum() == 3


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize(("number", "how"), [
    (signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit), (signal.SIGTERM, OSError),
])  # fmt: skip
def test_what_ends_the_command_is_not_the_planners_to_catch(store, tmp_path, number, how, late):
    def careful(observation: Observation) -> tuple[float, float]:
        with contextlib.suppress(BaseException):
            time.sleep(2 * late)
        signal.signal(signal.SIGALRM, signal.SIG_IGN)  # for an alarm of its own
        with contextlib.suppress(BaseException):
            os.kill(os.getpid(), number)
            time.sleep(1)
        return -5.0, 0.0

    def ended(number: int, frame: object) -> None:
        signal.signal(number, signal.SIG_IGN)
        raise how

    alarm, before = signal.getsignal(signal.SIGALRM), signal.signal(number, ended)
    try:
        with pytest.raises(how):
            alone(store, tmp_path / "sim", careful, planner_seconds=0.2 if late else 60)
        assert (signal.getsignal(number), signal.getsignal(signal.SIGALRM)) == (signal.SIG_IGN, alarm)
    finally:
        signal.signal(number, before)


def test_of_a_trajectory_the_first_state_is_driven() -> None:
    poses = [Pose(1.0 + k, 2.0, 0.1, 5.0) for k in range(4)]
    at = np.array([0.0, 2.0, 0.1, 5.0])
    assert checked_plan(poses, at, 0.2).tolist() == list(poses[0])
    assert [checked_plan((1.0, 2.0, 0.1, v), at, 0.2)[3] for v in (0, 2.95, 7.05, 9)] == [5, 2.95, 7.05, 5]
    for wrong in (np.zeros((0, 4)), np.zeros((3, 2)), np.zeros((2, 2, 4))):
        with pytest.raises(ValueError, match="a plan is"):
            checked_plan(wrong, at, 0.2)
    with pytest.raises(ValueError, match="not finite"):
        checked_plan([poses[0], (np.nan, 0, 0, 0)], at, 0.2)


def test_the_observation_is_all_in_si_units(store: Path, tmp_path: Path) -> None:
    seen: list[Observation] = []

    def looks(observation: Observation) -> Pose:
        seen.append(observation)
        return Pose(*observation.ego[:3], -1.0)

    by_segment = {saved.segment.segment_id: saved for saved in alone(store, tmp_path / "sim", looks)}
    assert {one.segment_id for one in seen} == set(by_segment)
    for one in seen:
        saved, t, agents = by_segment[one.segment_id], one.step, one.agents
        segment = saved.segment
        others = segment.valid[:, t] & (np.arange(segment.num_agents) != segment.ego)
        assert (one.time, one.dt) == (pytest.approx(t * segment.dt), pytest.approx(segment.dt))
        ego = [*saved.state[0, t, 0], *segment.size[segment.ego, :2]]
        np.testing.assert_allclose(one.ego, ego, atol=1e-4)
        moves = np.stack([agents.x, agents.y, agents.vx, agents.vy], -1)
        logged = np.concatenate([segment.position[others, t, :2], segment.velocity[others, t]], -1)
        np.testing.assert_allclose(moves, logged, atol=1e-4)
        assert (agents.id.tolist(), set(agents.type)) == (segment.agent_id[others].tolist(), {"vehicle"})
        assert len(one.lanes) == len(segment.road.lanes)
        assert not any(lane.points.flags.writeable for lane in one.lanes)
        assert one.route.ndim == 2
        # The last 2 s are as they were seen then.
        before = {other.step: other for other in seen if other.segment_id == one.segment_id}
        for past, then in zip(one.history, (before[step] for step in range(max(t - 10, 0), t)), strict=True):
            np.testing.assert_allclose([past.time, *past.ego], [then.time, *then.ego], atol=1e-4)
            for mine, other in zip(past.agents, then.agents, strict=True):
                np.testing.assert_array_equal(mine, other)


def test_only_the_ego_is_told_the_goal_of_its_planning_problem() -> None:
    segment = straight_road(3).replace(goal=[1.0, 2.0])
    goals = [scenario_of(segment, k, np.zeros((0, 2)), np.zeros(4), 0).goal for k in (segment.ego, 2)]
    np.testing.assert_allclose(goals, [segment.goal, segment.position[2, -1, :2]])


def test_bounds_and_neighbours_of_lanes() -> None:
    """Bounds lie half a width beside the centre line, by shapely, on its two sides; links are those of the map."""
    for segment, lost in ((straight_road(3), False), (crossing(4), False), (crossing(4), True)):
        road = segment.road
        width = np.where(lost & (np.arange(len(road.lanes)) == 0), np.nan, road.lane_width)
        known = segment.replace(road=dataclasses.replace(road, lane_width=width.astype(np.float32)))
        lanes = lanes_of(scenario_of(known, 0, np.zeros((0, 2)), np.zeros(4), 0))
        assert np.isnan(lanes[0].left).all() == np.isnan(lanes[0].right).all() == lost
        for k, lane in enumerate(lanes[lost:], start=int(lost)):
            middle = shapely.LineString(lane.points)
            for bound in (lane.left, lane.right):
                away = shapely.distance(middle, shapely.points(bound))
                np.testing.assert_allclose(away, lane.width / 2, rtol=2e-2)
            np.testing.assert_allclose((lane.left + lane.right) / 2, lane.points, atol=1e-9)
            assert shapely.LinearRing([*lane.right, *lane.left[::-1]]).is_ccw
            for name in ("successors", "predecessors", "left_neighbors", "right_neighbors"):
                pairs = road.successors[:, ::-1] if name == "predecessors" else getattr(road, name)
                assert set(getattr(lane, name)) == set(road.lane_id[pairs[pairs[:, 0] == k, 1]].tolist())


FINE = dict.fromkeys(("failed", "at_fault_collision", "red_lights", "beyond_route", "no_route", "offroad_time"), 0)


@pytest.mark.parametrize(("changes", "score"), [
    ({}, 50.0), ({"progress_ratio": 1.4}, 100.0), ({"progress_ratio": -0.1}, 0.0), ({"progress_ratio": None}, 100.0),
    ({"progress_ratio": None, "beyond_route": 1, "no_route": 0}, None),
    ({"progress_ratio": None, "beyond_route": 0, "no_route": 1}, None),
    ({"progress_ratio": None, "beyond_route": 1, "at_fault_collision": True}, 0.0),
    ({"progress_ratio": None, "beyond_route": None, "failed": "why"}, 0.0),
    ({"collision": True}, 50.0), ({"red_lights": 1}, 0.0), ({"offroad_time": 2.0}, 0.0),
    ({"progress_ratio": None, "logged_steps": 0}, None),
])  # fmt: skip
def test_the_score_of_a_run(changes: dict[str, Any], score: float | None) -> None:
    assert compared.run_score({**FINE, "progress_ratio": 0.5, **changes}) == score


def test_the_command_compares_planners_among_crowds(store, tmp_path, capsys):
    words = ["--data", str(store), "--rollouts", "2", "--search", "none", "--duration", "2"]
    places = [str(tmp_path / name) for name in ("idm", "log")]
    for name, place in zip(("idm", "log"), places, strict=True):
        assert main(["simulate", AGENT, "--planner", name, *words, "--out", place]) == 0
    capsys.readouterr()
    assert main(["planners", *places, "--json", "-"]) == 0
    records = json.loads(capsys.readouterr().out)["records"]
    assert records == [compared.planner_record(load_rollouts(place)) for place in places]
    assert [(one["planner"], len(one["per_run"])) for one in records] == [("idm", 4), ("log", 4)]
    assert main(["planners", *places]) == 0
    table = capsys.readouterr().out.splitlines()
    # What a suite does not save is as usual; beside the log, who enters and which lights counts, too.
    saved = dict(records[0]["settings"])
    del saved["lights"], saved["after_collision"]
    compared.check_crowds([records[0] | {"settings": saved}, records[1]])
    for more in ({"inflow": 1.0}, {"lights": [5.0, 1.0, 1.0]}, {"drives": {"3": "idm"}}):
        beside = [one | {"crowd": "playback"} for one in records]
        beside[1]["settings"] = beside[1]["settings"] | more
        with pytest.raises(ConfigError, match=next(iter(more))):
            compared.check_crowds(beside)
    for alone in (["--others", "idm"], ["--after-collision", "stop"]):
        assert main(["simulate", "playback", *alone, *words, "--out", str(tmp_path / "alone")]) == 1
        assert "is all log" in capsys.readouterr().err
    assert re.match(r"\| crowd +\| +planner \| +score \|", table[0])
    assert sorted(line.split("|")[2].strip() for line in table[2:4]) == ["idm", "log"]
    assert table[-1] == compared.winners(records)[0]
    assert main(["planners", str(store)]) == 1
    with pytest.raises(DataError, match="no planner drove here"):
        compared.planner_record(run(store, tmp_path / "bare", ""))


def test_a_segment_that_failed_is_no_recording_of_its_own(tmp_path: Path) -> None:
    late = hide(straight_road(3, seed=5, steps=11), 0, slice(0, 2))
    found = zip([crossing(3, steps=11), late, straight_road(3, steps=11)], "aab", strict=True)
    fill(tmp_path / "store", [segment.replace(group=group) for segment, group in found])
    record = compared.planner_record(alone(tmp_path / "store", tmp_path / "sim", "log"))
    assert {bool(one["failed"]): one["group"] for one in record["per_run"][1:]} == {False: "b", True: "a"}
    apart = {"a": 0.0, "b": 0.0}
    for one in record["per_run"]:
        apart[one["group"]] += (compared.run_score(one) - record["score"]) / (1 if one["group"] == "a" else 2)
    assert record["score_se"] == pytest.approx(np.sqrt(sum(x**2 for x in apart.values()) / 2))


def test_runs_without_defined_progress_have_no_score(tmp_path: Path) -> None:
    """Beside all lanes, beyond a lane that ends inside the map, and beside a log that stands."""

    def driven(name: str, y: float, speed: float, end: int = 400) -> RunSegment:
        lanes = (end, 0), (400, 60), (400, -60)
        x = 20 + speed * 0.2 * np.arange(11.0)[None]
        lines = [np.array([(k, left) for k in range(0, stop, 2)], float) for stop, left in lanes]
        position, velocity = np.stack([x, y + 0 * x], -1), np.stack([speed + 0 * x, 0 * x], -1)
        return make_segment(make_road(lines), position, 0 * x, velocity, segment_id=name)

    where = {"way": (0, 10), "beside": (200, 10), "stands": (200, 0), "end": (0, 10, 30)}
    fill(tmp_path / "store", [driven(name, *place) for name, place in where.items()])
    record = compared.planner_record(alone(tmp_path / "store", tmp_path / "sim", lambda seen: Control(5.0, 0.0)))
    runs = {one["segment"]: one for one in record["per_run"]}
    names = ("progress_ratio", "beyond_route", "no_route")
    found = {key: tuple(one[name] for name in names) for key, one in runs.items()}
    assert found.pop("way") == (pytest.approx(1.5, abs=0.05), 0, 0)
    assert found == {"beside": (None, 0, 1), "stands": (None, 0, 0), "end": (None, 1, 0)}
    assert (record["score"], record["score_runs"]) == (pytest.approx(100, abs=0.01), 2)
    assert record["progress_ratio"] == runs["way"]["progress_ratio"]
    record["planner"] = "hurries"
    lost = [one for one in record["per_run"] if compared.run_score(one) is None]
    other = record | {"planner": "none", "score": None, "per_run": lost}
    lines = [re.split(r" *\| *", line)[2:5] for line in compared.planners_text([other, record]).splitlines()[2:4]]
    assert lines == [["hurries", "100.0 ± 0.0", "2"], ["none", "–", "2"]]
    assert compared.paired_difference(record, other) == (None, None, 0)
    assert compared.winners([other, record])[0].startswith("log: hurries is first, its error unknown, –")
    assert "is level with same" in compared.winners([record, record | {"planner": "same"}])[0]
    # Ahead by 2.7 standard errors over four recordings, where Student's t of 3 degrees asks for 3.2.
    for one, ahead in ((record, (0.0112, 0.0512)), (other, (0.0, 0.0))):
        runs = [{"segment": f"{k}", "group": f"{k % 4}", "progress_ratio": 0.5 + ahead[k % 2]} for k in range(8)]
        one |= {"per_run": [FINE | run for run in runs], "score": 50 + ahead[0]}
    assert compared.winners([other, record])[0].startswith("log: hurries is first, within the error, 3.1 ± 1.2")
    assert compared.paired_difference(record, other)[2] == 4
    uneven = record | {"per_run": [run | {"group": f"{max(k, 5)}"} for k, run in enumerate(record["per_run"])]}
    assert compared.paired_difference(uneven, other)[2] == pytest.approx(8**2 / (6**2 + 1 + 1))
    record["per_run"] = [run | {"progress_ratio": 0.6} for run in record["per_run"]]  # in all groups as much ahead
    assert compared.winners([other, record])[0].startswith("log: hurries is first, its error unknown, 10.0 above")


def several(out: Path, segment: RunSegment, planner: Any, drives: Any, agent: Any = "playback", **how: Any):
    """Rollouts in which agents beside the ego have planners of their own."""
    fill(out / "store", [segment])
    data, known = SegmentStore(out / "store"), load_agent(agent)
    config = EvaluateConfig(**{"rollouts": 1, "duration": 2, **how})
    scenes = crowd_dataset(data, known, config, default=1, routes=True, also=tuple(drives))
    return save_simulation(out / "sim", known, scenes, config, planner=planner, drives=drives)[0]


@pytest.mark.parametrize("planner", ["idm", brakes])
def test_an_agent_is_driven_alike_whoever_is_the_ego(planner: Any, tmp_path: Path) -> None:
    """By a planner of its own beside an ego that plays back its log, or as the ego itself."""
    segment = straight_road(4, steps=11)
    beside = several(tmp_path / "a", segment, "log", {int(segment.agent_id[2]): planner})
    alone = several(tmp_path / "b", segment.replace(ego=2, segment_id="own"), planner, {})
    assert (beside.agents.tolist(), beside.drivers) == ([segment.ego, 2], ("log", *alone.drivers))
    np.testing.assert_allclose(beside.state[0, :, 1], alone.state[0, :, 0], atol=1e-3)
    np.testing.assert_allclose(beside.state[0, :, 0, :2], segment.position[segment.ego, :11, :2], atol=1e-3)
    assert np.abs(np.diff(alone.state[0, :, 0, 3])).max() > 0


TREE = {"search": "tree", "branches": 6, "prune_every": 4, "score": "flags"}


@pytest.mark.parametrize("search", [{}, TREE])
def test_two_planners_each_see_the_scene_from_their_own_seat(search: Any, tmp_path: Path) -> None:
    """And draw numbers of their own; a search copies both with its branches."""

    class Wanders:
        def reset(self, scenario: Scenario) -> None:
            self.rng, self.me, self.at = np.random.default_rng(scenario.seed), scenario.ego, scenario.state

        def plan(self, seen: Traffic) -> list[Pose]:
            assert (seen.ego, np.abs(seen.state - self.at).max() < 1e-3) == (self.me, True), "another's"
            assert sorted(np.abs(seen.position[list(ends)] - self.at[:2]).max(1) > 1) == [False, True]
            self.at = self.at + np.array([0.2 * self.at[3] + 0.3 * self.rng.random(), 0, 0, 0])
            ends[self.me].append(self.at[0])
            return [Pose(*self.at), Pose(*self.at)]

    segment, ends = straight_road(4, steps=11), {0: list[float](), 2: list[float]()}
    drives = {int(segment.agent_id[2]): Wanders}
    saved = several(tmp_path, segment, Wanders, drives, AGENT, rollouts=2, **search)
    assert saved.failed == {}
    for place, row in enumerate(ends):
        assert np.abs(np.subtract.outer(saved.state[:, 1:, place, 0], ends[row])).min(-1).max() < 1e-3
    np.testing.assert_allclose(saved.plan[:, :, :, 1], saved.state[:, 1:, :2, :2].swapaxes(1, 2), atol=1e-3)
    steps = np.concatenate([np.diff(ends[row]) for row in ends])
    assert len(np.unique(steps.round(6))) == len(steps), "planners draw alike"


def test_planners_of_others_fail_by_their_name_and_what_can_not_be_is_told(store, tmp_path, capsys):
    late = lambda end: partial(FunctionPlanner, lambda seen: (0.0, 0.0) if seen.step < end else None)  # noqa: E731
    segment = crossing(4, steps=11)
    saved = several(tmp_path, segment, late(5), {(agent := int(segment.agent_id[1])): late(3)})
    assert saved.failed[0].startswith(f"agent {agent}, step 3: ")
    assert saved.counted[0].sum(0).tolist() == [3, 3]
    words = f"simulate playback --data {tmp_path / 'store'} --duration 2 --out {tmp_path / 'out'} --planner"
    for given, status, why in (
        ("3=idm", 1, "the ego has one planner, there is none"), ("idm log", 1, "2 are named: idm, log"),
        (f"idm {agent}=log {agent}=idm", 1, f"agent {agent} already has another one"),
        (f"idm {agent}=no.py:plan", 1, "no such file"),
        (f"idm {agent}=log --goal {agent}=1,2", 1, f"a planner drives agent {agent}"),
        ("idm 99=log", 3, "99: not all are ids of vehicles beside the ego"), (f"log {agent}=idm", 0, ""),
    ):  # fmt: skip
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        assert main([*words.split(), *given.split()]) == status
        assert why in capsys.readouterr().err
    with pytest.raises(ConfigError, match="agent 7, which has a planner, is not driven"):
        run(store, tmp_path / "x", "log", drives={7: "log"})
    with pytest.raises(ConfigError, match="only beside one of the ego"):
        run(store, tmp_path / "x", "", drives={7: "log"})
