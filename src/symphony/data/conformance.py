"""Does a reader do what it promises? :func:`check_reader` finds out, for our readers and for anybody's.

A reader that passes on a few files of its format gives run segments in the right units, frame and orientation, the
same ones every time, and survives damaged files with errors that name them.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from symphony.data.plausibility import implausible, measure
from symphony.data.segment import RunSegment, content_hash, validate
from symphony.data.sources.base import Item, Reader, UnexpectedError
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError

CUTS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)
"""Shares of a file that its truncated copies keep; the last keeps all but one byte."""
SHOWN = 3
"""Cases of one failure that a report spells out."""


@dataclass
class Conformance:
    """What was found.

    Attributes:
        segments: how many were checked.
        skipped: records the reader gave an error for instead.
        damaged: damaged copies that were read.
        numbers: see :data:`symphony.data.plausibility.RANGES`.
        failures: check -> what is wrong; empty if all is well.
    """

    segments: int = 0
    skipped: list[DataError] = field(default_factory=list)
    damaged: int = 0
    numbers: dict[str, float] = field(default_factory=dict)
    failures: dict[str, list[str]] = field(default_factory=dict)

    def fail(self, check: str, message: str) -> None:
        """Note a failure."""
        self.failures.setdefault(check, []).append(message)

    def __str__(self) -> str:
        lines = [f"{self.segments} segments, {len(self.skipped)} skipped, {self.damaged} damaged copies"]
        for check, messages in self.failures.items():
            lines += [f"  {check}: {message}" for message in messages[:SHOWN]]
            if len(messages) > SHOWN:
                lines.append(f"  {check}: and {len(messages) - SHOWN} more")
        return "\n".join(lines)


class ConformanceError(AssertionError):
    """A reader or its segments break the contract; ``report`` says how."""

    def __init__(self, report: Conformance) -> None:
        self.report = report
        super().__init__(str(report))


def check_segments(segments: Sequence[RunSegment]) -> Conformance:
    """Check run segments of one source, however they came about.

    Checks: ``schema`` (validation), ``ids`` (unique), ``store`` (survives the store unchanged), and those of
    :data:`symphony.data.plausibility.RANGES`: ``time step``, ``re-centred``, ``masked`` (zeros where not valid),
    ``speed`` (velocity against positions and time), ``heading`` (against the motion), ``size``, ``successors``,
    ``neighbours``, ``lanes`` (traffic runs along them) and ``boundary`` (traffic is on its left). The last few need
    traffic: give segments in which vehicles move.

    Raises:
        ConformanceError: naming every check that failed.
    """
    report = _inspect(segments)
    if report.failures:
        raise ConformanceError(report)
    return report


def check_reader(
    reader: Reader, files: Iterable[str | Path], *, damage: int = 1, flips: int = 20, seed: int = 0
) -> Conformance:
    """Check a reader with a few good files of its format.

    Besides the checks of :func:`check_segments`: ``errors`` (nothing but :class:`DataError` comes of reading, and
    it names the file), ``source`` (segments name format and file), ``determinism`` (reading again, in another
    order and from another folder, gives equal content), ``truncated`` (a file cut short gives an error, and nothing
    that the whole file does not give), ``damaged`` (bytes changed: a valid segment or an error) and ``foreign``
    (emptied, replaced by noise, or a companion missing that is not optional: nothing but errors). A crash of the
    interpreter can't be caught, but will not go unnoticed either.

    Args:
        reader: the reader; give :meth:`Reader.companions` where files are read together with others.
        files: good files of its format with moving vehicles. Errors of single records are allowed and reported.
        damage: how many of the files, the smallest first, are copied and damaged.
        flips: copies with changed bytes of each of those, and of each of their companions.
        seed: of the damage.

    Raises:
        ConformanceError: naming every check that failed.
    """
    paths = [Path(file) for file in files]
    report = Conformance()
    first = {path: _read(reader, path, report) for path in paths}
    segments = [item for items in first.values() for item in items if isinstance(item, RunSegment)]
    skipped = [item for items in first.values() for item in items if isinstance(item, DataError)]
    sound = _inspect(segments)
    sound.skipped, sound.failures = skipped, report.failures | sound.failures
    report = sound
    for path, items in first.items():
        for segment in items:
            if isinstance(segment, RunSegment) and (segment.source, segment.file) != (reader.name, path.name):
                report.fail("source", f"{path}: names {segment.source!r} and {segment.file!r}")
    for path in reversed(paths):
        _compare(first[path], _read(reader, path, report), f"{path} read again", report)
    with tempfile.TemporaryDirectory(prefix="symphony-conformance-") as folder:
        good = [path for path, items in first.items() if any(isinstance(i, RunSegment) for i in items)]
        for number, path in enumerate(sorted(good, key=lambda p: p.stat().st_size)[:damage]):
            copies = _Copies(reader, path, Path(folder) / str(number))
            _compare(first[path], _read(reader, copies.path, report), f"{path} in another folder", report)
            _mistreat(copies, _hashes(first[path]), flips, np.random.default_rng([seed, number]), report)
    if report.failures:
        raise ConformanceError(report)
    return report


def _inspect(segments: Sequence[RunSegment]) -> Conformance:
    report = Conformance(segments=len(segments))
    if not segments:
        report.fail("segments", "there are none to check")
        return report
    for segment in segments:
        try:
            validate(segment)
        except DataError as error:
            report.fail("schema", str(error))
    ids = [segment.segment_id for segment in segments]
    for name in sorted({name for name in ids if ids.count(name) > 1}):
        report.fail("ids", f"{ids.count(name)} segments are called {name!r}")
    # Whatever follows takes the schema, and the store unique names, for granted.
    if not report.failures:
        _store(segments, report)
        report.numbers = measure(segments)
        report.failures |= implausible(report.numbers)
    return report


def _store(segments: Sequence[RunSegment], report: Conformance) -> None:
    with tempfile.TemporaryDirectory(prefix="symphony-conformance-") as folder:
        try:
            with StoreWriter(Path(folder) / "store") as writer:
                for segment in segments:
                    writer.append(segment)
            back = list(SegmentStore(Path(folder) / "store"))
        except DataError as error:
            report.fail("store", str(error))
            return
        for segment, stored in zip(segments, back, strict=True):
            group = segment.group or segment.segment_id
            if (content_hash(segment), group) != (content_hash(stored), stored.group):
                report.fail("store", f"segment {segment.segment_id} comes back changed")


def _read(reader: Reader, path: Path, report: Conformance, check: str = "errors") -> list[Item]:
    """What a file gives, with everything it must never give noted."""
    items: list[Item] = []
    try:
        items.extend(reader.read(path))
    except Exception as error:  # whatever it is, it is the finding
        report.fail(check, f"{path}: raises {type(error).__name__}: {error}")
    named = {str(path), *map(str, reader.companions(path))}
    for item in items:
        if isinstance(item, UnexpectedError):
            report.fail(check, f"{path}: raises {item.message}")
        if isinstance(item, DataError) and str(item.file) not in named:
            report.fail(check, f"{path}: the error names the file {item.file}: {item.message}")
        if isinstance(item, DataError) and not item.message:
            report.fail(check, f"{path}: an error without a message")
    if not items:
        report.fail(check, f"{path}: gives neither a segment nor an error")
    return items


def _hashes(items: Iterable[Item]) -> list[str]:
    """Content hash and group per segment, an empty text per error."""
    return [f"{content_hash(item)} {item.group}" if isinstance(item, RunSegment) else "" for item in items]


def _compare(before: list[Item], after: list[Item], what: str, report: Conformance) -> None:
    if _hashes(before) != _hashes(after):
        report.fail("determinism", f"{what} gives something else")


class _Copies:
    """A file and its companions in a folder of their own, one of which is damaged at a time."""

    def __init__(self, reader: Reader, path: Path, folder: Path) -> None:
        folder.mkdir()
        self.reader = reader
        self.path = folder / path.name
        self.files: dict[Path, bytes] = {}
        self.optional = {folder / part.name for part in reader.optional(path)}
        for part in (path, *reader.companions(path)):
            copy = folder / part.name
            shutil.copyfile(part, copy)
            self.files[copy] = copy.read_bytes()

    def read(self, part: Path, data: bytes | None, report: Conformance, check: str) -> list[Item]:
        """What the file gives while one part has other content, or none."""
        if data is None:
            part.unlink()
        else:
            part.write_bytes(data)
        try:
            report.damaged += 1
            return _read(self.reader, self.path, report, check)
        finally:
            part.write_bytes(self.files[part])


def _mistreat(
    copies: _Copies, whole: list[str], flips: int, rng: np.random.Generator, report: Conformance
) -> None:
    for part, data in copies.files.items():
        for size in dict.fromkeys(min(int(share * len(data)), len(data) - 1) for share in CUTS):
            what = f"{part.name} cut to {size} of {len(data)} bytes"
            _check_cut(copies, part, size, whole, what, report)
        for changed in _changed(data, flips, rng):
            for item in copies.read(part, changed, report, "damaged"):
                _check_valid(item, f"{part.name} with bytes changed", report)
        foreign: dict[str, bytes | None] = {"emptied": b"", "made noise": rng.bytes(max(len(data), 64))}
        foreign["made text"] = b"Not what you are looking for.\n" * 50
        if part not in copies.optional:
            foreign["removed"] = None
        for what, content in foreign.items():
            items = copies.read(part, content, report, "foreign")
            if any(isinstance(item, RunSegment) for item in items):
                report.fail("foreign", f"{part.name} {what}: gives a segment all the same")


def _check_cut(
    copies: _Copies, part: Path, size: int, whole: list[str], what: str, report: Conformance
) -> None:
    data = copies.files[part]

    def read(size: int) -> list[str]:
        return _hashes(copies.read(part, data[:size], report, "truncated"))

    found = read(size)
    if set(found) - {"", *whole}:
        report.fail("truncated", f"{what}: gives a segment that the whole file does not")
    # Where a file is cut exactly between two records, nothing is wrong with what is left; one byte less is.
    lost = [name for name in whole if name not in found]
    if lost and "" not in found and (size == 0 or "" not in read(size - 1)):
        report.fail("truncated", f"{what}: no error, though {len(lost)} records are gone")


def _check_valid(item: Item, what: str, report: Conformance) -> None:
    if isinstance(item, RunSegment):
        try:
            validate(item)
        except DataError as error:
            report.fail("damaged", f"{what}: gives a segment that breaks the schema: {error}")


def _changed(data: bytes, count: int, rng: np.random.Generator) -> Iterator[bytes]:
    """Copies with a bit flipped, a byte changed, or a stretch overwritten, repeated or taken out."""
    damages: tuple[Callable[[bytearray, int, int], None], ...] = (_flip, _zero, _repeat, _remove)
    for number in range(count):
        copy = bytearray(data)
        damages[number % len(damages)](copy, int(rng.integers(len(data))), int(rng.integers(1, 65)))
        yield bytes(copy)


def _flip(data: bytearray, at: int, size: int) -> None:
    data[at] ^= 1 << size % 8


def _zero(data: bytearray, at: int, size: int) -> None:
    data[at : at + size] = bytes(len(data[at : at + size]))


def _repeat(data: bytearray, at: int, size: int) -> None:
    data[at:at] = data[at : at + size]


def _remove(data: bytearray, at: int, size: int) -> None:
    del data[at : at + size]
