"""A planner as the ego: what it observes, how it is forked and fails; the included ones in hand-made scenes."""

from __future__ import annotations

import json
import re
import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from shapely import LineString, Point

from helpers_agents import small
from helpers_segments import CAR, LANE_WIDTH, along, crossing, hide, make_road, make_segment, ring, straight_road
from helpers_store import fill, stored
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import EvaluateConfig
from symphony.data.builtin import builtin_store
from symphony.data.segment import RunSegment, SignalState
from symphony.data.store import SegmentStore
from symphony.envs.dynamics import WHEELBASE
from symphony.envs.scene import collate, scene
from symphony.errors import ConfigError, DataError
from symphony.evaluation.report import report
from symphony.learning.demonstrations import SceneDataset
from symphony.planners import interface
from symphony.planners.driver import EgoPlanners, route_from
from symphony.planners.included import IDMPlanner
from symphony.planners.interface import Control, Pose, Scenario, Traffic, planner_maker
from symphony.planners.view import FunctionPlanner, Observation
from symphony.roadgraph import LaneGraph
from symphony.rollouts.driving import Simulation, beside_planner, simulation, spread_runs
from symphony.saved.folder import load_rollouts
from test_planner_kinds import run

AGENT = "pretrained:bc_ts_h"


class Wanderer:
    """Accelerates at random, and notices when it is not where it went or is asked twice."""

    def reset(self, scenario: Scenario) -> None:
        self.rng = np.random.default_rng(scenario.seed)
        self.state, self.step = scenario.state, 0

    def plan(self, traffic: Traffic) -> Pose:
        before = len(traffic.past) == len(traffic.past_valid) == min(traffic.step, 10)
        if traffic.step != self.step or not before or not np.allclose(traffic.state, self.state, atol=1e-3):
            raise RuntimeError("taken for another")
        x, y, heading, speed = traffic.state
        self.step, travel = self.step + 1, 0.2 * speed
        speed = max(speed + 0.5 * self.rng.normal(), 0.0)
        self.state = np.array([x + travel * np.cos(heading), y + travel * np.sin(heading), heading, speed])
        return Pose(*self.state)


class Shared(Wanderer):
    """Its copies are itself."""

    def __deepcopy__(self, memo: Any) -> Shared:
        return self


class Locked(Wanderer):
    """Can't be copied."""

    def __init__(self) -> None:
        self.lock = threading.Lock()


def dataset(count: int = 2) -> SceneDataset:
    store = SegmentStore(builtin_store("test"))
    return SceneDataset(store, 2, small().dynamics, range(count), routes=True, duration=1.2)


def simulated(make: Any, count: int = 2, **settings: Any) -> Any:
    data = dataset(count)
    egos = EgoPlanners("mine", make, [data.segment(i) for i in range(count)])
    config = EvaluateConfig(**{"rollouts": 4, "search": "none", **settings})
    return simulation(small(), data.scenes(range(count)), config, egos=[egos], keep_tree=True)


TREE: dict[str, Any] = {"search": "tree", "branches": 6, "rule": "best", "prune_every": 3}
SEARCHES = [{"search": "none"}, TREE, {"search": "tree", "branches": 6, "rule": "systematic", "trees": 2}]


class Foreseeing(Wanderer):
    """Gives back a trajectory whose end tells its branch by what all agents did; at times the next state alone."""

    def plan(self, traffic: Traffic) -> Any:
        pose = super().plan(traffic)
        seen = traffic.position[traffic.valid & (np.arange(len(traffic.valid)) != traffic.ego)].sum(0)
        return pose if traffic.step % 3 == 2 else [*[pose] * 29, Pose(*seen, 0.0, 0.0)]


