"""The interface of all readers of log formats, and what they share."""

from __future__ import annotations

import contextlib
import xml.etree.ElementTree as ET
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from symphony.data.odd import mended
from symphony.data.resample import EVEN
from symphony.data.segment import MAX_FILE, AgentType, Bools, Floats, RunSegment, validate
from symphony.errors import ConfigError, DataError

T = TypeVar("T")
Doubles = NDArray[np.float64]
Odd = dict[str, str]  # what was left out, or is unusual: kind -> example
Item = RunSegment | DataError  # one record of a file: a valid run segment, or why there is none
MAX_NUMBER = 1e8  # larger magnitudes are no metres, seconds or radians of a road
NEAR = 50.0  # metres within which another agent counts as a neighbour of an ego candidate
FROM_AXLE = 1.4  # metres from the rear axle to the middle of the box, of the cars that recorded these logs
MOVING = 2.0  # metres an agent must get away from where it is first seen to count as moving

MALFORMED = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)
"""The exceptions that plain code raises on data of an unexpected structure."""


class UnexpectedError(DataError):
    """The error of a record on which a reader, or a library below it, failed in a way that it did not foresee."""


class Reader(ABC):
    """Turns files of one format into run segments at the log's rate; without a ``group`` they are their own."""

    name: ClassVar[str]  # name of the format, also :attr:`RunSegment.source`
    patterns: ClassVar[tuple[str, ...]]  # file-name patterns the format's files go by, for searching a folder

    def read(self, path: str | Path) -> Iterator[Item]:
        """Yield one item per record of a file, in file order; it never raises.

        A record that can't be used is yielded as an error naming file, segment (where known) and field. Where the
        rest of the file can't be read, such an error comes last.
        """
        path = Path(path)
        try:
            refuse(path.is_dir(), "is a folder, expected a file", file=path)
            # A pipe may never end.
            refuse(path.exists() and not path.is_file(), "is not an ordinary file", file=path)
            items = iter(self._read(path))
            while True:
                # Absurd numbers may overflow on the way: the result is not finite, which validation reports.
                with np.errstate(over="ignore", invalid="ignore"):
                    item = next(items, None)
                    found = None if item is None else self._checked(item, path)
                if found is None:
                    return
                yield found
        except DataError as error:
            yield error.at(file=path)
        except OSError as error:
            yield DataError(f"can't be read: {error.strerror or error}", file=Path(error.filename or path))
        except Exception as error:  # one bad file must not end a conversion
            yield unexpected(error, file=path)

    def companions(self, path: Path) -> tuple[Path, ...]:
        """Return the files that a file of this format is read together with, such as its map; none by default."""
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
                # What is left of it once single agents, states and lines are left out, if that is a segment.
                with contextlib.suppress(DataError, IndexError, ValueError, TypeError):
                    return validate(mended(item))
                return DataError(error.message, file=path, segment=error.segment, field=error.field)
        except Exception as error:  # arrays of other kinds than a segment has
            return unexpected(error, file=path, segment=item.segment_id)

    @abstractmethod
    def _read(self, path: Path) -> Iterator[Item]:
        """Yield the records, not validated yet; may raise :class:`DataError` where it can't read on."""


@contextlib.contextmanager
def located(*, file: object = None, segment: str | None = None, field: str | None = None) -> Iterator[None]:
    """Add the missing places to a :class:`DataError`; with a field, malformed data raise one as well."""
    try:
        yield
    except DataError as error:
        found = error.at(file=file, segment=segment)
        found.field = field if found.field is None else found.field
        raise found from error
    except MALFORMED as error:
        if field is None:
            raise
        message = f"can't be read: {type(error).__name__}: {str(error)[:80]}"
        raise DataError(message, file=file, segment=segment, field=field) from error


def readable(
    kind: str, odd: dict[str, str], read: Callable[..., T | None], *arguments: Any, field: str | None = None
) -> Iterator[T]:
    """Yield what ``read`` gives, if anything; where it raises a :class:`DataError`, note the first of the kind."""
    try:
        with located(field=field):
            found = read(*arguments)
        if found is not None:
            yield found
    except DataError as error:
        # JSON may hold halves of letters, which no UTF-8 can.
        odd.setdefault(kind, f"{error.field}: {error.message}".encode(errors="backslashreplace").decode())


