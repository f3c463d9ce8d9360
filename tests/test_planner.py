"""A planner as the ego: what it observes, that it is forked with its branches, and that its failures are counted."""

from __future__ import annotations

import json
import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from helpers_agents import small
from helpers_segments import crossing, hide, straight_road
from helpers_store import fill
from symphony.cli import main
from symphony.config import EvaluateConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs.dynamics import WHEELBASE
from symphony.errors import ConfigError, DataError
from symphony.evaluation.report import report
from symphony.learning.demonstrations import SceneDataset
from symphony.planners.driver import EgoPlanners
from symphony.planners.interface import (
    MAX_ACCELERATION,
    MAX_BRAKING,
    Control,
    Pose,
    Scenario,
    Traffic,
    planner_maker,
)
from symphony.planners.view import FunctionPlanner, Observation
from symphony.rollouts.driving import simulation, spread_runs
from symphony.saved.folder import RolloutFolder, load_rollouts
from symphony.saved.saving import save_simulation

AGENT = "pretrained:bc_ts_h"


class Wanderer:
    """Accelerates at random, and notices when it is not where it went or is asked twice."""

    def reset(self, scenario: Scenario) -> None:
        self.rng = np.random.default_rng(scenario.seed)
        self.state, self.step = scenario.state, 0

    def plan(self, traffic: Traffic) -> Pose:
        if traffic.step != self.step or not np.allclose(traffic.state, self.state, atol=1e-3):
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


class Odd:
    """Gives back something odd at step 3 and coasts before."""

    what: Any = None

    def reset(self, scenario: Scenario) -> None:
        self.scenario = scenario

    def plan(self, traffic: Traffic) -> Any:
        if traffic.step < 3:
            return np.zeros(2)
        return self.what(traffic) if callable(self.what) else self.what


class Unready(Odd):
    def reset(self, scenario: Scenario) -> None:
        raise RuntimeError("not today")


def odd(given: Any) -> type[Odd]:
    return type("Odd", (Odd,), {"what": staticmethod(given) if callable(given) else given})


def dataset(agent: Any, count: int = 2, duration: int = 2, interactive: int = 2) -> SceneDataset:
    store = SegmentStore(builtin_store("test"))
    return SceneDataset(store, interactive, agent.dynamics, range(count), routes=True, duration=duration)


def simulated(make: Any, count: int = 2, **settings: Any) -> Any:
    agent = small()
    data = dataset(agent, count)
    egos = EgoPlanners("mine", make, [data.segment(i) for i in range(count)])
    config = EvaluateConfig(**{"rollouts": 4, "search": "none", **settings})
    return simulation(agent, data.scenes(range(count)), config, egos=egos, keep_tree=True)


TREE: dict[str, Any] = {"search": "tree", "branches": 6, "rule": "best", "prune_every": 5}
SEARCHES = [
    {"search": "none"},
    TREE,
    {"search": "tree", "branches": 6, "rule": "systematic", "trees": 2},
    {"search": "best", "branches": 2},
]


@pytest.mark.parametrize("settings", SEARCHES, ids=lambda given: "-".join(map(str, given.values())))
def test_planners_are_forked_with_their_branches(settings: dict[str, Any]) -> None:
    """A planner that went one way is never asked about another."""
    found = simulated(Wanderer, **settings)
    assert found.failed == ({}, {})
    if settings["search"] == "none":
        speed = found.rollouts.state[:, :, :, 0, 3]
        assert (speed[:, 0] != speed[:, 1]).any()
    if settings["search"] == "tree":
        parents = found.search.parents[..., :-1, :]
        assert (parents != torch.arange(parents.shape[-1])).any(), "nobody was forked"


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

    data = dataset(small())
    segment = data.segment(0)
    state = simulated(Pushes, rollouts=1).rollouts.state[0, 0].numpy()
    mine = [t for t in seen if t.ego == segment.ego and np.array_equal(t.size, segment.size[:, :2])]
    assert [t.step for t in mine] == list(range(segment.num_steps - 1))
    interactive = data.scenes([0]).interactive[0].tolist()
    others = np.setdiff1d(np.arange(segment.num_agents), interactive)
    for t in mine:
        for found, expected in (
            (t.position[interactive], state[t.step, :, :2]),
            (t.state, state[t.step, 0]),
            (t.position[others], segment.position[others, t.step, :2]),
            (t.velocity[others], segment.velocity[others, t.step]),
            (t.time, t.step * segment.dt),
        ):
            np.testing.assert_allclose(found, expected, atol=1e-4)
        assert (t.valid[others] == segment.valid[others, t.step]).all()
        assert (t.lights == segment.signal_state[:, t.step]).all()
    change = np.diff(state[:5, 0, 3]) / segment.dt
    np.testing.assert_allclose(change[:3], MAX_ACCELERATION, atol=1e-3)
    assert change[3] == pytest.approx(-min(MAX_BRAKING, state[3, 0, 3] / segment.dt), abs=1e-3)
    assert told[0].steps == segment.num_steps - 1
    assert np.linalg.norm(told[0].route[0] - segment.position[segment.ego, 0, :2]) < 4
    assert len({one.seed for one in told}) == len(told)