@pytest.mark.parametrize("settings", SEARCHES, ids=lambda given: "-".join(map(str, given.values())))
def test_planners_are_forked_with_their_branches(settings: dict[str, Any]) -> None:
    """One that went one way is never asked about another; trajectories are those of the branch that drove them."""
    found = simulated(Foreseeing, **settings)
    assert found.failed == ({}, {})
    if settings["search"] == "tree":
        parents = found.search.parents[..., :-1, :]
        assert (parents != torch.arange(parents.shape[-1])).any(), "nobody was forked"
    places = found.rollouts.state[..., :2].numpy()
    for (meant,), both in zip(np.moveaxis(found.meant, 2, 1), places, strict=True):
        state, other = both[:, :, 0], both[:, :-1, 1]
        assert settings["search"] != "none" or (state[0] != state[1]).any()
        assert meant.shape == (len(state), state.shape[1] - 1, 20, 2)
        said = np.isfinite(meant[:, :, 0]).all(-1)
        assert (said == (np.arange(said.shape[1]) % 3 != 2)).all()
        np.testing.assert_allclose(meant[:, :, 0][said], state[:, 1:][said], atol=1e-3)
        logged = (meant[:, :, -1] - other)[:, said[0]]  # of all but the two who are driven
        np.testing.assert_allclose(logged, logged[:1].repeat(len(logged), 0), atol=2e-2)
    assert settings["search"] != "none" or simulated(Wanderer).meant == (None, None)


def test_planners_that_share_their_memory_are_taken_for_another() -> None:
    found = simulated(Shared, **TREE)
    assert any("taken for another" in why for each in found.failed for why in each.values())


def test_one_that_cannot_be_copied_drives_without_a_search() -> None:
    assert simulated(Locked).failed == ({}, {})
    with pytest.raises(ConfigError, match=r"'mine' can't be copied.*--search none"):
        simulated(Locked, **TREE)
    # Said before the work, also where no branch might turn out to be copied.
    with pytest.raises(ConfigError, match="can't be copied"):
        simulated(Locked, **(TREE | {"rule": "replace", "threshold": 1e9}))


@pytest.mark.parametrize("score", ["discriminator", "rule"])
def test_the_search_scores_learned_agents_only(score: str) -> None:
    result = simulated(Wanderer, search="tree", score=score, branches=6).search
    assert (result.simulated_scores[..., 0] == 0).all()
    if score == "discriminator":
        assert (result.simulated_scores[..., 1] != 0).all()


def test_it_sees_everyone_and_its_controls_are_a_vehicles() -> None:
    seen: list[Traffic] = []
    told: list[Scenario] = []

    class Pushes:
        def reset(self, scenario: Scenario) -> None:
            told.append(scenario)

        def plan(self, traffic: Traffic) -> Control:
            seen.append(traffic)
            return Control(99.0 if traffic.step < 3 else -99.0, 0.0)

    data = dataset()
    segment = data.segment(0)
    state = simulated(Pushes, rollouts=1).rollouts.state[0, 0].numpy()
    mine = [t for t in seen if t.ego == segment.ego and np.array_equal(t.size, segment.size[:, :2])]
    assert [t.step for t in mine] == list(range(segment.num_steps - 1))
    interactive = data.scenes([0]).interactive[0].tolist()
    others = np.setdiff1d(np.arange(segment.num_agents), interactive)
    for t in mine:
        for found, expected in (
            (t.position[interactive], state[t.step, :, :2]), (t.state, state[t.step, 0]),
            (t.position[others], segment.position[others, t.step, :2]),
            (t.velocity[others], segment.velocity[others, t.step]), (t.time, t.step * segment.dt),
        ):  # fmt: skip
            np.testing.assert_allclose(found, expected, atol=1e-4)
        assert (t.valid[others] == segment.valid[others, t.step]).all()
        assert (t.lights == segment.signal_state[:, t.step]).all()
    change = np.diff(state[:5, 0, 3]) / segment.dt
    np.testing.assert_allclose(change[:3], interface.MAX_ACCELERATION, atol=1e-3)
    assert change[3] == pytest.approx(-min(interface.MAX_BRAKING, state[3, 0, 3] / segment.dt), abs=1e-3)
    assert told[0].steps == segment.num_steps - 1
    assert np.linalg.norm(told[0].route[0] - segment.position[segment.ego, 0, :2]) < 4
    assert len({one.seed for one in told}) == len(told)
    assert route_from(np.array([[0.0, 0], [3, 0], [4, 0]]), 3.5)[0].tolist() == [3.5, 0]


