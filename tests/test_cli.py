"""The command line: what it offers, how it ends, what it prints."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, get_args

import pytest
import tyro
from tensordict import TensorDict, nn

import symphony.data.convert
from helpers_cli import commands, words
from helpers_convert import FakeReader
from helpers_processes import apart, forget, output_of
from helpers_saved import played
from helpers_segments import crossing, straight_road
from helpers_store import stored
from symphony import __version__
from symphony.agents import Agent, discriminator_network, goal_network, policy_network
from symphony.bench.measures import MEASURES
from symphony.cli import main
from symphony.cli.data import Info
from symphony.cli.planners import Rate
from symphony.cli.recipe import Arguments
from symphony.cli.shared import print_table
from symphony.config import METHODS, TrainConfig
from symphony.config.profiles import PROFILES, expanded
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError
from symphony.saved.folder import About, save_rollouts

LINES = (Path(__file__).parent / "cli.txt").read_text().splitlines()
HEAVY = {"torch", "torchrl", "tensordict", "wandb", "matplotlib", "numpy", "shapely", "google"}
store = stored(lambda: [crossing(), straight_road(4, segment_id="straight")])


def help_of_all() -> None:
    """Tell the help of every command, which imports nothing heavy."""
    forget("symphony", "helpers_cli", *HEAVY)
    helps = importlib.import_module("helpers_cli")
    helps.help_of()
    json.dump(helps.helps(), sys.stdout)
    assert not HEAVY & set(sys.modules), HEAVY & set(sys.modules)


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return json.loads(output_of(help_of_all, said=tmp_path_factory.mktemp("help") / "said"))


@pytest.mark.parametrize("command", commands(), ids=" ".join)
def test_every_option_is_explained_in_whole_sentences(command: tuple[str, ...], told: dict[str, str]) -> None:
    text = told[" ".join(command)]
    assert text.startswith(f"usage: symphony {' '.join(command)} ")
    helps = re.findall(r"^  --([\w.-]+)(.*?)\s*\((?:default|required)", text, re.M | re.S)
    assert len(helps) == len(re.findall("^  --[a-z]", text, re.M))
    for name, text in helps:
        assert re.search(r"\s[A-Z`].*\.$", text, re.S), f"--{name}: {text!r}"


def test_training_has_at_most_fifty_options() -> None:
    assert len([line for line in LINES if line.startswith("train --")]) <= 50


def test_what_users_type_changes_on_purpose_only(told: dict[str, str]) -> None:
    now = words(told)
    assert now == LINES, (
        f"gone: {sorted(set(LINES) - set(now))}, new: {sorted(set(now) - set(LINES))}; "
        "write the list anew: python tests/helpers_cli.py > tests/cli.txt"
    )


def test_what_is_required_shows_no_default(told: dict[str, str]) -> None:
    for command in ("plot curves", "data merge", "table", "planners"):
        assert re.search(r"\.\.\. +[A-Z][^()]*(\([^()]*\)[^()]*)?\(required\)", told[command]), command


def test_rates_that_are_hunted_are_those_of_a_suite() -> None:
    rates = [name for name, measure in MEASURES.items() if measure.kind == "rate"]
    assert list(get_args(Rate)) == rates


def test_installed_command_prints_whatever_the_terminal_can_show(store: Path) -> None:
    command = Path(sys.executable).with_name("symphony")
    how: Any = {"capture_output": True, "text": True, "env": {**os.environ, "PYTHONIOENCODING": "ascii"}}
    assert subprocess.run([command, "--version"], check=True, **how).stdout == f"symphony {__version__}\n"
    assert r"\u2013" in subprocess.run([command, "data", "info", str(store)], check=True, **how).stdout
    assert subprocess.run(f"{command} --version >&- 2>&-", shell=True, check=True)  # noqa: S602 - our own words
    words = f"env -u PYTHONUNBUFFERED {command} --version >/dev/full"
    full = subprocess.run(words, shell=True, check=False, stderr=-1)  # noqa: S602
    assert (full.returncode, full.stderr) == (1, b"symphony: error: No space left on device\n")


WRONG = """