def test_it_steers_a_vehicle_of_its_own_length() -> None:
    """Heading by the distance driven: with tan(slip) half of tan(steering), 2 sin(slip) over the wheelbase."""
    segment = dataset(small()).segment(0)
    state = simulated(partial(FunctionPlanner, lambda _: Control(1.0, 0.2)), rollouts=1)
    path = state.rollouts.state[0, 0, :, 0].double()
    driven = (0.5 * (path[1:, 3] + path[:-1, 3]) * segment.dt).sum()
    turned = np.unwrap(path[:, 2].numpy())
    expected = 2 * np.sin(np.arctan(0.5 * np.tan(0.2))) / (WHEELBASE * float(segment.size[segment.ego, 0]))
    assert (turned[-1] - turned[0]) / float(driven) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (lambda _: 1 / 0, "step 3: ZeroDivisionError: division by zero (test_planner.py:"),
        ((float("nan"), 0.0), "step 3: ValueError: a plan that is not finite"),
        (None, "step 3: "),
        (lambda t: Pose(t.state[0] + 50, t.state[1], 0.0, 5.0), "a target 50.0 m away"),
        (lambda t: t.position.fill(0), "read-only"),
    ],
)
def test_what_is_odd_fails_the_run_from_there_on(given: Any, why: str) -> None:
    found = simulated(odd(given), count=1, rollouts=2)
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


def test_nobody_plans_beyond_the_end_of_a_segment_beside_a_longer_one(tmp_path: Path) -> None:
    asked: dict[str, list[int]] = {}

    def noted(seen: Observation) -> tuple[float, float]:
        asked.setdefault(seen.segment_id, []).append(seen.step)
        return 0.0, 0.0

    segments = [crossing(4, steps=4), straight_road(4, steps=7)]
    fill(tmp_path / "store", segments)
    data = SceneDataset(SegmentStore(tmp_path / "store"), 2, small().dynamics, routes=True)
    egos = EgoPlanners("mine", partial(FunctionPlanner, noted), segments)
    config = EvaluateConfig(rollouts=1, search="none")
    assert simulation(small(), data.scenes(range(2)), config, egos=egos).failed == ({}, {})
    assert asked == {s.segment_id: list(range(s.num_steps - 1)) for s in segments}


@pytest.fixture
def store(tmp_path: Path) -> Path:
    late = hide(straight_road(3, seed=5, steps=11), 0, slice(0, 2))
    fill(tmp_path / "store", [crossing(4, steps=11), late, straight_road(4, steps=11)])
    return tmp_path / "store"


def run(store: Path, out: Path, planner: str, batch: int = 2, **settings: Any) -> RolloutFolder:
    agent = small()
    data = SceneDataset(SegmentStore(store), 2, agent.dynamics, routes=True, duration=2)
    config = EvaluateConfig(rollouts=2, branches=4, batch=batch, **settings)
    return save_simulation(out, agent, data, config, planner=planner)


def test_the_same_seed_gives_the_same_bytes_in_any_batch(store: Path, tmp_path: Path) -> None:
    one, other = (run(store, tmp_path / str(batch), f"{__name__}:Wanderer", batch) for batch in (1, 3))
    digests = [{e.segment: e.sha256 for e in folder.entries} for folder in (one, other)]
    assert digests[0] == digests[1]
    assert len(digests[0]) == 2
    third = run(store, tmp_path / "seed", f"{__name__}:Wanderer", seed=1)
    assert {e.segment: e.sha256 for e in third.entries} != digests[0]


