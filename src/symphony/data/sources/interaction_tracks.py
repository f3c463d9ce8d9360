"""Track files of the INTERACTION format: comma-separated values, one row per track and time."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.resample import EVEN, local_line, wrap
from symphony.data.segment import AgentType, Bools
from symphony.data.sources.base import Doubles, located, refuse
from symphony.errors import DataError

MAX_BYTES = 1 << 29  # bytes of one file; the largest published ones have a fourth of it
CHUNK = 50_000  # lines that are parsed at a time
NEEDED = ("track_id", "timestamp_ms", "agent_type", "x", "y", "vx", "vy")

_TYPES = {
    **dict.fromkeys(("car", "truck", "bus", "van", "motorcycle"), AgentType.VEHICLE),
    **dict.fromkeys(("bike", "bicycle", "cyclist"), AgentType.CYCLIST),
    "pedestrian": AgentType.PEDESTRIAN,
    "pedestrian/bicycle": AgentType.UNSET,
}
NOMINAL = {AgentType.PEDESTRIAN: (0.7, 0.7), AgentType.CYCLIST: (1.8, 0.7)}
"""Length and width in metres of agents whose box the format does not give."""
CYCLING = 2.5  # m/s: of the type ``pedestrian/bicycle``, tracks whose fastest tenth is faster are cyclists
APART = 4.0  # metres from their mean, beyond which two positions at one time are those of two agents
MAX_GAP_MS = 1000  # longest time step that is taken for one
SIGMA = 0.2  # seconds: of the Gaussian weights of the line whose slope is the velocity
WALKING = 1.0  # m/s above which the direction of motion is a heading
OFF = np.deg2rad(45)  # angle to the motion from which on a logged heading does not count
_MOVING = 3.0
_ENOUGH = 20
_HINT = " (motion='positions' takes both from the positions)"


@dataclass(frozen=True)
class Rows:
    """N rows of one or two files, ordered by case, time and track."""

    case: NDArray[np.int64]  # number of the case; 0 throughout where the file is one recording
    time: NDArray[Any]  # milliseconds, and once they are stepped the number of the step
    track: NDArray[np.int64]  # id; that of a track named P7 is -8, that of track 7 is 7
    kind: NDArray[np.int64]  # agent types, UNSET for pedestrian/bicycle
    state: Doubles  # [N, 7] x, y, vx, vy, heading, length, width; NaN where not given
    marks: Bools  # [N, 2] whether the track is one to predict, and an interacting one

    def __len__(self) -> int:
        return len(self.time)

    def take(self, where: NDArray[np.integer] | slice) -> Rows:
        """Return some of the rows."""
        return Rows(*(array[where] for array in vars(self).values()))

    def between(self, begin: int, stop: int) -> Rows:
        """Return the rows of some steps of one case."""
        return self.take(slice(*np.searchsorted(self.time, [begin, stop])))


def read_rows(path: Path) -> Rows:
    """Read a track file; a :class:`DataError` names file and line if it is too large, cut or lacks a field."""
    size = path.stat().st_size
    refuse(size > MAX_BYTES, f"{size} bytes, at most {MAX_BYTES} can be read", file=path)
    with located(file=path, field="a line"), path.open("rb") as file:
        head = file.readline()
        refuse(not head.strip(), "the file is empty")
        names = [name.strip() for name in _ascii(head, 1).rstrip("\r\n").split(",")]
        for name in NEEDED:
            refuse(names.count(name) != 1, f"{names.count(name)} columns of that name, expected one", name)
        parts, first = [], 2
        while lines := list(itertools.islice(file, CHUNK)):
            whole = lines[-1].endswith(b"\n")
            refuse(not whole, "the last line is not complete: the file was cut short", "last line")
            parts.append(_rows(names, _ascii(b"".join(lines), first), first))
            first += len(lines)
        refuse(not parts, "the file has no rows")
        return joined(*parts)


def _ascii(data: bytes, first: int) -> str:
    """Return the text of some lines of a file, the first of which has the number ``first``."""
    try:
        return data.decode("ascii")
    except UnicodeDecodeError as error:
        line = first + data.count(b"\n", 0, error.start)
        raise DataError("not ASCII text", field=f"line {line}") from error


def joined(*parts: Rows) -> Rows:
    """Return the rows of all files, by case, time and track."""
    rows = Rows(*(np.concatenate(arrays) for arrays in zip(*(vars(p).values() for p in parts), strict=True)))
    return rows.take(np.lexsort((rows.track, rows.time, rows.case)))


def _rows(names: list[str], text: str, first: int) -> Rows:
    """Parse some lines of a file, the first of which has the number ``first``."""
    lines = [line.rstrip("\r").split(",") for line in text.split("\n")[:-1]]
    for k, line in enumerate(lines):
        if len(line) != len(names):
            raise DataError(f"{len(line)} fields, expected {len(names)}", field=f"line {first + k}")
    columns = dict(zip(names, zip(*lines, strict=True), strict=True))

    def column(name: str, value: Callable[[str], Any], default: str = "") -> NDArray[Any]:
        found = []
        for k, entry in enumerate(columns.get(name, (default,) * len(lines))):
            try:
                found.append(value(entry))
            except (KeyError, ValueError):
                message = f"{entry[:40]!r} can't be read"
                raise DataError(message, field=f"line {first + k}: {name}") from None
        return np.array(found)

    needed = [column(name, _number) for name in ("x", "y", "vx", "vy")]
    given = [column(name, partial(_number, unknown=("", "nan"))) for name in ("psi_rad", "length", "width")]
    marks = [column(name, _whole, "0") for name in ("track_to_predict", "interesting_agent")]
    return Rows(
        case=column("case_id", _whole, "0"),
        time=column("timestamp_ms", partial(_number, most=2.0**53)),
        track=column("track_id", _track_id),
        kind=column("agent_type", lambda text: int(_TYPES[text.strip().lower()])),
        state=np.stack([*needed, *given], axis=-1),
        marks=np.stack(marks, axis=-1) != 0,
    )


def _number(text: str, most: float = 1e8, unknown: tuple[str, ...] = ()) -> float:
    if text.strip().lower() in unknown:
        return np.nan
    value = float(text)
    if not abs(value) <= most:
        raise ValueError(text)
    return value


def _whole(text: str) -> int:
    value = _number(text, 2.0**53)
    if not value.is_integer():
        raise ValueError(text)
    return int(value)


def _track_id(text: str) -> int:
    digits = text.strip().removeprefix("P")
    if not (digits.isdecimal() and len(digits) <= 15):
        raise ValueError(text)
    return -1 - int(digits) if text.strip().startswith("P") else int(digits)


def stepped(rows: Rows) -> tuple[Rows, float, float]:
    """Return (rows with numbers of steps for times, seconds per step, milliseconds at step 0) of a recording.

    Times may be rounded to milliseconds, so that the steps of 30 Hz look uneven, and frames may be missing. A
    :class:`DataError` where there are fewer than two times, or they are not multiples of one step.
    """
    times, which = np.unique(rows.time, return_inverse=True)
    refuse(len(times) < 2, "fewer than two steps", "timestamp_ms")
    gaps = np.diff(times)
    usual = float(np.median(gaps))
    # Gap by gap, so that the error of the usual step does not add up over the recording.
    count = float(np.rint(gaps / usual).sum())
    mean = float(times[-1] - times[0]) / max(count, 1)
    whole = float(np.rint(mean)), 1000 / max(np.rint(1000 / mean), 1)  # milliseconds, or frames a second
    step = next((each for each in whole if abs(each - mean) * count <= 1.5), mean)
    number = np.rint((times - times[0]) / step).astype(np.int64)
    off = np.abs(times - times[0] - number * step) > EVEN * step + 1
    wrong = not usual <= MAX_GAP_MS or off.any() or (np.diff(number) < 1).any()
    refuse(wrong, f"times are not multiples of their usual step of {usual:g} ms", "timestamp_ms")
    return replace(rows, time=number[which]), step / 1000, float(times[0])


def check_motion(rows: Rows, dt: float, start: float) -> None:
    """Refuse rows whose velocities and headings of vehicles that move are not those of their positions.

    Compared over a second: medians over all vehicles, so that single wild tracks do not count. Takes what
    :func:`stepped` gives. A :class:`DataError` says, too, if a track has two states at one time.
    """
    twice = _twice(rows)
    if len(twice):
        time = start + 1000 * dt * rows.time[twice[0]]
        at = f"track {rows.track[twice[0]]} has two states at {time:.0f} ms"
        raise DataError(f"{at}, and {len(twice)} times so in all{_HINT}", field="timestamp_ms")
    by_track = rows.take(np.lexsort((rows.time, rows.track, rows.case)))
    lag = max(1, round(1 / dt))
    one, two = by_track.take(slice(None, -lag)), by_track.take(slice(lag, None))
    both = (one.track == two.track) & (one.case == two.case) & (two.time - one.time == lag)
    both &= (one.kind == AgentType.VEHICLE) & (two.kind == AgentType.VEHICLE)
    covered = (two.state[:, :2] - one.state[:, :2]) / (lag * dt)
    fast = both & (np.hypot(*covered.T) > _MOVING)
    if fast.sum() < _ENOUGH:
        return
    covered, logged = covered[fast], ((one.state[:, 2:4] + two.state[:, 2:4]) / 2)[fast]
    course = np.arctan2(*covered.T[::-1])
    ratio = float(np.median(np.hypot(*logged.T) / np.hypot(*covered.T)))
    far = not 0.8 <= ratio <= 1.25
    refuse(far, f"velocities are {ratio:.2f} times the speed of the positions{_HINT}", "vx, vy")
    for name, angle in (("vx, vy", np.arctan2(*logged.T[::-1])), ("psi_rad", one.state[fast, 4])):
        error = float(np.nanmedian(np.abs(wrap(angle - course)))) if not np.isnan(angle).all() else 0.0
        refuse(error > 0.5, f"points {np.degrees(error):.0f} degrees off the motion{_HINT}", name)


def _twice(rows: Rows) -> NDArray[np.int64]:
    keys = np.stack([rows.case, rows.time, rows.track])
    return np.flatnonzero((keys[:, 1:] == keys[:, :-1]).all(axis=0)) + 1


def merged(rows: Rows) -> Rows:
    """Return rows in which positions and velocities that a track has twice at one time have become their mean."""
    twice = _twice(rows)
    if not len(twice):
        return rows
    first = np.setdiff1d(np.arange(len(rows)), twice)
    number = np.searchsorted(first, np.arange(len(rows)), side="right") - 1
    total = np.zeros((len(first), 4))
    np.add.at(total, number, rows.state[:, :4])
    found = rows.take(first)
    found.state[:, :4] = total / np.bincount(number)[:, None]
    off = np.hypot(*(rows.state[:, :2] - found.state[number, :2]).T) > APART
    wrong = rows.track[off | (rows.kind != found.kind[number])]
    refuse(len(wrong), f"track {wrong[:1]} has states at one time that are far apart or of two types", "track_id")
    return found


def resolved(rows: Rows, dt: float, *, by_positions: bool) -> Rows:
    """Return rows of :func:`stepped` in which ``pedestrian/bicycle`` are pedestrians or, if fast (:data:`CYCLING`),
    cyclists; speeds are those of the positions if ``by_positions``, else of the logged velocities.
    """
    kind = rows.kind.copy()
    unknown = np.flatnonzero(kind == AgentType.UNSET)
    speed = _speeds(rows, dt) if by_positions else np.hypot(rows.state[:, 2], rows.state[:, 3])
    keys = np.stack([rows.case[unknown], rows.track[unknown]])
    for case, track in np.unique(keys, axis=1).T:
        mine = unknown[(keys[0] == case) & (keys[1] == track)]
        fast = np.percentile(speed[mine], 90) > CYCLING
        kind[mine] = AgentType.CYCLIST if fast else AgentType.PEDESTRIAN
    return replace(rows, kind=kind)


def _speeds(rows: Rows, dt: float) -> Doubles:
    """Return [N] m/s to the next state of the same track, at its last from the one before; 0 for a single one."""
    order = np.lexsort((rows.time, rows.track, rows.case))
    case, track, time = rows.case[order], rows.track[order], rows.time[order]
    same = (case[1:] == case[:-1]) & (track[1:] == track[:-1])
    step = np.hypot(*np.diff(rows.state[order, :2], axis=0).T)
    speed = np.where(same, step / np.where(same, np.diff(time) * dt, 1.0), np.nan)
    ahead, behind = np.append(speed, np.nan), np.append(np.nan, speed)
    found = np.zeros(len(rows))
    found[order] = np.nan_to_num(np.where(np.isnan(ahead), behind, ahead))
    return found


def completed(rows: Rows, dt: float, *, by_positions: bool) -> Rows:
    """Return rows of one case, headings that are not given being the direction of motion at the nearest step at which
    the agent moves, or 0 if it never does.

    If ``by_positions``, velocities become slopes of the positions, and headings that are far off the motion do not
    count: trackers give 0 to what stands before it moves. Driving backwards can't be recognised. Whole tracks are
    looked at, so that a state is the same in every window.
    """
    order, state = np.lexsort((rows.time, rows.track)), rows.state.copy()
    for mine in np.split(order, np.flatnonzero(np.diff(rows.track[order])) + 1):
        if not by_positions and not np.isnan(state[mine, 4]).any():
            continue
        step = rows.time[mine] - rows.time[mine[0]]
        if by_positions:
            place, valid = np.zeros((1, step[-1] + 1, 2)), np.zeros((1, step[-1] + 1), np.bool_)
            place[0, step], valid[0, step] = state[mine, :2], True
            # The line reaches over 4 sigma: at least to the next step.
            state[mine, 2:4] = local_line(place, valid, dt, max(SIGMA, dt / 4))[1][0, step]
        course = _nearest_course(state[mine, 2:4], step)
        off = by_positions & (np.abs(wrap(state[mine, 4] - course)) > OFF)
        state[mine, 4] = np.where(off | np.isnan(state[mine, 4]), np.nan_to_num(course), state[mine, 4])
    return replace(rows, state=state)


def _nearest_course(velocity: Doubles, step: NDArray[np.int64]) -> Doubles:
    """Return [N] direction of motion at the nearest step at which an agent moves; NaN if it never does."""
    known = np.flatnonzero(np.hypot(*velocity.T) > WALKING)
    if not len(known):
        return np.full(len(step), np.nan)
    middle = (step[known[1:]] + step[known[:-1]]) / 2
    return np.asarray(np.arctan2(*velocity[known[np.searchsorted(middle, step)]].T[::-1]))
