"""Conversions that die, are taken up again, or are shared among workers: always the same store and report."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from helpers_convert import FakeReader
from helpers_processes import apart
from symphony import parallel as engine
from symphony.data import parts, store_format, store_writer
from symphony.data.convert import convert
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError, SymphonyError

LOGS = {
    "a.scene": ["straight 1", "broken 5", "crossing 2"],
    "b.scene": ["straight 1", "lonely 7"],
    "c.scene": ["stop"],
    "d.scene": ["crossing 3", "straight 1", "straight 4", "straight 4"],
}


@pytest.fixture(autouse=True)
def no_sync(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk's own cache is not under test, and waiting for it is slow."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@pytest.fixture
def logs(tmp_path: Path) -> list[Path]:
    return write(tmp_path / "logs", LOGS)


def write(folder: Path, logs: dict[str, list[str]]) -> list[Path]:
    folder.mkdir()
    for name, lines in logs.items():
        (folder / name).write_text("\n".join(lines))
    return [folder / name for name in logs]


def content(path: Path) -> dict[str, bytes]:
    """Every file of a store."""
    return {str(p.relative_to(path)): p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


def snapshots(folder: Path, action: Callable[[], Any]) -> list[Path]:
    """Copies of a folder as a process would leave it that is killed before it changes a file.

    Of the many like moments, between the columns of one record and between the files of one store that is
    removed, a few.
    """
    taken: list[Path] = []
    count = itertools.count()

    def spied(change: Callable[..., Any], every: int = 1) -> Callable[..., Any]:
        def wrapper(*args: Any, **options: Any) -> Any:
            if next(count) % every == 0:
                taken.append(folder.parent / "moments" / str(len(taken)))
                shutil.copytree(folder, taken[-1])
            return change(*args, **options)

        return wrapper

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_writer, "_write_at", spied(store_writer._write_at, 97))
        for name, every in {"rename": 1, "replace": 1, "rmdir": 3, "unlink": 97}.items():
            patch.setattr(os, name, spied(getattr(os, name), every))
        action()
    assert len(taken) > 10
    return taken


def test_killed_between_any_two_changes_of_a_file(
    logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "PART_FILES", 2)
    home = tmp_path / "home"
    home.mkdir()

    def run(folder: Path) -> Any:
        return convert(FakeReader(), logs, folder / "store")

    report = run(tmp_path / "whole")
    expected = content(tmp_path / "whole" / "store")
    for moment in snapshots(home, lambda: run(home)):
        if content(moment / "store") != expected or (moment / "store.partial" / "job.json").exists():
            assert run(moment) == report
        elif (moment / "store.partial").exists():
            (moment / "store.partial").rmdir()  # all that was left to do
        assert content(moment / "store") == expected
        assert [p.name for p in moment.iterdir()] == ["store"]


def converted(folder: Path, workers: int, told: Connection) -> None:
    """Convert in a process that may be killed, and tell how it goes."""
    os.fsync = lambda descriptor: None
    parts.PART_FILES = 3
    # Of all that this process holds, workers need little.
    preload = multiprocessing.get_context("forkserver").set_forkserver_preload
    engine.get_ready = lambda _: preload([convert.__module__, FakeReader.__module__])

    def progress(*_: Any) -> None:
        told.send("on")

    convert(FakeReader(), [folder / "logs"], folder / "store", workers=workers, progress=progress)
    told.send("end")


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_kill_9_at_random_moments(tmp_path: Path) -> None:
    rng = random.Random(1)
    scenes = (f"{rng.choice(['straight', 'crossing', 'broken'])} {k}" for k in range(64))
    logs = {f"{k:02d}.scene": list(itertools.islice(scenes, 4)) for k in range(16)}
    whole = convert(FakeReader(), write(tmp_path / "logs", logs), tmp_path / "whole")
    kills, ended = 0, False
    while not ended:
        heard, told = multiprocessing.Pipe(duplex=False)
        process = apart(converted, tmp_path, 2, told)
        told.close()
        ended = heard.recv() == "end"
        if kills < 2:  # to start two workers takes seconds
            time.sleep(rng.uniform(0, 0.04))
            process.kill()
        with contextlib.suppress(EOFError):
            while not ended:
                ended = heard.recv() == "end"
        process.join()
        kills += process.exitcode == -signal.SIGKILL
    assert kills >= 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["logs", "store", "whole"]
    assert content(tmp_path / "store") == content(tmp_path / "whole")
    assert SegmentStore(tmp_path / "store").report == whole.to_json()


def test_finished_files_are_not_read_again(
    logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "PART_FILES", 1)
    logs[3].write_text("crossing 3\ninterrupt\nstraight 4")
    with pytest.raises(KeyboardInterrupt):
        convert(FakeReader(), logs, tmp_path / "store")
    read: list[str] = []

    class Watched(FakeReader):
        _stops = False

        def _read(self, path: Path) -> Any:
            read.append(path.name)
            return super()._read(path)

    convert(Watched(), logs, tmp_path / "store")
    assert read == ["d.scene"]


def test_workers_make_the_same_store(
    logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "PART_FILES", 1)
    told: list[list[tuple[int, int, int]]] = []
    for count in (1, 3):
        told.append([])
        convert(
            FakeReader(),
            logs,
            tmp_path / f"by{count}",
            workers=count,
            progress=lambda done, total, report: told[-1].append((done, total, report.converted)),
        )
    assert content(tmp_path / "by1") == content(tmp_path / "by3")
    assert told[0] == told[1]
    assert not multiprocessing.active_children()


class Deadly(FakeReader):
    def _read(self, path: Path) -> Any:
        if path.name == "c.scene" and multiprocessing.parent_process() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._read(path)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_worker_that_dies_costs_no_finished_work(
    logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "PART_FILES", 1)
    with pytest.raises(SymphonyError, match="a worker process ended"):
        convert(Deadly(), logs, tmp_path / "store", workers=2)
    assert (tmp_path / "store.partial").is_dir()
    convert(Deadly(), logs, tmp_path / "store")
    convert(FakeReader(), logs, tmp_path / "whole")
    assert content(tmp_path / "store") == content(tmp_path / "whole")


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("rate", "rate is 10.0, but the conversion that was interrupted had 5.0"),
        ("fewer", r"the files are others, .* \(.*d\.scene\)"),
        ("order", "in another order"),
        ("map", r"were changed, since the conversion was interrupted \(.*b\.map\)"),
        ("option", "options is {'option': 'option'}, but .* had {'option': 'usual'}"),
    ],
)
def test_other_arguments_do_not_go_on(logs: list[Path], tmp_path: Path, what: str, message: str) -> None:
    class WithMaps(FakeReader):
        def __init__(self, option: str = "usual") -> None:
            self.option = option

        def companions(self, path: Path) -> tuple[Path, ...]:
            return (path.with_suffix(".map"),)

    for log in logs[:2]:
        log.with_suffix(".map").write_text("a map")
    logs[3].write_text("interrupt")
    with pytest.raises(KeyboardInterrupt):
        convert(WithMaps(), logs, tmp_path / "store")
    if what == "map":
        os.utime(logs[1].with_suffix(".map"), ns=(0, 1))
    files = {"fewer": logs[:3], "order": logs[::-1]}.get(what, logs)
    reader = WithMaps("option" if what == "option" else "usual")
    with pytest.raises(ConfigError, match=message):
        convert(reader, files, tmp_path / "store", rate=10.0 if what == "rate" else 5.0)
    assert (tmp_path / "store.partial" / "job.json").is_file()


def test_a_folder_of_somebodys_own_is_left_alone(logs: list[Path], tmp_path: Path) -> None:
    """Of the name that unfinished work gets: a folder with notes, and a store."""
    notes = tmp_path / "store.partial"
    notes.mkdir()
    (notes / "notes.txt").write_text("mine")
    convert(FakeReader(), logs[1:2], tmp_path / "other.partial")
    before = content(tmp_path / "other.partial")
    for name in ("store", "other"):
        with pytest.raises(DataError, match="no conversion left"):
            convert(FakeReader(), logs, tmp_path / name)
    assert (notes / "notes.txt").read_text() == "mine"
    assert content(tmp_path / "other.partial") == before


def test_what_is_in_the_way_is_told(logs: list[Path], tmp_path: Path) -> None:
    out, partial = tmp_path / "store", tmp_path / "store.partial"
    logs[3].write_text("straight 9\ninterrupt")
    with pytest.raises(KeyboardInterrupt):
        convert(FakeReader(), logs, out)
    with store_format.lock(partial), pytest.raises(DataError, match="being written by another process"):
        convert(FakeReader(), logs, out)
    convert(FakeReader(), logs[:1], tmp_path / "other")
    (tmp_path / "other").rename(out)
    with pytest.raises(DataError, match="unfinished conversion to that name: delete one of them"):
        convert(FakeReader(), logs, out)
    shutil.rmtree(out)
    for damaged, message in (("[]", "not an object"), ('{"files": [1]}', "not the job of a conversion")):
        (partial / "job.json").write_text(damaged)
        with pytest.raises(DataError, match=message):
            convert(FakeReader(), logs, out)
