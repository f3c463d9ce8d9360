"""Mistakes of users: one clear line, nothing lost, and never an old answer for a new question."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers_losses import spec
from helpers_runs import run_of, tiny
from helpers_segments import crossing
from helpers_store import stored
from symphony.agents import load_agent
from symphony.agents.agent import build_agent
from symphony.cli import ALL_FAILED, main
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError
from symphony.planners.identity import source_of
from symphony.rollouts.crowd import crowd_dataset
from symphony.saved.folder import load_rollouts
from symphony.saved.saving import save_simulation

PLAN = "def plan(seen):\n    return {}\n"
store = stored(lambda: [crossing(5, seed=seed, steps=6) for seed in range(3)])
run = run_of(partial(tiny, "bc_ts_h", steps=2))


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs a command in an empty folder; gives its exit code and what it printed."""
    monkeypatch.chdir(tmp_path)

    def call(*words: Any) -> tuple[int, str]:
        code = main([str(word) for word in words])
        printed = capsys.readouterr()
        return code, " ".join((printed.out + printed.err).split())

    return call


def drive(store: Path, *more: Any, agent: Any = "playback", rollouts: int = 1) -> list[Any]:
    """A simulation of the first segment."""
    return ["simulate", agent, "--data", store, "--segments", 0, "--rollouts", rollouts, *more]


def test_a_planner_that_was_changed_is_another_simulation(store: Path, told: Any) -> None:
    Path("mine.py").write_text(PLAN.format("(-0.5, 0.0)"))
    for _ in range(2):
        assert told(*drive(store, "--planner", "mine.py:plan", "--out", "a"))[0] == 0
    Path("mine.py").write_text(PLAN.format("(2.0, 0.0)"))
    code, words = told(*drive(store, "--planner", "mine.py:plan", "--out", "a"))
    assert (code, "another simulation, which differs in settings" in words) == (1, True)
    code, words = told(*drive(store, "--planner", "mine.py:plan", "--out", "c[/x]"))  # which is no markup
    assert (code, "symphony view 'c[/x]'" in words) == (0, True)


BRAKE = """
import json, sys
for line in sys.stdin:
    told = json.loads(line)
    print(json.dumps({} if "reset" in told else {"step": told["plan"]["step"], "plan": [-1.0, 0.0]}), flush=True)
"""


def steady(gain: Any, seen: Any) -> tuple[float, float]:
    return gain, 0.0


class Steady:
    """A planner that holds something, and an object that prints as its place in memory."""

    def __init__(self, gain: Any = 0.0) -> None:
        self.gain, self.whole = gain, self

    def reset(self, scenario: Any) -> None:
        """Nothing to remember."""

    def plan(self, seen: Any) -> tuple[float, float]:
        return self.gain, 0.0