def refuse(wrong: object, message: str, field: str | None = None, *, file: object = None) -> None:
    """Raise a :class:`DataError` where something is wrong."""
    if wrong:
        raise DataError(message, field=field, file=file)


def unexpected(error: Exception, *, file: object = None, segment: str | None = None) -> UnexpectedError:
    """Return the error that stands for a record on which a reader fails."""
    message = f"can't be read: {type(error).__name__}: {str(error)[:200]}"
    return UnexpectedError(message, file=file, segment=segment)


def read_whole(path: Path, most: int | None = None) -> bytes:
    """Return the content of a file; a :class:`DataError` if it is empty or has more than ``most`` bytes."""
    size, most = path.stat().st_size, MAX_FILE if most is None else most
    refuse(size > most, f"{size} bytes, at most {most}: too large for a file of this format", file=path)
    data = path.read_bytes()
    refuse(not data.strip(), "the file is empty", file=path)
    return data


def load_xml(path: Path, what: str = "CommonRoad") -> ET.Element:
    """Parse a file that declares no document type, which rules out every kind of entity attack. ``what`` is the name
    of the format, for the :class:`DataError` where the file is something else.
    """
    data = read_whole(path)

    def declared(*declaration: Any) -> None:
        raise DataError(f"declares a document type, which {what} files never do", file=path, field="DOCTYPE")

    # ElementTree's fast parser has no hook for document types; a pass without any other handler costs little.
    guard = expat.ParserCreate()
    guard.StartDoctypeDeclHandler = declared
    try:
        guard.Parse(data, True)
        return ET.fromstring(data)  # noqa: S314 - no document type, hence no entities
    except (expat.ExpatError, ET.ParseError, ValueError, LookupError) as error:
        raise DataError(f"not well-formed XML: {error}", file=path) from error


def number(text: str | None, field: str) -> float:
    """Return a finite number of at most :data:`MAX_NUMBER`."""
    try:
        value = float(text or "")
    except ValueError:
        raise DataError(f"{(text or '').strip()[:40]!r} is not a number", field=field) from None
    if not abs(value) <= MAX_NUMBER:
        raise DataError(f"{value:g} is not finite or absurdly large", field=field)
    return value


def finite(points: Doubles) -> Doubles:
    """Return points if all their coordinates are finite and at most :data:`MAX_NUMBER`."""
    refuse(not (np.abs(points) <= MAX_NUMBER).all(), "a coordinate that is not finite or absurdly large")
    return points


def integer(text: str | None, field: str) -> int:
    """Return an id or a count of 64 bits."""
    try:
        value = int(text or "")
    except ValueError:
        raise DataError(f"{(text or '').strip()[:40]!r} is not an integer", field=field) from None
    if not -(2**63) <= value < 2**63:
        raise DataError("the integer exceeds 64 bits", field=field)
    return value


