"""One writer for each output: another is refused by name (docs/determinism.md); a machine that lacks something."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest

from helpers_processes import apart
from helpers_runs import tiny
from helpers_saved import searched
from helpers_store import contents
from symphony.cli import main
from symphony.data.builtin import builtin_store
from symphony.data.generate import Plan, generate
from symphony.errors import DataError, SymphonyError
from symphony.files import Lock, lock_file
from symphony.recipes import train
from symphony.saved.folder import RolloutWriter, load_rollouts, save_rollouts
from test_generate import needs_sumo

STORE = ["--data", str(builtin_store("test"))]
SHORT = ["--segments", "0", "--duration", "1"]
REFUSED = r"is being written by another process: \d+ on "


def test_two_simulations_into_one_folder(tmp_path: Path) -> None:
    about, (first, second) = searched()
    with RolloutWriter(tmp_path / "sim", about) as writer:
        for other in (about, replace(about, seed=7)):  # the same simulation, too
            with pytest.raises(DataError, match=REFUSED):
                RolloutWriter(tmp_path / "sim", other)
        writer.add(first)
    with pytest.raises(DataError, match="another simulation, which differs in seed"):
        RolloutWriter(tmp_path / "sim", replace(about, seed=7))
    with RolloutWriter(tmp_path / "sim", about) as writer:
        writer.add(second)
    assert load_rollouts(tmp_path / "sim").ids == [first.segment.segment_id, second.segment.segment_id]
    assert not list(tmp_path.rglob("*.lock"))


def test_a_folder_that_was_removed_meanwhile(tmp_path: Path) -> None:
    about, (first, second) = searched()
    with RolloutWriter(tmp_path / "sim", about) as writer:
        writer.add(first)
        shutil.rmtree(tmp_path / "sim")
        save_rollouts(tmp_path / "sim", replace(about, seed=7), [])
        with pytest.raises(DataError, match="was removed or replaced while this process wrote into it"):
            writer.add(second)
    assert load_rollouts(tmp_path / "sim").about.seed == 7
    assert not load_rollouts(tmp_path / "sim").ids


def test_one_that_died_before_it_had_begun(tmp_path: Path) -> None:
    about, (first, _) = searched()
    (tmp_path / "sim" / "segments").mkdir(parents=True)
    (tmp_path / "sim" / "rollouts.lock").write_text("who")
    save_rollouts(tmp_path / "sim", about, [first])
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "notes.txt").write_text("mine")
    for held in (False, True):
        if held:
            (tmp_path / "own" / "rollouts.lock").touch()
        with pytest.raises(DataError, match="not a folder of rollouts"):
            RolloutWriter(tmp_path / "own", about)


COMMANDS: dict[str, Callable[[str], list[str]]] = {
    "sim/rollouts.lock": lambda sim: ["simulate", "playback", *STORE, *SHORT, "--out", sim],
    "sim/report.lock": lambda sim: ["report", sim],
    "sim/export/export.lock": lambda sim: ["export", sim],
    ".page.html.lock": lambda sim: ["view", sim, "--out", "page.html"],
    ".picture.png.lock": lambda sim: ["evaluate", "playback", *STORE, *SHORT, "--figure", "picture.png"],
    ".segment.png.lock": lambda sim: ["plot", "segment", STORE[1], "--segment", "0", "--out", "segment.png"],
    "demo/demo.lock": lambda sim: ["demo", "--out", "demo"],
    "run/run.lock": lambda sim: ["train", "bc", *STORE, "--out", "run", "--profile", "smoke"],
}


@pytest.mark.parametrize("lock", COMMANDS)
def test_commands_that_write_refuse_a_second(lock, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_rollouts("sim", *searched())
    before = contents(tmp_path)
    (tmp_path / lock).parent.mkdir(parents=True, exist_ok=True)
    with Lock(tmp_path / lock):
        assert main(COMMANDS[lock]("sim")) == 1
        assert f"is being written by another process: {os.getpid()} on " in capsys.readouterr().err
    assert contents(tmp_path) == before


def test_a_folder_that_learns_is_taken_over_by_nobody(tmp_path, monkeypatch):
    config = tiny("bc", builtin_store("train"), tmp_path / "run", steps=2, checkpoint_every=1)
    monkeypatch.setattr(Lock, "check", lambda self: (_ for _ in ()).throw(DataError("taken")))
    with pytest.raises(DataError, match="taken"):
        train(config)
    assert not list(tmp_path.rglob("*.lock"))


def test_what_is_no_file_needs_no_lock(tmp_path: Path) -> None:
    with lock_file(Path(os.devnull)), lock_file(Path(os.devnull)):
        pass
    (tmp_path / "link").symlink_to(tmp_path / "file")
    with lock_file(tmp_path / "file"), pytest.raises(DataError, match=REFUSED):
        lock_file(tmp_path / "link")


def hammer(folder: Path, times: int) -> None:
    """Take a lock and give it back, again and again; fails if two have it at once."""
    had = 0
    while had < times:
        try:
            with Lock(folder / "x.lock"):
                os.close(os.open(folder / "inside", os.O_CREAT | os.O_EXCL))
                (folder / "inside").unlink()
                had += 1
        except DataError:
            continue


def test_no_two_have_it_at_once(tmp_path: Path) -> None:
    processes = [apart(hammer, tmp_path, 200) for _ in range(3)]
    for process in processes:
        process.join(60)
    assert [process.exitcode for process in processes] == [0, 0, 0]


@needs_sumo
def test_what_the_machine_lacks_ends_a_generation_and_costs_no_network(tmp_path: Path) -> None:
    full, late = OSError(errno.ENOSPC, "No space left on device"), subprocess.TimeoutExpired("sumo", 600)
    for fault in (OSError(errno.EMFILE, "Too many open files"), late, [subprocess.CompletedProcess([], -9)], full):
        where = (Path, "write_bytes") if fault is full else (subprocess, "run")  # there the programs say nothing
        with patch.object(*where, side_effect=fault), pytest.raises((SymphonyError, OSError)) as error:
            generate(Plan(1), tmp_path)
        assert not isinstance(error.value, DataError)
    state = generate(Plan(1), tmp_path)
    assert (state.networks, state.failed) == (1, {})
