"""Conversion of logged driving into a segment store, and what such a store holds."""

from __future__ import annotations

import contextlib
import math
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from symphony.data import resample as resampling
from symphony.data import store_format
from symphony.data.segment import RunSegment
from symphony.data.selection import usable
from symphony.data.sources import Reader, get_reader
from symphony.data.store import SegmentStore, StoreWriter
from symphony.errors import ConfigError, DataError

REASONS_SHOWN = 5
"""Reasons an error lists when nothing could be converted."""


@dataclass(frozen=True)
class Skip:
    """A record or file that was left out."""

    message: str
    file: str = ""
    segment: str = ""
    field: str = ""

    @property
    def reason(self) -> str:
        """The message with numbers blanked, so that like cases are counted together."""
        text = re.sub(r"-?\d+(\.\d+)?", "#", self.message)
        return f"{self.field}: {text}" if self.field else text

    def __str__(self) -> str:
        return str(
            DataError(
                self.message,
                file=self.file or None,
                segment=self.segment or None,
                field=self.field or None,
            )
        )


@dataclass
class Report:
    """What a conversion did.

    Attributes:
        converted: segments added.
        present: segments that the store held before.
        files: files read.
        skipped: what was left out.
        settings: arguments of the conversion.
    """

    converted: int = 0
    present: int = 0
    files: int = 0
    skipped: list[Skip] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def reasons(self) -> dict[str, int]:
        """How often something was skipped for each reason, most frequent first."""
        return dict(Counter(skip.reason for skip in self.skipped).most_common())

    def to_json(self) -> dict[str, Any]:
        """As kept with the store."""
        return {**asdict(self), "reasons": self.reasons}

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Report:
        """The reverse of :meth:`to_json`; an empty mapping gives an empty report."""
        known = {key: value[key] for key in ("converted", "present", "files", "settings") if key in value}
        try:
            return cls(**known, skipped=[Skip(**skip) for skip in value.get("skipped", ())])
        except TypeError as error:
            raise DataError(f"not a conversion report: {error}", field="skipped") from error

    def after(self, earlier: Report) -> Report:
        """This report joined to the one of an earlier conversion into the same store."""
        skipped = list(dict.fromkeys([*earlier.skipped, *self.skipped]))
        return Report(
            earlier.converted + self.converted, 0, earlier.files + self.files, skipped, self.settings
        )


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
    reader_options: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Report:
    """Convert logs into a segment store.

    A new store appears under its name once it is complete; a conversion that fails leaves nothing behind.
    A record or file that can't be used is counted, reported and skipped.

    Args:
        reader: name of the format, or a reader.
        files: files of that format, or directories to search for them.
        out: directory of the store.
        rate: steps per second (paper: 5).
        interactive: interactive agents a segment must have at its first step (N_I).
        smooth: sigma in seconds of the smoothing of tracks before they are resampled; 0 for none.
        append: add to the store if there is one, skipping the segments it holds.
        reader_options: arguments of the reader.
        progress: told how far it is.

    Returns:
        The report, which is kept with the store as well (joined to the earlier ones).

    Raises:
        ConfigError: an argument out of range, or an unknown format or reader option.
        DataError: ``out`` exists already, or not one segment could be converted.
    """
    _check_arguments(rate, interactive, smooth)
    out = Path(out).absolute()
    options = dict(reader_options or {})
    if isinstance(reader, str):
        reader = get_reader(reader, **options)
    settings = {"reader": reader.name, "rate": rate, "interactive": interactive, "smooth": smooth}
    report = Report(settings=settings | options)
    run = _Run(report, reader, 1 / rate, smooth, interactive, progress)
    paths = expand(files, reader.patterns)
    existing = _existing(out, append, 1 / rate)
    if existing is not None:
        with StoreWriter(out, append=True) as writer:
            earlier = Report.from_json(existing.report)
            try:
                run(paths, writer, frozenset(existing.ids))
            finally:  # what was added before an interruption stays, and so does the reason for each gap
                writer.write_report(report.after(earlier).to_json())
        _refuse_nothing(report)
        return report
    with _replacing(out) as draft:
        with StoreWriter(draft) as writer:
            run(paths, writer, frozenset())
            writer.write_report(report.to_json())
        _refuse_nothing(report)
    return report


