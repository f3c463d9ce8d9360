"""Files that appear complete or not at all, locks, and results as JSON."""

from __future__ import annotations

import fcntl
import json
import math
import os
import re
import socket
import sys
import uuid
import weakref
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from symphony.errors import DataError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file to be written in the block, of the same suffix as ``path``, which it replaces in the end.

    Makes its folder. If the block fails, what was at ``path`` stays as it was and nothing is left behind. Links are
    followed, and what is no ordinary file (a terminal, a pipe) is written to as it is.

    Raises:
        DataError: the disk refuses.
    """
    place = Path(os.path.realpath(path))
    with naming(path):
        place.parent.mkdir(parents=True, exist_ok=True)
        if place.exists() and not place.is_file():
            yield place
            return
        _remove_drafts(place)
        draft = _draft(place)
        try:
            yield draft
            with draft.open("rb+") as file:
                os.fsync(file.fileno())
            draft.replace(place)
        finally:
            draft.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """See now, before work that takes long, that a file can be written in the end. Makes its folder.

    Raises:
        DataError: it can't; names the file.
    """
    place = Path(os.path.realpath(path))
    with naming(path):
        place.parent.mkdir(parents=True, exist_ok=True)
        if place.is_dir():
            raise DataError("is a folder; name a file", file=path)
        if place.is_file() or not place.exists():  # not a terminal, or a pipe
            _draft(place).touch()
            _draft(place).unlink()


def _draft(place: Path) -> Path:
    return place.with_name(f".{place.stem}.{os.getpid()}.new{place.suffix}")


def _remove_drafts(place: Path) -> None:
    """Remove drafts of this file by processes that were killed."""
    pattern = re.compile(rf"\.{re.escape(place.stem)}\.(\d+)\.new{re.escape(place.suffix)}")
    for other in place.parent.iterdir():
        match = pattern.fullmatch(other.name)
        if match is None:
            continue
        try:
            os.kill(int(match[1]), 0)
        except (ProcessLookupError, OverflowError):
            other.unlink(missing_ok=True)
        except PermissionError:
            pass  # somebody else's process lives


def write_file(path: Path, text: str) -> None:
    """Write a text file, which appears complete or not at all, and its folder.

    Raises:
        DataError: the disk refuses.
    """
    with replacing(path) as draft:
        draft.write_text(text, encoding="utf-8")


def write_json(path: Path, result: Any) -> None:
    """Write a result as JSON, making its folder; numbers that are not finite become null."""
    write_file(path, json_text(result))


def json_text(result: Any) -> str:
    """A result as JSON; numbers that are not finite become null."""
    return json.dumps(finite(result), indent=2, allow_nan=False) + "\n"


class Lock:
    """Keeps other writers out of a folder, or a file, until it is closed or this process ends.

    Args:
        path: the file that stands for it, removed in the end. It says who writes, which whoever else comes is told.
        output: what is written; by default the folder of that file.

    Attributes:
        run: an id of what is done.

    Raises:
        DataError: another process is at it, or the disk refuses; names the output.
    """

    def __init__(self, path: Path, output: Path | None = None) -> None:
        self.path, self.output, self.run = path, output or path.parent, uuid.uuid4().hex[:8]
        program = Path(sys.argv[0])
        name = program.parent.name if program.stem == "__main__" else program.name
        command = " ".join([name, *sys.argv[1:2]])
        with naming(path):
            self._file = self._taken()
            who = f"{os.getpid()} on {socket.gethostname()}, run {self.run} of {command}"
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, who.encode(errors="replace"), 0)
        self._close = weakref.finalize(self, _release, path, self._file, os.getpid())

    def _taken(self) -> int:
        while True:
            file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                who = os.pread(file, 500, 0).decode(errors="replace")
                os.close(file)
                raise DataError(f"is being written by another process: {who}", file=self.output) from error
            except OSError:
                os.close(file)
                raise
            if _is_at(file, self.path):
                return file
            os.close(file)  # who had it has removed it meanwhile

    def check(self) -> None:
        """See that the output is still ours.

        Raises:
            DataError: the folder was removed, and another process may be writing a new one there.
        """
        if not _is_at(self._file, self.path):
            message = f"was removed or replaced while run {self.run} wrote into it"
            raise DataError(message, file=self.output)

    def close(self) -> None:
        """Let others in."""
        self._close()

    def __enter__(self) -> Lock:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False


def _release(path: Path, file: int, process: int) -> None:
    # A copy of the process that took it has no say.
    if os.getpid() == process and _is_at(file, path):
        path.unlink(missing_ok=True)
    os.close(file)


def lock_file(path: Path) -> AbstractContextManager[object]:
    """Keep other writers away from a file for as long as the work on it takes; makes its folder.

    What is no ordinary file (a terminal, a pipe) is left alone.

    Raises:
        DataError: as :class:`Lock`.
    """
    place = Path(os.path.realpath(path))
    if place.exists() and not place.is_file():
        return nullcontext()
    with naming(path):
        place.parent.mkdir(parents=True, exist_ok=True)
    return Lock(place.with_name(f".{place.name}.lock"), path)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of the disk, with the file that they are about."""
    try:
        yield
    except OSError as error:
        raise DataError(f"can't be written: {error.strerror or error}", file=path) from error


@contextmanager
def locating(path: str | Path) -> Iterator[None]:
    """Errors of the disk as they are, but those that name no file, such as of a full disk, get this one's name.

    For where a :class:`DataError` means a bad record.
    """
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def finite(value: Any) -> Any:
    """A result with null for numbers that are not finite."""
    if isinstance(value, dict):
        return {name: finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
