"""What a user gets wrong: one clear line, nothing lost, and never an old answer for a new question."""

from __future__ import annotations

import json
import shutil
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers_runs import tiny
from helpers_segments import crossing
from helpers_store import fill
from symphony.agents import load_agent
from symphony.cli import ALL_FAILED, main
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.errors import DataError
from symphony.evaluation.planners import check_crowds, winners
from symphony.planners.calls import answer, plans_of
from symphony.recipes import train
from symphony.rollouts.crowd import crowd_dataset
from symphony.saved.folder import load_rollouts
from symphony.saved.identity import source_of
from symphony.saved.saving import save_simulation

PLAN = "def plan(seen):\n    return {}\n"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "store"
    fill(path, [crossing(5, seed=seed, steps=8) for seed in range(3)])
    return path


@pytest.fixture(scope="module")
def run(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tiny("bc_ts_h", store, tmp_path_factory.mktemp("runs") / "run", steps=2))


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs a command in an empty folder; gives its exit code and what it printed."""
    monkeypatch.chdir(tmp_path)

    def call(*words: Any) -> tuple[int, str]:
        code = main([str(word) for word in words])
        printed = capsys.readouterr()
        return code, " ".join((printed.out + printed.err).split())

    return call


BRAKE = """
import json, sys
for line in sys.stdin:
    told = json.loads(line)
    print(json.dumps({} if "reset" in told else {"step": told["plan"]["step"], "plan": [-1.0, 0.0]}), flush=True)
