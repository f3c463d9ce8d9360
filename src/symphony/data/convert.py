"""Conversion of logged driving into a segment store, and what such a store holds."""

from __future__ import annotations

import inspect
import json
import math
import shutil
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from symphony.data import joins, overlaps, store_format
from symphony.data.bounds import MAX_AGENTS, MAX_DT, MIN_DT
from symphony.data.parts import (
    ODD,
    Outcome,
    Preparation,
    Stored,
    Task,
    divide,
    elsewhere,
    here,
    tags_of,
)
from symphony.data.report import Report, Skip
from symphony.data.resample import MAX_SIGMA
from symphony.data.sources import Reader, get_reader
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.data.unfinished import STORE, Draft, Job, folder_of, read_journal
from symphony.errors import ConfigError, DataError
from symphony.parallel import Engine

__all__ = ["Progress", "Report", "Skip", "convert", "expand", "info"]

MIN_RATE, MAX_RATE = 1 / MAX_DT, 1 / MIN_DT
MAX_WORKERS = 4096
REASONS_SHOWN = 5
"""Reasons an error lists when nothing could be converted."""
CHECKPOINT = 2.0
"""Seconds after which files that are done are put on record."""

_PLAIN = (str, int, float, bool, type(None))
"""Kinds of a reader's attributes that are kept as its options."""

Progress = Callable[[int, int, Report], None]
"""Called with the files done, the files in all, and the report so far, after each record and file."""


def convert(
    reader: str | Reader,
    files: Iterable[str | Path],
    out: str | Path,
    *,
    rate: float = 5.0,
    interactive: int = 2,
    smooth: float = 0.0,
    append: bool = False,
    exclude_overlaps: bool = False,
    radius: float | None = None,
    hold_lights: bool = False,
    strict: bool = False,
    reader_options: Mapping[str, Any] | None = None,
    workers: int = 1,
    engine: Engine = "local",
    progress: Progress | None = None,
) -> Report:
    """Convert logs into a segment store.

    A new store appears under its name once it is complete, and a store that is added to changes once everything
    is converted; until then the work lies in ``OUT.partial``. A conversion that is interrupted, however rudely,
    goes on there when it is called again with the same arguments, and gives the same store and report as one that
    was not; it converts no file again that was done ``CHECKPOINT`` seconds before. One that fails leaves nothing
    behind. A record or file that can't be used is counted, reported and skipped.

    Args:
        reader: name of the format, or a reader.
        files: files of that format, or directories to search for them.
        out: directory of the store.
        rate: steps per second (paper: 5).
        interactive: interactive agents a segment must have at its first step (N_I).
        smooth: sigma in seconds of the smoothing of tracks before they are resampled; 0 for none.
        append: add to the store if there is one, skipping the segments it holds.
        exclude_overlaps: leave out segments in whose log boxes overlap (see :mod:`symphony.data.overlaps`); they
            are counted either way.
        radius: metres around the ego's path that are kept, of map and agents; None for all.
        hold_lights: give lights the last state that the log knows (before the first: the first) where it knows none.
        strict: skip a record of which something odd would be left out, such as an agent without a size (see
            :mod:`symphony.data.odd`).
        reader_options: arguments of the reader.
        workers: processes that convert files (see :func:`symphony.parallel.ordered_map`); the result does not
            depend on it.
        engine: where they are; with Ray on several machines, ``files`` and ``out`` must be on a file system that
            all of them share.
        progress: told how far it is.

    Returns:
        The report, which is kept with the store as well (joined to the earlier ones).

    Raises:
        ConfigError: an argument out of range, an unknown format or reader option, or another argument than an
            unfinished conversion to the same place was begun with.
        DataError: ``out`` exists already, or not one segment could be converted.
        SymphonyError: a worker process died; what is done stays, as after an interrupt.
    """
    _check_arguments(rate, interactive, smooth, workers, radius)
    out = Path(out).absolute()
    options = dict(reader_options or {})
    if isinstance(reader, str):
        reader = get_reader(reader, **options)
    else:
        # What it was made with, as far as it keeps that under the same names.
        asked = inspect.signature(type(reader)).parameters
        own = {name: value for name, value in vars(reader).items() if name in asked}
        found = {name: value for name, value in own.items() if isinstance(value, _PLAIN)}
        options = {"options": found} if found else {}
    settings = {"reader": reader.name, "rate": rate, "interactive": interactive, "smooth": smooth} | options
    settings |= {"exclude_overlaps": True} if exclude_overlaps else {}
    settings |= {} if radius is None else {"radius": radius}
    settings |= {"hold_lights": True} if hold_lights else {}
    settings |= {"strict": True} if strict else {}
    paths = expand(files, reader.patterns)
    changed = {
        str(file.absolute()): file.stat().st_mtime_ns
        for path in paths
        for file in (path, *reader.companions(path))
        if file.exists()
    }
    draft = Draft(out, _job(settings, paths, changed, out, append, 1 / rate))
    with closing(draft):
        report = draft.report
        try:
            if not draft.finished:
                recipe = Preparation(
                    reader,
                    1 / rate,
                    smooth,
                    interactive,
                    draft.before,
                    exclude_overlaps,
                    radius,
                    hold_lights,
                    strict,
                )
                _Run(draft, list(map(str, paths)), recipe, progress)(workers, engine)
            if report.converted or report.present:
                draft.finish(report)
                return report
        except (ConfigError, DataError):
            if not report.files:
                draft.discard()
            raise
        draft.discard()
    raise _nothing(report)