def _check_arguments(rate: float, interactive: int, smooth: float) -> None:
    if not 0 < rate < math.inf:
        raise ConfigError(f"rate must be positive, is {rate}")
    if not 0 <= smooth < math.inf:
        raise ConfigError(f"smooth must not be negative, is {smooth}")
    if interactive < 1:
        raise ConfigError(f"interactive must be at least 1, is {interactive}")


def _existing(out: Path, append: bool, dt: float) -> SegmentStore | None:
    """The store to append to, if there is one."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return None
    if not (out / store_format.HEADER).is_file():
        raise DataError("exists and is not a segment store: refusing to write there", file=out)
    if not append:
        raise DataError("is a segment store already: append to it, or choose another name", file=out)
    store = SegmentStore(out)
    if len(store) and abs(store[0].dt - dt) > 1e-6:
        message = f"holds segments at {1 / store[0].dt:g} steps per second, not {1 / dt:g}"
        raise DataError(message, file=out, field="rate")
    return store


@contextlib.contextmanager
def _replacing(out: Path) -> Iterator[Path]:
    """A new directory that takes the name ``out`` at the end, and is removed if that is not reached."""
    made = [folder for folder in out.parents if not folder.exists()]
    draft = out.with_name(f".{out.name}.{os.getpid()}.partial")
    shutil.rmtree(draft, ignore_errors=True)
    try:
        draft.mkdir(parents=True)
        yield draft
        if out.exists():
            out.rmdir()
        draft.rename(out)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        with contextlib.suppress(OSError):
            for folder in made:
                folder.rmdir()
        raise


def _refuse_nothing(report: Report) -> None:
    if report.converted or report.present:
        return
    lines = [f"none of {len(report.skipped)} records could be converted"]
    lines += [f"  {skip}" for skip in report.skipped[:REASONS_SHOWN]]
    more = len(report.skipped) - REASONS_SHOWN
    raise DataError("\n".join([*lines, f"  and {more} more"] if more > 0 else lines))


@dataclass
class _Run:
    """The loop over files and records."""

    report: Report
    reader: Reader
    dt: float
    sigma: float
    interactive: int
    progress: Progress | None

    def __call__(self, paths: list[Path], writer: StoreWriter, before: frozenset[str]) -> None:
        for path in paths:
            for record in self.reader.read(path):
                self._record(path, record, writer, before)
                self._tell(len(paths))
            self.report.files += 1
            self._tell(len(paths))

    def _record(
        self, path: Path, record: RunSegment | DataError, writer: StoreWriter, before: frozenset[str]
    ) -> None:
        if isinstance(record, DataError):
            self._skip(record, path)
        elif record.segment_id in before:
            self.report.present += 1
        else:
            try:
                writer.append(self._prepared(record))
                self.report.converted += 1
            except DataError as error:
                self._skip(error, path, record.segment_id)

    def _prepared(self, segment: RunSegment) -> RunSegment:
        if self.sigma > 0:
            segment = resampling.smooth(segment, self.sigma)
        segment = resampling.resample(segment, self.dt)
        usable(segment, self.interactive)
        return segment

    def _skip(self, error: DataError, path: Path, segment: str | None = None) -> None:
        name = error.segment or segment or ""
        self.report.skipped.append(Skip(error.message, str(path), name, error.field or ""))

    def _tell(self, total: int) -> None:
        if self.progress is not None:
            self.progress(self.report.files, total, self.report)


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
    return list(dict.fromkeys(found))


def info(path: str | Path) -> dict[str, Any]:
    """What a store holds, as JSON can hold it.

    Returns:
        Among others ``segments``, ``agents`` (in all), ``checksum``, ``sources`` (segments of each) and
        ``skipped`` (how many; ``skipped_details`` says which, ``reasons`` counts like cases).

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
        "reasons": report.reasons,
        "skipped_details": [asdict(skip) for skip in report.skipped],
    }
