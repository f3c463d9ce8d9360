"""How commands end: killed, out of disk, with odd texts; and that what they write is whole or not there."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from helpers_convert import FakeReader
from helpers_sources import ROAD, commonroad, driver
from symphony.cli import main
from symphony.data import store_writer
from symphony.data.convert import convert
from symphony.data.sources.sumo import process
from symphony.data.store import SegmentStore
from symphony.errors import DataError
from symphony.files import replacing, write_file, write_json


def test_control_characters_do_not_reach_the_terminal(tmp_path, capsys):
    class Hostile(FakeReader):
        def _read(self, path):
            yield DataError("a\x1b[2Jb")
            yield from super()._read(path)

    text = str(DataError("a\x1b[2Jb\x9b\u202ec\nd", file="x\x07", segment="s\r\n", field="f\udc80"))
    assert text == "file x\\x07, segment s\\r\\n, field f\\udc80: a\\x1b[2Jb\\x9b\\u202ec\nd"
    path = tmp_path / "a.xml"
    path.write_text(commonroad(ROAD, driver(7)).replace("2020a", "20\u202e\x9b31m"))
    assert main(["data", "convert", "commonroad", str(path), "--out", str(tmp_path / "no")]) == 1
    assert set(filter(lambda c: not c.isprintable(), capsys.readouterr().err)) <= {"\n"}
    (tmp_path / "a.scene").write_text("straight 1")
    convert(Hostile(), [tmp_path / "a.scene"], tmp_path / "out")
    capsys.readouterr()
    assert main(["data", "info", str(tmp_path / "out")]) == 0
    found = capsys.readouterr().out
    assert ("a\\x1b[#Jb" in found, "\x1b[2J" in found) == (True, False)  # numbers are blanked


def test_a_full_disk_names_the_file(tmp_path, monkeypatch):
    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DataError, match="can't be written: No space left") as error:
        write_json(tmp_path / "a.json", {})
    assert (error.value.file, list(tmp_path.iterdir())) == (tmp_path / "a.json", [])


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_conversion_ends_where_a_column_finds_the_disk_full(tmp_path, monkeypatch):
    """And is not told as one more bad record."""
    (tmp_path / "a.scene").write_text("straight 1\nstraight 2")
    write = store_writer._write_at

    def full(file, *rest):
        with Path("/dev/full").open("r+b", buffering=0) as other:
            write(other if "position" in file.name else file, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(store_writer, "_write_at", full)
        with pytest.raises(DataError, match="can't be written: No space left"):
            convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "store")
    convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "store")
    assert SegmentStore(tmp_path / "store").ids == ["straight-1", "straight-2"]


def test_what_is_written_is_whole_or_not_there(tmp_path):
    path, link, pipe = (tmp_path / name for name in ("new/a.json", "link.json", "pipe"))
    write_file(path, "one")
    with pytest.raises(ZeroDivisionError), replacing(path) as draft:
        draft.write_text("tw" * (1 // 0))
    assert path.read_text() == "one"
    # Drafts of killed processes are removed, those of others are not.
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    names = (f".a.{dead.pid}.new.json", f".a.{os.getppid()}.new.json", f".b.{dead.pid}.new.json")
    for name in names:
        (path.parent / name).touch()
    link.symlink_to(path)
    write_file(link, "three")
    assert (link.is_symlink(), path.read_text()) == (True, "three")
    assert sorted(each.name for each in path.parent.iterdir()) == sorted([*names[1:], "a.json"])
    # What is no file is written to.
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_file(pipe, "text")
    assert (os.read(reader, 10), pipe.is_fifo()) == (b"text", True)
    os.close(reader)
    reader, writer = os.pipe()
    write_file(Path(f"/dev/fd/{writer}"), "text")
    assert os.read(reader, 10) == b"text"


SLOW = """
import time
from symphony import cli
from symphony.cli.data import Verify
Verify.__call__ = lambda self: (print("ready", flush=True), time.sleep(60))
raise SystemExit(cli.main(["data", "verify", "x"]))
"""


def test_a_terminated_command_says_so():
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, "-c", SLOW], **pipes)
    assert process.stdout.readline() == "ready\n"
    process.terminate()
    _, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (143, "symphony: error: terminated\n")


def test_no_store_can_be_made_of_the_root(capsys, tmp_path):
    (tmp_path / "a.xml").write_text(commonroad(ROAD, driver(7), driver(8)))
    assert main(["data", "convert", "commonroad", str(tmp_path), "--out", "/"]) == 1
    assert "no name of its own" in capsys.readouterr().err


# There is no store: whoever got to work would complain of that.
@pytest.mark.parametrize(("command", "complaint"), [
    ("plot segment DIR/no-store --segment 0 --out a.bmp", "must end in"),
    ("evaluate playback --data DIR/no-store --figure a.bmp", "must end in"),
    ("evaluate playback --data DIR/no-store --json DIR/file/a.png", "can't be written"),
    ("evaluate playback --data DIR/no-store --figure DIR/folder", "is a folder"),
])  # fmt: skip
def test_places_for_results_are_tried_before_the_work(command, complaint, tmp_path, capsys):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    assert main([word.replace("DIR", str(tmp_path)) for word in command.split()]) == 1
    assert complaint in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_folders_of_killed_simulations_are_removed(tmp_path, monkeypatch):
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
