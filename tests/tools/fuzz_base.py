"""What everything that is fuzzed has in common."""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from fuzz_mutations import Rng

Files = dict[str, bytes]

ACCEPTED, REFUSED, ABSURD, FOREIGN = "accepted", "refused", "absurd", "foreign"


@dataclass(frozen=True)
class Target:
    """One thing that reads files.

    Attributes:
        good: its files, by name; the first is the one that is opened.
        mutate: changes some of them.
        run: reads them from a folder and says what came of it, with what is wrong where something is; raises
            whatever it raises.
    """

    good: Callable[[], Files]
    mutate: Callable[[Rng, Files], Files]
    run: Callable[[Path, str], tuple[str, str]]


every = ContextVar("every", default=False)
"""Whether more is done with all files."""


def one_in(many: int, folder: Path) -> bool:
    """Whether the files of a folder are among the one in so many that more is done with; the same ones always."""
    return (
        every.get()
        or zlib.crc32(b"".join(each.read_bytes() for each in sorted(folder.rglob("*.*")))) % many == 0
    )


def written(write: Callable[[Path], Path]) -> Callable[[], Files]:
    """The files that a function writes into a folder, the one it returns first."""

    def files() -> Files:
        with tempfile.TemporaryDirectory() as folder:
            log = write(Path(folder))
            paths = sorted((p for p in Path(folder).rglob("*") if p.is_file()), key=lambda path: path != log)
            return {str(path.relative_to(folder)): path.read_bytes() for path in paths}

    return files
