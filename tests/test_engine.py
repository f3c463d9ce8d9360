"""Tasks in other processes: order, laziness, and how it ends when something goes wrong."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from symphony.errors import ConfigError, DataError, SymphonyError
from symphony.parallel import WorkerError, ordered_map


def slow_square(number: int) -> int:
    time.sleep(0.05 if number % 3 == 0 else 0.0)
    return number * number


def environment(name: str) -> str:
    return os.environ.get(name, "")


def fail_at_three(number: int) -> int:
    if number == 3:
        raise DataError("three", file="log", segment="s", field="agents")
    return number


def die_at_three(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def alive(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):  # the latter if it ends between opening and reading
        return False


def gone(pids: list[int]) -> bool:
    """Whether the processes end; generously long, for a busy machine."""
    until = time.monotonic() + 60
    while any(map(alive, pids)) and time.monotonic() < until:
        time.sleep(0.02)
    return not any(map(alive, pids))


class Counted:
    """An iterator that knows how much of it was taken."""

    def __init__(self, total: int) -> None:
        self.taken, self.total = 0, total

    def __iter__(self) -> Iterator[int]:
        for k in range(self.total):
            self.taken += 1
            yield k


@pytest.mark.parametrize("workers", [1, 3])
def test_results_come_in_order_and_tasks_are_taken_as_needed(workers: int) -> None:
    tasks = Counted(20)
    found = []
    for result in ordered_map(slow_square, tasks, workers=workers):
        found.append(result)
        assert tasks.taken - len(found) < 2 * workers
    assert found == [k * k for k in range(20)]
    assert list(ordered_map(slow_square, [], workers=workers)) == []


def test_workers_leave_each_other_a_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    names = ["OMP_NUM_THREADS", "OMP_WAIT_POLICY"]
    assert list(ordered_map(environment, names, workers=2)) == ["1", "passive"]
    assert list(ordered_map(environment, names)) == ["7", ""]
    assert os.environ.get("OMP_WAIT_POLICY") is None


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_comes_through_whole_and_ends_the_workers(workers: int) -> None:
    found = []
    with pytest.raises(DataError) as error:  # noqa: PT012
        for result in ordered_map(fail_at_three, range(1000), workers=workers):
            found.append(result)
    assert found == [0, 1, 2]
    assert str(error.value) == "file log, segment s, field agents: three"
    assert not multiprocessing.active_children()


def test_a_worker_that_is_killed_is_told() -> None:
    with pytest.raises(SymphonyError, match="a worker process ended before its task was done"):
        list(ordered_map(die_at_three, range(1000), workers=2))
    with pytest.raises(WorkerError) as died:
        list(ordered_map(die_at_three, range(4), workers=2))
    assert 3 in died.value.tasks
    assert len(died.value.tasks) <= 2
    assert not multiprocessing.active_children()


OTHER = importlib.import_module("symphony.data.store").__name__
"""Something that this process has imported and that the tasks don't need."""


def imported(names: list[str]) -> tuple[int, int, list[bool]]:
    return os.getppid(), os.getpid(), [name in sys.modules for name in names]


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked from a server on Linux only")
def test_workers_share_what_was_imported_for_them() -> None:
    names = [OTHER, "numpy", "symphony.no_such_module"]
    found = list(ordered_map(imported, [names] * 8, workers=2))
    servers, workers = {server for server, _, _ in found}, {worker for _, worker, _ in found}
    assert len(servers) == 1
    assert not servers & {*workers, os.getpid()}
    assert all(there == [True, True, False] for _, _, there in found)


def mark_unless_stopped(path: Path) -> Path:
    if path.name != "quick":
        time.sleep(5)
    path.touch()
    return path


def test_leaving_early_abandons_what_is_under_way(tmp_path: Path) -> None:
    names = ("quick", "a", "b", "c", "d")
    results = ordered_map(mark_unless_stopped, [tmp_path / name for name in names], workers=2)
    assert next(results).exists()
    results.close()
    assert not multiprocessing.active_children()
    assert [p.name for p in tmp_path.iterdir()] == ["quick"]


SCRIPT = """
import os, time
from symphony.parallel import ordered_map
def sleep_or_return(seconds):
    time.sleep(seconds)
    return os.getpid()
if __name__ == "__main__":
    for pid in ordered_map(sleep_or_return, [0.0, 0.0, 30.0, 30.0, 30.0, 30.0], workers=2):
        print(pid, flush=True)
"""


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
@pytest.mark.parametrize("how", ["SIGINT", "SIGKILL"])
def test_workers_end_with_the_process_that_started_them(how: str, tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, str(tmp_path / "script.py")]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, start_new_session=True, **pipes) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        pids = [int(process.stdout.readline()) for _ in range(2)]
        if how == "SIGINT":  # as Ctrl-C does: to the whole group
            os.killpg(process.pid, signal.SIGINT)
        else:
            process.kill()
        assert gone(pids)
        errors = process.stderr.read()
    assert process.returncode in {-getattr(signal, how), 128 + signal.SIGINT}
    assert errors.count("Traceback") == (how == "SIGINT")


def test_bad_arguments_are_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    bad: list[tuple[dict[str, Any], str]] = [({"workers": 0}, "workers"), ({"engine": "dask"}, "engine")]
    for options, message in [*bad, ({"engine": "ray"}, r"pip install 'symphony-traffic\[ray\]'")]:
        with pytest.raises(ConfigError, match=message):
            ordered_map(slow_square, [1], **options)


@pytest.mark.slow
def test_ray_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # for its workers
    monkeypatch.setenv("RAY_worker_niceness", "0")  # 15 by default: on a busy machine they would hardly run
    try:
        tasks = Counted(20)
        results = ordered_map(slow_square, tasks, workers=2, engine="ray")
        assert next(results) == 0
        assert tasks.taken == 4
        assert list(results) == [k * k for k in range(1, 20)]
        assert list(ordered_map(environment, ["OMP_NUM_THREADS"], engine="ray")) == ["1"]
        with pytest.raises(DataError, match="file log, segment s, field agents: three"):
            list(ordered_map(fail_at_three, range(10), workers=2, engine="ray"))
        with pytest.raises(SymphonyError, match="a Ray worker failed"):
            list(ordered_map(die_at_three, range(10), workers=2, engine="ray"))
    finally:
        ray.shutdown()
