"""Conversion of logged driving into a segment store, merging of stores, and summaries of stores.

The folder ``NAME.partial`` beside the store-to-be ``NAME`` holds a conversion that is not finished::

    job.json      what is being done
    parts/        what is converted, each part a store of its own
    store/        the parts put together
    store.lock    held while someone works on it

So a conversion can die at any moment: the same command makes the parts that are missing. A part is some consecutive
files, converted record by record: what passes between processes is a path, and no process holds more than one record.
"""

from __future__ import annotations

import inspect
import json
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatch
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from symphony.data import joins, overlaps, store_format
from symphony.data import resample as resampling
from symphony.data.odd import crop, from_ego, oddities, with_agents
from symphony.data.report import Report, Skip
from symphony.data.resample import MAX_SIGMA
from symphony.data.segment import MAX_AGENTS, MAX_DT, MIN_DT, RunSegment
from symphony.data.selection import exclusion
from symphony.data.sources import Reader, get_reader
from symphony.data.sources.base import unexpected
from symphony.data.store import TWICE, SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError
from symphony.files import read_object, write_json
from symphony.parallel import Engine, ordered_map

PART_BYTES, PART_FILES = 8 << 20, 64  # small files go together: a part is some 60 files to write and delete
ODD = "odd"  # tag of a segment with something unusual: what it is -> an example


