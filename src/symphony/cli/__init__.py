"""The ``symphony`` command: what it offers, and how it ends.

Modules of this package import nothing heavy at the top, so that ``--help`` answers at once; each command
imports what it needs when it runs.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence

import tyro

from symphony._version import __version__
from symphony.cli import data, demo, evaluate, export, figure, plot, profiles, report, table, train, view
from symphony.errors import ConfigError, SymphonyError

__all__ = ["main"]

FAILED, USAGE, INTERRUPTED = 1, 2, 130

DESCRIPTION = """Realistic and diverse traffic agents learned from logged driving.

Every command explains itself, as in `symphony data convert --help`. The version: `symphony --version`. With
SYMPHONY_DEBUG=1 in the environment, errors come with their traceback."""

# Every command is a dataclass: its fields are the arguments, `run` does the work and raises what goes wrong.
app = tyro.extras.SubcommandApp()
app.command(data.app, name="data", help=data.__doc__)
app.command(name="train")(train.Train)
app.command(name="evaluate")(evaluate.Evaluate)
app.command(name="table")(table.Table)
app.command(figure.app, name="figure", help=figure.__doc__)
app.command(plot.app, name="plot", help=plot.__doc__)
app.command(name="view")(view.View)
app.command(name="report")(report.Report)
app.command(name="export")(export.Export)
app.command(name="demo")(demo.Demo)


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        args: the arguments, by default those of the process.

    Returns:
        Exit status: 0 done, 1 failed, 2 wrong usage, 130 interrupted.
    """
    args = sys.argv[1:] if args is None else list(args)
    if args == ["--version"]:
        return _guarded(lambda: print(f"symphony {__version__}"))  # noqa: T201
    try:
        if args[:1] == ["train"]:
            args = profiles.expanded(args)
        command = app.cli(
            prog="symphony",
            description=DESCRIPTION,
            args=args,
            config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
        )
    except ConfigError as error:
        return _complain(error, USAGE)
    except SystemExit as stop:
        return int(stop.code or 0)
    return _guarded(command.run)


def _guarded(action: Callable[[], object]) -> int:
    """Run something; errors that a user can meet become one line and an exit status."""
    try:
        action()
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our output has gone, say `head`; Python would complain once more as it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except KeyboardInterrupt:
        return _complain("interrupted", INTERRUPTED)
    except (SymphonyError, OSError) as error:
        return _complain(error, FAILED)
    return 0


def _complain(error: object, status: int) -> int:
    if isinstance(error, BaseException) and os.environ.get("SYMPHONY_DEBUG", "0") not in {"", "0"}:
        raise error
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename is not None else ""
        error = f"{where}{error.strerror}"
    sys.stderr.write(f"symphony: error: {error}\n")
    return status
