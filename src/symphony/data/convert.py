"""Conversion of logged driving into a segment store, and what such a store holds.

The folder ``NAME.partial`` beside the store-to-be ``NAME`` holds a conversion that is not finished::

    job.json      what is being done, and its report once all is in its place
    parts/        what is converted, each part a store of its own
    store/        the parts put together
    store.lock    held while someone works on it

So a conversion can die at any moment: the same command makes the parts that are missing.
"""

from __future__ import annotations

import contextlib
import inspect
import json
import math
import shutil
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from symphony.data import joins, overlaps, store_format
from symphony.data.bounds import MAX_AGENTS, MAX_DT, MIN_DT
from symphony.data.parts import ODD, PRESENT, Preparation, Task, make_part, tasks_of
from symphony.data.report import Report, Skip
from symphony.data.resample import MAX_SIGMA
from symphony.data.sources import Reader, get_reader
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError
from symphony.parallel import Engine, ordered_map

FORMAT, VERSION = "symphony conversion", 2
JOB, STORE, PARTS = "job.json", "store", "parts"
MAX_WORKERS = 4096
REASONS_SHOWN = 5
"""Reasons an error lists when nothing could be converted."""

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
    was not. One that fails leaves nothing behind. A record or file that can't be used is counted, reported and
    skipped.

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
    for name, value, least, most in (
        ("rate", rate, 1 / MAX_DT, 1 / MIN_DT),
        ("smooth", smooth, 0, MAX_SIGMA),
        ("interactive", interactive, 1, MAX_AGENTS),
        ("workers", workers, 1, MAX_WORKERS),
    ):
        if not least <= value <= most:
            raise ConfigError(f"{name} must be between {least:g} and {most:g}, is {value:g}")
    if radius is not None and not 0 < radius < math.inf:
        raise ConfigError(f"radius must be positive, is {radius}")
    out = Path(out).absolute()
    options = dict(reader_options or {})
    if isinstance(reader, str):
        reader = get_reader(reader, **options)
    else:
        # What it was made with, as far as it keeps that under the same names.
        asked = inspect.signature(type(reader)).parameters
        kept = {k: v for k, v in vars(reader).items() if k in asked and isinstance(v, _PLAIN)}
        options = {"options": kept} if kept else {}
    settings = {"reader": reader.name, "rate": rate, "interactive": interactive, "smooth": smooth} | options
    given = {
        "exclude_overlaps": exclude_overlaps or None,
        "radius": radius,
        "hold_lights": hold_lights or None,
        "strict": strict or None,
    }
    settings |= {name: value for name, value in given.items() if value is not None}
    paths = expand(files, reader.patterns)
    read = [file for path in paths for file in (path, *reader.companions(path)) if file.exists()]
    job = Job(
        json.loads(json.dumps(settings, default=str)),  # as it is read back
        [(str(path.absolute()), path.stat().st_size) for path in paths],
        changed={str(file.absolute()): file.stat().st_mtime_ns for file in read},
    )
    with closing(_Draft(out, _placed(job, out, append, 1 / rate))) as draft:
        before = None if draft.job.before is None else (str(out), draft.job.before)
        recipe = Preparation(
            reader, 1 / rate, smooth, interactive, before, exclude_overlaps, radius, hold_lights, strict
        )
        report = draft.run(tasks_of(recipe, draft.job.files, draft.parts), workers, engine, progress)
    if report.converted or report.present:
        return report
    lines = [f"none of {len(report.skipped)} records could be converted"]
    lines += [f"  {skip}" for skip in report.skipped[:REASONS_SHOWN]]
    more = len(report.skipped) - REASONS_SHOWN
    raise DataError("\n".join([*lines, f"  and {more} more"] if more > 0 else lines))


@dataclass(frozen=True)
class Job:
    """What a conversion does.

    Attributes:
        settings: arguments that its results depend on.
        files: path and bytes of every file, in order.
        changed: when each file, and each that is read together with one, was last changed (nanoseconds).
        before: segments in the store that is added to; None where a new one is made.
        earlier: report of the store that is added to.
    """

    settings: Mapping[str, Any]
    files: list[tuple[str, int]]
    changed: Mapping[str, int] = field(default_factory=dict)
    before: int | None = None
    earlier: Mapping[str, Any] = field(default_factory=dict)

    def check_same(self, begun: Job, folder: Path) -> None:
        """Refuse to go on with a conversion that was begun otherwise; names the first thing that differs."""
        for name in {**begun.settings, **self.settings}:
            old, new = begun.settings.get(name), self.settings.get(name)
            if old != new:
                raise ConfigError(
                    f"{name} is {new}, but the conversion that was interrupted had {old}: give the same "
                    f"arguments to go on with it, or delete {folder} to begin anew"
                )
        others = set(begun.changed.items()) ^ set(self.changed.items())
        if others or begun.files != self.files:
            first = min(others)[0] if others else "in another order"
            raise ConfigError(
                f"the files are others, or were changed, since the conversion was interrupted ({first}): "
                f"delete {folder} to begin anew"
            )