@dataclass(frozen=True)
class Preparation:
    """Settings by which the records of a file become segments: see :func:`symphony.data.convert.convert`."""

    reader: Reader
    dt: float
    sigma: float
    interactive: int
    exclude_overlaps: bool = False
    radius: float | None = None
    hold_lights: bool = False
    strict: bool = False

    def outcomes(self, path: str) -> Iterator[RunSegment | Skip]:
        """Yield a segment or a skip for each record of a file, in its order."""
        for record in self.reader.read(path):
            if isinstance(record, DataError):
                yield Skip.of(record, path)
            else:
                yield self._prepared(record, path)

    def _prepared(self, segment: RunSegment, path: str) -> RunSegment | Skip:
        try:
            # What the log knows of lights before the ego comes holds, too.
            segment = from_ego(resampling.hold_lights(segment) if self.hold_lights else segment)
            if self.strict and segment.odd:
                kind, example = next(iter(segment.odd.items()))
                raise DataError(f"{kind} ({example})", field="strict")
            road, gaps = joins.joined(segment.road)
            segment = segment.replace(road=road, joined_gaps=gaps)
            if self.sigma > 0:
                segment = resampling.smooth(segment, self.sigma)
            segment = resampling.resample(segment, self.dt)
            segment = with_agents(segment, np.asarray(segment.valid.any(axis=1)))  # some were seen in between
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
    """Return the parts that files (path, bytes) are converted in; they depend only on the sizes."""
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
    """Convert the files of a task, unless that was done before; the part appears once it is complete. Its report has
    a list of ``entries`` for each file: the number of a segment in the part, or a skipped record.
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
    # Of a name that occurs twice the first is kept; the one that collects the parts sees it twice.
    if writer.has(outcome.segment_id):
        return writer.index_of(outcome.segment_id)
    odd = {**outcome.odd, **dict.fromkeys(oddities(outcome), "")}
    tags = {ODD: odd, overlaps.TAG: len(overlaps.overlapping(outcome)), joins.TAG: outcome.joined_gaps}
    return writer.append(outcome, tags={name: value for name, value in tags.items() if value})


JOB, STORE, PARTS, STALE = "job.json", "store", "parts", "stale"
REASONS_SHOWN = 5  # by an error when nothing could be converted
Told = Callable[[int, int], None]
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
    exclude_overlaps: bool = False,
    radius: float | None = None,
    hold_lights: bool = False,
    strict: bool = False,
    reader_options: Mapping[str, Any] | None = None,
    workers: int = 1,
    engine: Engine = "local",
    progress: Progress = lambda *_: None,
) -> Report:
    """Convert logs into a segment store.

    The store appears under its name once it is complete; until then the work lies in ``OUT.partial``. A conversion
    that is interrupted or killed goes on there when it is called again with the same arguments, and gives the same
    store and report as one that was not. One that fails leaves no store behind. A record or file that can't be used
    is counted, reported and skipped.

    Args:
        reader: name of the format, or a reader.
        files: files of that format, or directories to search for them.
        out: directory of the store.
        rate: steps per second (paper: 5).
        interactive: interactive agents a segment must have at its first step (N_I).
        smooth: sigma in seconds of the smoothing of tracks before they are resampled; 0 for none.
        exclude_overlaps: leave out segments in whose log boxes overlap (see :mod:`symphony.data.overlaps`).
        radius: metres around the ego's path that are kept, of map and agents; None for all.
        hold_lights: give lights the last state that the log knows (before the first: the first) where it knows none.
        strict: skip a record of which something odd would be left out or filled in (see :mod:`symphony.data.odd`).
        reader_options: arguments of the reader.
        workers: processes that convert files (see :func:`symphony.parallel.ordered_map`), for the same result.
        engine: where they are; with Ray, all machines must share the file system of ``files`` and ``out``.
        progress: told how far it is.

    Returns the report, which is kept with the store as well.

    Raises:
        ConfigError: an argument is invalid, or is not the one that an unfinished conversion there was begun with.
        DataError: ``out`` exists already, or no segment could be converted.
        SymphonyError: a worker process died; what is done stays, as after an interrupt.
    """
    for name, value, least, most in (
        ("rate", rate, 1 / MAX_DT, 1 / MIN_DT),
        ("smooth", smooth, 0, MAX_SIGMA),
        ("interactive", interactive, 1, MAX_AGENTS),
        ("radius", 1 if radius is None else radius, 1e-9, 1e9),
    ):
        if not least <= value <= most:
            raise ConfigError(f"{name} must be between {least:g} and {most:g}, is {value:g}")
    out = Path(out).resolve()
    reader, options = _reader(reader, reader_options)
    if radius is not None and options.get("egos") == "problem":
        raise ConfigError("radius keeps what is near the ego's logged path; the ego of a planning problem has none")
    settings = {"reader": reader.name, "rate": rate, "interactive": interactive, "smooth": smooth} | options
    given = {"exclude_overlaps": exclude_overlaps, "hold_lights": hold_lights, "strict": strict, "radius": radius}
    settings |= {name: value for name, value in given.items() if value}
    paths = expand(files, reader.patterns)
    read = [file for path in paths for file in (path, *reader.companions(path)) if file.exists()]
    job = Job(
        json.loads(json.dumps(settings, default=str)),  # as it is read back
        [[str(path.absolute()), path.stat().st_size] for path in paths],
        {str(file.absolute()): file.stat().st_mtime_ns for file in read},
    )
    folder = folder_of(out)
    begun = read_job(folder)
    if begun is not None:
        job.check_same(begun, folder)
    # Whether its store is in its place already.
    done = begun is not None and not (folder / STORE).exists() and (out / store_format.HEADER).is_file()
    done = done and SegmentStore(out).report.get("settings") == job.settings
    if not done:
        _check_free(out, begun)
    folder.mkdir(parents=True, exist_ok=True)
    with store_format.lock(folder):
        if begun is None:
            _begin(job, folder)
        shutil.rmtree(folder / STALE, ignore_errors=True)
        (folder / PARTS).mkdir(exist_ok=True)
        if done:
            report = Report.from_json(SegmentStore(out).report)
        else:
            rules = exclude_overlaps, radius, hold_lights, strict
            how = Preparation(reader, 1 / rate, smooth, interactive, *rules)
            try:
                report = _collected(how, job, folder, workers, engine, progress)
            except (ConfigError, DataError):
                if all(part.suffix for part in (folder / PARTS).iterdir()):  # none is complete
                    _remove(folder)
                raise
            if report.converted:
                (folder / STORE).rename(out)
        _remove(folder)
    if not report.converted:
        lines = [f"none of {len(report.skipped)} records could be converted"]
        lines += [f"  {skip.error}" for skip in report.skipped[:REASONS_SHOWN]]
        more = len(report.skipped) - REASONS_SHOWN
        raise DataError("\n".join([*lines, f"  and {more} more"] if more > 0 else lines))
    return report


def _reader(reader: str | Reader, options: Mapping[str, Any] | None) -> tuple[Reader, dict[str, Any]]:
    """Return the reader and its options, as far as a given one keeps them under the names of its arguments."""
    if isinstance(reader, str):
        return get_reader(reader, **(options or {})), dict(options or {})
    asked, plain = inspect.signature(type(reader)).parameters, (str, int, float, bool, type(None))
    kept = {k: v for k, v in vars(reader).items() if k in asked and isinstance(v, plain)}
    return reader, {"options": kept} if kept else {}


@dataclass(frozen=True)
class Job:
    """The description of a conversion."""

    settings: dict[str, Any]  # arguments that its results depend on
    files: list[list[Any]]  # path and bytes of every file, in order
    changed: dict[str, int]  # when each, and each that is read with one, was last changed (nanoseconds)

    def check_same(self, begun: Job, folder: Path) -> None:
        """Refuse to go on with a conversion that was begun with other arguments; names the first that differs."""
        for name in {**begun.settings, **self.settings}:
            old, new = begun.settings.get(name), self.settings.get(name)
            if old != new:
                raise ConfigError(
                    f"{name} is {new}, but the conversion that was interrupted had {old}: give the same "
                    f"arguments to continue it, or delete {folder} to begin again"
                )
        others = set(begun.changed.items()) ^ set(self.changed.items())
        if others or begun.files != self.files:
            first = min(others)[0] if others else "in another order"
            raise ConfigError(
                f"the files are others, or have changed, since the conversion was interrupted ({first}): "
                f"delete {folder} to begin again"
            )


def read_job(folder: Path) -> Job | None:
    """Return the job begun in a folder, None where there is none; a :class:`DataError` if it is not a job."""
    path = folder / JOB
    if not path.is_file():
        return None
    try:
        job = Job(**read_object(path))
        sound = [*map(type, vars(job).values())] == [dict, list, dict]
        if not sound or not all(type(time) is int for time in job.changed.values()):
            raise TypeError("parts of other types")
    except TypeError as error:
        raise DataError("not the job of a conversion, or of another release", file=path) from error
    return job


def folder_of(out: Path) -> Path:
    """Return where the unfinished conversion into a store lies."""
    if not out.name:
        raise DataError("no place for a store: it has no name of its own", file=out)
    return out.with_name(out.name + store_format.PARTIAL)


def _check_free(out: Path, begun: Job | None) -> None:
    """Refuse a place where something exists already."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    message = "is a segment store already: choose another name (`symphony data merge` puts stores together)"
    if not (out / store_format.HEADER).is_file():
        message = "exists and is not a segment store: refusing to write there"
    elif begun is not None:
        held = f"{folder_of(out)} holds an unfinished conversion to that name"
        message = f"exists, and {held}: delete one of them"
    raise DataError(message, file=out)


