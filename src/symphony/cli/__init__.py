"""The ``symphony`` command: what it offers, and how it ends.

Nothing heavy is imported at the top, so that ``--help`` answers at once; each command imports what it needs.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from typing import Any, get_args

import tyro

from symphony import __version__, allocator, errors
from symphony.cli.shared import Command, Result, tell
from symphony.config.checks import check, type_hints
from symphony.config.profiles import expanded
from symphony.files import lock_file

__all__ = ["main"]

FAILED, USAGE, ALL_FAILED, INTERRUPTED, TERMINATED = 1, 2, 3, 130, 143  # how commands end, beside 0
POSITIONAL = get_args(tyro.conf.Positional[int])[1]

DESCRIPTION = """Realistic and diverse traffic agents learned from logged driving.

Every command explains itself, as in `symphony data convert --help`. The version: `symphony --version`. With
SYMPHONY_DEBUG=1 in the environment, errors come with their traceback. Exit status: 0 done, 1 failed, 2 wrong usage,
3 every simulated run failed."""
COMMANDS = """data agents.train agents.evaluate agents.table plot rollouts.simulate rollouts.view rollouts.report
rollouts.export planners.planners planners.test planners.hunt wosac agents.agents agents.demo agents.doctor"""
"""Commands by the modules they are in, in the order of the help; a module alone is a group of commands."""

app = tyro.extras.SubcommandApp()
for _module, _, _name in (_place.partition(".") for _place in COMMANDS.split()):
    _found = importlib.import_module(f"symphony.cli.{_module}")
    if _name:
        app.command(name=_name)(getattr(_found, _name.capitalize()))
    else:
        _group = app.command(tyro.extras.SubcommandApp(), name=_module, help=_found.__doc__)
        for _class in Command.__subclasses__():
            if _class.__module__ == _found.__name__:
                _group.command(name=_class.__name__.lower())(_class)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line, by default with the arguments of the process, and return the exit status."""
    if args is None:
        settle()
    args = list(sys.argv[1:] if args is None else args)
    if args == ["--version"]:
        return guarded(lambda: print(f"symphony {__version__}"))  # noqa: T201
    try:
        chosen = app.cli(
            prog="symphony",
            description=DESCRIPTION,
            args=expanded(args) if args[:1] == ["train"] else args,
            config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
        )
        results: list[Any] = []
        for name, hint in type_hints(chosen.__class__).items():
            marks, value = getattr(hint, "__metadata__", ()), getattr(chosen, name)
            shown = filter(None, (getattr(mark, "metavar", None) for mark in marks if POSITIONAL in marks))
            check(next(shown, f"--{name.replace('_', '-')}"), value, hint)
            results += [value for mark in marks if isinstance(mark, Result) and str(value or "-") != "-"]
    except errors.ConfigError as error:
        return _complain(error, USAGE)
    except (SystemExit, BrokenPipeError) as stop:
        # Help or an error was printed; its reader, such as `head`, may have gone.
        return guarded(lambda: None) or int(getattr(stop, "code", FAILED) or 0)

    def run() -> None:
        with contextlib.ExitStack() as held:
            for path in results:  # tried and locked before the work
                held.enter_context(lock_file(path))
            chosen()

    return guarded(run)


def settle() -> None:
    """Apply the settings of a process of our own before it loads torch; the user's settings take precedence."""
    allocator.tune()
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by who started us
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - until the end
    if isinstance(sys.stdout, io.TextIOWrapper):  # of an encoding that may lack `≤`
        sys.stdout.reconfigure(errors="backslashreplace")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # threads that spin take the cores of a busy machine
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.access(cache if os.path.isdir(cache) else os.path.dirname(cache), os.W_OK):  # else torch has a place
        os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", os.path.join(cache, "symphony", "compiled"))


def guarded(action: Callable[[], object]) -> int:
    """Run an action; turn errors that a user can meet into one line and an exit status."""
    ours = threading.current_thread() is threading.main_thread()  # others get no signals
    before = signal.signal(signal.SIGTERM, _terminate) if ours else None
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _warn
            action()
            sys.stdout.flush()
    except BrokenPipeError:
        return FAILED
    except (KeyboardInterrupt, RuntimeError, MemoryError) as error:
        if isinstance(error, MemoryError) or re.search("allocate memory|out of memory", str(error)):
            first = str(error).strip().partition("\n")[0] or "no more to be had"
            return _complain(error, FAILED, f"out of memory, try less at a time (rollouts, batch, workers): {first}")
        # Where an interrupt comes while TensorDict lends weights to a module, it raises an error of its own.
        stop = error.__context__ if isinstance(error, RuntimeError) else error
        if not isinstance(stop, KeyboardInterrupt):
            raise
        return _complain(str(stop) or "interrupted", TERMINATED if str(stop) else INTERRUPTED)
    except (errors.SymphonyError, OSError) as error:
        usage, failed = isinstance(error, errors.CouldNotRunError), isinstance(error, errors.AllFailedError)
        return _complain(error, USAGE if usage else ALL_FAILED if failed else FAILED)
    finally:
        try:
            sys.stdout.flush()
        except OSError:  # its reader, such as `head`, has gone, or a disk is full: Python would print another error
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if ours:
            signal.signal(signal.SIGTERM, before)
    return 0


def _terminate(number: int, frame: object) -> None:
    """End the process as an interrupt does."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough: tidying up must not be cut short
    raise KeyboardInterrupt("terminated")


def _warn(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
    """Show our warnings in one line, and those of libraries unchanged."""
    if issubclass(category, errors.DataWarning):
        tell(f"symphony: warning: {message}")
    else:
        sys.stderr.write(warnings.formatwarning(message, category, *place[:2]))


def _complain(error: object, status: int, text: str = "") -> int:
    if isinstance(error, BaseException) and os.environ.get("SYMPHONY_DEBUG", "0") not in {"", "0"}:
        raise error
    if isinstance(error, OSError) and error.strerror:
        error = f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
    sys.stderr.write("symphony: error: " + errors.printable(f"{text or error}\n", keep="\n"))
    return status
