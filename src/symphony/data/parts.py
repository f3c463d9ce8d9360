"""From the records of log files to segments ready for a store, here or in a worker process.

A *part* is some consecutive files, converted record by record into a small store of its own: what passes between
processes is a path, no process holds more than one record in memory, and what is done is not done again.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symphony.data import joins, overlaps
from symphony.data import resample as resampling
from symphony.data.odd import crop, from_ego, oddities
from symphony.data.report import Skip
from symphony.data.segment import RunSegment
from symphony.data.selection import exclusion
from symphony.data.sources import Reader
from symphony.data.sources.base import unexpected
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError

PART_BYTES, PART_FILES = 8 << 20, 64  # small files go together: a part is some 60 files to write and delete
ODD = "odd"  # tag of a segment with something unusual: what it is -> an example


@dataclass(frozen=True)
class Preparation:
    """How the records of a file become segments: see :func:`symphony.data.convert.convert`."""

    reader: Reader
    dt: float
    sigma: float
    interactive: int
    exclude_overlaps: bool = False
    radius: float | None = None
    hold_lights: bool = False
    strict: bool = False

    def outcomes(self, path: str) -> Iterator[RunSegment | Skip]:
        """Yield what becomes of each record of a file, in its order."""
        for record in self.reader.read(path):
            if isinstance(record, DataError):
                yield Skip.of(record, path)
            else:
                yield self._prepared(record, path)

    def _prepared(self, segment: RunSegment, path: str) -> RunSegment | Skip:
        try:
            segment = from_ego(segment)
            if self.strict and segment.odd:
                kind, example = next(iter(segment.odd.items()))
                raise DataError(f"{kind} ({example})", field="strict")
            road, gaps = joins.joined(segment.road)
            segment = segment.replace(road=road, joined_gaps=gaps)
            if self.sigma > 0:
                segment = resampling.smooth(segment, self.sigma)
            if self.hold_lights:
                segment = resampling.hold_lights(segment)
            segment = resampling.resample(segment, self.dt)
            if self.radius is not None:
                segment = crop(segment, self.radius)
            excluded = exclusion(segment, self.interactive)
        except DataError as error:
            return Skip.of(error, path, segment.segment_id)
        except (OSError, ConfigError):  # the machine's fault or the caller's, not the record's
            raise
        except Exception as error:  # one bad record must not end a conversion
            return Skip.of(unexpected(error), path, segment.segment_id)
        if excluded is not None:
            return Skip.of(excluded[1], path, segment.segment_id, excluded[0])
        if self.exclude_overlaps and (pairs := len(overlaps.overlapping(segment))):
            found = DataError(f"the boxes of {pairs} pairs of agents overlap in the log", field="agents")
            return Skip.of(found, path, segment.segment_id, overlaps.TAG)
        return segment


@dataclass(frozen=True)
class Task:
    """A part to make: how, from which files, and where it lies once it is complete."""

    recipe: Preparation
    files: tuple[str, ...]
    path: Path


def tasks_of(recipe: Preparation, files: list[list[Any]], folder: Path) -> list[Task]:
    """Return the parts that files (path, bytes) are converted in; they depend on nothing but the sizes."""
    groups: list[list[str]] = []
    total = 0
    for name, size in files:
        if not groups or total + size > PART_BYTES or len(groups[-1]) == PART_FILES:
            groups.append([])
            total = 0
        groups[-1].append(name)
        total += size
    return [Task(recipe, tuple(names), folder / f"{k:08d}") for k, names in enumerate(groups)]


def make_part(task: Task) -> Path:
    """Convert the files of a task, unless that was done before; the part appears once it is complete.

    Its report has a list of ``entries`` for each file: the number of a segment in the part, or a skipped record.
    """
    if task.path.exists():
        return task.path
    draft = Path(tempfile.mkdtemp(prefix=f"{task.path.name}.", dir=task.path.parent))
    with StoreWriter(draft) as writer:
        entries = [[_entry(o, writer) for o in task.recipe.outcomes(file)] for file in task.files]
        writer.write_report({"entries": entries})
    try:
        draft.rename(task.path)
    except OSError:
        if not task.path.exists():
            raise
        shutil.rmtree(draft)  # another worker was first
    return task.path


def _entry(outcome: RunSegment | Skip, writer: StoreWriter) -> Any:
    if isinstance(outcome, Skip):
        return outcome.to_json()
    # Of a name that comes twice the first is kept; whoever takes them out of the part sees it twice.
    if writer.has(outcome.segment_id):
        return writer.index_of(outcome.segment_id)
    odd = {**outcome.odd, **dict.fromkeys(oddities(outcome), "")}
    tags = {ODD: odd, overlaps.TAG: len(overlaps.overlapping(outcome)), joins.TAG: outcome.joined_gaps}
    return writer.append(outcome, tags={name: value for name, value in tags.items() if value})