def test_a_segment_without_its_ego_is_on_record(store: Path, tmp_path: Path) -> None:
    folder = run(store, tmp_path / "sim", "log", search="none")
    assert [(entry.segment, entry.rollouts) for entry in folder.failures] == [("straight-5", 2)]
    assert "ego" in str(folder.failures[0].failed)
    assert folder.about.drivers == {"ego": "log", "interactive": "tiny", "others": "playback"}
    for saved in folder:
        assert saved.agents[0] == saved.segment.ego
        assert saved.drivers == ("log", "tiny")
        assert saved.goal[0, 0] >= 0
    with pytest.raises(DataError, match="another simulation"):
        run(store, tmp_path / "sim", "idm", search="none")


def test_the_command_simulates_reports_and_shows(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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
@settings(max_examples=100, deadline=None)
@given(
    runs=st.integers(1, 300),
    segments=st.integers(1, 600),
    search=st.sampled_from(["none", "tree", "best"]),
    trees=st.sampled_from([1, 2, 16]),
)
def test_runs_are_spread_over_as_many_segments_as_there_are(
    runs: int, segments: int, search: Any, trees: int
) -> None:
    agent = small()
    config = EvaluateConfig(search=search, trees=trees, rule="systematic", branches=16)
    count, how = spread_runs(agent, config, runs, segments)
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


def test_a_hundred_runs_are_a_hundred(store: Path, tmp_path: Path) -> None:
    words = ["--data", str(store), "--planner", "idm", "--duration", "2", "--out", str(tmp_path / "sim")]
    assert main(["simulate", "playback", "--runs", "9", "--rollouts", "3", *words]) == 2
    assert main(["simulate", "playback", "--runs", "9", *words]) == 0
    assert report(load_rollouts(tmp_path / "sim"), "ego").totals()["runs"] == 9
    words[-1] = str(tmp_path / "searched")
    assert main(["simulate", AGENT, "--runs", "20", "--branches", "4", *words]) == 0
    found = load_rollouts(tmp_path / "searched")
    # 10 of each would be 20, but three trees of four branches give 12: then rather few of many segments.
    assert [entry.rollouts for entry in (*found.entries, *found.failures)] == [8, 8, 8]


@pytest.mark.parametrize(
    ("changes", "kind"), [({}, "none"), ({"search": "tree"}, "tree"), ({"branches": 3}, "tree")]
)
def test_beside_a_planner_nothing_is_searched_unless_asked_for(
    store: Path, tmp_path: Path, changes: Any, kind: str
) -> None:
    """A search asks the planner once for each branch."""
    data = SceneDataset(SegmentStore(store), 2, small().dynamics, routes=True, duration=2)
    config = EvaluateConfig(rollouts=2, **changes)
    folder = save_simulation(tmp_path / "sim", small(), data, config, planner=f"{__name__}:Wanderer")
    assert folder.about.settings["search"] == kind
    assert (folder[0].trees is None) == (kind == "none")


def test_around_log_playback_the_ego_is_alone(store: Path, tmp_path: Path) -> None:
    words = ["--data", str(store), "--rollouts", "1", "--planner", "idm"]
    assert main(["simulate", "playback", "--out", str(tmp_path / "one"), *words]) == 0
    assert all(saved.drivers == ("idm",) for saved in load_rollouts(tmp_path / "one"))
    assert main(["simulate", "playback", "--out", str(tmp_path / "two"), *words, "--interactive", "2"]) == 1


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("best", "idm, log, an import path"),
        ("pipe:no_such_command -x", "there is no command 'no_such_command'"),
        ("no_such.py:plan", "no such file"),
        ("dataclasses:Field", "can't be made: TypeError"),
        ("threading:Event", "has no reset and no plan"),
        (f"{__name__}:Angry", "can't be made: RuntimeError: never"),
    ],
)
def test_what_is_no_planner_is_refused(name: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        planner_maker(name)


class Angry:
    def __init__(self) -> None:
        raise RuntimeError("never")


def test_one_that_can_not_begin_fails_all_of_its_run() -> None:
    found = simulated(Unready, count=1, rollouts=2, search="tree", branches=4)
    assert set(found.failed[0].values()) == {found.failed[0][0]}
    assert "reset: RuntimeError: not today" in found.failed[0][0]
    assert not found.rollouts.counted.any()