def _begin(job: Job, folder: Path) -> None:
    # Else what is left of a process that died before it had begun; it is cleared.
    own = (PARTS, STORE, STALE, store_format.LOCK)
    foreign = [p.name for p in folder.iterdir() if p.name not in own and not p.name.startswith(".job.")]
    if foreign:
        message = f"no conversion left {min(foreign)!r} there: give it, or the store, another name"
        raise DataError(message, file=folder)
    shutil.rmtree(folder / PARTS, ignore_errors=True)
    write_json(folder / JOB, asdict(job))


def _collected(how: Preparation, job: Job, folder: Path, workers: int, engine: Engine, tell: Progress) -> Report:
    """Make the missing parts, and copy their content, in order, into one store."""
    tasks = tasks_of(how, job.files, folder / PARTS)
    report = Report(settings=dict(job.settings))
    shutil.rmtree(folder / STORE, ignore_errors=True)
    for stale in (folder / PARTS).glob("*.*"):
        shutil.rmtree(stale, ignore_errors=True)
    made = ordered_map(make_part, tasks, workers=workers, engine=engine)
    with closing(made), StoreWriter(folder / STORE) as writer:
        for task, path in zip(tasks, made, strict=True):
            part = SegmentStore(path)
            for file, entries in zip(task.files, part.report["entries"], strict=True):
                for entry in entries:
                    _take(entry, part, file, writer, report)
                    tell(report.files, len(job.files), report)
                report.files += 1
                tell(report.files, len(job.files), report)
        writer.write_report(report.to_json())
    return report


