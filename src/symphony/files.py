"""Writing files: whole or not at all, and with their names in what the disk complains of."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Errors of the operating system that name no file, such as that of a full disk, get this one's name."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file to be written in the block, of the same suffix as ``path``, which it replaces in the end.

    Makes the folder. If the block fails, what was at ``path`` stays as it was and nothing is left behind. Links are
    followed, and what is no ordinary file (a terminal, a pipe) is written to as it is.
    """
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not path.is_file():
        yield path
        return
    draft = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        with naming(path):
            yield draft
            with draft.open("rb") as file:
                os.fsync(file.fileno())
            draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, complete or not at all, and its folder."""
    with replacing(path) as draft:
        draft.write_text(text, encoding="utf-8")
