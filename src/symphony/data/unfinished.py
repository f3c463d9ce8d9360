"""A conversion that is not finished: what is done lies beside the store-to-be until everything is.

The folder ``NAME.partial`` beside the store ``NAME``::

    journal.jsonl   first line: what is being done; then one line per checkpoint
    store/          the segments converted so far, those past the last checkpoint to be taken back
    parts/          what workers converted ahead, each a store of its own
    store.lock      held while someone works on it

So a conversion can die at any moment: the same command takes up at the last checkpoint.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from symphony.data import store_format
from symphony.data.report import Report, Skip
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError
from symphony.files import locating

FORMAT, VERSION = "symphony conversion", 1
JOURNAL, STORE, PARTS = "journal.jsonl", "store", "parts"
_LATER = ("overlaps", "joined_gaps")
"""Counts that older journals do not have."""


@dataclass(frozen=True)
class Job:
    """What a conversion does.

    Attributes:
        settings: arguments that its results depend on.
        files: path and bytes of every file, in order.
        before: segments in the store that is added to; None where a new one is made.
        earlier: report of the store that is added to.
        changed: when each file, and each that is read together with one, was last changed (nanoseconds).
    """

    settings: Mapping[str, Any]
    files: list[tuple[str, int]]
    before: int | None = None
    earlier: Mapping[str, Any] = field(default_factory=dict)
    changed: Mapping[str, int] = field(default_factory=dict)

    def check_same(self, begun: Job, folder: Path) -> None:
        """Refuse to go on with a conversion that was begun otherwise.

        Raises:
            ConfigError: locating the first setting that differs.
        """
        names = dict.fromkeys([*begun.settings, *self.settings])
        pairs = [(name, begun.settings.get(name), self.settings.get(name)) for name in names]
        olds, news = dict(begun.files), dict(self.files)
        pairs.append(("files", _some(begun.files), _some(self.files)))
        pairs += [(f"size of {name}", size, news.get(name)) for name, size in olds.items()]
        for name, old, new in pairs:
            if old != new:
                message = (
                    f"{name} is {new}, but the conversion that was interrupted had {old}: give the same "
                    f"arguments to go on with it, or delete {folder} to begin anew"
                )
                raise ConfigError(message)
        # Journals from before this was kept don't say.
        for name in begun.changed.keys() | self.changed.keys() if begun.changed else ():
            if begun.changed.get(name) != self.changed.get(name):
                raise ConfigError(
                    f"{name} was changed since the conversion was interrupted: delete {folder} to begin anew"
                )
        if begun.files != self.files:
            raise ConfigError(f"files are in another order than in the conversion begun in {folder}")


def _some(files: list[tuple[str, int]]) -> str:
    names = sorted(name for name, _ in files)
    shown = ", ".join(names[:2] + (["…"] if len(names) > 3 else []) + names[2:][-1:])
    return f"{len(names)} ({shown})"


@dataclass(frozen=True)
class Begun:
    """What a journal says.

    Attributes:
        job: what is to be done.
        report: what was done at the last checkpoint.
        segments: how many were collected until then.
        finished: whether they are in the store that is added to.
        size: bytes of the journal that are sound.
    """

    job: Job
    report: Report
    segments: int = 0
    finished: bool = False
    size: int = 0


class Draft:
    """The folder of a conversion under way; only one process at a time.

    Args:
        out: the store-to-be, or the store that is added to.
        job: what is to be done.

    Attributes:
        job: what is to be done.
        report: what was done until the last checkpoint, when it is begun.
        resumed: whether an earlier process had begun it.

    Raises:
        ConfigError: another conversion was begun there.
        DataError: another process is at it, or the folder is damaged, or holds something else.
    """

    def __init__(self, out: Path, job: Job) -> None:
        self.out, self.folder = out, folder_of(out)
        self._made = [p for p in self.folder.parents if not p.exists()]
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = store_format.lock(self.folder)
        try:
            self._begin(job)
        except BaseException:
            self._lock.close()
            raise

    def _begin(self, job: Job) -> None:
        begun = read_journal(self.folder)
        self.resumed = begun is not None
        if begun is None:
            _check_own(self.folder)
            _clear(self.folder)  # left by a process that died before it had begun, or while it tidied up
            begun = Begun(job, Report(settings=dict(job.settings)))
        else:
            job.check_same(begun.job, self.folder)
        self.job, self.report, self._segments = begun.job, begun.report, begun.segments
        self._finished = begun.finished
        self._journal = (self.folder / JOURNAL).open("ab")
        self._journal.truncate(begun.size)
        if not self.resumed:
            self._write({"format": FORMAT, "version": VERSION, "job": asdict(job)})
        self._told = len(self.report.skipped)
        self.parts.mkdir(exist_ok=True)
        for stale in self.parts.glob("*.*"):
            shutil.rmtree(stale, ignore_errors=True)

    @property
    def store(self) -> Path:
        """Where segments are collected."""
        return self.folder / STORE

    @property
    def parts(self) -> Path:
        """Where workers put what they converted."""
        return self.folder / PARTS

    @property
    def finished(self) -> bool:
        """Whether only the tidying up is left to do."""
        done = self.report.files == len(self.job.files)
        moved = self.job.before is None and not self.store.exists() and self.out.exists()
        return self._finished or (self.resumed and done and moved)

    @property
    def before(self) -> tuple[str, int] | None:
        """The store that is added to and the segments it held, if there was one."""
        return None if self.job.before is None else (str(self.out), self.job.before)

    def writer(self) -> StoreWriter:
        """Adds to what was collected until the last checkpoint; anything after that is cut off."""
        return StoreWriter(self.store, append=True, keep=self._segments)

    def checkpoint(self, report: Report, writer: StoreWriter) -> None:
        """Put on record that ``report.files`` files are done; this survives whatever comes."""
        writer.sync()
        skipped = [skip.to_json() for skip in report.skipped[self._told :]]
        names = ("files", "converted", "present", "odd", "odd_examples", *_LATER)
        counts = {name: getattr(report, name) for name in names}
        self._write(counts | {"segments": len(writer), "skipped": skipped})
        self._told = len(report.skipped)

    def _write(self, line: Mapping[str, Any]) -> None:
        with locating(self.folder / JOURNAL):
            self._journal.write(json.dumps(line, ensure_ascii=False, default=str).encode() + b"\n")
            self._journal.flush()
            os.fsync(self._journal.fileno())

    def finish(self, report: Report) -> None:
        """Give the store its name, or add what was collected to the store that is there; then tidy up."""
        if not self.finished:
            if self.job.before is None:
                store_format.write_json(self.store / store_format.REPORT, report.to_json())
                with contextlib.suppress(FileNotFoundError):
                    self.out.rmdir()
                self.store.rename(self.out)
            else:
                self._add(report)
        self.close()
        self._remove()

    def _add(self, report: Report) -> None:
        collected = SegmentStore(self.store)
        with StoreWriter(self.out, append=True) as writer:
            for k, name in enumerate(collected.ids):
                if not writer.has(name):  # it is, where this was interrupted
                    writer.copy(collected, k)
            writer.write_report(report.after(Report.from_json(self.job.earlier)).to_json())
        self._write({"finished": True})

    def discard(self) -> None:
        """Leave nothing behind."""
        self.close()
        self._remove()
        with contextlib.suppress(OSError):
            for folder in self._made:
                folder.rmdir()

    def _remove(self) -> None:
        # The journal last: without one, whatever else is found here is taken for rubbish.
        _clear(self.folder, keep=JOURNAL)
        shutil.rmtree(self.folder)

    def close(self) -> None:
        """Let the next process in."""
        self._journal.close()
        self._lock.close()


def folder_of(out: Path) -> Path:
    """Where the unfinished conversion into a store lies.

    Raises:
        DataError: the root of a file system can't be a store.
    """
    if not out.name:
        raise DataError("no place for a store: it has no name of its own", file=out)
    return out.with_name(out.name + store_format.PARTIAL)


def read_journal(folder: Path) -> Begun | None:
    """What was begun in a folder; None where there is no journal, or only the beginning of its first line.

    Raises:
        DataError: it is not such a journal, or of another version.
    """
    path = folder / JOURNAL
    if not path.is_file():
        return None
    data = path.read_bytes()
    size = data.rfind(b"\n") + 1  # a torn last line was never on record
    if not size:
        return None
    try:
        head, *lines = (json.loads(line) for line in data[:size].splitlines())
        if head["format"] != FORMAT or head["version"] != VERSION:
            message = f"a {head['format']} of version {head['version']}; this release knows version {VERSION}"
            raise DataError(message, file=path)
        job = Job(**head["job"] | {"files": [(str(name), int(size)) for name, size in head["job"]["files"]]})
        report, segments, finished = Report(settings=dict(job.settings)), 0, False
        for line in lines:
            if "finished" in line:
                finished = True
                continue
            names = ("files", "converted", "present", "segments")
            counts = [line[name] for name in names] + [line.get(name, 0) for name in _LATER]
            if not all(type(count) is int and count >= 0 for count in counts) or counts[0] > len(job.files):
                raise ValueError(f"{counts} are no counts of {len(job.files)} files")
            report.files, report.converted, report.present, segments, *later = counts
            report.overlaps, report.joined_gaps = later
            report.odd, report.odd_examples = (dict(line.get(n, {})) for n in ("odd", "odd_examples"))
            report.skipped += [Skip(**skip) for skip in line["skipped"]]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(f"not the journal of a conversion: {error}", file=path) from error
    return Begun(job, report, segments, finished, size)


def _check_own(folder: Path) -> None:
    """Refuse a folder of the same name that is somebody's own: it is about to be cleared."""
    foreign = {child.name for child in folder.iterdir()} - {JOURNAL, STORE, PARTS, store_format.LOCK}
    if foreign:
        message = f"no conversion left {min(foreign)!r} there: give the folder, or the store, another name"
        raise DataError(message, file=folder)


def _clear(folder: Path, keep: str = store_format.LOCK) -> None:
    for child in folder.iterdir():
        if child.name == keep:
            continue
        if child.is_dir():
            shutil.rmtree(child)
        else:
            child.unlink()
