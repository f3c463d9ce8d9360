"""How commands end: killed, out of disk, with odd texts; and that what they write is whole or not there."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from helpers_convert import FakeReader
from helpers_segments import straight_road
from helpers_sources import ROAD, commonroad, driver
from symphony.cli import main
from symphony.data import store_writer
from symphony.data.convert import convert
from symphony.data.sources.base import Item
from symphony.data.sources.sumo import process
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError
from symphony.files import replacing, write_file, write_json


def test_control_characters_do_not_reach_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = str(DataError("a\x1b[2Jb\x9b\u202ec\nd", file="x\x07", segment="s\r\n", field="f\udc80"))
    assert text == "file x\\x07, segment s\\r\\n, field f\\udc80: a\\x1b[2Jb\\x9b\\u202ec\nd"
    path = tmp_path / "a.xml"
    path.write_text(commonroad(ROAD, driver(7)).replace("2020a", "20\u202e\x9b31m"))
    assert main(["data", "convert", "commonroad", str(path), "--out", str(tmp_path / "out")]) == 1
    assert set(filter(lambda c: not c.isprintable(), capsys.readouterr().err)) <= {"\n"}


def test_reports_show_no_control_characters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    class Hostile(FakeReader):
        def _read(self, path: Path) -> Iterator[Item]:
            yield DataError("a\x1b[2Jb")
            yield from super()._read(path)

    (tmp_path / "a.scene").write_text("straight 1")
    convert(Hostile(), [tmp_path / "a.scene"], tmp_path / "out")
    assert main(["data", "info", str(tmp_path / "out")]) == 0
    found = capsys.readouterr().out
    assert "a\\x1b[#Jb" in found  # numbers are blanked
    assert "\x1b[2J" not in found


def test_a_full_disk_names_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with StoreWriter(tmp_path / "store") as writer:
        writer.append(straight_road(seed=1))
        with monkeypatch.context() as patch:
            patch.setattr(os, "fsync", full)
            for path, write in (
                (tmp_path / "store" / "report.json", lambda: writer.write_report({})),
                (tmp_path / "a.json", lambda: write_json(tmp_path / "a.json", {})),
            ):
                with pytest.raises(DataError, match="can't be written: No space left") as error:
                    write()
                assert error.value.file == path
    assert sorted(path.name for path in tmp_path.iterdir()) == ["store"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_conversion_ends_where_a_column_finds_the_disk_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And is not told as one more bad record."""
    (tmp_path / "a.scene").write_text("straight 1\nstraight 2")
    write = store_writer._write_at

    def full(file: Any, *rest: Any) -> None:
        with Path("/dev/full").open("r+b", buffering=0) as other:
            write(other if "position" in file.name else file, *rest)

    monkeypatch.setattr(store_writer, "_write_at", full)
    with pytest.raises(DataError, match="can't be written: No space left"):
        convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "store")
    monkeypatch.undo()
    convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "store")
    assert SegmentStore(tmp_path / "store").ids == ["straight-1", "straight-2"]


def test_what_is_written_is_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.json"
    write_file(path, "one")

    def fail() -> None:
        with replacing(path) as draft:
            draft.write_text("tw")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert path.read_text() == "one"
    assert [each.name for each in path.parent.iterdir()] == ["a.json"]
    link = tmp_path / "link.json"
    link.symlink_to(path)
    write_file(link, "three")
    assert link.is_symlink()
    assert path.read_text() == "three"


def test_drafts_of_killed_processes_are_removed(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    names = (f".a.{dead.pid}.new.json", f".a.{os.getppid()}.new.json", f".b.{dead.pid}.new.json")
    for name in names:
        (tmp_path / name).touch()
    write_file(tmp_path / "a.json", "{}")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*names[1:], "a.json"])


def test_what_is_no_file_is_written_to(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_file(pipe, "text")
    assert os.read(reader, 10) == b"text"
    os.close(reader)
    assert pipe.is_fifo()


SLOW = """
import time
from symphony import cli
from symphony.cli.data import Verify
Verify.__call__ = lambda self: (print("ready", flush=True), time.sleep(60))
raise SystemExit(cli.main(["data", "verify", "x"]))
"""


def test_a_terminated_command_says_so() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.terminate()
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (143, "symphony: error: terminated\n")


def test_no_store_can_be_made_of_the_root(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(commonroad(ROAD, driver(7), driver(8)))
    assert main(["data", "convert", "commonroad", str(tmp_path), "--out", "/"]) == 1
    assert "no name of its own" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command",
    [
        ["plot", "segment", "DIR", "--segment", "0", "--out", "a.bmp"],
        ["evaluate", "playback", "--data", "DIR", "--figure", "a.bmp"],
    ],
)
def test_pictures_of_unknown_kinds_are_refused_before_the_work(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # There is no store: whoever got to work would complain of that.
    assert main([str(tmp_path) if word == "DIR" else word for word in command]) == 1
    assert "must end in" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--json", "--figure"])
@pytest.mark.parametrize(
    ("place", "complaint"), [("file/a.png", "can't be written"), ("folder", "is a folder")]
)
def test_places_for_results_are_tried_before_the_work(
    option: str, place: str, complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    # There is no store: whoever got to work would complain of that.
    given = ["evaluate", "playback", "--data", str(tmp_path / "no-store"), option, str(tmp_path / place)]
    assert main(given) == 1
    told = capsys.readouterr().err
    assert place.partition("/")[0] in told
    assert complaint in told
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_folders_of_killed_simulations_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    old = time.time() - 2 * process.SETTLED
    with process.scratch() as living:
        left, new, other = (tmp_path / name for name in ("symphony-sumo-a", "symphony-sumo-b", "other"))
        for folder in (left, new, other):
            (folder / "inside").mkdir(parents=True)
        for folder in (left, living, other):
            os.utime(folder, (old, old))
        with process.scratch() as folder:
            assert folder.is_dir()
        assert sorted(tmp_path.iterdir()) == sorted([living, new, other])
    assert not living.exists()