def test_it_steers_a_vehicle_of_its_own_length() -> None:
    """Heading by the distance driven: with tan(slip) half of tan(steering), 2 sin(slip) over the wheelbase."""
    segment = dataset().segment(0)
    state = simulated(partial(FunctionPlanner, lambda _: Control(1.0, 0.2)), rollouts=1)
    path = state.rollouts.state[0, 0, :, 0].double()
    driven = (0.5 * (path[1:, 3] + path[:-1, 3]) * segment.dt).sum()
    turned = np.unwrap(path[:, 2].numpy())
    expected = 2 * np.sin(np.arctan(0.5 * np.tan(0.2))) / (WHEELBASE * float(segment.size[segment.ego, 0]))
    assert (turned[-1] - turned[0]) / float(driven) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("given", "why"), [
    (lambda _: 1 / 0, "step 3: ZeroDivisionError: division by zero (test_planner.py:"),
    (lambda _: (float("nan"), 0.0), "step 3: ValueError: a plan that is not finite"), (lambda _: None, "step 3: "),
    (lambda seen: Pose(seen.ego.x + 50, seen.ego.y, 0.0, 5.0), "a target 50.0 m away"),
    (lambda seen: Pose(seen.ego.x, seen.ego.y, 0.0, -90.0), "a target 0.0 m away at -90.0 m/s"),
    (lambda seen: seen.route.fill(0), "read-only"),
])  # fmt: skip
def test_what_is_odd_fails_the_run_from_there_on(given: Any, why: str) -> None:
    odd = partial(FunctionPlanner, lambda seen: given(seen) if seen.step == 3 else (0.0, 0.0))
    found = simulated(odd, count=1, rollouts=2)
    assert sorted(found.failed[0]) == [0, 1]
    assert why in found.failed[0][0]
    counted = found.rollouts.counted[0]
    assert counted[:, :3].all()
    assert not counted[:, 3:].any()
    assert found.rollouts.state.isfinite().all()


def test_failures_are_those_of_their_own_rollouts_in_a_search() -> None:
    """Half of the branches fail; no leaf is without what became of its own planner."""
    fates: dict[int, bool] = {}

    class Moody(Wanderer):
        def reset(self, scenario: Scenario) -> None:
            super().reset(scenario)
            self.bad = bool(fates.setdefault(scenario.seed, len(fates) % 2 == 0))

        def plan(self, traffic: Traffic) -> Pose:
            if self.bad and traffic.step == 2:
                raise RuntimeError("no more")
            return super().plan(traffic)

    found = simulated(Moody, count=1, search="tree", branches=6, rule="best", prune_every=4)
    first = found.search.slots[0, 0, 0].tolist()
    assert sorted(found.failed[0]) == [k for k, slot in enumerate(first) if slot % 2 == 0]


CALLS: list[tuple[str, int]] = []


def noted(seen: Observation) -> tuple[float, float]:
    CALLS.append((seen.segment_id, seen.step))
    return 0.0, 0.0


def test_nobody_plans_beyond_the_end_of_a_segment_beside_a_longer_one(tmp_path: Path) -> None:
    CALLS.clear()
    segments = [crossing(4, steps=4), straight_road(4, steps=7)]
    data = SceneDataset(fill(tmp_path / "store", segments), 2, small().dynamics, routes=True)
    egos = EgoPlanners("mine", partial(FunctionPlanner, noted), segments)
    config = EvaluateConfig(rollouts=1, search="none")
    assert simulation(small(), data.scenes(range(2)), config, egos=[egos]).failed == ({}, {})
    assert sorted(CALLS) == [(s.segment_id, step) for s in segments for step in range(s.num_steps - 1)]


LATE = hide(straight_road(3, seed=5, steps=11), 0, slice(0, 2))
store = stored(lambda: [crossing(4, steps=11), LATE, straight_road(4, steps=11)])


def test_the_same_seed_gives_the_same_bytes_in_any_batch(store: Path, tmp_path: Path) -> None:
    how: dict[str, Any] = {"planner": f"{__name__}:Wanderer", "search": "tree", "branches": 4}
    one, other = (run(store, tmp_path / str(batch), batch=batch, **how) for batch in (1, 3))
    digests = [{e.segment: e.sha256 for e in folder.entries} for folder in (one, other)]
    assert (digests[0], len(digests[0])) == (digests[1], 2)
    third = run(store, tmp_path / "seed", seed=1, **how)
    assert {e.segment: e.sha256 for e in third.entries} != digests[0]


def test_a_segment_without_its_ego_is_on_record(store: Path, tmp_path: Path) -> None:
    folder = run(store, tmp_path / "sim", "log")
    assert [(entry.segment, entry.rollouts) for entry in folder.failures] == [("straight-5", 2)]
    assert "ego" in str(folder.failures[0].failed)
    assert folder.about.drivers == {"ego": "log", "interactive": "tiny", "others": "playback"}
    for saved in folder:
        assert saved.agents[0] == saved.segment.ego
        assert saved.drivers == ("log", "tiny")
        assert saved.goal[0, 0] >= 0
    with pytest.raises(DataError, match="another simulation"):
        run(store, tmp_path / "sim", "idm")


