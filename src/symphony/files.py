"""Files that appear complete or not at all, and results as JSON."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from symphony.errors import DataError

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]


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
        draft = place.with_name(f".{place.stem}.{os.getpid()}.new{place.suffix}")
        _remove_left(place)
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
        if place.exists() and not place.is_file():  # a terminal, a pipe
            return
        draft = place.with_name(f".{place.stem}.{os.getpid()}.new{place.suffix}")
        draft.touch()
        draft.unlink()


def _remove_left(place: Path) -> None:
    """Drafts of this file by processes that were killed."""
    if os.name != "posix":  # elsewhere there is no asking whether a process lives
        return
    pattern = re.compile(rf"\.{re.escape(place.stem)}\.(\d+)\.new{re.escape(place.suffix)}")
    for other in place.parent.iterdir():
        match = pattern.fullmatch(other.name)
        if match is not None and not _lives(int(match[1])):
            other.unlink(missing_ok=True)


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass  # somebody else's
    return True


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


def lock(path: Path) -> BinaryIO:
    """Keep other writers out of a folder until the file that is returned is closed, or this process ends.

    Args:
        path: the file in the folder that stands for it; it stays there.

    Raises:
        DataError: another process is in there, or the disk refuses; names the folder.
    """
    with naming(path):
        file = path.open("ab")
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.close()
            raise DataError("is being written by another process", file=path.parent) from error
    return file


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
