"""Files that appear complete or not at all, locks, and results as JSON."""

from __future__ import annotations

import fcntl
import json
import math
import os
import re
import socket
import sys
import weakref
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from symphony.errors import DataError


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turn errors of the disk into a :class:`DataError` that names the file they are about."""
    try:
        yield
    except OSError as error:
        raise DataError(f"can't be written: {error.strerror or error}", file=path) from error


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a draft of the same suffix, which replaces ``path`` at the end of the block; make its folder.

    If the block fails, what was at ``path`` stays as it was. Links are followed, and what is not an ordinary file (a
    terminal, a pipe) is written to directly. Raises a :class:`DataError` if the disk refuses.
    """
    with naming(path):
        place = _place(path)
        if place.exists() and not place.is_file():
            yield place
            return
        # Drafts of this file by processes that were killed go.
        pattern = re.compile(rf"\.{re.escape(place.stem)}\.(\d+)\.new{re.escape(place.suffix)}")
        for found in filter(None, map(pattern.fullmatch, os.listdir(place.parent))):
            if not lives(int(found[1])):
                (place.parent / found[0]).unlink(missing_ok=True)
        draft = place.with_name(f".{place.stem}.{os.getpid()}.new{place.suffix}")
        try:
            yield draft
            with draft.open("rb+") as file:
                os.fsync(file.fileno())
            draft.replace(place)
        finally:
            draft.unlink(missing_ok=True)


def _place(path: Path) -> Path:
    if path.exists() and not path.is_file():
        return path  # a pipe by way of `/dev/fd` is a link to what is no path
    place = Path(os.path.realpath(path))
    place.parent.mkdir(parents=True, exist_ok=True)
    return place


def lives(process: int) -> bool:
    """Return whether a process of this machine runs."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError, PermissionError) as error:
        return isinstance(error, PermissionError)  # another user's process
    return True


def write_file(path: Path, text: str) -> None:
    """Write a text file, as :func:`replacing` does; what UTF-8 can't hold, as of odd paths, is escaped."""
    with replacing(path) as draft:
        draft.write_text(text, encoding="utf-8", errors="backslashreplace")


def read_object(path: Path) -> dict[str, Any]:
    """Parse a JSON object; a :class:`DataError` if it can't be read, or is not one."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"can't be read: {error.strerror or error}", file=path) from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"not valid JSON ({error})", file=path) from error
    if not isinstance(found, dict):
        raise DataError("not a JSON object", file=path)
    return found


def write_json(path: Path, result: Any) -> None:
    """Write the :func:`json_text` of a result, as :func:`replacing` does."""
    write_file(path, json_text(result))


def json_text(result: Any) -> str:
    """Return a result as JSON; numbers that are not finite become null."""
    return json.dumps(finite(result), indent=2, allow_nan=False) + "\n"


def finite(value: Any) -> Any:
    """Return a result with None for numbers that are not finite."""
    if isinstance(value, dict):
        return {name: finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Lock(AbstractContextManager["Lock"]):
    """Keeps other writers, who get an error, out of a folder or a file until it is closed or this process ends. The
    file at ``path``, removed in the end, stands for the ``output``, by default its folder, which is made.
    """

    def __init__(self, path: Path, output: Path | None = None) -> None:
        self.path, self.output = path, output or path.parent
        program = Path(sys.argv[0]).name.replace("__main__.py", "symphony")
        who = f"{os.getpid()} on {socket.gethostname()}: {' '.join([program, *sys.argv[1:2]])}"
        with naming(self.output):
            path.parent.mkdir(parents=True, exist_ok=True)
            while not _is_at(file := self._taken(), path):  # its holder has removed it meanwhile
                os.close(file)
            os.ftruncate(file, 0)
            os.pwrite(file, who.encode(errors="replace"), 0)
        self._file, self.close = file, weakref.finalize(self, _release, path, file, os.getpid())

    def _taken(self) -> int:
        file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            who = os.pread(file, 500, 0).decode(errors="replace")
            os.close(file)
            raise DataError(f"is being written by another process: {who}", file=self.output) from error
        return file

    def check(self) -> None:
        """Raise a :class:`DataError` if the folder was removed: another process may be writing a new one there."""
        if not _is_at(self._file, self.path):
            raise DataError("was removed or replaced while this process wrote into it", file=self.output)

    def __exit__(self, *error: object) -> None:
        self.close()


def _is_at(file: int, path: Path) -> bool:
    with suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(file), path.stat())
    return False


def _release(path: Path, file: int, process: int) -> None:
    if os.getpid() == process and _is_at(file, path):  # a copy of the process that took it has no say
        path.unlink(missing_ok=True)
    os.close(file)


def lock_file(path: Path) -> AbstractContextManager[object]:
    """Keep other writers away from a file, as :class:`Lock` does; a terminal needs no lock."""
    with naming(path):
        place = _place(path)
    if place.is_dir():
        raise DataError("is a folder; name a file", file=path)
    if place.exists() and not place.is_file():
        return nullcontext()
    return Lock(place.with_name(f".{place.name}.lock"), path)