def test_the_command_simulates_reports_and_shows(store, tmp_path, monkeypatch, capsys):
    (tmp_path / "mine.py").write_text(
        "class Planner:\n"
        "    def reset(self, scenario):\n"
        "        self.ends = 5 if scenario.segment_id == 'crossing-0' else 99\n"
        "    def plan(self, traffic):\n"
        "        return (0.0, 0.0) if traffic.step < self.ends else None\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    words = f"--data {store} --out sim --rollouts 2 --search none --duration 2".split()
    assert main(["simulate", AGENT, "--planner", "mine:Planner", *words]) == 0
    assert "4 of 6 runs failed, the first: crossing-0, step 5: " in capsys.readouterr().err
    found = report(load_rollouts("sim"), "ego")
    assert (found.totals()["runs"], found.totals()["failed_runs"]) == (6, 4)
    assert found.agent == f"mine:Planner among {AGENT}"
    assert main(["report", "sim", "--evaluated", "ego"]) == 0
    assert json.loads(Path("sim/report.json").read_text())["failed_runs"] == 4
    assert main(["view", "sim"]) == 0
    assert "mine:Planner" in Path("sim/view.html").read_text()


@example(runs=53, segments=2, search="tree", trees=1)  # 53 of one segment would take four trees of 14
@settings(max_examples=50, deadline=None)
@given(st.integers(1, 300), st.integers(1, 600), *map(st.sampled_from, (["none", "tree"], [1, 2, 16])))
def test_runs_are_spread_over_as_many_segments_as_there_are(runs, segments, search, trees):
    agent = small()
    config = EvaluateConfig(search=search, trees=trees, rule="systematic", branches=16)
    count, how = spread_runs(agent, config, runs, segments)
    least, some = spread_runs(agent, config, runs, segments, planned=True)
    # As few trees as can be, as many in each segment.
    assert least * some.trees < -(-runs // 16) + some.trees if search == "tree" else (least, some) == (count, how)
    assert runs <= least * some.rollouts
    plan = agent.plan(how)  # refuses what can't be simulated
    assert 1 <= count <= segments
    assert plan.trees * plan.taken == how.rollouts
    assert runs <= count * how.rollouts
    if search == "none" or trees == 1:
        # No fewer rollouts of each would do, but for runs that come out exactly: less than twice as many.
        least = -(-runs // segments)
        assert least <= how.rollouts < 2 * least + 2
        assert count * how.rollouts < runs + how.rollouts
    if search == "none" and segments >= runs:
        assert (count, how.rollouts) == (runs, 1)


def test_a_hundred_runs_are_a_hundred_and_beside_the_log_the_ego_is_alone(store, tmp_path, capsys):
    words = ["--data", str(store), "--planner", "idm", "--duration", "2", "--out", str(tmp_path / "sim")]
    assert main(["simulate", "playback", "--runs", "9", "--rollouts", "3", *words]) == 2
    assert main(["simulate", "playback", "--runs", "9", *words]) == 0
    found = load_rollouts(tmp_path / "sim")
    assert report(found, "ego").totals()["runs"] == 9
    assert all(saved.drivers == ("idm",) for saved in found)
    assert main(["simulate", "playback", "--interactive", "2", *words[:-1], str(tmp_path / "two")]) == 1
    words[-1] = str(tmp_path / "a search")
    assert main(["simulate", AGENT, "--runs", "20", "--branches", "4", *words]) == 0
    assert f"symphony view '{words[-1]}'" in capsys.readouterr().out
    found = load_rollouts(Path(words[-1]))
    # 10 of each would be 20, but three trees of four branches give 12: then rather few of many segments.
    assert [entry.rollouts for entry in (*found.entries, *found.failures)] == [8, 8, 8]


def test_beside_a_planner_nothing_is_searched_unless_asked_for() -> None:
    """A search asks the planner once for each branch: by default there are few, and all count where they can."""
    for changes, *how in (
        ({}, "none", 1, 0), ({"branches": 3, "rollouts": 2}, "tree", 1, 3), ({"search": "tree"}, "tree", 4, 4),
        ({"search": "tree", "rollouts": 1}, "tree", 1, 4), ({"search": "tree", "rollouts": 7}, "tree", 1, 7),
        ({"trees": 2}, "tree", 2, 8), ({"trees": 16}, "tree", 16, 4),
    ):  # fmt: skip
        found = beside_planner(EvaluateConfig(**changes))  # type: ignore[arg-type]
        assert [found.search, found.trees, found.branches] == how, changes
        assert beside_planner(found) == found


def test_a_planner_is_asked_in_no_more_trees_than_the_runs_are_leaves_of(tmp_path: Path) -> None:
    fill(tmp_path / "store", [straight_road(4, steps=3, segment_id=f"road-{i}") for i in range(5)])
    words = f"simulate {AGENT} --search tree --planner {__name__}:noted --data {tmp_path}/store --runs".split()
    for runs, segments in ((4, 1), (16, 4), (64, 4)):
        CALLS.clear()
        assert main([*words, str(runs), "--out", str(tmp_path / str(runs))]) == 0
        assert (len(CALLS), len(dict(CALLS))) == (2 * runs, segments)  # one of each step of each run
        assert sum(entry.rollouts for entry in load_rollouts(tmp_path / str(runs)).entries) == runs


@pytest.mark.parametrize(("name", "why"), [
    ("best", "idm, log, an import path"), ("pipe:no_such_command -x", "there is no command 'no_such_command'"),
    ("no_such.py:plan", "no such file"), ("dataclasses:Field", "can't be made: TypeError"),
    ("threading:Event", "has no reset and no plan"), (f"{__name__}:Forgetful", "has no reset"),
    (f"{__name__}:Angry", "can't be made: RuntimeError: never"),
])  # fmt: skip
def test_what_is_no_planner_is_refused(name: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        planner_maker(name)


class Angry:
    def __init__(self) -> None:
        raise RuntimeError("never")


class Forgetful(IDMPlanner):
    def plan(self, traffic: Traffic) -> Control:
        return Control(-1.0, 0.0)


class Halting(Forgetful):
    """No IDM any more, whatever its base and its attributes say."""

    rule = "idm"

    def reset(self, scenario: Scenario) -> None: ...


@pytest.mark.parametrize("text", ["not today", None])
def test_one_that_can_not_begin_fails_all_of_its_run(text: str | None) -> None:
    class RefusalError(RuntimeError):
        def __str__(self) -> str:
            return text  # type: ignore[return-value]  # an exception that can't say what it is

    class Unready(Wanderer):
        def reset(self, scenario: Scenario) -> None:
            raise RefusalError

    found = simulated(Unready, count=1, rollouts=2, search="tree", branches=4)
    assert set(found.failed[0].values()) == {found.failed[0][0]}
    assert re.search(f"reset: RefusalError: {text or '<exception str'}", found.failed[0][0])
    assert not found.rollouts.counted.any()


LENGTH, LIMIT = CAR[0], 14.0  # m, m/s of hand-made roads


def driven(*segments: RunSegment, planner: Any = "idm") -> Simulation:
    """The ego by a planner, everyone else as logged."""
    scenes = collate([scene(one, [one.ego], LaneGraph(one.road)) for one in segments])
    egos = EgoPlanners("mine", planner_maker(planner), list(segments))
    return simulation(load_agent("playback"), scenes, EvaluateConfig(rollouts=1), egos=[egos])


def states(*segments: RunSegment, planner: Any = "idm") -> Any:
    """[B, T + 1, 4] of the egos in runs that did not fail."""
    found = driven(*segments, planner=planner)
    assert not any(found.failed)
    return found.rollouts.state[:, 0, :, 0].numpy()


def in_a_row(speeds: list[float], starts: list[float], steps: int = 106, lane: Any = 0) -> RunSegment:
    """Cars at constant speeds on a straight road of two lanes, by default all on the first one."""
    speed, start = np.asarray(speeds, float)[:, None], np.asarray(starts, float)[:, None]
    x = start + speed * 0.2 * np.arange(steps)
    y = np.broadcast_to(LANE_WIDTH * np.reshape(lane, (-1, 1)), x.shape)
    line = np.arange(0.0, 1000.0, 2.0)
    road = make_road([np.stack([line, np.full_like(line, k * LANE_WIDTH)], -1) for k in (0, 1)])
    velocity = np.stack([speed + 0 * x, 0 * x], -1)
    return make_segment(road, np.stack([x, y], -1), 0 * x, velocity)


ROWS = {
    "standing-3": in_a_row([3, 0], [20, 130]), "standing-14": in_a_row([14, 0], [20, 130]),
    "leader": in_a_row([10, 8], [20, 45]), "alone": in_a_row([10], [60]),
    "others": in_a_row([10, 0, 0], [60, 100, 30], lane=(0, 1, 0)),
}  # fmt: skip


@pytest.fixture(scope="module")
def rows() -> dict[str, Any]:
    """Return what IDM does in each."""
    return dict(zip(ROWS, states(*ROWS.values()), strict=True))


def test_planners_that_build_on_idm_drive_as_they_say(rows: dict[str, Any]) -> None:
    """By their own parameters, and by their own plan where they have one."""
    (wide,) = states(ROWS["standing-14"], planner=partial(IDMPlanner, gap=6.0))
    assert rows["standing-14"][-1, 0] - wide[-1, 0] == pytest.approx(4.0, abs=1.0)
    (halting,) = states(in_a_row([14, 0], [20, 130], steps=26), planner=Halting)
    np.testing.assert_allclose(np.diff(halting[:25, 3]), -0.2, atol=1e-4)


@pytest.mark.parametrize("speed", [3, 14])
def test_idm_stops_behind_a_standing_car(speed: int, rows: dict[str, Any]) -> None:
    found = rows[f"standing-{speed}"]
    gap = 130 - found[:, 0] - LENGTH
    assert 1.5 < gap.min() <= gap[-1] < 3.0
    assert found[-1, 3] < 0.1
    assert np.diff(found[:, 3]).min() > -0.2 * 6
    np.testing.assert_allclose(found[:, 1:3], 0, atol=1e-4)


def test_idm_keeps_its_place_where_steps_are_long() -> None:
    """Steps of more metres than are looked at around the last place."""
    (found,) = states(in_a_row([14, 0], [20, 180], steps=31).replace(dt=2.0))
    assert np.diff(found[:, 0]).max() > 20
    assert (180 - found[:, 0] - LENGTH).min() > 0
    assert found[-1, 3] < 0.5


def test_idm_follows_at_its_headway(rows: dict[str, Any]) -> None:
    """Where nothing changes any more, s = (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    found, leader = rows["leader"], 8.0
    gap = 45 + leader * 21 - found[-1, 0] - LENGTH
    assert found[-1, 3] == pytest.approx(leader, abs=0.05)
    assert gap == pytest.approx((2 + 1.5 * leader) / np.sqrt(1 - (leader / LIMIT) ** 4), abs=0.3)


def test_idm_stops_behind_a_standing_car_where_its_route_comes_by_twice() -> None:
    gaps = (15.0, 40.0)
    segments = [ring(gap, aside=aside) for gap, aside in zip(gaps, (-0.4, 0.0), strict=True)]
    for segment, gap, found in zip(segments, gaps, states(*segments), strict=True):
        assert (scene(segment, [0], LaneGraph(segment.road)).route_count.max() * 3 > 2 * np.pi * 15).item()
        turned = np.arctan2(found[:, 0], -found[:, 1])
        ahead = (0.2 + gap / 15 - turned) * 15.0
        assert LENGTH + 1.0 < ahead.min() <= ahead[-1] < LENGTH + 5.0
        assert found[-1, 3] < 0.5


def test_idm_goes_around_the_block_however_long_it_waits_before() -> None:
    """Behind one that goes straight on, at the end of a street back onto which its route leads."""
    street, turn, time = np.arange(0.0, 61.0, 2.0), np.linspace(0, np.pi, 24), 0.2 * np.arange(351)
    x, y = np.append(60 + 10 * np.sin(turn), -10 * np.sin(turn)), 10 - 10 * np.append(np.cos(turn), -np.cos(turn))
    lines = [np.stack(line, -1) for line in ((street, 0 * street), (x, y), (60 + 6 * street, 0 * street))]
    road = make_road(lines, successors=[(0, 1), (1, 0), (0, 2)])
    path, waits = np.concatenate([*lines[:2], lines[0][1:], lines[2][1:]]), np.maximum(time - 30, 0)
    place, heading = along(path, np.stack([np.minimum(5 + 10 * time, 45) + 10 * waits, 55 + 0 * time]))
    place[1, :, 0] += 15 * waits
    speed = np.stack([10.0 * ((time < 4) | (time > 30)), 15.0 * (time > 30)])[..., None]
    segment = make_segment(road, place, heading, speed * np.stack([np.cos(heading), np.sin(heading)], -1))
    (found,) = states(segment)
    assert found[:, 1].max() > 19
    assert found[-1, 0] > 100


def test_a_car_in_the_next_lane_or_behind_is_nobody_to_follow(rows: dict[str, Any]) -> None:
    alone = rows["alone"]
    assert LIMIT - 0.2 <= alone[-1, 3] <= alone[:, 3].max() <= LIMIT + 1e-3
    np.testing.assert_allclose(alone, rows["others"], atol=1e-5)


def test_idm_keeps_its_lane_in_turns() -> None:
    segment = crossing(1, steps=91, seed=1)
    segment.signal_state[:] = SignalState.GO
    (found,) = states(segment)
    logged = LineString(segment.position[0, :, :2])
    inside = [xy for xy in found[:, :2] if logged.project(Point(xy)) < logged.length - 0.1]
    assert len(inside) > 45
    assert max(logged.distance(Point(xy)) for xy in inside) < 0.5
    turned = np.diff(np.unwrap(found[:, 2])) / 0.2
    assert np.abs(turned * found[1:, 3]).max() < 4.0


def at_a_light(mine: SignalState, others: SignalState, larger: float = 1) -> RunSegment:
    """A car 12 m before a left turn without limits, its own light in one state, those of its approach in another."""
    segment = crossing(2, steps=61, seed=0).replace(ego=1)
    path = LineString(segment.position[1, :, :2])
    state = np.full_like(segment.signal_state, others)
    leads = [path.distance(Point(segment.road.lanes[int(lane)][6, :2])) < 0.3 for lane in segment.signal_lane]
    state[leads] = mine
    segment.road.speed_limit[:] = np.nan
    segment.road.lanes.points[:, :2] *= larger
    powers = {"position": 1, "signal_point": 1, "velocity": 0.5, "dt": 0.5}
    return segment.replace(signal_state=state, **{n: getattr(segment, n) * larger**k for n, k in powers.items()})


@pytest.mark.parametrize("larger", [1, 4])
def test_idm_stops_at_its_own_red_light_alone(larger: float) -> None:
    stop, go = SignalState.STOP, SignalState.GO
    red, free, passed, late = (at_a_light(*pair, larger) for pair in ((stop, go), *3 * [(go, stop)]))
    passed.signal_state[:, 30:], late.signal_state[:, 5:] = stop, SignalState.CAUTION  # too late to stop for
    on_approach = red.replace(signal_lane=(red.signal_lane - 8) // 3)  # a light at the end of its lane
    path, same, *others = states(red, on_approach, free, passed, late)
    np.testing.assert_array_equal(path, same)
    stop = np.linalg.norm(red.signal_point[:, :2] - path[-1, :2], axis=-1).min()
    assert path[-1, 3] < 0.1
    assert 0.5 * LENGTH < stop < 0.5 * LENGTH + 4
    assert min(other[-1, 3] for other in others) > 3


def test_off_the_lanes_the_run_fails() -> None:
    segment = in_a_row([10], [20], steps=11)
    found = driven(segment.replace(position=segment.position + np.float32([0, 200, 0])))
    assert "on no lane" in found.failed[0][0]
    assert not found.rollouts.counted.any()


@pytest.mark.parametrize("whole", [straight_road(3, steps=21), crossing(4, seed=2, steps=21)])
def test_the_log_is_reproduced_its_holes_are_filled_and_its_end_is_told(whole: RunSegment) -> None:
    found = driven(hide(hide(whole, 0, slice(8, 10)), 0, slice(16, 21)), planner="log")
    assert "step 15: ValueError: the log of the ego ends at step 15" in found.failed[0][0]
    assert found.rollouts.counted[0, 0].all(-1).tolist() == [True] * 15 + [False] * 5
    path = found.rollouts.state[0, 0, :16, 0].numpy()
    logged = np.column_stack([whole.position[0, :, :2], whole.heading[0], np.hypot(*whole.velocity[0].T)])[:16]
    np.testing.assert_allclose(path[:, :2], logged[:, :2], atol=0.2)
    known = [*range(8), *range(10, 16)]
    np.testing.assert_allclose(path[known], logged[known], atol=1e-4)