def _check_arguments(
    rate: float, interactive: int, smooth: float, workers: int, radius: float | None
) -> None:
    if radius is not None and not 0 < radius < math.inf:
        raise ConfigError(f"radius must be positive, is {radius}")
    if not 0 < rate < math.inf:
        raise ConfigError(f"rate must be positive, is {rate}")
    if not MIN_RATE <= rate <= MAX_RATE:
        raise ConfigError(f"rate must be between {MIN_RATE:g} and {MAX_RATE:g} steps per second, is {rate:g}")
    if not 0 <= smooth < math.inf:
        raise ConfigError(f"smooth must not be negative, is {smooth}")
    if smooth > MAX_SIGMA:
        raise ConfigError(f"smooth must be at most {MAX_SIGMA:g} seconds, is {smooth:g}")
    if not 1 <= interactive <= MAX_AGENTS:
        raise ConfigError(f"interactive must be at least 1 and at most {MAX_AGENTS}, is {interactive}")
    if not 1 <= workers <= MAX_WORKERS:
        raise ConfigError(f"workers must be at least 1 and at most {MAX_WORKERS}, is {workers}")


def _job(
    settings: Mapping[str, Any],
    paths: list[Path],
    changed: Mapping[str, int],
    out: Path,
    append: bool,
    dt: float,
) -> Job:
    """What there is to do, after a look at what is there already."""
    settings = json.loads(json.dumps(settings, default=str))  # as it is read back
    files = [(str(path.absolute()), path.stat().st_size) for path in paths]
    folder = folder_of(out)
    begun = read_journal(folder)
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        if begun is not None and begun.job.before is not None:
            raise DataError(f"is gone, and {folder} holds an unfinished conversion that adds to it", file=out)
        return Job(settings, files, changed=changed)
    if not (out / store_format.HEADER).is_file():
        raise DataError("exists and is not a segment store: refusing to write there", file=out)
    if begun is not None and begun.job.before is None:
        if begun.report.files < len(begun.job.files) or (folder / STORE).exists():
            message = f"exists, and {folder} holds an unfinished conversion to that name: delete one of them"
            raise DataError(message, file=out)
        return Job(settings, files, changed=changed)  # died between giving the store its name and tidying up
    if not append:
        raise DataError("is a segment store already: append to it, or choose another name", file=out)
    if begun is not None:
        return Job(settings, files, begun.job.before, begun.job.earlier, changed)
    store = SegmentStore(out)
    store.check_complete()
    if len(store) and abs(store[0].dt - dt) > 1e-6:
        message = f"holds segments at {1 / store[0].dt:g} steps per second, not {1 / dt:g}"
        raise DataError(message, file=out, field="rate")
    return Job(settings, files, len(store), store.report, changed)


def _nothing(report: Report) -> DataError:
    lines = [f"none of {len(report.skipped)} records could be converted"]
    lines += [f"  {skip}" for skip in report.skipped[:REASONS_SHOWN]]
    more = len(report.skipped) - REASONS_SHOWN
    return DataError("\n".join([*lines, f"  and {more} more"] if more > 0 else lines))