def to_float32(array: NDArray[np.float64]) -> Floats:
    """Narrow numbers; those out of range become infinite (validation reports them) without a warning."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(array).astype(np.float32)


def motion(position: Doubles, heading: Doubles, velocity: Doubles, valid: Bools) -> dict[str, Any]:
    """Return the fields of a run segment for states; what is not valid becomes 0, and so does an unknown height.
    Takes re-centred positions [A, T, 2 or 3], headings [A, T], velocities [A, T, 2] and what is valid [A, T].
    """
    place = np.pad(position, ((0, 0), (0, 0), (0, 3 - position.shape[-1])))
    return {
        "position": to_float32(np.where(valid[..., None], place, 0.0)),
        "heading": to_float32(np.where(valid, heading, 0.0)),
        "velocity": to_float32(np.where(valid[..., None], velocity, 0.0)),
        "valid": valid,
    }


def from_rear_axle(states: Doubles, columns: Sequence[int], valid: Bools, dt: float) -> Doubles:
    """Return the states [T, D] of a recording car whose rear axle was logged, brought to the middle of its box.

    The columns are those of x, y, heading, and the velocity's x and y. The middle lies :data:`FROM_AXLE` ahead of the
    axle, and its velocity gains what turning adds.
    """
    x, y, heading, *velocity = columns
    moved, steps = states.copy(), np.flatnonzero(valid & np.isfinite(states).all(axis=-1))
    angle = np.unwrap(states[steps, heading])
    turn = np.gradient(angle, steps * dt) if len(steps) > 1 else np.zeros(len(steps))
    ahead = FROM_AXLE * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    moved[steps[:, None], [x, y]] += ahead
    moved[steps[:, None], velocity] += turn[:, None] * ahead[:, ::-1] * (-1, 1)
    return moved


def pairs(links: list[tuple[int, int]]) -> NDArray[np.int32]:
    """Return [E, 2] int32 without repeats, in order of first appearance."""
    return np.array(list(dict.fromkeys(links)), np.int32).reshape(-1, 2)


def time_step(times: Doubles, field: str) -> float:
    """Return the seconds between steps that begin at ``times`` [T], T at least 2.

    They are rounded to the millisecond where that fits the log: at 15 or 30 Hz it would be up to a percent off. Where
    steps are off by more than a tenth it is the usual one, to which :func:`symphony.data.resample.evened` brings the
    log. A :class:`DataError` says if more than a third of the steps differ from it, or half of them are missing.
    """
    gaps = np.diff(times)
    usual = float(np.median(gaps))
    steps = np.rint(gaps / usual) if usual > 0 else gaps
    single = (steps == 1) & (np.abs(gaps - usual) <= 0.5 * usual)
    if not (usual > 0 and 0 < steps.sum() <= 2 * len(gaps) and single.mean() >= 2 / 3):
        raise DataError(f"steps of {gaps.min():g} to {gaps.max():g} s are uneven", field=field)
    mean = float((times[-1] - times[0]) / steps.sum())
    even = (np.abs(gaps - steps * mean) <= EVEN * mean).all()
    return round(mean, 3) if abs(round(mean, 3) - mean) <= (1e-3 if even else 1e-2) * mean else mean


def busiest_first(
    agent_id: NDArray[np.int64],
    agent_type: NDArray[np.uint8],
    position: Doubles,
    valid: Bools,
    dynamic: Bools | None = None,
) -> NDArray[np.int64]:
    """Return the rows of the vehicles that move and are valid at every step, the one to be the ego first.

    That is the one with the most moving neighbours, summed over the steps; then the lowest id. Positions [A, T, 2]
    are metres, and ``dynamic`` [A] says which may be egos; by default all.
    """
    # Not the length of the path: the jitter of a parked car's track would add up.
    start = position[np.arange(len(position)), valid.argmax(1), None]
    away = np.hypot(*np.moveaxis(position - start, -1, 0))
    moving = np.where(valid, away, 0).max(axis=1, initial=0) > MOVING
    able = (agent_type == AgentType.VEHICLE) & moving & valid.all(axis=1)
    rows = np.flatnonzero(able if dynamic is None else able & dynamic)
    scores = []
    for row in rows:
        distance = np.hypot(*np.moveaxis(position[moving] - position[row], -1, 0))
        scores.append(int(((distance < NEAR) & valid[moving]).sum()))
    return rows[np.lexsort((agent_id[rows], -np.array(scores, np.int64)))]


def by_ego(segment: RunSegment, candidates: NDArray[np.int64], egos: str) -> Iterator[RunSegment]:
    """Yield a segment, or one for each candidate in order of id, all in one frame and on one map."""
    if egos == "one":
        yield segment
        return
    for ego in sorted(candidates.tolist(), key=lambda row: int(segment.agent_id[row])):
        yield segment.replace(ego=ego, segment_id=f"{segment.segment_id}_ego{segment.agent_id[ego]}")


def check_choice(name: str, value: str, *known: str) -> None:
    """Raise a :class:`ConfigError` if an option of a reader has an unknown value."""
    if value not in known:
        raise ConfigError(f"{name} must be {' or '.join(map(repr, known))}, is {value!r}")
