"""Functions in processes of their own that find everything imported: a program needs seconds for it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable
from multiprocessing import forkserver, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from symphony.data import engine


def apart(function: Callable[..., Any], *given: Any, said: Path | None = None) -> BaseProcess:
    """Start a function of a module with these arguments, which are pickled.

    On Linux its process is forked from one that has imported what this one has, and has no threads: it may fork, too.

    Args:
        function: whose result is the exit status, ``None`` for 0.
        given: its arguments.
        said: file for what it prints; errors come into a second, whose name ends on ``.err``.
    """
    engine.get_ready([function.__module__])
    process = multiprocessing.get_context(engine._START).Process(target=_run, args=(function, given, said))
    process.start()
    return process


def share_the_server() -> None:
    """Have workers of this process, itself started by :func:`apart`, forked from the same server (Linux).

    A program would start a server of its own for them, which takes seconds. Not for processes that are killed: the
    server ends if that happens between their call and what they have to say.
    """
    if engine._START == "forkserver":
        forkserver._forkserver.ensure_running = forkserver.ensure_running = resource_tracker.ensure_running


def _run(function: Callable[..., Any], given: tuple[Any, ...], said: Path | None) -> None:
    if said is not None:
        for stream, name in enumerate((str(said), f"{said}.err"), 1):
            os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o600), stream)
    status = 1
    engine._mask(signal.SIG_UNBLOCK)  # the server was started while interrupts were put off
    try:
        status = int(function(*given) or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