nonsense
data
data info
data info x --interactive -1 => --interactive must not be negative, is -1
data convert nonsense x --out y
data convert womd x
data convert womd --out y
data convert womd x --out y --egos all
data convert womd x --out y --window 4
data generate --out y
data convert womd x --out y --rate nan => --rate must be a number, is nan
data convert womd x --out y --interactive -3
data convert womd x --out y --radius nan
data convert interaction x --out y --stride 0
data generate --out y --preset town --seed 1
data generate --out y --count 1 --kinds random => (known: town, grid, ramp, street, and files of roads
train bc --data x --out y --steps many
train bc --data x --out y --batch 0 => batch must be positive, is 0
evaluate --data x
evaluate playback --data x --unknown 1
plot curves --out a.png => give at least 1 RUN ...
plot curvature --out a.png
table --setting main
table --setting main --runs => give at least 1 --runs
table --setting short --runs x
plot curves x --out a.png --window nan
plot curves x --out a.png --window 1.1 => --window must be at most 1, is 1.1
hunt x --planner idm --data y --out z --metric nonsense
hunt x --planner idm --data y --out z --trees 1 => --trees must be at least 4, is 1
demo --steps -1
simulate playback --data x --out y --threshold nan
simulate playback --data x --out y --planner-seconds nan
simulate playback --data x --out y --runs -1
plot segment x --segment 0 --out a.png --interactive 0
simulate playback --data x --out y --runs 5 --segments a
simulate playback --data x --out y --runs 5 --rollouts 2
wosac submit playback --data x --out y --horizon 4
"""


@pytest.mark.parametrize("line", WRONG.splitlines()[1:])
def test_wrong_usage_is_status_2_and_bounds_are_told_as_they_are_typed(line, tmp_path, monkeypatch, capsys):
    args, _, told = line.partition(" => ")
    monkeypatch.chdir(tmp_path)
    assert main(args.split()) == 2
    captured = capsys.readouterr()
    assert captured.out == "" != captured.err.strip()
    assert told in captured.err
    assert not list(tmp_path.iterdir())


MEMORY = "out of memory, try less at a time (rollouts, batch, workers): "


@pytest.mark.parametrize(("error", "status", "message"), [
    (DataError("is bent", file="a.xml", field="lane"), 1, "file a.xml, field lane: is bent"),
    (FileNotFoundError(2, "No such file or directory", "x/y"), 1, "x/y: No such file or directory"),
    (MemoryError(), 1, f"{MEMORY}no more to be had"),
    (RuntimeError("CPU: can't allocate memory\nat 0"), 1, f"{MEMORY}CPU: can't allocate memory"),
    (OSError(28, "No space left on device"), 1, "No space left on device"), (KeyboardInterrupt(), 130, "interrupted"),
    (ZeroDivisionError("is ours"), 0, ""),  # an error of programming is not hidden
])  # fmt: skip
def test_failures_become_one_line_and_a_status(error, status, message, monkeypatch, capsys):
    def fail(self: Info) -> None:
        with TensorDict.from_module(module := nn.TensorDictSequential()).to_module(module):  # as losses do
            raise error

    monkeypatch.setattr(Info, "__call__", fail)
    monkeypatch.delenv("SYMPHONY_DEBUG", raising=False)
    if status:
        assert main(["data", "info", "x"]) == status
        assert tuple(capsys.readouterr()) == ("", f"symphony: error: {message}\n")
        monkeypatch.setenv("SYMPHONY_DEBUG", "1")
    if not isinstance(error, KeyboardInterrupt):
        with pytest.raises(type(error)):
            main(["data", "info", "x"])


def to_nobody(*arguments: str) -> int:
    """Run a command that writes into a pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    os.dup2(writer, 1)
    return main(arguments)


def test_a_closed_pipe_is_no_traceback(store: Path, tmp_path: Path) -> None:
    for given in (["data", "info", str(store), "--json", "-"], ["train", "bc", "--help"]):
        process = apart(to_nobody, *given, said=tmp_path / given[0])
        process.join()
        assert ((tmp_path / f"{given[0]}.err").read_text(), process.exitcode) == ("", 1)


def test_convert_reports_what_it_did(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.setattr(symphony.data.convert, "get_reader", lambda name, **options: FakeReader())
    logs, out = [str(tmp_path / f"{k}.scene") for k in (1, 2)], tmp_path / "out"
    for k, file in enumerate(logs):
        Path(file).write_text(f"straight {k}\nbroken 1\nbroken 2")
    options = ["--out", str(out), "--rate", "2.5", "--interactive", "3", "--smooth", "0.1"]
    assert main(["data", "convert", "womd", *logs, *options]) == 0
    captured = capsys.readouterr()
    rows = [" ".join(line.split()) for line in captured.out.splitlines()]
    assert {"segments 2", "tracks: # is not # 4"} <= {*rows}
    assert "2 converted, 4 skipped" in captured.err
    assert SegmentStore(out).ids == ["straight-0", "straight-1"]
    assert SegmentStore(out)[0].dt == pytest.approx(0.4)
    assert main(["data", "convert", "interaction", *logs, "--out", f"{out}-2", "--window", "4", "--egos", "all"]) == 0
    settings = SegmentStore(out).report["settings"]
    assert (settings["rate"], settings["interactive"], settings["smooth"]) == (2.5, 3, 0.1)


def test_info_as_json_and_as_text_agree(store: Path, capsys: Any) -> None:
    def info(*arguments: str, folder: Path = store) -> str:
        assert main(["data", "info", str(folder), *arguments]) == 0
        return capsys.readouterr().out

    whole = json.loads(info("--json", "-"))
    assert (whole["segments"], whole["checksum"]) == (2, SegmentStore(store).checksum())
    chosen = whole["interactive"]
    assert (chosen["count"], sum(chosen["contexts"].values())) == (2, 2)
    assert chosen["segments"].keys() == set(SegmentStore(store).ids)
    assert json.loads(info("--json", "-", "--interactive", "99"))["interactive"]["too_few"] == 2
    assert "interactive" not in json.loads(info("--json", "-", "--interactive", "0"))
    rows = {" ".join(line.split()) for line in info().splitlines()}
    facts = {name: whole[name] for name in ("segments", "agents", "checksum")} | chosen["contexts"]
    assert {f"{name} {value}" for name, value in facts.items()} <= rows
    StoreWriter(store.parent / "empty").close()
    assert "none" in info(folder=store.parent / "empty")


@pytest.mark.parametrize(
    "change", ["--segment nobody", "--segment 2", "--out a.docx", "--step 51", "--step -1", "--interactive 9"]
)
def test_plot_refuses_what_it_cannot_draw(store: Path, change: str, tmp_path: Path, capsys: Any) -> None:
    command = ["plot", "segment", str(store), "--segment", "straight", "--out", str(tmp_path / "a.png")]
    with contextlib.chdir(tmp_path):
        assert main([*command, *change.split()]) == 1
    error = capsys.readouterr().err
    assert error.startswith("symphony: error: ")
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def look(folder: Path, commands: tuple[str, ...], needless: set[str]) -> None:
    """Run commands there, none of which may import what it does not need."""
    forget("symphony", *needless)
    sys.modules.pop("torch._dynamo", None)
    os.chdir(folder)
    command_line = importlib.import_module("symphony.cli")
    for command in commands:
        assert command_line.main(command.split()) == 0
        assert not needless & set(sys.modules), command


def test_looking_at_results_imports_no_torchrl_and_no_torch_where_nothing_is_computed(tmp_path: Path) -> None:
    save_rollouts(tmp_path / "sim", About("made"), [played(straight_road(2, steps=6))])
    (tmp_path / "metrics.jsonl").write_text('{"step": 1, "loss": 2.0}\n')
    looks = ("agents", "plot curves . --out a.png", "view sim --out b.png", "export sim")
    output_of(look, tmp_path, looks, {"torch"}, said=tmp_path / "said")
    needless = {"torchrl", "tensordict", "torch._dynamo"}
    output_of(look, tmp_path, ("view sim", "report sim"), needless, said=tmp_path / "said")


def test_tables_are_aligned_and_never_break_a_name(capsys: pytest.CaptureFixture[str]) -> None:
    name, title = "runs/" + "long_name_" * 9, "/path/" + "of_a_store_" * 12
    print_table([["agent", "number"], [name, "1.0"], ["b\x1b[2J", "10.0"]], title, heads=1)
    first, *rows = capsys.readouterr().out.splitlines()
    assert first == title
    assert len({len(row) for row in rows}) == 1
    assert sum(name in row for row in rows) == 1
    assert any(row.startswith("b\\x1b[2J ") for row in rows)


def test_doctor_simulates_and_says_what_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["simulation"]["rollouts"], bool(found["packages"]["torch"])) == (2, True)
    assert set(found["extras"]) == {"eclipse-sumo", "pyarrow", "ray", "imageio-ffmpeg", "gymnasium"}


@cache
def settings(method: str, *args: str) -> TrainConfig:
    return tyro.cli(Arguments, args=expanded([method, "--data", "a", "--out", "b", "--test", "c", *args])).config


@pytest.mark.parametrize("profile", PROFILES)
def test_every_profile_is_a_valid_configuration_of_every_method(profile: str) -> None:
    config = settings("mgail_ts_h", "--profile", profile)
    assert (config == settings("mgail_ts_h")) == (profile == "default")
    for method in METHODS:
        assert replace(config, method=method).method == method  # which looks whether the rest suits it
    for actions in ("bicycle", "displacement"):
        spec = config.spec(actions, 0.2, goals=True, discriminator=True, searches=True)
        agent = Agent("built", policy_network(spec), spec, goal_network(spec), discriminator_network(spec))
        assert set(agent.modules) == {"policy", "goals", "discriminator"}


def test_the_paper_is_followed() -> None:
    config = settings("mgail_ts_h", "--profile=paper", "--interactive", "8", "--duration", "20")
    assert (config.duration, config.agent.interactive) == (20, 8)
    search = config.search
    assert (config.steps, config.segments, config.checkpoint_every) == (70_000, 16, 2_000)
    assert (search.branches, search.test_branches, search.prune_every, search.rule) == (4, 16, 10, "best")
    assert (config.agent.num_points, config.validation.segments) == (1_000, 200)
    assert (config.mgail.regression, config.mgail.react, config.mgail.cost) == (0, True, "log_d")
    assert config.discriminator.features == "paper"


def test_what_is_given_has_precedence() -> None:
    words = ["bc", "--steps", "3", "--profile", "default"]
    assert expanded(words) == words
    for steps in (["--steps", "7"], ["--steps=7"]):
        for args in ([*steps, "--profile", "smoke"], ["--profile", "smoke", *steps]):
            config = settings("bc", *args)
            assert (config.steps, config.states) == (7, 16)


def test_unknown_profiles_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match=r"one of default, .*not 'labtop'"):
        expanded(["bc", "--profile", "labtop"])
    assert main(["train", "bc", "--data", str(tmp_path), "--out", str(tmp_path), "--profile=fast"]) == 2
    assert "profile is one of default, paper, recommended, laptop, tiny, smoke" in capsys.readouterr().err
