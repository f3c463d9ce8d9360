"""Functions in processes of their own that find everything imported: a program needs seconds for it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import sys
import traceback
import warnings
from collections.abc import Callable
from multiprocessing import connection, forkserver, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from symphony import parallel as engine


def serve_from_here() -> None:
    """Have all processes from now on forked from a copy of this one, as it is, with what it has imported (Linux)."""
    server = forkserver._forkserver
    # Python 3.14's servers want a key; there they begin as in the product.
    if engine._START != "forkserver" or hasattr(server, "_forkserver_authkey"):
        return
    with socket.socket(socket.AF_UNIX) as listener, warnings.catch_warnings():
        address = connection.arbitrary_address("AF_UNIX")
        listener.bind(address)
        listener.listen()
        alive, ended_with_us = os.pipe()
        warnings.simplefilter("ignore", DeprecationWarning)  # a thread of xdist's stays behind
        with engine._starting():  # as in the product
            pid = os.fork()
        if pid == 0:
            try:
                os.close(ended_with_us)
                if "torch" in sys.modules:  # not imported here: what shall hold for it is not yet set
                    sys.modules["torch"].set_num_threads(1)
                signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
                forkserver.main(os.dup(listener.fileno()), alive, [])
            finally:
                os._exit(0)
        os.close(alive)
    server._forkserver_address, server._forkserver_alive_fd = address, ended_with_us
    server._forkserver_pid = pid


def apart(function: Callable[..., Any], *given: Any, said: Path | None = None) -> BaseProcess:
    """Start a function of a module, whose result is the exit status (``None`` for 0), on Linux forked from a process
    without threads; arguments are pickled. What it prints comes into a file, errors into one that ends on ``.err``.
    """
    process = multiprocessing.get_context(engine._START).Process(target=_run, args=(function, given, said))
    process.start()
    return process


def fork(action: Callable[..., None], *args: Any) -> int:
    """Do something in a process of its own, forked from this one as it is; returns its number."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        action(*args)
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def output_of(function: Callable[..., Any], *given: Any, said: Path, limit: float | None = None) -> str:
    """Return what a function prints that :func:`apart` starts and that must end well, within some seconds."""
    process = apart(function, *given, said=said)
    process.join(limit)
    process.kill()  # where it hangs
    process.join()
    assert process.exitcode == 0, Path(f"{said}.err").read_text()[-4000:]
    return said.read_text()


def forget(*packages: str) -> None:
    """Have packages and modules imported again from now on, in a process that :func:`apart` has started."""
    for name in list(sys.modules):
        if name.partition(".")[0] in packages:
            del sys.modules[name]


def share_the_server() -> None:
    """Have workers of this process, which must not be killed, forked from the same server: another takes seconds."""
    if engine._START == "forkserver":
        forkserver._forkserver.ensure_running = forkserver.ensure_running = resource_tracker.ensure_running


def _run(function: Callable[..., Any], given: tuple[Any, ...], said: Path | None) -> None:
    if said is not None:
        for stream, name in enumerate((str(said), f"{said}.err"), 1):
            os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o600), stream)
    status = 1  # and the server was started while interrupts were put off
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        status = int(function(*given) or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