"""


def drive(store: Path, *more: Any, rollouts: int = 1) -> list[Any]:
    """The common part of a simulation of the first segment beside the log."""
    return ["simulate", "playback", "--data", store, "--segments", 0, "--rollouts", rollouts, *more]


def test_a_planner_that_was_changed_is_another_simulation(store: Path, told: Any) -> None:
    Path("mine.py").write_text(PLAN.format("(-0.5, 0.0)"))
    assert told(*drive(store, "--planner", "mine.py:plan", "--out", "a"))[0] == 0
    assert told(*drive(store, "--planner", "mine.py:plan", "--out", "a"))[0] == 0
    Path("mine.py").write_text(PLAN.format("(2.0, 0.0)"))
    code, words = told(*drive(store, "--planner", "mine.py:plan", "--out", "a"))
    assert code == 1
    assert "another simulation, which differs in settings" in words
    assert told(*drive(store, "--planner", "mine.py:plan", "--out", "b"))[0] == 0


def steady(gain: float, seen: Any) -> tuple[float, float]:
    return gain, 0.0


class Steady:
    def __init__(self, gain: Any = 0.0) -> None:
        self.gain = gain

    def reset(self, scenario: Any) -> None:
        """Nothing to remember."""

    def plan(self, traffic: Any) -> tuple[float, float]:
        return self.gain, 0.0


def test_a_planner_with_other_parameters_is_another_simulation(store: Path, tmp_path: Path) -> None:
    agent, config = load_agent("playback"), EvaluateConfig(rollouts=1)
    data = crowd_dataset(SegmentStore(store), agent, config, [0], default=1, routes=True)

    def drive(gain: float) -> float:
        folder = save_simulation(tmp_path / "sim", agent, data, config, planner=partial(steady, gain))
        assert folder.about.drivers["ego"] == f"{__name__}:steady"
        return float(folder[0].state[0, -1, 0, 3] - folder[0].state[0, 0, 0, 3])

    assert drive(1.0) == drive(1.0) > 0.5
    with pytest.raises(DataError, match=r"differs in settings\.planner"):
        drive(2.0)
    sources = [source_of(partial(Steady, **told)) for told in ({}, {"gain": 1.0}, {"gain": 2.0})]
    sources.append(source_of(partial(Steady, 1.0)))
    assert len(set(sources)) == len(sources)
    assert source_of(partial(Steady, object())) == source_of(partial(Steady, object()))


def steadily(gain: float) -> Any:
    def plan(seen: Any) -> tuple[float, float]:
        return gain, 0.0

    return plan


class Shop:
    def __init__(self, gain: float) -> None:
        self.gain = gain

    def plan(self, seen: Any) -> tuple[float, float]:
        return self.gain, 0.0

    def __call__(self, seen: Any) -> tuple[float, float]:
        return self.plan(seen)


class Part:
    """Prints as its place in memory."""

    def __init__(self, value: Any) -> None:
        self.value, self.whole = value, self


def middle(gain: float) -> Any:
    """Numbers of which Python prints only the first and the last."""
    values = np.zeros(5000)
    values[2500] = gain
    return values


def network(gain: float) -> Any:
    layer = torch.nn.Linear(1, 2000)
    torch.nn.init.constant_(layer.weight, 0.0)
    torch.nn.init.constant_(layer.bias, gain)
    return layer


HELD: dict[str, Any] = {
    "array": middle,
    "tensor": lambda gain: torch.from_numpy(middle(gain)).requires_grad_(),
    "network": network,
    "object": lambda gain: Part({"deep": [Part(gain)]}),
    "set": lambda gain: {"a", gain},
    "objects": lambda gain: np.array([Part(gain), None]),
}


@pytest.mark.parametrize("kind", HELD)
@pytest.mark.parametrize("bind", [Shop, lambda held: partial(steady, held)], ids=["object", "partial"])
def test_whatever_a_planner_holds_is_looked_at_whole(kind: str, bind: Any) -> None:
    one, same, other = (source_of(bind(HELD[kind](gain))) for gain in (1.0, 1.0, 2.0))
    assert one == same != other


@pytest.mark.parametrize("make", [steadily, Shop, lambda gain: Shop(gain).plan])
def test_what_a_function_or_an_object_holds_is_part_of_the_planner(make: Any) -> None:
    assert source_of(make(1.0)) == source_of(make(1.0)) != source_of(make(2.0))


def test_a_command_is_what_it_starts_and_what_that_reads(tmp_path: Path) -> None:
    script = tmp_path / "mine.py"
    found = []
    for text in ("a", "b"):
        script.write_text(text)
        found += [source_of(f"pipe:{sys.executable} {script}"), source_of(f"pipe:python {script}")]
    assert len(set(found)) == 4


def test_other_weights_under_the_same_name_are_another_simulation(store: Path, run: Path, told: Any) -> None:
    command = ["simulate", run, "--data", store, "--segments", 0, "--rollouts", 2, "--out", "a"]
    assert told(*command)[0] == 0
    agent = load_agent(str(run))
    with torch.no_grad():
        next(agent.modules["policy"].parameters()).add_(1e-3)
    data = SegmentStore(store)
    config = EvaluateConfig(rollouts=2)
    with pytest.raises(Exception, match="differs in settings"):
        save_simulation("a", agent, crowd_dataset(data, agent, config, [0]), config)


def test_an_agent_that_searches_otherwise_is_another_simulation(store: Path, run: Path, told: Any) -> None:
    shutil.copytree(run, "own")
    command = ["simulate", "own", "--data", store, "--segments", 0, "--rollouts", 2, "--out", "a"]
    assert told(*command)[0] == 0
    file = Path("own/agent.json")
    spec = json.loads(file.read_text())
    spec["search"]["threshold"] = 0.25
    file.write_text(json.dumps(spec))
    code, words = told(*command)
    assert (code, "differs in settings.specification" in words) == (1, True)


def test_folders_from_before_weights_were_kept_are_gone_on_with(store: Path, run: Path, told: Any) -> None:
    command = ["simulate", run, "--data", store, "--rollouts", 2, "--out", "a"]
    assert told(*command, "--segments", 0)[0] == 0
    manifest = json.loads(Path("a/manifest.json").read_text())
    del manifest["settings"]["weights"], manifest["settings"]["specification"]
    Path("a/manifest.json").write_text(json.dumps(manifest))
    assert told(*command, "--segments", 1)[0] == 0
    assert len(load_rollouts("a")) == 2
    code, words = told(*command, "--segments", 2, "--goals", "tree")
    assert (code, "differs in settings.goals" in words) == (1, True)


def test_planners_that_no_file_defines(store: Path, tmp_path: Path) -> None:
    # As of python -c, or of what is typed in.
    body = "def plan(seen):\n    return 0.0, 0.0\n"
    typed: dict[str, Any] = {"__name__": "__main__"}
    exec(body, typed)  # noqa: S102
    agent, config = load_agent("playback"), EvaluateConfig(rollouts=1)
    data = crowd_dataset(SegmentStore(store), agent, config, [0], default=1, routes=True)
    assert len(save_simulation(tmp_path / "sim", agent, data, config, planner=typed["plan"])) == 1
    assert source_of(f"pipe:{sys.executable} -c '{'#' * 300}'") == source_of(f"pipe:{sys.executable} -c ''")


def test_a_command_that_failed_leaves_nothing_in_the_way(store: Path, run: Path, told: Any) -> None:
    Path("brake.py").write_text(BRAKE)
    command = ["simulate", run, "--data", store, "--segments", 0, "--rollouts", 2, "--out", "a"]
    code, words = told(*command, "--planner", "pipe:python brake.py", "--search", "tree")
    assert code == 1
    assert "--search none" in words
    assert told(*command, "--planner", "pipe:python brake.py")[0] == 0


def test_a_report_of_nothing_says_so(store: Path, told: Any) -> None:
    Path("mine.py").write_text(PLAN.format("missing"))
    code, words = told(*drive(store, "--planner", "mine.py:plan", "--out", "a"))
    assert (code, "all 1 runs failed" in words) == (ALL_FAILED, True)
    code, words = told("report", "a", "--evaluated", "ego")
    assert code == ALL_FAILED
    assert "no run could be evaluated" in words
    assert Path("a/report.html").is_file()
    code, words = told("evaluate", *drive(store, "--planner", "mine.py:plan", "--json", "a.json")[1:])
    assert (code, "all 1 runs failed" in words) == (ALL_FAILED, True)
    assert Path("a.json").is_file()


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("__import__('sys').exit()", "called sys.exit(None)"),
        ("(*seen.ego[:2], 2e5, 1.0)", "a heading of 200000 rad"),
        ("(*seen.ego[:2], 1e300, 1.0)", "a heading of 1e+300 rad"),
    ],
)
def test_what_a_planner_does_wrong_ends_its_run_only(store: Path, told: Any, body: str, reason: str) -> None:
    Path("mine.py").write_text(PLAN.format(body))
    code, words = told(*drive(store, "--planner", "mine.py:plan", "--out", "a"))
    assert code == ALL_FAILED
    assert "all 1 runs failed" in words
    assert reason in words


def test_a_batch_of_planners_that_plans_nothing() -> None:
    class Idle:
        def plan_batch(self: Any, seen: Any) -> Any:
            return None

    (given,) = plans_of([Idle()], [None])  # type: ignore[list-item]
    assert isinstance(given, TypeError)
    assert isinstance(answer(lambda: exec("raise SystemExit(3)")), RuntimeError)  # noqa: S102


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import sys\nsys.exit()\n", "SystemExit"),
        ("def plan(:\n", "SyntaxError"),
        ("1 / 0\n", "ZeroDivisionError"),
    ],
)
@pytest.mark.parametrize("name", ["mistaken.py:plan", "mistaken_{}:plan"])
def test_a_file_that_can_not_be_imported(store: Path, told: Any, text: str, message: str, name: str) -> None:
    module = name.format(message.lower())
    Path(module.rpartition(":")[0].removesuffix(".py") + ".py").write_text(text)
    code, words = told(*drive(store, "--planner", module, "--out", "a"))
    assert code == 1
    assert message in words
    assert "error:" in words


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--planner", "idm", "--planner-seconds", "inf"], "planner-seconds must be above 0"),
        (["--planner", "pipe:python 'foo"], "No closing quotation"),
        (["--planner", "idm", "--segments", "0", "0"], "is named twice: 0, 0"),
        (["--goal", "1=3,4"], "follows no goals"),
        (["--planner", "idm", "--device", "foo"], "unknown device 'foo'"),
    ],
)
def test_one_line_names_the_mistake(store: Path, told: Any, words: list[str], message: str) -> None:
    agent = ["simulate", "constant_velocity", "--data", store, "--out", "a", "--rollouts", 1]
    if "--segments" not in words:
        agent += ["--segments", 0]
    if "--goal" in words:
        ids = SegmentStore(store)[0].agent_id.tolist()
        place = SegmentStore(store)[0].position[0, -1, :2].tolist()
        words = ["--goal", f"{ids[0]}={place[0]:.1f},{place[1]:.1f}"]
    if "foo" in words:
        agent[1] = "pretrained:bc_ts_h"
    code, printed = told(*agent, *words)
    assert code in (1, 2)
    assert message in printed
    assert "Traceback" not in printed


def test_paths_are_no_markup(store: Path, told: Any) -> None:
    for out in ("a[lr=0.001]", "b[", "c[/x]"):
        code, words = told(*drive(store, "--planner", "idm", "--out", out))
        assert code == 0
        assert f"symphony view {out}" in words
        assert told("report", out, "--evaluated", "ego")[0] == 0


def test_only_what_was_asked_for_is_evaluated(store: Path, told: Any) -> None:
    command = ["evaluate", "playback", "--data", store, "--planner", "idm", "--rollouts", 1]
    for number in (0, 1):
        words = ["--segments", number, "--save-rollouts", "kept", "--json", f"{number}.json"]
        assert told(*command, *words)[0] == 0
        assert json.loads(Path(f"{number}.json").read_text())["runs"] == 1
    assert len(load_rollouts("kept")) == 2
    code, words = told(*command, "--metrics", "wosac")
    assert (code, "go without --planner" in words) == (2, True)
    # Nor are planners compared that drove other segments, or not in the same way.
    code, words = told("planners", "0.json", "1.json")
    assert (code, "all segments differ" in words) == (1, True)
    # Where some are shared, those are compared.
    told(*command, "--segments", 0, 1, "--save-rollouts", "kept", "--json", "both.json")
    code, words = told("planners", "0.json", "both.json")
    assert (code, "in the 1 segments that both drove" in words) == (0, True)
    assert told(*command, "--segments", 0, "--json", "2.json", "--duration", 1)[0] == 0
    code, words = told("planners", "0.json", "2.json")
    assert (code, "duration differ" in words) == (1, True)
    # How often, and a search beside the log that does not search, don't matter.
    more = ["--segments", 0, "--json", "3.json", "--search", "none"]
    assert told("evaluate", "playback", "--data", store, "--planner", "log", "--rollouts", 2, *more)[0] == 0
    assert told("planners", "0.json", "3.json")[0] == 0
    Path("no.json").write_text("def")
    code, words = told("planners", "no.json")
    assert (code, "not valid JSON" in words) == (1, True)


def test_of_two_planners_the_better_one_is_better_where_both_drove() -> None:
    def record(name: str, scores: dict[str, float]) -> dict[str, Any]:
        runs = [
            {"segment": segment, "group": "", "failed": None, "progress_ratio": score / 100}
            | {"at_fault_collision": False, "red_lights": 0, "offroad_time": 0.0}
            for segment, score in scores.items()
        ]
        found = {"planner": name, "crowd": "playback", "settings": {"interactive": 1}, "per_run": runs}
        return found | {"score": float(np.mean(list(scores.values()))), "store": {"checksum": "a"}}

    careful = record("careful", {"a": 60.0, "b": 70.0})
    quick = record("quick", {"b": 50.0, "c": 99.0, "d": 99.0})
    check_crowds([careful, quick])
    (sentence,) = winners([careful, quick])
    assert sentence.startswith("log: careful is first")
    assert "20.0 above quick, in the 1 segments that both drove" in sentence
