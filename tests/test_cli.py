from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import symphony.data.convert
from helpers_cli import words
from helpers_interaction import public, track
from helpers_processes import apart
from helpers_saved import played
from helpers_segments import crossing, straight_road
from symphony import __version__
from symphony.cli import GONE, main
from symphony.cli.data import Info
from symphony.data.segment import RunSegment
from symphony.data.sources import Reader
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError
from symphony.saved.folder import About, save_rollouts

HEAVY = {"torch", "torchrl", "tensordict", "wandb", "matplotlib", "numpy", "shapely", "google.protobuf"}


@pytest.fixture
def store(tmp_path: Path) -> Path:
    path = tmp_path / "store"
    with StoreWriter(path) as writer:
        writer.append(crossing())
        writer.append(straight_road(4, segment_id="straight"))
    return path


class MadeReader(Reader):
    """Gives one good segment and two broken records for each file."""

    name = "made"
    patterns = ("*.made",)

    def _read(self, path: Path) -> Iterator[RunSegment | DataError]:
        yield straight_road(6, segment_id=path.stem)
        yield DataError("has 3 wheels", file=path, segment="tricycle", field="agents")
        yield DataError("has 5 wheels", file=path, segment="spare", field="agents")


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setattr(symphony.data.convert, "get_reader", lambda name, **options: MadeReader())
    files = [tmp_path / "one.made", tmp_path / "two.made"]
    for file in files:
        file.write_text("")
    return [str(file) for file in files]


COMMANDS = (
    "|data|data convert|data info|plot segment|train|evaluate|table|plot curvature|plot curves|view|report"
    "|export|wosac evaluate|wosac submit|agents|doctor|planners|demo"
)


