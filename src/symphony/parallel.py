"""Parallel application of a function to tasks, in processes of this machine or on a Ray cluster."""

from __future__ import annotations

import contextlib
import itertools
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from typing import Any, Literal, TypeVar

from symphony.errors import ConfigError, SymphonyError

T = TypeVar("T")
R = TypeVar("R")
Results = Generator[R, None, None]
Engine = Literal["local", "ray"]

IN_FLIGHT = 2  # tasks per worker that are submitted and not yet collected
# A worker has one core: OpenMP threads of several workers would only take the cores from each other.
WORKER_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
# Python looks for modules in the current folder first, where anything may lie, in a process that it starts for us.
_SAFE = {"PYTHONSAFEPATH": "1"}
# A fork of this very process would inherit torch's threads without their state; a server that only imports has none.
_START: Literal["forkserver", "spawn"] = "forkserver" if sys.platform == "linux" else "spawn"


class WorkerError(SymphonyError):
    """The error of a worker process that ended before its task was done: one of ``tasks``, the numbers under way."""

    def __init__(self, tasks: list[int]) -> None:
        why = "killed (out of memory?), crashed, or started in a script without `if __name__ == '__main__':`"
        super().__init__(f"a worker process ended before its task was done: {why}")
        self.tasks = tasks


def ordered_map(
    function: Callable[[T], R],
    tasks: Iterable[T],
    *,
    workers: int = 1,
    engine: Engine = "local",
    imports: Sequence[str] = (),
) -> Results[R]:
    """Apply a function of a module to every task; results come in the order of the tasks, whichever is done first.

    Tasks are taken as results are requested, at most ``2 * workers`` ahead. One local worker is this very process. An
    error, an interrupt or ``close`` abandons the tasks under way. What ``function`` raises comes through; a worker
    that dies is a :class:`WorkerError`. ``engine`` is ``local`` for processes of this machine or ``ray`` for the
    cluster at ``RAY_ADDRESS`` or the one of ``ray.init``, else one on this machine. ``imports`` are modules that
    local workers need beside the function's own.
    """
    if workers < 1:
        raise ConfigError(f"workers must be at least 1, is {workers}")
    if engine == "ray":
        return _ray_map(_ray(workers), function, iter(tasks), IN_FLIGHT * workers)
    if engine != "local":
        raise ConfigError(f"unknown engine {engine!r} (known: local, ray)")
    if workers == 1:
        return (function(task) for task in tasks)
    return _local_map(function, iter(tasks), workers, [function.__module__, *imports])


def get_ready(imports: Sequence[str]) -> None:
    """Start the process that workers are forked from (Linux), with what they need and ours that is imported here."""
    if _START == "forkserver":
        names = [name for name in sys.modules if name.startswith("symphony.")] + list(imports)
        forkserver.set_forkserver_preload([name for name in names if name != "__main__"])
        with _starting():
            forkserver.ensure_running()


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Give processes started inside the environment of workers; they put off interrupts: the parent's are enough."""
    given = WORKER_ENVIRONMENT | _SAFE
    before = {name: os.environ[name] for name in given if name in os.environ}
    try:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        os.environ.update(given)
        yield
    finally:
        for name in given:
            os.environ.pop(name, None)
        os.environ.update(before)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


@contextlib.contextmanager
def _put_off() -> Iterator[None]:
    """Handle signals that come meanwhile, whichever thread gets them, at the end: half a start can't be tidied up."""
    came: list[int] = []
    ours = threading.current_thread() is threading.main_thread()  # others get no signals
    kinds = [kind for kind in (signal.SIGINT, signal.SIGTERM) if ours and signal.getsignal(kind) is not None]
    before = {kind: signal.signal(kind, lambda number, _: came.append(number)) for kind in kinds}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)
        for number in came:
            signal.raise_signal(number)


def _ahead(submit: Callable[[T], Any], tasks: Iterator[T], count: int) -> Iterator[deque[Any]]:
    """Yield before each result the submitted tasks, the one whose turn it is first."""
    pending = deque(map(submit, itertools.islice(tasks, count)))
    while pending:
        yield pending
        pending.popleft()
        pending.extend(map(submit, itertools.islice(tasks, 1)))


def _local_map(function: Callable[[T], R], tasks: Iterator[T], workers: int, names: list[str]) -> Results[R]:
    get_ready(names)
    context = multiprocessing.get_context(_START)
    lifeline, ours = context.Pipe(duplex=False)
    environment = {**os.environ, **WORKER_ENVIRONMENT}  # a server keeps that which it was started with
    pool = ProcessPoolExecutor(workers, context, _begin_worker, (lifeline, environment))

    def submit(task: T) -> Any:
        with _put_off(), _starting():  # processes are started here, as they are needed
            return pool.submit(function, task)

    pending, done = deque[Any](), 0
    try:
        for pending in _ahead(submit, tasks, IN_FLIGHT * workers):
            yield pending[0].result()
            done += 1
    except BrokenProcessPool as error:
        lost = [done + k for k, task in enumerate(pending) if not task.done() or task.exception() is not None]
        raise WorkerError(lost[:workers]) from error  # they are begun in their order
    finally:
        ours.close()
        pool.shutdown(wait=True, cancel_futures=True)
        lifeline.close()


def _begin_worker(lifeline: Connection, environment: dict[str, str]) -> None:
    for name in _SAFE:  # but for what a worker starts itself
        os.environ.pop(name, None)
    os.environ.update(environment)
    threading.Thread(target=_watch, args=(lifeline,), daemon=True).start()


def _watch(lifeline: Connection) -> None:
    """End at once, whatever the task, when the parent closes its end of the pipe or ends, in whatever way."""
    with contextlib.suppress(EOFError, OSError):
        lifeline.recv_bytes()
    os._exit(1)


def _ray(workers: int) -> Any:
    address = os.environ.get("RAY_ADDRESS")
    size: dict[str, Any] = {} if address else {"num_cpus": workers, "include_dashboard": False}
    try:
        import ray  # noqa: PLC0415 (optional)

        if not ray.is_initialized():
            ray.init(address=address or "local", log_to_driver=False, logging_level=logging.WARNING, **size)
    except ImportError as error:
        raise ConfigError("the engine 'ray' needs Ray: pip install 'symphony-traffic[ray]'") from error
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise ConfigError(f"no Ray cluster at RAY_ADDRESS={address}: {error}") from error
    return ray


def _ray_map(ray: Any, function: Callable[[T], R], tasks: Iterator[T], count: int) -> Results[R]:
    remote = ray.remote(num_cpus=1, runtime_env={"env_vars": WORKER_ENVIRONMENT})(function)
    pending: deque[Any] = deque()
    try:
        for pending in _ahead(remote.remote, tasks, count):
            yield ray.get(pending[0])
    except ray.exceptions.RayTaskError as error:  # unwrapped, so that callers catch what the function raised
        raise error.cause if isinstance(error.cause, Exception) else SymphonyError(str(error)) from error
    except ray.exceptions.RayError as error:
        raise SymphonyError(f"a Ray worker failed: {error}") from error
    finally:
        for reference in pending:
            with contextlib.suppress(ray.exceptions.RayError):
                ray.cancel(reference, force=True)
