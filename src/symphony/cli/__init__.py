"""The ``symphony`` command: what it offers, and how it ends.

Modules of this package import nothing heavy at the top, so that ``--help`` answers at once; each command
imports what it needs when it runs.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TextIO, get_type_hints

import tyro

from symphony import allocator
from symphony._version import __version__
from symphony.cli import (
    agents,
    data,
    demo,
    doctor,
    evaluate,
    export,
    planners,
    plot,
    report,
    simulate,
    table,
    test,
    train,
    view,
    wosac,
)
from symphony.cli.shared import PARAGRAPHS, warn
from symphony.config.profiles import expanded
from symphony.errors import (
    AllFailedError,
    ConfigError,
    CouldNotRunError,
    DataWarning,
    SymphonyError,
    printable,
)
from symphony.files import lock_file

__all__ = ["main"]

FAILED, USAGE, ALL_FAILED, INTERRUPTED, TERMINATED = 1, 2, 3, 130, 143

GONE = {
    "plot tree": "`symphony simulate RUN --data DIR --out SIM` and `symphony view SIM` show the branches of a search",
    "plot rollouts": "`symphony evaluate RUN --data DIR --figure FILE` draws rollouts, and so does `symphony view`",
    "plot curvature --data": "evaluate the runs first: `symphony evaluate RUN --data DIR`",
    "data convert --append": "convert into another store, and put the two together by `symphony data merge`",
    "simulate --agents": "the agent is named without an option: `symphony simulate RUN --data DIR --out SIM`",
}
"""Commands and options that are gone, and what takes their place."""

DESCRIPTION = """Realistic and diverse traffic agents learned from logged driving.

Every command explains itself, as in `symphony data convert --help`. The version: `symphony --version`. With
SYMPHONY_DEBUG=1 in the environment, errors come with their traceback. Exit status: 0 done, 1 failed, 2 wrong usage,
3 every simulated run failed."""

# Every command is a dataclass: its fields are the arguments, `run` does the work and raises what goes wrong.
app = tyro.extras.SubcommandApp()
app.command(data.app, name="data", help=data.__doc__)
app.command(name="train")(train.Train)
app.command(name="evaluate")(evaluate.Evaluate)
app.command(name="table")(table.Table)
app.command(plot.app, name="plot", help=plot.__doc__)
app.command(name="simulate")(simulate.Simulate)
app.command(name="view")(view.View)
app.command(name="report")(report.Report)
app.command(name="export")(export.Export)
app.command(name="planners")(planners.Planners)
app.command(name="test")(test.Test)
app.command(wosac.app, name="wosac", help=wosac.__doc__)
app.command(name="agents")(agents.Agents)
app.command(name="demo")(demo.Demo)
app.command(name="doctor")(doctor.Doctor)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        args: the arguments, by default those of the process.

    Returns:
        Exit status: 0 done, 1 failed, 2 wrong usage, 3 every simulated run failed, 130 interrupted, 143 terminated.
    """
    if args is None:
        settle()
        args = sys.argv[1:]
    args = list(args)
    if args == ["--version"]:
        return guarded(lambda: print(f"symphony {__version__}"))  # noqa: T201
    try:
        for gone, instead in GONE.items():
            *command, last = gone.split()
            if args[: len(command)] == command and last in args[len(command) :]:
                raise ConfigError(f"`symphony {gone}` is gone: {instead}")
        if args[:1] == ["train"]:
            args = expanded(args)
        chosen = app.cli(
            prog="symphony",
            description=DESCRIPTION,
            args=args,
            config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
            registry=PARAGRAPHS,
        )
    except ConfigError as error:
        return _complain(error, USAGE)
    except SystemExit as stop:
        # Help or a complaint was printed; whoever read it may have gone, say `head`.
        return guarded(lambda: None) or int(stop.code or 0)

    def run() -> None:
        with contextlib.ExitStack() as held:
            for path in results_of(chosen):
                held.enter_context(lock_file(path))
            chosen.run()

    return guarded(run)


def results_of(command: Any) -> Iterator[Path]:
    """Files that a command writes once everything is done: its results whose metavar is FILE."""
    for name, hint in get_type_hints(type(command), include_extras=True).items():
        path, extras = getattr(command, name), getattr(hint, "__metadata__", ())
        named = any(getattr(extra, "metavar", None) == "FILE" for extra in extras)
        if name in ("json", "figure", "out", "junit") and named and path is not None and str(path) != "-":
            yield path


def settle() -> None:
    """Settings of a process that is ours alone, before it loads torch; those of the user take precedence."""
    allocator.tune()
    # Threads of OpenMP that spin while they wait take the cores of a busy machine.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


class Terminated(KeyboardInterrupt):
    """The process was asked to end (SIGTERM); whatever tidies up after an interrupt does so after this."""


@contextlib.contextmanager
def _ended_politely() -> Iterator[None]:
    """Inside, SIGTERM ends the work as an interrupt does, where there are signals to be had."""

    def end(number: int, frame: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough: tidying up must not be cut short
        raise Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def guarded(action: Callable[[], object]) -> int:
    """Run something; errors that a user can meet become one line and an exit status."""
    try:
        with _ended_politely(), warnings.catch_warnings():
            warnings.showwarning = _warn
            action()
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our output has gone, say `head`; Python would complain once more as it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except Terminated:
        return _complain("terminated", TERMINATED)
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)
    except (SymphonyError, OSError) as error:
        if isinstance(error, CouldNotRunError):
            return _complain(error, USAGE)
        return _complain(error, ALL_FAILED if isinstance(error, AllFailedError) else FAILED)
    return 0


def _warn(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Show our warnings in one line, those of libraries as they are."""
    if issubclass(category, DataWarning):
        warn(str(message))
    else:
        (file or sys.stderr).write(warnings.formatwarning(message, category, filename, lineno, line))


def _complain(error: object, status: int) -> int:
    if isinstance(error, BaseException) and os.environ.get("SYMPHONY_DEBUG", "0") not in {"", "0"}:
        raise error
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename is not None else ""
        error = f"{where}{error.strerror}"
    text = printable(str(error), keep="\n")
    sys.stderr.write(f"symphony: error: {text}\n")
    return status
