"""All commands and what they take, as `tests/cli.txt` holds them: `python tests/helpers_cli.py > tests/cli.txt`."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator
from unittest import mock

from tyro.extras import SubcommandApp

from symphony import cli


def words(told: dict[str, str]) -> list[str]:
    """A line for each argument of each command, as its help shows it."""
    return [f"{command} {word}" for command, text in told.items() for word in _words(text)]


def helps() -> dict[str, str]:
    """The help of every command."""
    return {" ".join(command): help_of(*command) for command in commands()}


def help_of(*command: str) -> str:
    """The help of a command."""
    with mock.patch.dict(os.environ, {"COLUMNS": "110"}):  # no wider, or boxes stand beside one another
        with contextlib.redirect_stdout(io.StringIO()) as shown:
            assert cli.main([*command, "--help"]) == 0
        return shown.getvalue()


def commands(app: SubcommandApp = cli.app, *before: str) -> list[tuple[str, ...]]:
    """The words of every command."""
    found: list[tuple[str, ...]] = []
    for name, given in app._subcommands.items():
        group = isinstance(given.target, SubcommandApp)
        found += commands(given.target, *before, name) if group else [(*before, name)]
    return found


def _words(told: str) -> Iterator[str]:
    first = option = "--?[a-z]"
    for line in told.splitlines():
        if re.match(r" \w", line):
            first = r"\S" if line.split()[0] == "positional" else option
        elif found := re.match(rf"  ({first}.*?)(  |$)", line):
            names = re.findall(r"(?<!\S)--?[a-z][\w.-]*", found[1]) or [found[1]]
            if names[0] != "-h":
                yield ", ".join(names)


if __name__ == "__main__":
    sys.stdout.write("\n".join(words(helps())) + "\n")
