"""From the records of log files to segments ready for a store, here or in a worker process.

A worker converts a *part*, some consecutive files, into a small store of its own, record by record: what
passes between processes is a path, and no process holds more than one record in memory.
"""

from __future__ import annotations

import functools
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symphony.data import joins, overlaps
from symphony.data import resample as resampling
from symphony.data.bounds import oddities
from symphony.data.crop import crop
from symphony.data.odd import from_ego
from symphony.data.report import Skip
from symphony.data.segment import RunSegment
from symphony.data.selection import exclusion
from symphony.data.sources import Reader
from symphony.data.sources.base import unexpected
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError
from symphony.parallel import Engine, ordered_map

PART_BYTES, PART_FILES = 8 << 20, 64
"""Small files are converted so many at a time, since every part costs some 60 small files to write and delete."""
PRESENT = "present"
ODD = "odd"
"""Tag of a segment with something unusual: what it is -> an example (a list of what it is in older stores)."""


@dataclass(frozen=True)
class Stored:
    """A segment that a worker left in a part."""

    store: SegmentStore
    index: int

    @property
    def segment_id(self) -> str:
        """Its id."""
        return self.store.ids[self.index]

    @property
    def tags(self) -> dict[str, Any]:
        """What it is tagged with."""
        return self.store.tags(self.index)


Outcome = RunSegment | Stored | Skip | None
"""What became of a record; None where the store held the segment before."""


@dataclass(frozen=True)
class Preparation:
    """How the records of a file become segments.

    Attributes:
        reader: of the format.
        dt: seconds per step.
        sigma: of the smoothing in seconds, 0 for none.
        interactive: interactive agents a segment must have (N_I).
        before: path of the store that is added to, and the segments it held; their ids are passed over.
        exclude_overlaps: leave out segments with overlapping boxes (see :mod:`symphony.data.overlaps`).
        radius: metres around the ego's path that are kept (see :mod:`symphony.data.crop`); None for all.
        hold_lights: keep the state of lights where the log has none.
        strict: leave out records of which something odd would be (see :mod:`symphony.data.odd`).
    """

    reader: Reader
    dt: float
    sigma: float
    interactive: int
    before: tuple[str, int] | None = None
    exclude_overlaps: bool = False
    radius: float | None = None
    hold_lights: bool = False
    strict: bool = False

    def outcomes(self, path: str) -> Iterator[Outcome]:
        """One for each record of a file, in its order."""
        before = frozenset[str]() if self.before is None else _ids(*self.before)
        for record in self.reader.read(path):
            if isinstance(record, DataError):
                yield Skip.of(record, path)
            elif record.segment_id in before:
                yield None
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


def tags_of(segment: RunSegment) -> dict[str, Any]:
    """What a segment is tagged with that has something unusual, boxes that overlap, or lanes that were joined."""
    odd = {**segment.odd, **dict.fromkeys(oddities(segment), "")}
    gaps = {joins.TAG: segment.joined_gaps} if segment.joined_gaps else {}
    return ({ODD: odd} if odd else {}) | (overlaps.tags(segment) or {}) | gaps


@functools.lru_cache(maxsize=1)
def _ids(path: str, count: int) -> frozenset[str]:
    return frozenset(SegmentStore(path).ids[:count])


def divide(sizes: list[int]) -> list[range]:
    """Consecutive files, by number, that are converted in one go; depends on nothing but their sizes in bytes."""
    parts: list[range] = []
    begin, total = 0, 0
    for k, size in enumerate(sizes):
        if k > begin and (total + size > PART_BYTES or k - begin == PART_FILES):
            parts.append(range(begin, k))
            begin, total = k, 0
        total += size
    return [*parts, range(begin, len(sizes))] if sizes else parts


@dataclass(frozen=True)
class Task:
    """A part to make.

    Attributes:
        recipe: how.
        files: paths of its files.
        start: number of the first of them among all files.
        folder: where parts lie.
    """

    recipe: Preparation
    files: tuple[str, ...]
    start: int
    folder: Path

    @property
    def stop(self) -> int:
        """Number of the file after the last."""
        return self.start + len(self.files)

    @property
    def path(self) -> Path:
        """Where the finished part lies."""
        return self.folder / f"{self.start:08d}"


def make_part(task: Task) -> Path:
    """Convert the files of a task, unless that was done before; the part appears once it is complete."""
    if task.path.exists():
        return task.path
    draft = Path(tempfile.mkdtemp(prefix=f"{task.path.name}.", dir=task.folder))
    with StoreWriter(draft) as writer:
        entries = [
            [_entry(outcome, writer, file) for outcome in task.recipe.outcomes(file)] for file in task.files
        ]
        writer.write_report({"entries": entries})
    try:
        draft.rename(task.path)
    except OSError:
        if not task.path.exists():
            raise
        shutil.rmtree(draft)  # another worker was first
    return task.path


def _entry(outcome: Outcome, writer: StoreWriter, file: str) -> Any:
    if isinstance(outcome, RunSegment):
        # Of a name that comes twice the first is kept; whoever takes them out of the part sees it twice.
        if writer.has(outcome.segment_id):
            return writer.index_of(outcome.segment_id)
        try:
            return writer.append(outcome, tags=tags_of(outcome) or None)
        except DataError as error:
            outcome = Skip.of(error, file, outcome.segment_id)
    return outcome.to_json() if isinstance(outcome, Skip) else PRESENT


def open_part(path: Path) -> list[Iterator[Outcome]]:
    """For each file of a part, what :meth:`Preparation.outcomes` gave."""
    store = SegmentStore(path)

    def outcome(entry: Any) -> Outcome:
        if isinstance(entry, int):
            return Stored(store, entry)
        return None if entry == PRESENT else Skip(**entry)

    return [map(outcome, entries) for entries in store.report["entries"]]


def here(task: Task) -> list[Iterator[Outcome]]:
    """The same in this process, from one record to the next; from a part only if there is one already."""
    if task.path.exists():
        return open_part(task.path)
    return [task.recipe.outcomes(file) for file in task.files]


def elsewhere(tasks: list[Task], workers: int, engine: Engine) -> Iterator[list[Iterator[Outcome]]]:
    """The same for many tasks, made by worker processes."""
    with closing(ordered_map(make_part, tasks, workers=workers, engine=engine)) as made:
        for path in made:
            yield open_part(path)