def _take(entry: Any, part: SegmentStore, file: str, writer: StoreWriter, report: Report) -> None:
    """Copy a segment of a part, or record why there is none."""
    if not isinstance(entry, int):
        report.skipped.append(Skip(**entry))
    elif writer.has(part.ids[entry]):
        report.skipped.append(Skip(TWICE, file, part.ids[entry], "segment_id"))
    else:
        writer.copy(part, entry)
        tags = part.tags(entry)
        report.converted += 1
        report.note(tags.get(ODD, {}), part.ids[entry])
        report.overlaps += overlaps.TAG in tags
        report.joined_gaps += tags.get(joins.TAG, 0)


def _remove(folder: Path) -> None:
    """Remove a finished job's folder: first the parts, since half a part must not count, and the job file last."""
    (folder / PARTS).rename(folder / STALE)
    for name in (STALE, STORE):
        shutil.rmtree(folder / name, ignore_errors=True)
    (folder / JOB).unlink()
    shutil.rmtree(folder)


def expand(files: Iterable[str | Path], patterns: tuple[str, ...]) -> list[Path]:
    """Return files as named, and for a directory all files inside whose names fit one of the patterns, sorted."""
    found: list[Path] = []
    for path in map(Path, files):
        if not path.exists():
            raise DataError("no such file or directory", file=path)
        inside = [p for p in path.rglob("*") if any(fnmatch(p.name, pattern) for pattern in patterns)]
        inside = sorted(p for p in inside if p.is_file()) if path.is_dir() else [path]
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
    """Return what a store holds, as JSON can hold it: its :meth:`SegmentStore.summary`, and much of its report."""
    store = SegmentStore(path)
    report = Report.from_json(store.report)
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
        "unfinished_generation": store.unfinished,
    }


def merge(paths: Sequence[Path], out: Path, progress: Told = lambda *_: None, mirror: bool = False) -> SegmentStore:
    """Copy all segments of some stores, in their order, into a new one, which appears once it is complete.

    With ``mirror`` all follow once more, mirrored. Its report joins theirs. ``progress`` is told how many
    segments are done, of how many. A :class:`DataError` names the store if ``out`` exists or is being made, a segment
    is in two stores, the generation of one is not finished, or stores differ in their time step.
    """
    out, seen, report = out.resolve(), set[str](), Report()
    if out.exists():
        raise DataError("exists already; choose another folder", file=out)
    stores = [SegmentStore(path) for path in paths]
    for store in stores:
        for names in (store.ids, [name + resampling.MIRRORED for name in store.ids] if mirror else []):
            if twice := seen.intersection(names):
                raise DataError(TWICE, file=store.path, segment=min(twice))
            seen.update(names)
        if store.unfinished is not None:
            raise DataError(store.unfinished, file=store.path)
        report = Report.from_json(store.report).after(report)
    steps = {float(dt) for store in stores for dt in store.time_steps}
    if len(steps) > 1:
        listed = ", ".join(f"{dt:g} s" for dt in sorted(steps))
        raise DataError(f"stores with different time steps can't be merged: {listed}", file=paths[0])
    if read_job(folder_of(out)) is not None:
        raise DataError(f"an unfinished conversion to that name lies in {folder_of(out)}", file=out)
    draft = out.with_name(f"{out.name}.merging")
    if (draft / store_format.REPORT).is_file():  # which a merge writes last
        what = "is a store, in the way of what is merged; move it"
        raise DataError(f"{what}, or rename it to {out.name} if a merge was killed", file=draft)
    if (draft / store_format.HEADER).is_file():  # of a merge that was killed, or goes on, which is told
        with store_format.lock(draft):
            for part in sorted(draft.iterdir(), key=lambda part: part.name == store_format.HEADER):
                (shutil.rmtree if part.is_dir() else Path.unlink)(part)  # at last what says that it is a store
    total = sum(map(len, stores)) * (1 + mirror)
    with StoreWriter(draft) as writer:
        ways = writer.copy, lambda store, k: writer.append(resampling.mirrored(store[k]), tags=store.tags(k))
        for way, store in product(ways[: 1 + mirror], stores):
            for index in range(len(store)):
                way(store, index)
                progress(len(writer), total)
    report = replace(report, converted=total, settings={"merged": [s.path.name for s in stores], "mirrored": mirror})
    tagged = {name: getattr(report, name) * (1 + mirror) for name in ("overlaps", "joined_gaps")}
    report = replace(report, **tagged, odd={kind: number * (1 + mirror) for kind, number in report.odd.items()})
    writer.write_report(report.to_json())
    draft.rename(out)
    return SegmentStore(out)
