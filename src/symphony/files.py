"""Files that appear complete or not at all, and results as JSON."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from symphony.errors import DataError


def write_file(path: Path, text: str) -> None:
    """Write a text file that appears complete or not at all. Raises DataError if the disk refuses."""
    new = path.with_name(f".new-{os.getpid()}-{path.name}")
    with naming(path):
        try:
            with new.open("w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            new.replace(path)
        finally:
            new.unlink(missing_ok=True)


def write_json(path: Path, result: Any) -> None:
    """Write a result as JSON, making its folder; numbers that are not finite become null."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, json_text(result))


def json_text(result: Any) -> str:
    """A result as JSON; numbers that are not finite become null."""
    return json.dumps(_finite(result), indent=2, allow_nan=False) + "\n"


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of the disk, with the file that they are about."""
    try:
        yield
    except OSError as error:
        raise DataError(f"can't be written: {error.strerror or error}", file=path) from error


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