def _placed(job: Job, out: Path, append: bool, dt: float) -> Job:
    """The job, with what it adds to, after a look at what is there already."""
    folder = folder_of(out)
    begun, done = read_job(folder) or (None, None)
    if done is not None and begun is not None:
        return replace(job, before=begun.before, earlier=begun.earlier)
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        if begun is not None and begun.before is not None:
            raise DataError(f"is gone, and {folder} holds an unfinished conversion that adds to it", file=out)
        return job
    if not (out / store_format.HEADER).is_file():
        raise DataError("exists and is not a segment store: refusing to write there", file=out)
    if begun is not None and begun.before is None:
        message = f"exists, and {folder} holds an unfinished conversion to that name: delete one of them"
        raise DataError(message, file=out)
    if not append:
        raise DataError("is a segment store already: append to it, or choose another name", file=out)
    if begun is not None:
        return replace(job, before=begun.before, earlier=begun.earlier)
    store = SegmentStore(out)
    store.check_complete()
    if len(store) and abs(store[0].dt - dt) > 1e-6:
        message = f"holds segments at {1 / store[0].dt:g} steps per second, not {1 / dt:g}"
        raise DataError(message, file=out, field="rate")
    return replace(job, before=len(store), earlier=store.report)


class _Draft:
    """The folder of a conversion under way; only one process at a time.

    Raises:
        ConfigError: another conversion was begun there.
        DataError: another process is at it, or the folder is damaged, or holds something else.
    """

    def __init__(self, out: Path, job: Job) -> None:
        self.out, self.folder = out, folder_of(out)
        self.parts, self.store = self.folder / PARTS, self.folder / STORE
        self._made = [p for p in self.folder.parents if not p.exists()]
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = store_format.lock(self.folder)
        try:
            self.done: Report | None
            begun, self.done = read_job(self.folder) or (None, None)
            if begun is None:
                # Else what is left of a process that died before it had begun; it is about to be cleared.
                own = {PARTS, STORE, store_format.LOCK, f"{JOB}.tmp"}
                if foreign := {child.name for child in self.folder.iterdir()} - own:
                    message = (
                        f"no conversion left {min(foreign)!r} there: give it, or the store, another name"
                    )
                    raise DataError(message, file=self.folder)
                shutil.rmtree(self.parts, ignore_errors=True)
                self._write(job, None)
            else:
                job.check_same(begun, self.folder)
            self.job = job if begun is None else begun
            self.parts.mkdir(exist_ok=True)
            for stale in self.parts.glob("*.*"):
                shutil.rmtree(stale, ignore_errors=True)
        except BaseException:
            self._lock.close()
            raise

    def _write(self, job: Job, done: Report | None) -> None:
        report = None if done is None else done.to_json()
        head = {"format": FORMAT, "version": VERSION, "job": asdict(job), "report": report}
        store_format.write_json(self.folder / JOB, head)

    def run(self, tasks: list[Task], workers: int, engine: Engine, progress: Progress | None) -> Report:
        """Make the parts that are missing, put all together, and tidy up."""
        if self.done is None:
            try:
                self.done = self._collected(tasks, workers, engine, progress)
            except (ConfigError, DataError):
                if all(part.suffix for part in self.parts.iterdir()):  # none is complete
                    self._remove(discard=True)
                raise
            if not (self.done.converted or self.done.present):
                self._remove(discard=True)
                return self.done
            if self.job.before is not None:
                self._add(self.done)
            self._write(self.job, self.done)
        if self.store.exists() and self.job.before is None:
            with contextlib.suppress(FileNotFoundError):
                self.out.rmdir()
            self.store.rename(self.out)
        self._remove()
        return self.done

    def _collected(
        self, tasks: list[Task], workers: int, engine: Engine, progress: Progress | None
    ) -> Report:
        """Copy what the parts hold, in their order, into one store."""
        report = Report(settings=dict(self.job.settings))
        total = len(self.job.files)

        def tell() -> None:
            if progress is not None:
                progress(report.files, total, report)

        shutil.rmtree(self.store, ignore_errors=True)
        with closing(_made(tasks, workers, engine)) as made, StoreWriter(self.store) as writer:
            for task, path in zip(tasks, made, strict=True):
                part = SegmentStore(path)
                for file, entries in zip(task.files, part.report["entries"], strict=True):
                    for entry in entries:
                        _take(entry, part, file, writer, report)
                        tell()
                    report.files += 1
                    tell()
            writer.write_report(report.to_json())
        return report

    def _add(self, report: Report) -> None:
        collected = SegmentStore(self.store)
        with StoreWriter(self.out, append=True) as writer:
            for k, name in enumerate(collected.ids):
                if not writer.has(name):  # it is, where this was interrupted
                    writer.copy(collected, k)
            writer.write_report(report.after(Report.from_json(self.job.earlier)).to_json())

    def _remove(self, discard: bool = False) -> None:
        """Without a job, whatever is found here is taken for rubbish: so parts that count no more go after it."""
        self.close()
        if discard:
            (self.folder / JOB).unlink()
        shutil.rmtree(self.store, ignore_errors=True)
        shutil.rmtree(self.parts)
        (self.folder / JOB).unlink(missing_ok=True)
        shutil.rmtree(self.folder)
        if discard:
            with contextlib.suppress(OSError):
                for folder in self._made:
                    folder.rmdir()

    def close(self) -> None:
        """Let the next process in."""
        self._lock.close()


