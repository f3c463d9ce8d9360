"""Processes that share work: the same numbers, pictures, files and errors as in one, in order; how they end."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers_agents import make_agent
from helpers_pool import Counted, die_at_three, environment, fail_at_three, slow_square
from helpers_processes import apart, share_the_server
from helpers_segments import crossing, straight_road
from helpers_store import contents, stored
from symphony import keys
from symphony.cli import main
from symphony.config.evaluation import EvaluateConfig, compiles
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError, SymphonyError
from symphony.evaluation import Evaluation, evaluate
from symphony.imports import load_object
from symphony.learning.demonstrations import SceneDataset
from symphony.parallel import WorkerError, ordered_map
from symphony.rollouts.unroll import NotFiniteError
from symphony.rollouts.workers import batches, naming, segments_together, shared
from symphony.saved.folder import About, RolloutWriter
from symphony.saved.rollouts import SavedRollouts
from test_extremes import Spoiled

METRIC = "helpers_workers:travelled"
CONFIG = EvaluateConfig(rollouts=4, trees=2, batch=1, search="tree", metric=(METRIC,), seed=3)
ABOUT = About("made", 3, {}, {"rollouts": 4}, {"checksum": "ab"})
LENGTHS = (11, 9, 7, 12, 10)
MADE = [(straight_road if k % 2 else crossing)(3 + k % 2, seed=k, steps=steps) for k, steps in enumerate(LENGTHS)]
store = stored(lambda: MADE, opened=True)


class Seen:
    """The results of an evaluation, and what it shows on its way."""

    def __init__(self, store: SegmentStore, out: Path, **changes: Any) -> None:
        self.progress: list[tuple[int, int]] = []
        self.items: list[int] = []
        writer = RolloutWriter(out, ABOUT)

        def observe(item: int, saved: SavedRollouts) -> None:
            self.items.append(item)
            writer.add(saved)

        def progress(done: int, total: int) -> None:
            self.progress.append((done, total))

        self.found: Evaluation = evaluate(
            make_agent(), store, replace(CONFIG, **changes), progress, baselines=True, observe=observe
        )
        writer.close()
        self.files = contents(out)

    def numbers(self) -> list[Any]:
        everyone = [self.found, *self.found.baselines]
        return [(one.numbers(), one.metrics.rows(), list(one.metrics.segments), one.own) for one in everyone]


@pytest.fixture(scope="module")
def alone(store: SegmentStore, tmp_path_factory: pytest.TempPathFactory) -> Seen:
    return Seen(store, tmp_path_factory.mktemp("alone"))


@pytest.mark.slow
def test_everything_is_the_same_with_two_workers(alone: Seen, store: SegmentStore, tmp_path: Path) -> None:
    together = Seen(store, tmp_path / "out", workers=2)
    assert together.progress == alone.progress == [(k, 5) for k in range(1, 6)]
    assert repr(together.numbers()) == repr(alone.numbers())  # to the last digit, where NaN is like NaN
    assert together.files == alone.files
    assert len(alone.files) >= 5
    assert together.items == alone.items
    assert together.found.seconds > 0
    assert len(together.found.own[METRIC]) == 5


@given(st.integers(0, 300), st.integers(0, 20), st.integers(1, 9))
def test_batches_are_all_items_in_order_whoever_gets_them(items: int, batch: int, workers: int) -> None:
    config = EvaluateConfig(batch=batch, workers=workers)
    found = batches(range(items), batch or 64, config)
    assert [i for part in found for i in part] == list(range(items))
    assert all(1 <= len(part) <= (batch or 64) for part in found)
    assert len({len(part) for part in found[:-1]}) <= 1
    if batch:
        assert all(len(part) == batch for part in found[:-1])
    elif workers > 1 and items >= 2 * workers:
        assert len(found) > workers  # nobody is left without one


def test_a_card_is_filled_as_far_as_it_has_room(monkeypatch: pytest.MonkeyPatch) -> None:
    agent, found = make_agent(), []
    for free in (1 << 20, 1 << 24, 1 << 28, 1 << 33, 1 << 37):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _, free=free: (free, free))
        found.append(segments_together(agent, EvaluateConfig(device="cuda:0", search="none"), 2))
    assert [compiles("auto", device, 1 << 20) for device in ("cpu", "cpu:0", "cuda:0")] == [False, False, True]
    assert found[0] == 1 < found[1] < found[2] < found[3] == found[4] == 1024


def spoiled() -> Any:
    """An agent whose policy fails in the second segment of every batch."""
    agent = make_agent()
    return replace(agent, policy=Spoiled(agent.policy, keys.LOGITS, 1, 1))


def test_errors_name_the_segment(store: SegmentStore) -> None:
    name = store.ids[2]
    config = replace(CONFIG, metric=("helpers_workers:short_scenes_fail",))
    with pytest.raises(ZeroDivisionError, match="too short for me") as error:
        evaluate(make_agent(), store, config)
    assert error.value.__notes__ == [f"in one of the run segments {name}"]
    with pytest.raises(ConfigError, match="no_such"):
        evaluate(make_agent(), store, replace(CONFIG, metric=("helpers_workers:no_such",), workers=2))


@pytest.mark.slow
def test_errors_of_workers_are_those_of_one_process(store: SegmentStore) -> None:
    config = replace(CONFIG, workers=2, metric=(), batch=3)
    with pytest.raises(NotFiniteError, match=f"segment {store.ids[1]}: the policy put out") as error:
        evaluate(spoiled(), store, config)
    with pytest.raises(NotFiniteError) as alone:
        evaluate(spoiled(), store, replace(config, workers=1))
    assert str(error.value) == str(alone.value)
    with pytest.raises(ZeroDivisionError, match="too short for me") as own:
        evaluate(make_agent(), store, replace(config, metric=("helpers_workers:short_scenes_fail",)))
    assert own.value.__notes__ == [f"in one of the run segments {', '.join(store.ids[:3])}"]


@pytest.mark.slow
def test_a_worker_that_dies_names_the_segments_at_hand(store: SegmentStore) -> None:
    config = replace(CONFIG, workers=2, metric=("helpers_workers:short_scenes_kill",), batch=1)
    told = r"a worker process ended .*; at hand were the run segments "
    with pytest.raises(SymphonyError, match=told) as error:
        evaluate(make_agent(), store, config)
    named = str(error.value).rpartition(" segments ")[2].split(", ")
    assert store.ids[2] in named
    assert len(named) <= 2


def test_what_a_file_defines_is_sent_by_its_path(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("class Own:\n    size = 3\n\ndef made(items):\n    return Own().size\n")
    made = load_object(f"{tmp_path}/own.py:made")
    assert list(shared(made, [[0], [1]], EvaluateConfig(workers=2))) == [3, 3]


def test_what_cannot_be_sent_is_refused(store: SegmentStore) -> None:
    with pytest.raises(ConfigError, match="can't be shared among processes"):
        list(shared(lambda items: items, [[0]], EvaluateConfig(workers=2)))
    assert list(shared(lambda items: items, [[0], [1]], EvaluateConfig())) == [[0], [1]]
    with pytest.raises(OSError, match="disk") as error, naming(SceneDataset(store, indices=[3, 1]), [1]):
        raise OSError("disk")
    assert error.value.__notes__ == [f"in one of the run segments {store.ids[1]}"]


def of_command(started: Path, arguments: list[str]) -> int:
    """Run a command whose workers leave a file each in a folder."""
    os.environ["STARTED"] = str(started)
    share_the_server()
    return main(arguments)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
@pytest.mark.parametrize(("how", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_workers_end_with_the_command(store: SegmentStore, tmp_path: Path, how: int, status: int) -> None:
    (tmp_path / "started").mkdir()
    command = ["evaluate", "playback", "--data", str(store.path), "--workers", "2", "--batch", "1"]
    arguments = [*command, "--metric", "helpers_workers:waits"]
    process = apart(of_command, tmp_path / "started", arguments, said=tmp_path / "said")
    until = time.monotonic() + 400  # generously long, for a busy machine
    while len(list((tmp_path / "started").iterdir())) < 2 and time.monotonic() < until:
        assert process.is_alive()
        time.sleep(0.1)
    os.kill(process.pid, how)
    process.join(90)  # before its workers end by themselves
    process.kill()  # where it goes on
    process.join()
    workers = [int(path.name) for path in (tmp_path / "started").iterdir()]
    assert len({*workers} - {process.pid}) == len(workers) == 2
    assert gone(workers)
    assert process.exitcode == status
    said = (tmp_path / "said.err").read_text().strip().splitlines()[-1]
    assert said == f"symphony: error: {'interrupted' if how == signal.SIGINT else 'terminated'}"


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


@pytest.mark.parametrize("workers", [1, 3])
def test_results_come_in_order_and_tasks_are_taken_as_needed(workers: int) -> None:
    tasks, found = Counted(20), []
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
    with pytest.raises(WorkerError, match="a worker process ended before its task was done") as died:
        list(ordered_map(die_at_three, range(1000), workers=2))
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


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_signals_wait_for_a_worker_that_is_being_started(how: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def submit(*task: Any) -> None:
        os.kill(os.getpid(), how)
        begun.append(task)

    begun: list[Any] = []
    monkeypatch.setattr("symphony.parallel.ProcessPoolExecutor.submit", submit)
    before = signal.signal(how, signal.default_int_handler)
    with pytest.raises(KeyboardInterrupt):
        list(ordered_map(abs, [1, 2], workers=2))
    signal.signal(how, before)
    assert len(begun) == 1


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
        pids = [int(process.stdout.readline()) for _ in range(2)]
        if how == "SIGINT":  # as Ctrl-C does: to the whole group
            os.killpg(process.pid, signal.SIGINT)
        else:
            process.kill()
        assert gone(pids)
        errors = process.stderr.read()
    assert process.returncode in {-getattr(signal, how), 128 + signal.SIGINT}
    assert errors.count("Traceback") == (how == "SIGINT")


def test_workers_import_nothing_from_the_current_folder(tmp_path: Path) -> None:
    """Where anything may lie; the installed command does not, either."""
    for name in ("types.py", "random.py", "symphony.py"):
        (tmp_path / name).write_text(f"print({name!r}, file=open('read', 'a'))")
    given = f"simulate playback --data {builtin_store('test')} --segments 0 1 --out sim --workers 2 --batch 1".split()
    command = [Path(sys.executable).with_name("symphony"), *given]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    assert not (tmp_path / "read").exists()


def test_bad_arguments_are_refused_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    bad: list[tuple[dict[str, Any], str]] = [({"workers": 0}, "workers"), ({"engine": "dask"}, "engine")]
    for options, message in [*bad, ({"engine": "ray"}, r"pip install 'symphony-traffic\[ray\]'")]:
        with pytest.raises(ConfigError, match=message):
            ordered_map(slow_square, [1], **options)