def test_help_explains_without_importing_anything_heavy() -> None:
    code = (
        "import contextlib, io, json, sys\n"
        "from symphony.cli import main\n"
        "found = {}\n"
        f"for command in {COMMANDS.split('|')}:\n"
        "    with contextlib.redirect_stdout(io.StringIO()) as shown:\n"
        "        status = main([*command.split(), '--help'])\n"
        f"    found[command] = status, shown.getvalue()[:80], sorted({HEAVY} & set(sys.modules))\n"
        "print(json.dumps(found))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    for command, (status, shown, loaded) in json.loads(done.stdout).items():
        assert shown.startswith(f"usage: symphony {command}".rstrip()), command
        assert (status, loaded) == (0, []), command


def test_installed_command_prints_the_version() -> None:
    command = Path(sys.executable).with_name("symphony")
    done = subprocess.run([command, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"symphony {__version__}\n"


@pytest.mark.parametrize(
    "args",
    [
        [],
        ["nonsense"],
        ["data"],
        ["data", "convert", "nonsense", "x", "--out", "y"],
        ["data", "convert", "womd", "x"],
        ["data", "convert", "womd", "--out", "y"],
        ["data", "convert", "womd", "x", "--out", "y", "--rate", "0"],
        ["data", "convert", "womd", "x", "--out", "y", "--rate", "nan"],
        ["data", "convert", "womd", "x", "--out", "y", "--interactive", "0"],
        ["data", "convert", "womd", "x", "--out", "y", "--smooth", "-1"],
        ["data", "info"],
        ["train", "bc", "--data", "x", "--out", "y", "--steps", "many"],
        ["train", "bc", "--data", "x", "--out", "y", "--steps", "0"],
        ["evaluate", "--data", "x"],
        ["evaluate", "playback", "--data", "x", "--unknown", "1"],
        ["evaluate", "playback", "--data", "x", "--planner", "idm", "--figure", "f.png"],
        ["evaluate", "playback", "--data", "x", "--planner", "idm", "--metrics", "wosac"],
        ["simulate", "playback", "--data", "x", "--out", "y", "--runs", "5", "--segments", "a"],
        ["simulate", "playback", "--data", "x", "--out", "y", "--runs", "5", "--rollouts", "2"],
    ],
    ids=" ".join,
)
def test_wrong_usage_is_status_2(
    args: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(args) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.strip()
    assert "Traceback" not in captured.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (
            DataError("is bent", file="a.xml", field="lane"),
            1,
            "symphony: error: file a.xml, field lane: is bent\n",
        ),
        (FileNotFoundError(2, "No such file or directory", "x/y"), 1, "x/y: No such file or directory\n"),
        (OSError(28, "No space left on device"), 1, "symphony: error: No space left on device\n"),
        (KeyboardInterrupt(), 130, "symphony: error: interrupted\n"),
    ],
)
def test_failures_become_one_line_and_a_status(
    error: BaseException,
    status: int,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(self: Info) -> None:
        raise error

    monkeypatch.setattr(Info, "run", fail)
    monkeypatch.delenv("SYMPHONY_DEBUG", raising=False)
    assert main(["data", "info", "x"]) == status
    captured = capsys.readouterr()
    assert captured.err.endswith(message)
    assert captured.err.count("\n") == 1
    assert captured.out == ""


def test_debugging_shows_the_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SYMPHONY_DEBUG", "1")
    with pytest.raises(DataError):
        main(["data", "info", str(tmp_path / "none")])


def test_programming_errors_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Info) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(Info, "run", fail)
    with pytest.raises(ZeroDivisionError):
        main(["data", "info", "x"])


def to_nobody(*arguments: str) -> int:
    """Run a command that writes into a pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    os.dup2(writer, 1)
    return main(arguments)


def test_a_closed_pipe_is_no_traceback(store: Path, tmp_path: Path) -> None:
    process = apart(to_nobody, "data", "info", str(store), "--json", "-", said=tmp_path / "said")
    process.join()
    assert (tmp_path / "said.err").read_text() == ""
    assert process.exitcode == 1


def test_convert_reports_what_it_did(
    logs: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["data", "convert", "womd", *logs, "--out", str(out)]) == 0
    captured = capsys.readouterr()
    rows = [" ".join(line.split()) for line in captured.out.splitlines()]
    assert rows[1:] == ["converted 2", "skipped", "agents: has # wheels 4"]
    assert "2 converted, 4 skipped" in captured.err
    assert SegmentStore(out).ids == ["one", "two"]


def test_convert_passes_its_options_on(logs: list[str], tmp_path: Path) -> None:
    out = str(tmp_path / "out")
    options = ["--out", out, "--rate", "2.5", "--interactive", "3", "--smooth", "0.1"]
    assert main(["data", "convert", "womd", logs[0], *options]) == 0
    segment = SegmentStore(out)[0]
    assert segment.dt == pytest.approx(0.4)
    settings = SegmentStore(out).report["settings"]
    assert (settings["rate"], settings["interactive"], settings["smooth"]) == (2.5, 3, 0.1)


def test_convert_fails_when_nothing_could_be_used(
    logs: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(MadeReader, "_read", lambda self, path: iter([DataError("empty", file=path)]))
    assert main(["data", "convert", "womd", *logs, "--out", str(tmp_path / "out")]) == 1
    assert "empty" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_convert_reads_real_files(samples: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    source = samples / "womd"
    assert main(["data", "convert", "womd", str(source), "--out", str(out)]) == 0
    assert len(SegmentStore(out)) == 1
    picture = tmp_path / "segment.png"
    assert main(["plot", "segment", str(out), "--segment", "0", "--out", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_info_as_json_and_as_text_agree(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "info", str(store), "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["segments"] == 2
    assert found["checksum"] == SegmentStore(store).checksum()
    assert main(["data", "info", str(store)]) == 0
    text = capsys.readouterr().out
    rows = dict(line.split(maxsplit=1) for line in text.splitlines() if len(line.split()) > 1)
    assert rows["segments"].strip() == rows["made"].strip() == "2"
    assert rows["agents"].strip() == str(found["agents"])
    assert rows["checksum"].strip() == found["checksum"]


def test_info_says_who_is_interactive(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def found(*arguments: str) -> dict[str, Any]:
        assert main(["data", "info", str(store), "--json", "-", *arguments]) == 0
        return json.loads(capsys.readouterr().out)

    counts = found()["interactive"]
    assert counts["count"] == 2
    assert sum(counts["contexts"].values()) == 2
    assert "segments" not in counts
    listed = found("--per-segment")["interactive"]
    assert listed.pop("segments").keys() == set(SegmentStore(store).ids)
    assert listed == counts
    assert found("--interactive", "99")["interactive"] == {"count": 99, "contexts": {}, "too_few": 2}
    assert "interactive" not in found("--interactive", "0")
    assert main(["data", "info", str(store)]) == 0
    text = capsys.readouterr().out
    for context, count in counts["contexts"].items():
        assert re.search(rf"partner: {context} +{count}\b", text)
    assert main(["data", "info", str(store), "--per-segment"]) == 2
    assert "--json" in capsys.readouterr().err
    assert main(["data", "info", str(store), "--interactive", "-1"]) == 2
    assert "negative" in capsys.readouterr().err


def test_info_of_an_empty_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    StoreWriter(tmp_path / "empty").close()
    assert main(["data", "info", str(tmp_path / "empty")]) == 0
    assert "none" in capsys.readouterr().out


@pytest.mark.parametrize("segment", ["straight", "1"])
def test_plot_finds_a_segment_by_id_or_number(store: Path, segment: str, tmp_path: Path) -> None:
    out = tmp_path / "new" / "segment.svg"
    assert main(["plot", "segment", str(store), "--segment", segment, "--out", str(out)]) == 0
    assert "straight" in out.read_text()


@pytest.mark.parametrize(
    "change",
    [
        {"--segment": "nobody"},
        {"--segment": "2"},
        {"--out": "segment.docx"},
        {"--step": "51"},
        {"--step": "-1"},
        {"--interactive": "9"},
        {"--interactive": "0"},
    ],
    ids=str,
)
def test_plot_refuses_what_it_cannot_draw(
    store: Path,
    change: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = {"--segment": "straight", "--out": "segment.png"} | change
    flat = [word for pair in arguments.items() for word in pair]
    assert main(["plot", "segment", str(store), *flat]) == 1
    captured = capsys.readouterr()
    assert captured.err.startswith("symphony: error: ")
    assert captured.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["store"]


def test_every_vehicle_can_be_the_ego(
    samples: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(samples / "commonroad" / "ngsim" / "USA_US101-2_1_T-1.xml")
    for egos, least in (("one", 1), ("all", 5)):
        out = str(tmp_path / egos)
        assert main(["data", "convert", "commonroad", file, "--out", out, "--egos", egos]) == 0
        assert main(["data", "info", out, "--json", "-"]) == 0
        found = json.loads("{" + capsys.readouterr().out.partition("{")[2])["segments"]
        assert (found == 1) if egos == "one" else (found >= least)
    assert main(["data", "convert", "womd", file, "--out", out + "x", "--egos", "all"]) == 2


def test_options_of_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [row for k in range(3) for row in track(k, x=-15 * k, y=2 + 4 * (k % 2), logged=0.5)]
    file = str(public(tmp_path, rows))
    command = ["data", "convert", "interaction", file, "--out"]
    assert main([*command, str(tmp_path / "a"), "--window", "4"]) == 1
    assert "0.50 times the speed of the positions" in capsys.readouterr().err
    more = ["--motion", "positions", "--window", "4", "--stride", "2", "--egos", "all"]
    assert main([*command, str(tmp_path / "a"), *more]) == 0
    store = SegmentStore(tmp_path / "a")
    # Of 11.9 s, windows begin at 0, 2 … 8 s, the last being 3.9 s long; three cars each.
    assert len(store) == 5 * 3
    assert store.num_maps == 1
    assert set(store.groups.tolist()) == {"DR_X_000"}
    assert main(["data", "info", str(tmp_path / "a")]) == 0
    assert re.search(r"recordings +1\b", capsys.readouterr().out)
    for option, value in (("--window", "4"), ("--stride", "2"), ("--motion", "positions")):
        assert main(["data", "convert", "womd", file, "--out", str(tmp_path / "b"), option, value]) == 2
        assert f"{option} is for interaction" in capsys.readouterr().err


def test_what_users_type_changes_on_purpose_only() -> None:
    held = (Path(__file__).parent / "cli.txt").read_text().splitlines()
    now = words()
    assert now == held, (
        f"gone: {sorted(set(held) - set(now))}, new: {sorted(set(now) - set(held))}; "
        "say so in cli.GONE, and write the list anew: python tests/helpers_cli.py > tests/cli.txt"
    )


@pytest.mark.parametrize("gone", GONE)
def test_what_is_gone_is_told_with_what_takes_its_place(
    gone: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*gone.split(), "x"]) == 2
    assert f"`symphony {gone}` is gone: {GONE[gone]}" in capsys.readouterr().err
    assert not any(
        line.startswith(gone) for line in (Path(__file__).parent / "cli.txt").read_text().splitlines()
    )


LIGHT = """
import sys
from symphony.cli import main
for command in sys.argv[1:]:
    assert main(command.split()) == 0
    assert not {"torchrl", "tensordict", "torch._dynamo"} & set(sys.modules), command
"""


def test_looking_at_results_waits_for_no_torchrl(tmp_path: Path) -> None:
    save_rollouts(tmp_path / "sim", About("made"), [played(straight_road(2, steps=6))])
    (tmp_path / "metrics.jsonl").write_text('{"step": 1, "loss": 2.0}\n')
    commands = ("agents", "plot curves . --out a.png", "view sim", "view sim --out b.png", "report sim")
    subprocess.run([sys.executable, "-c", LIGHT, *commands], cwd=tmp_path, check=True)