class Called(Steady):
    def __call__(self, seen: Any) -> tuple[float, float]:
        return self.plan(seen)


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
    "number": lambda gain: gain, "array": middle,
    "tensor": lambda gain: torch.from_numpy(middle(gain)).requires_grad_(), "network": network,
    "object": lambda gain: Steady({"deep": [Steady(gain)]}), "set": lambda gain: {"a", gain},
    "objects": lambda gain: np.array([Steady(gain), None]),
}  # fmt: skip
WAYS: dict[str, Any] = {
    "object": Called, "method": lambda held: Steady(held).plan, "partial": lambda held: partial(steady, held),
    "class": lambda held: partial(Steady, gain=held), "closure": lambda held: lambda seen: (held, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("kind", HELD)
@pytest.mark.parametrize("way", WAYS)
def test_whatever_a_planner_holds_is_looked_at_whole(kind: str, way: str) -> None:
    one, same, other = (source_of(WAYS[way](HELD[kind](gain))) for gain in (1.0, 1.0, 2.0))
    assert one == same != other


def test_a_command_is_what_it_starts_and_what_that_reads(tmp_path: Path) -> None:
    script, found = tmp_path / "mine.py", []
    for text in ("a", "b"):
        script.write_text(text)
        found += [source_of(f"pipe:{sys.executable} {script}"), source_of(f"pipe:python {script}")]
    assert len(set(found)) == 4
    texts = {"served": "A = 1\n", "held": "import served\ndef plan(seen): ...\n", "mine": "from held import plan\n"}
    for name, text in [*texts.items(), *texts.items()]:
        (tmp_path / f"{name}.py").write_text(text + "\n" * len(found))
        found += [source_of(f"{script}:plan")] if len(found) > 4 or name == "mine" else []
    assert len(set(found)) == 8  # by the file that names it, the one that holds it, and what that imports
    assert source_of(f"pipe:{sys.executable} -c '{'#' * 300}'") == source_of(f"pipe:{sys.executable} -c ''")


def test_other_weights_or_another_search_are_another_simulation(store: Path, run: Path, told: Any) -> None:
    shutil.copytree(run, "own")
    command = drive(store, "--out", "a", agent="own", rollouts=2)
    assert told(*command)[0] == 0
    agent, config = load_agent("own"), EvaluateConfig(rollouts=2)
    with torch.no_grad():
        next(agent.modules["policy"].parameters()).add_(1e-3)
    with pytest.raises(Exception, match="differs in settings"):
        save_simulation("a", agent, crowd_dataset(SegmentStore(store), agent, config, [0]), config)
    file = Path("own/agent.json")
    spec = json.loads(file.read_text())
    spec["search"]["threshold"] = 0.25
    file.write_text(json.dumps(spec))
    code, words = told(*command)
    assert (code, "differs in settings.specification" in words) == (1, True)


def test_a_folder_is_not_gone_on_with_by_another_simulation(store: Path, run: Path, told: Any) -> None:
    command = ["--rollouts", 2, "--out", "a", "--data"]
    for segment, end in enumerate(("", "/../" + Path(store).name)):  # as a shell completes it, or somebody types it
        again = f"{run}{end[:1]}", *command, f"{store}{end}", "--segments"
        assert told("simulate", *again, segment)[0] == 0
    assert len(load_rollouts("a")) == 2
    code, words = told("simulate", *again, 2, "--goals", "tree")
    assert (code, "differs in settings.goals" in words) == (1, True)


@pytest.mark.parametrize(("words", "why"), [
    ("evaluate pretrained:bc_ts_h --branches 8", "--branches has no effect on search 'backtrack'"),
    ("evaluate pretrained:bc_rl --logged-goals", "--logged-goals has no effect: pretrained:bc_rl follows none"),
    ("evaluate playback --search tree", "--search has no effect on playback"),
    ("simulate playback --out a --planner idm --trees 2 --rollouts 4", "--trees has no effect on search 'log'"),
    ("simulate idm --out a --planner-seconds 3", "--planner-seconds has no effect without --planner"),
    ("simulate pretrained:bc_rl --out sim --lights 9 3 2", "are for open traffic beyond the log: see --duration"),
])  # fmt: skip
def test_an_option_without_effect_is_refused(told: Any, store: Path, words: str, why: str) -> None:
    code, printed = told(*words.split(), "--data", store)
    assert (code > 0, why in printed) == (True, True)


@pytest.mark.parametrize(("words", "message"), [
    ("plot routes --data empty", "no run segments"), ("simulate idm --data empty --runs 3", "no run segments"),
    ("plot curvature nowhere", "nowhere/config.json: can't be read: No such file"),
])  # fmt: skip
def test_what_holds_nothing_is_named(told: Any, words: str, message: str) -> None:
    StoreWriter("empty").close()
    code, printed = told(*words.split(), "--out", "a.png")
    assert (code, message in printed) == (1, True)


def test_a_command_that_failed_leaves_nothing_in_the_way(store: Path, run: Path, told: Any) -> None:
    Path("brake.py").write_text(BRAKE)
    command = drive(store, "--out", "a", "--planner", "pipe:python brake.py", agent=run, rollouts=2)
    code, words = told(*command, "--search", "tree")
    assert (code, "--search none" in words) == (1, True)
    assert told(*command)[0] == 0


@pytest.mark.parametrize(("body", "reason"), [
    ("__import__('sys').exit()", "raised SystemExit()"),
    ("(_ for _ in ()).throw(__import__('asyncio').CancelledError())", "raised CancelledError()"),
    ("(*seen.ego[:2], 2e5, 1.0)", "a heading of 200000 rad"), ("missing", "missing"),
    ("[seen.ego[:4], (1e6, 0, 0, 0)]", "a trajectory past 100000 m"),
])  # fmt: skip
def test_what_a_planner_does_wrong_ends_its_run_only(store: Path, told: Any, body: str, reason: str) -> None:
    Path("mine.py").write_text(PLAN.format(body))
    code, words = told(*drive(store, "--planner", "mine.py:plan", "--out", "a"))
    assert (code, "all 1 runs failed" in words, reason in words) == (ALL_FAILED, True, True)
    if body == "missing":  # a report of nothing says so
        assert told("report", "a", "--evaluated", "ego")[0] == ALL_FAILED
        assert Path("a/report.html").is_file()


@pytest.mark.parametrize(("words", "message"), [
    ("--planner idm --planner-seconds inf", "planner-seconds must be above 0"),
    ("--planner pipe:'foo", "No closing quotation"), ("--planner idm --segments 0 0", "is named twice: 0, 0"),
    ("--goal 7=3,4", "follows no goals"), ("--pace 0.5", "no learned agent"), ("--planner idm 3=", "no planner, as"),
    *((f"--planner exits{end}:plan", "SystemExit") for end in ("", ".py")),
    *((f"--planner wrong{end}:plan", "SyntaxError") for end in ("", ".py")),
    ("--search tree --rule math:sqrt", "can't be called as needed"), ("--device foo", "unknown device 'foo'"),
])  # fmt: skip
def test_one_line_names_the_mistake(store: Path, told: Any, words: str, message: str) -> None:
    Path("exits.py").write_text("exit()\n")
    Path("wrong.py").write_text("def plan(:\n")
    agent = "pretrained:bc_ts_h" if "--rule" in words else "constant_velocity"
    code, printed = told(*drive(store, "--out", "a", *words.split(), agent=agent))
    assert code in (1, 2)
    assert (message in printed, "error:" in printed, "Traceback" in printed) == (True, True, False)


@pytest.mark.parametrize("part", ["policy", "encoder", "network"])
def test_own_networks_that_can_not_be_called(part: str) -> None:
    found = spec("bicycle")
    own = found.discriminator if part == "network" else found.agent
    own = replace(own, **{part: "math:sqrt"})
    found = replace(found, **{"discriminator" if part == "network" else "agent": own})
    with pytest.raises(ConfigError, match="'math:sqrt' can't be called as needed"):
        build_agent("own", found)


def test_planners_that_did_not_meet_the_same_are_not_compared(store: Path, told: Any) -> None:
    def drove(out: str, *words: Any, planner: str = "idm") -> None:
        words = "--planner", planner, "--out", out, "--rollouts", 1, *words
        assert told("simulate", "playback", "--data", store, *words)[0] == 0

    for number in (0, 1):
        drove(str(number), "--segments", number)
    code, words = told("planners", "0", "1")
    assert (code, "all segments differ" in words) == (1, True)
    # Where some are shared, those are compared.
    drove("both", "--segments", 0, 1)
    code, words = told("planners", "0", "both")
    assert (code, "in the 1 segments that both drove" in words) == (0, True)
    drove("short", "--segments", 0, "--duration", 1)
    code, words = told("planners", "0", "short")
    assert (code, "duration differ" in words) == (1, True)
    # A search beside the log that does not search doesn't matter.
    drove("log", "--segments", 0, "--search", "none", planner="log")
    assert told("planners", "0", "log")[0] == 0
