"""Limits of the schema: what is absurd is refused, what is merely odd is counted.

The sizes keep one record of a log, whatever it claims to hold, within some hundred megabytes of memory; readers look
at them before they allocate anything.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from symphony.errors import DataError

if TYPE_CHECKING:
    from symphony.data.segment import Polylines, RoadMap, RunSegment

MAX_COORDINATE = 20_000.0
"""Metres from the origin beyond which float32 no longer resolves a millimetre; segments must be re-centred."""
MAX_HEIGHT = 10_000.0
"""Metres above or below the origin."""
MAX_ORIGIN = 1e8
"""Metres; map projections count in the millions."""
MIN_DT, MAX_DT = 0.005, 5.0
"""Seconds per step."""
MAX_SPEED = 350.0
"""m/s; nothing on wheels was ever faster."""
MAX_JUMP = 1000.0
"""Metres from one step to the next."""
MIN_SIZE, MAX_SIZE = 0.05, 100.0
"""Metres of a box's side."""
MAX_HEADING = 1000.0
"""Radians: headings need not be wrapped, but nobody turns that often."""
MAX_WIDTH = 1000.0
"""Metres of a lane."""
MAX_NAME = 200
"""Characters of a segment's id, its source, its group and the name of its file."""

MAX_STEPS = 10_000
"""Steps of a segment: a quarter of an hour at 10 Hz."""
MAX_AGENTS = 5_000
MAX_STATES = 2_000_000
"""Agents times steps."""
MAX_POINTS = 1_000_000
"""Points of a map."""
MAX_LENGTH = 5e6
"""Metres of all lines of a map."""
MAX_FILE = 64 << 20
"""Bytes of a file that is read as a whole (CommonRoad, Argoverse 2)."""

ODD_SPEED = 70.0
ODD_JUMP = 100.0
ODD_SMALL, ODD_LARGE = 0.2, 30.0
ODD_DT = (0.02, 1.0)
ODD_HEADING = 8 * np.pi
ODD_FAR = 5_000.0

Check = tuple[str, bool, str]
"""Field, whether it holds, and what is wrong if it doesn't."""


def check_counts(agents: int, steps: int, field: str) -> None:
    """Refuse more agents or steps than a segment may have, before room is made for them.

    Raises:
        DataError: naming ``field``.
    """
    for count, most, what in (
        (steps, MAX_STEPS, "steps"),
        (agents, MAX_AGENTS, "agents"),
        (agents * steps, MAX_STATES, "states (agents times steps)"),
    ):
        if count > most:
            raise DataError(f"{count} {what}, at most {most} are read: cut the log", field=field)


def check_signals(lights: int, steps: int, field: str) -> None:
    """Likewise for traffic lights.

    Raises:
        DataError: naming ``field``.
    """
    if lights * steps > 10 * MAX_STATES:
        raise DataError(f"{lights} lights at {steps} steps, too many to read", field=field)


def size_checks(s: RunSegment) -> Iterator[Check]:
    """The counts and names; before anything that is slow on large arrays."""
    steps, agents = s.valid.shape[-1] if s.valid.ndim else 0, len(s.agent_id)
    yield "valid", steps <= MAX_STEPS, f"{steps} steps, at most {MAX_STEPS}: cut the log"
    states = agents * steps
    yield "agent_id", agents <= MAX_AGENTS, f"{agents} agents, at most {MAX_AGENTS}"
    yield "valid", states <= MAX_STATES, f"{states} states, at most {MAX_STATES}: cut the log"
    for name in ("segment_id", "source", "file", "group"):
        text = getattr(s, name)
        yield name, len(text) <= MAX_NAME, f"{len(text)} characters, at most {MAX_NAME}"
        yield name, not text or text.isprintable(), "holds characters that can't be printed"
    points = sum(len(lines.points) for lines in (s.road.lanes, s.road.boundary, s.road.marks))
    yield "road", points <= MAX_POINTS, f"{points} map points, at most {MAX_POINTS}"