class _Run:
    """Collects what the files give, in their order, whoever converts them."""

    def __init__(
        self, draft: Draft, paths: list[str], recipe: Preparation, progress: Progress | None
    ) -> None:
        self.draft, self.report, self.progress, self.total = draft, draft.report, progress, len(paths)
        parts = divide([size for _, size in draft.job.files])
        tasks = [Task(recipe, tuple(paths[p.start : p.stop]), p.start, draft.parts) for p in parts]
        self.tasks = [task for task in tasks if task.stop > self.report.files]
        self._used: list[Path] = []
        self._last = time.monotonic()

    def __call__(self, workers: int, engine: Engine) -> None:
        if self.draft.resumed:
            self._tell()
        with closing(self._results(workers, engine)) as results, self.draft.writer() as writer:
            for task, found in zip(self.tasks, results, strict=True):
                undone = self.report.files - task.start  # past 0 where an earlier process stopped in between
                for path, outcomes in list(zip(task.files, found, strict=True))[undone:]:
                    for outcome in outcomes:
                        self._add(outcome, path, writer)
                        self._tell()
                    self.report.files += 1
                    self._tell()
                    self._checkpoint(writer)
                self._used.append(task.path)
            self._checkpoint(writer, at_once=True)

    def _results(self, workers: int, engine: Engine) -> Generator[list[Iterator[Outcome]], None, None]:
        if workers == 1 and engine == "local":
            yield from map(here, self.tasks)
        else:
            yield from elsewhere(self.tasks, workers, engine)

    def _add(self, outcome: Outcome, path: str, writer: StoreWriter) -> None:
        if outcome is None:
            self.report.present += 1
        elif isinstance(outcome, Skip):
            self.report.skipped.append(outcome)
        else:
            try:
                if isinstance(outcome, Stored):
                    found = outcome.tags
                    writer.copy(outcome.store, outcome.index)
                else:
                    found = tags_of(outcome)
                    writer.append(outcome, tags=found or None)
                self.report.converted += 1
                self.report.note(found.get(ODD, {}), outcome.segment_id)
                self.report.overlaps += overlaps.TAG in found
                self.report.joined_gaps += found.get(joins.TAG, 0)
            except DataError as error:
                self.report.skipped.append(Skip.of(error, path, outcome.segment_id))

    def _tell(self) -> None:
        if self.progress is not None:
            self.progress(self.report.files, self.total, self.report)

    def _checkpoint(self, writer: StoreWriter, at_once: bool = False) -> None:
        """Not after every file: small ones are converted faster than the disk confirms."""
        if not at_once and time.monotonic() - self._last < CHECKPOINT:
            return
        self.draft.checkpoint(self.report, writer)
        for part in self._used:
            shutil.rmtree(part, ignore_errors=True)
        self._used.clear()
        self._last = time.monotonic()


def expand(files: Iterable[str | Path], patterns: tuple[str, ...]) -> list[Path]:
    """Files as named, and for a directory all files inside whose names fit one of the patterns, sorted.

    Raises:
        DataError: a path that does not exist, a directory without such files, or no paths at all.
    """
    found: list[Path] = []
    for path in map(Path, files):
        if not path.exists():
            raise DataError("no such file or directory", file=path)
        if not path.is_dir():
            found.append(path)
            continue
        inside = [p for p in path.rglob("*") if any(fnmatch(p.name, pattern) for pattern in patterns)]
        inside = sorted(p for p in inside if p.is_file())
        if not inside:
            raise DataError(f"no {' or '.join(p.removeprefix('*') for p in patterns)} files in {path}")
        found += inside
    if not found:
        raise DataError("no files given")
    for path in found:
        # Journals and reports are UTF-8; a name that is not could be neither written nor found again.
        if any(0xD800 <= ord(letter) <= 0xDFFF for letter in str(path.absolute())):
            raise DataError("the name of a file or of its folder is not UTF-8: give it another", file=path)
    return list(dict.fromkeys(found))


def info(path: str | Path) -> dict[str, Any]:
    """What a store holds, as JSON can hold it.

    Returns:
        Among others ``segments``, ``agents`` (in all), ``checksum``, ``sources`` (segments of each), ``skipped`` (how
        many; ``skipped_details`` says which, ``reasons`` counts like cases), ``exclusions`` (how many of these under
        each of the paper's), ``problems`` (the reasons of the others), ``odd`` (what is unusual about how many of the
        segments; ``odd_examples`` the first of each), ``groups`` (recordings the segments are of), ``overlaps``
        (segments in whose log boxes overlap), ``joined_gaps`` (links between lanes that conversion has added, summed
        over segments; see :mod:`symphony.data.joins`), ``unfinished`` (None, or how far a conversion is that will add
        to the store) and ``unfinished_generation`` (None, or how many segments are there, of how many).

    Raises:
        DataError: not a segment store, or a damaged one.
    """
    store = SegmentStore(path)
    report = Report.from_json(store.report)
    return {
        "path": str(store.path),
        "format": store_format.FORMAT,
        "version": store_format.VERSION,
        **store.summary(),
        "checksum": store.checksum(),
        "files": report.files,
        "settings": report.settings,
        "skipped": len(report.skipped),
        "exclusions": report.exclusions,
        "reasons": report.reasons,
        "problems": report.problems,
        "odd": report.odd,
        "odd_examples": report.odd_examples,
        "overlaps": report.overlaps,
        "joined_gaps": report.joined_gaps,
        "groups": len(set(store.groups.tolist())),
        "skipped_details": [skip.to_json() for skip in report.skipped],
        "unfinished": _unfinished(store.path),
        "unfinished_generation": store.unfinished,
    }


def _unfinished(path: Path) -> dict[str, int] | None:
    begun = read_journal(folder_of(path))
    return None if begun is None else {"files": begun.report.files, "of": len(begun.job.files)}