def _made(tasks: list[Task], workers: int, engine: Engine) -> Generator[Path, None, None]:
    if workers == 1 and engine == "local":
        yield from map(make_part, tasks)
    else:
        with closing(ordered_map(make_part, tasks, workers=workers, engine=engine)) as made:
            yield from made


def _take(entry: Any, part: SegmentStore, file: str, writer: StoreWriter, report: Report) -> None:
    """Copy a segment of a part, or note what else became of a record."""
    if entry == PRESENT:
        report.present += 1
    elif isinstance(entry, int):
        try:
            writer.copy(part, entry)
        except DataError as error:
            report.skipped.append(Skip.of(error, file, part.ids[entry]))
            return
        tags = part.tags(entry)
        report.converted += 1
        report.note(tags.get(ODD, {}), part.ids[entry])
        report.overlaps += overlaps.TAG in tags
        report.joined_gaps += tags.get(joins.TAG, 0)
    else:
        report.skipped.append(Skip(**entry))


def folder_of(out: Path) -> Path:
    """Where the unfinished conversion into a store lies."""
    if not out.name:
        raise DataError("no place for a store: it has no name of its own", file=out)
    return out.with_name(out.name + store_format.PARTIAL)


def read_job(folder: Path) -> tuple[Job, Report | None] | None:
    """What was begun in a folder, and its report once all is in its place; None where nothing was begun.

    Raises:
        DataError: it is not such a job, or of another version.
    """
    path = folder / JOB
    if not path.is_file():
        return None
    head = store_format.read_json(path)
    try:
        if (head["format"], head["version"]) != (FORMAT, VERSION):
            message = f"a {head['format']} of version {head['version']}; this release knows version {VERSION}"
            raise DataError(message, file=path)
        job = Job(**head["job"] | {"files": [(str(name), int(size)) for name, size in head["job"]["files"]]})
        return job, None if head["report"] is None else Report.from_json(head["report"])
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"not the job of a conversion: {error}", file=path) from error


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
        # Reports are UTF-8; a name that is not could be neither written nor found again.
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
        over segments), ``unfinished`` (None, or how far a conversion is that will add to the store) and
        ``unfinished_generation`` (None, or how many segments are there, of how many).

    Raises:
        DataError: not a segment store, or a damaged one.
    """
    store = SegmentStore(path)
    report = Report.from_json(store.report)
    folder = folder_of(store.path)
    begun = read_job(folder)
    parts = [] if begun is None else [p for p in (folder / PARTS).glob("*") if not p.suffix]
    done = sum(len(SegmentStore(part).report["entries"]) for part in parts)
    kept = ("files", "settings", "exclusions", "reasons", "problems", "odd", "odd_examples", "overlaps")
    return {
        "path": str(store.path),
        "format": store_format.FORMAT,
        "version": store_format.VERSION,
        **store.summary(),
        "checksum": store.checksum(),
        **{name: getattr(report, name) for name in (*kept, "joined_gaps")},
        "skipped": len(report.skipped),
        "groups": len(set(store.groups.tolist())),
        "skipped_details": [skip.to_json() for skip in report.skipped],
        "unfinished": None if begun is None else {"files": done, "of": len(begun[0].files)},
        "unfinished_generation": store.unfinished,
    }