def value_checks(s: RunSegment) -> Iterator[Check]:
    """The values; after shapes, dtypes and that they are finite."""
    yield "dt", MIN_DT <= s.dt <= MAX_DT, f"{s.dt:g} s, expected {MIN_DT:g} to {MAX_DT:g}"
    yield _most("size", -s.size[:, :2], -MIN_SIZE, f"a side of less than {MIN_SIZE:g} m")
    yield "size", bool((s.size[:, 2] >= 0).all()), "a height below 0"
    speed = _largest(s.velocity)
    yield "velocity", speed <= MAX_SPEED, f"{speed:.4g} m/s, at most {MAX_SPEED:g} is plausible"
    turn = _largest(s.heading)
    yield "heading", turn <= MAX_HEADING, f"{turn:.4g} rad, at most {MAX_HEADING:g} is plausible"
    jump = float(_jumps(s).max(initial=0))
    yield "position", jump <= MAX_JUMP, f"a jump of {jump:.4g} m in a step, at most {MAX_JUMP:g} is plausible"
    height = _largest(s.position[..., 2])
    yield "position", height <= MAX_HEIGHT, f"a height of {height:.4g} m: not re-centred"
    far = _largest(s.signal_point)
    yield "signal_point", far <= MAX_COORDINATE, f"{far:.4g} m from the origin: not re-centred"
    far = _largest(s.origin)
    yield "origin", far <= MAX_ORIGIN, f"{far:.4g} m, at most {MAX_ORIGIN:g}"
    yield from _road_checks(s.road)


def _road_checks(road: RoadMap) -> Iterator[Check]:
    for name in ("lanes", "boundary", "marks"):
        points = getattr(road, name).points
        far = _largest(points[:, :2])
        message = f"{far:.4g} m from the origin, at most {MAX_COORDINATE:g}"
        yield f"road.{name}", far <= MAX_COORDINATE, message
        height = _largest(points[:, 2])
        message = f"a height of {height:.4g} m, at most {MAX_HEIGHT:g}"
        yield f"road.{name}", height <= MAX_HEIGHT, message
    lines = (road.lanes, road.boundary, road.marks)
    length = sum(map(line_length, lines))
    yield "road", length <= MAX_LENGTH, f"{length:.4g} m of lines, at most {MAX_LENGTH:g}"
    for name, most in (("speed_limit", MAX_SPEED), ("lane_width", MAX_WIDTH)):
        array = getattr(road, name)
        yield _most(f"road.{name}", array[~np.isnan(array)], most, f"more than {most:g}")


def oddities(segment: RunSegment) -> list[str]:
    """What is unusual about a valid segment: worth a look where it is frequent, no reason to leave it out."""
    s, seen = segment, segment.valid
    sides = s.size[seen.any(1), :2]
    points = (s.road.lanes.points, s.road.boundary.points, s.road.marks.points)
    found = {
        f"an agent faster than {ODD_SPEED:g} m/s": _largest(s.velocity[seen]) > ODD_SPEED,
        f"an agent that jumps, at over {ODD_JUMP:g} m/s": bool((_jumps(s) > ODD_JUMP * s.dt + 1).any()),
        f"a box with a side under {ODD_SMALL:g} m": bool((sides < ODD_SMALL).any()),
        f"a box with a side over {ODD_LARGE:g} m": bool((sides > ODD_LARGE).any()),
        f"a time step outside {ODD_DT[0]:g} to {ODD_DT[1]:g} s": not ODD_DT[0] <= s.dt <= ODD_DT[1],
        "a heading that has turned more than 4 times": _largest(s.heading[seen]) > ODD_HEADING,
        f"a map that reaches beyond {ODD_FAR / 1000:g} km": max(map(_largest, points)) > ODD_FAR,
        "lights known for less than half of the time (see --hold-lights)": _now_and_then(s.signal_state),
    }
    return [what for what, applies in found.items() if applies]


def _now_and_then(state: NDArray[np.integer[Any]]) -> bool:
    """Whether lights [K, T] that have a state at some step have none (0) at most others."""
    share = (state != 0).mean(1)
    return bool(((share > 0) & (share < 0.5)).any())


def _jumps(s: RunSegment) -> NDArray[np.float64]:
    """[A, T - 1] metres from each step to the next, 0 where an agent is not valid at both."""
    way = np.hypot(*np.moveaxis(np.diff(s.position[..., :2].astype(np.float64), axis=1), -1, 0))
    return np.where(s.valid[:, 1:] & s.valid[:, :-1], way, 0.0)


def line_length(lines: Polylines) -> float:
    """Metres of all lines."""
    sides = np.hypot(*np.diff(lines.points[:, :2].astype(np.float64), axis=0).T)
    owner = lines.line_index
    return float(sides[owner[1:] == owner[:-1]].sum())


def _largest(array: NDArray[Any]) -> float:
    return float(np.abs(array).max(initial=0))


def _most(field: str, array: NDArray[Any], most: float, message: str) -> Check:
    return field, bool((array <= most).all()), message
