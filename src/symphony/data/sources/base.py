"""What every reader of a log format offers."""

from __future__ import annotations

import contextlib
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from symphony.data.bounds import MAX_FILE
from symphony.data.odd import mended
from symphony.data.resample import EVEN
from symphony.data.segment import Floats, RunSegment, validate
from symphony.errors import DataError

Item = RunSegment | DataError
"""One record of a file: a valid run segment, or why there is none."""


class UnexpectedError(DataError):
    """A record that made a reader, or a library below it, fail in a way the reader did not foresee."""


class Reader(ABC):
    """Turns the files of one format into run segments at the log's own rate.

    A segment whose ``group`` a reader leaves empty is a group of its own.

    Attributes:
        name: name of the format, also :attr:`RunSegment.source`.
        patterns: file-name patterns the format's files go by, for searching a folder.
    """

    name: ClassVar[str]
    patterns: ClassVar[tuple[str, ...]]

    def read(self, path: str | Path) -> Iterator[Item]:
        """Yield one item per record of a file, in file order; no file makes it raise.

        A record that can't be used is yielded as an error naming file, segment (where known) and field, so
        that the caller can count it and go on. Where the rest of the file can't be read, such an error comes
        last. That holds for whatever a reader or a library raises on content it did not expect.
        """
        path = Path(path)
        try:
            if path.is_dir():
                raise DataError("is a folder, expected a file", file=path)
            if path.exists() and not path.is_file():
                raise DataError("is no ordinary file", file=path)  # a pipe may never end
            for item in self._read(path):
                yield self._checked(item, path)
        except DataError as error:
            yield error.at(file=path)
        except OSError as error:
            yield DataError(f"can't be read: {error.strerror or error}", file=path)
        except Exception as error:  # one bad file must not end a conversion
            yield unexpected(error, file=path)

    def companions(self, path: Path) -> tuple[Path, ...]:
        """Further files that a file of this format is read together with, such as its map; none by default."""
        return ()

    def optional(self, path: Path) -> tuple[Path, ...]:
        """Those of the :meth:`companions` without which a file can be read, since many have none; none by default."""
        return ()

    @staticmethod
    def _checked(item: Item, path: Path) -> Item:
        if isinstance(item, DataError):
            return item.at(file=path)
        try:
            item = item if item.group else item.replace(group=item.segment_id)
            try:
                return validate(item)
            except DataError as error:
                return _mended(item) or DataError(
                    error.message, file=path, segment=error.segment, field=error.field
                )
        except Exception as error:  # arrays of other kinds than a segment has
            return unexpected(error, file=path, segment=item.segment_id)

    @abstractmethod
    def _read(self, path: Path) -> Iterator[Item]:
        """Yield the records, not validated yet; may raise :class:`DataError` where it can't read on."""


def _mended(segment: RunSegment) -> RunSegment | None:
    """What is left of a segment that breaks the schema, if that is one (see :func:`symphony.data.odd.mended`)."""
    with contextlib.suppress(DataError, IndexError, ValueError, TypeError):
        return validate(mended(segment))
    return None


def unexpected(error: Exception, *, file: object = None, segment: str | None = None) -> UnexpectedError:
    """What a record is reported as that a reader fails on."""
    message = f"can't be read: {type(error).__name__}: {str(error)[:200]}"
    return UnexpectedError(message, file=file, segment=segment)


def read_whole(path: Path) -> bytes:
    """The content of a file of at most :data:`MAX_FILE` bytes.

    Raises:
        DataError: there are more.
        OSError: it can't be read.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > MAX_FILE:
            message = f"{size} bytes, at most {MAX_FILE}: too large for a file of this format"
            raise DataError(message, file=path)
        data = file.read(size + 1)
    if len(data) > size:
        raise DataError("grew while it was read", file=path)
    return data


def to_float32(array: NDArray[np.float64]) -> Floats:
    """Narrow, letting numbers out of range become infinite (validation reports them) without a warning."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(array).astype(np.float32)


def codes(values: NDArray[np.int64], count: int, field: str) -> NDArray[np.uint8]:
    """Enumeration values as uint8.

    Raises:
        DataError: a value is outside 0 … count - 1.
    """
    bad = np.unique(values[(values < 0) | (values >= count)])
    if len(bad):
        raise DataError(f"unknown value {bad[0]}, expected 0 … {count - 1}", field=field)
    return values.astype(np.uint8)


def pairs(links: list[tuple[int, int]]) -> NDArray[np.int32]:
    """[E, 2] int32 without repeats, in order of first appearance."""
    return np.array(list(dict.fromkeys(links)), np.int32).reshape(-1, 2)


def time_step(times: NDArray[np.float64], field: str) -> float:
    """Seconds between steps that begin at ``times`` [T], T at least 2; to the millisecond where that fits the log.

    At 15 or 30 Hz it does not: with rounded steps a log would run up to a percent too fast or slow. Where steps are
    off by more than a tenth it is the usual one, to which :func:`symphony.data.resample.evened` brings the log.

    Raises:
        DataError: more than a third of the steps are no such ones, or half of them are missing; names ``field``.
    """
    gaps = np.diff(times)
    mean = float(gaps.mean())
    dt = round(mean, 3)
    dt = dt if abs(dt - mean) <= 1e-3 * mean else mean
    if dt > 0 and (np.abs(gaps - dt) <= EVEN * dt).all():
        return dt
    usual = float(np.median(gaps))
    steps = np.rint(gaps / usual) if usual > 0 else gaps
    even = (steps == 1) & (np.abs(gaps - usual) <= 0.5 * usual)
    if not (usual > 0 and 0 < steps.sum() <= 2 * len(gaps) and even.mean() >= 2 / 3):
        raise DataError(f"steps of {gaps.min():g} to {gaps.max():g} s are uneven", field=field)
    mean = float((times[-1] - times[0]) / steps.sum())
    return round(mean, 3) if abs(round(mean, 3) - mean) <= 1e-2 * mean else mean
