"""The run segment: one schema for every source of logged driving.

Units: metres, seconds, m/s, radians counter-clockwise from +x. World frame as logged, minus
:attr:`RunSegment.origin`. Legend: A agents, T steps, L lanes, K boundary or marking polylines, P points of all
polylines of one kind, Q traffic lights.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.errors import DataError

MAX_COORDINATE = 20_000.0  # metres from the origin, beyond which float32 no longer resolves a millimetre
MAX_HEIGHT = 10_000.0  # metres above or below the origin
MAX_ORIGIN = 1e8  # metres; map projections count in the millions
MIN_DT, MAX_DT = 0.005, 5.0  # seconds per step
MAX_SPEED = 350.0  # m/s; nothing on wheels was ever faster
MAX_JUMP = 1000.0  # metres from one step to the next
MIN_SIZE, MAX_SIZE = 0.05, 100.0  # metres of a box's side
MAX_HEADING = 1000.0  # radians: headings need not be wrapped, but nobody turns that often
MAX_WIDTH = 1000.0  # metres of a lane
MAX_NAME = 200  # characters of a segment's id, its source, its group and the name of its file

MAX_STEPS = 10_000  # a quarter of an hour at 10 Hz
MAX_AGENTS = 5_000
MAX_STATES = 2_000_000  # agents times steps
MAX_POINTS = 1_000_000  # of a map
MAX_LENGTH = 5e6  # metres of all lines of a map
MAX_FILE = 64 << 20  # bytes of a file that is read as a whole (CommonRoad, Argoverse 2)


def check_counts(agents: int, steps: int, field: str) -> None:
    """Refuse more agents or steps than a segment may have before room is made for them; the error names ``field``."""
    for count, most, what in (
        (steps, MAX_STEPS, "steps"),
        (agents, MAX_AGENTS, "agents"),
        (agents * steps, MAX_STATES, "states (agents times steps)"),
    ):
        if count > most:
            raise DataError(f"{count} {what}, at most {most} are read: cut the log", field=field)


def check_signals(lights: int, steps: int, field: str) -> None:
    """Refuse more states of traffic lights than can be read; the error names ``field``."""
    if lights * steps > 10 * MAX_STATES:
        raise DataError(f"{lights} lights at {steps} steps, too many to read", field=field)


Floats = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]
Bools = NDArray[np.bool_]
Check = tuple[str, bool, str]  # field, whether it holds, and what is wrong if it doesn't
STATES = ("position", "heading", "velocity", "valid")  # a row for each agent, a column for each step
TIMED = (*STATES, "signal_state")


class AgentType(IntEnum):
    """The type of a track (WOMD's numbering)."""

    UNSET = 0
    VEHICLE = 1
    PEDESTRIAN = 2
    CYCLIST = 3
    OTHER = 4


class LaneType(IntEnum):
    """The type of a lane (WOMD's numbering)."""

    UNDEFINED = 0
    FREEWAY = 1
    SURFACE_STREET = 2
    BIKE_LANE = 3


class MarkType(IntEnum):
    """The type of a map feature that is neither a lane nor road boundary."""

    UNDEFINED = 0
    ROAD_LINE = 1
    CROSSWALK = 2
    SPEED_BUMP = 3
    DRIVEWAY = 4
    STOP_SIGN = 5


class SignalState(IntEnum):
    """The state of a traffic light for one lane (WOMD's numbering)."""

    UNKNOWN = 0
    ARROW_STOP = 1
    ARROW_CAUTION = 2
    ARROW_GO = 3
    STOP = 4
    CAUTION = 5
    GO = 6
    FLASHING_STOP = 7
    FLASHING_CAUTION = 8


RED = (SignalState.STOP, SignalState.ARROW_STOP)
AMBER = (SignalState.CAUTION, SignalState.ARROW_CAUTION)
GREEN = (SignalState.GO, SignalState.ARROW_GO)


@dataclass(frozen=True)
class Polylines:
    """Ragged polylines: line k is ``points[offsets[k]:offsets[k + 1]]``."""

    points: Floats  # [P, 3] x, y, z in metres (z = 0 where the source has none), float32
    offsets: Ints  # [K + 1] int64, rising from 0 to P

    @classmethod
    def of(cls, lines: Sequence[NDArray[Any]]) -> Polylines:
        """Build polylines from arrays [P_k, 2 or 3], one per line."""
        arrays = [np.asarray(line, dtype=np.float32).reshape(len(line), -1) for line in lines]
        arrays = [a if a.shape[1] == 3 else np.pad(a, ((0, 0), (0, 1))) for a in arrays]
        offsets = np.cumsum([0, *(len(a) for a in arrays)], dtype=np.int64)
        points = np.concatenate(arrays) if arrays else np.zeros((0, 3), np.float32)
        return cls(points, offsets)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __getitem__(self, k: int) -> Floats:
        if not 0 <= k < len(self):
            raise IndexError(k)
        return self.points[self.offsets[k] : self.offsets[k + 1]]

    @property
    def line_index(self) -> Ints:
        """The line [P] that each point belongs to."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))


@dataclass(frozen=True)
class RoadMap:
    """Lane graph, road boundary and markings."""

    lanes: Polylines  # centre lines in the direction of travel (single points where the source has no more)
    lane_id: Ints  # [L] int64, the source's own ids (unique)
    lane_type: Ints  # [L] uint8, :class:`LaneType`
    speed_limit: Floats  # [L] float32 m/s, NaN where unknown
    lane_width: Floats  # [L] float32 metres, NaN where unknown
    #: [E, 2] int32 lane indices (from, to): traffic flows from the end of one into the other. Predecessors
    #: are the same pairs read backwards.
    successors: Ints
    #: [E', 2] int32 (lane, the lane on its left that a lane change may reach, same direction)
    left_neighbors: Ints
    right_neighbors: Ints  # [E'', 2] int32 (lane, the one on its right)
    #: edge of the drivable area, *oriented: the drivable side is on the left*. Closed rings repeat their first point.
    boundary: Polylines
    marks: Polylines  # other features (lines, crosswalks, stop signs; a sign is a line of one point)
    mark_type: Ints  # [K] uint8, :class:`MarkType`

    @property
    def widths(self) -> NDArray[np.float64]:
        """The widths of lanes [L] in metres, nominal ones where the source does not give them."""
        nominal = np.where(self.lane_type == LaneType.BIKE_LANE, 1.6, 3.6)
        return np.where(np.isnan(self.lane_width), nominal, self.lane_width)


@dataclass(frozen=True)
class RunSegment:
    """A stretch of logged driving: agents, map and lights, at a fixed time step."""

    segment_id: str  # unique name, stable between conversions
    source: str  # format it came from, such as ``womd``
    dt: float  # seconds between steps
    ego: int  # index of the ego agent (the recording vehicle, or the one picked by the reader)
    agent_id: Ints  # [A] int64, the source's ids (unique)
    agent_type: Ints  # [A] uint8, :class:`AgentType`
    size: Floats  # [A, 3] float32 length, width, height of the box (height 0 where unknown)
    position: Floats  # [A, T, 3] float32 box centre x, y, z; 0 where not valid
    heading: Floats  # [A, T] float32, as logged (not wrapped); 0 where not valid
    velocity: Floats  # [A, T, 2] float32, world frame; 0 where not valid
    valid: Bools  # [A, T] bool
    road: RoadMap  # the map, in the same frame
    signal_lane: Ints  # [Q] int32 index of the lane each light controls
    signal_point: Floats  # [Q, 3] float32 its stop point
    signal_state: Ints  # [Q, T] uint8, :class:`SignalState` (``UNKNOWN`` where unobserved)
    origin: NDArray[np.float64]  # [3] float64, what was subtracted from the logged coordinates
    #: step up to which the log counts as history (0 where the source has no such notion)
    current_step: int = 0
    #: [I] int32 agents the source marks as interacting
    interest: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    #: [J] int32 agents the source marks for prediction
    predict: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    file: str = ""  # name of the file it was read from, without folder
    #: the recording it is part of. Segments of one recording share it, may overlap in time and are not independent
    #: samples; empty if unknown, which stands for ``segment_id``. Not part of the content hash.
    group: str = field(default="", metadata={"hashed": False})
    #: links between lanes that conversion has added (see :mod:`symphony.data.joins`); a store keeps it as a tag. Not
    #: part of the content hash.
    joined_gaps: int = field(default=0, metadata={"hashed": False})
    #: what is unusual, or was left out (see :mod:`symphony.data.odd`): kind -> example. A store keeps it as a tag.
    #: Not part of the content hash.
    odd: Mapping[str, str] = field(default_factory=dict, metadata={"hashed": False})
    #: x, y where the ego is to come past, which its log does not show (a planning problem of CommonRoad). A store
    #: keeps it as a tag. Part of the content hash where there is one.
    goal: list[float] | None = field(default=None, metadata={"hashed": "given"})
    #: number of logged steps, if the segment goes on past its log (:mod:`symphony.rollouts.onward`); 0 if all steps
    #: are logged. Not part of the content hash, and never in a store.
    logged: int = field(default=0, metadata={"hashed": False})

    @property
    def num_agents(self) -> int:
        """The number of agents, A."""
        return len(self.agent_id)

    @property
    def num_steps(self) -> int:
        """The number of steps, T."""
        return self.position.shape[1]

    @property
    def log_steps(self) -> int:
        """The number of logged steps."""
        return self.logged or self.num_steps

    def replace(self, **changes: Any) -> RunSegment:
        """Return a copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def during(self, steps: slice, **changes: Any) -> RunSegment:
        """Return what is known of some of the steps, with other fields changed."""
        return self.replace(**{name: getattr(self, name)[:, steps] for name in TIMED}, **changes)


def content_hash(segment: RunSegment | RoadMap) -> str:
    """Return SHA-256 over all fields that are hashed, with dtypes and shapes; equal content, equal hashes."""
    digest = hashlib.sha256()
    _feed(digest, segment)
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    if dataclasses.is_dataclass(value):
        for item in dataclasses.fields(value):
            hashed = item.metadata.get("hashed", True)
            if hashed is True or (hashed and getattr(value, item.name) is not None):
                digest.update(item.name.encode() + b"=")
                _feed(digest, getattr(value, item.name))
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    else:
        digest.update(repr(value).encode())
    digest.update(b";")


def validate(segment: RunSegment) -> RunSegment:
    """Check the whole schema: sizes, dtypes, shapes, ranges, indices, finite and plausible numbers.

    Returns the segment itself, or raises a :class:`DataError` that names it and the first field that is wrong.
    """
    for name, ok, message in _checks(segment):
        if not ok:
            raise DataError(message, file=segment.file or None, segment=segment.segment_id, field=name)
    return segment


def _checks(s: RunSegment) -> Iterator[Check]:
    agents, steps = s.num_agents, s.valid.shape[1] if s.valid.ndim == 2 else -1
    lights, lanes = len(s.signal_lane), len(s.road.lane_id)
    yield "segment_id", bool(s.segment_id) and "/" not in s.segment_id, "must be a non-empty name without '/'"
    # The counts come before anything that is slow on large arrays.
    points = sum(len(lines.points) for lines in (s.road.lanes, s.road.boundary, s.road.marks))
    for name, count, least, most, what in (
        ("valid", steps, 2, MAX_STEPS, "steps"),
        ("agent_id", agents, 1, MAX_AGENTS, "agents"),
        ("valid", agents * steps, 1, MAX_STATES, "states"),
        ("road", points, 0, MAX_POINTS, "map points"),
    ):
        fits = least <= count <= most or s.valid.ndim != 2
        yield name, fits, f"{count} {what}, allowed are {least} to {most}"
    for name in ("segment_id", "source", "file", "group"):
        text = getattr(s, name)
        yield name, len(text) <= MAX_NAME, f"{len(text)} characters, at most {MAX_NAME}"
        yield name, not text or text.isprintable(), "holds characters that can't be printed"
    yield "valid", s.valid.dtype == np.bool_ and s.valid.shape == (agents, steps), "must be bool [A, T]"
    yield from _array("agent_id", s.agent_id, (agents,), np.int64)
    yield "agent_id", len(np.unique(s.agent_id)) == agents, "ids are not unique"
    yield from _array("agent_type", s.agent_type, (agents,), np.uint8, len(AgentType))
    yield from _array("size", s.size, (agents, 3), np.float32)
    yield from _array("position", s.position, (agents, steps, 3), np.float32)
    yield from _array("heading", s.heading, (agents, steps), np.float32)
    yield from _array("velocity", s.velocity, (agents, steps, 2), np.float32)
    far = largest(s.position[..., :2])
    yield "position", far < MAX_COORDINATE, f"{far:.0f} m from the origin: not re-centred"
    yield "ego", 0 <= s.ego < agents, f"index {s.ego} outside the {agents} agents"
    yield "ego", bool(s.valid[s.ego].any()), "the ego is valid at no step"
    yield from _road_checks(s.road)
    yield from _array("signal_lane", s.signal_lane, (lights,), np.int32, lanes)
    yield from _array("signal_point", s.signal_point, (lights, 3), np.float32)
    yield from _array("signal_state", s.signal_state, (lights, steps), np.uint8, len(SignalState))
    yield from _array("interest", s.interest, (len(s.interest),), np.int32, agents)
    yield from _array("predict", s.predict, (len(s.predict),), np.int32, agents)
    yield from _array("origin", s.origin, (3,), np.float64)
    place = s.goal is None or (isinstance(s.goal, list) and [type(x) for x in s.goal] == [float, float])
    place = place and all(abs(x) < MAX_COORDINATE for x in s.goal or ())
    yield "goal", place, "must be None or a list of x and y, floats near the origin"
    yield "logged", 0 <= s.logged <= steps, f"{s.logged} outside the {steps} steps"
    yield "current_step", 0 <= s.current_step < steps, f"{s.current_step} outside the {steps} steps"
    sides = MIN_SIZE, MAX_SIZE
    plausible: tuple[tuple[str, float, float, float, float, str], ...] = (
        ("dt", s.dt, s.dt, MIN_DT, MAX_DT, "s"),
        ("size", s.size[:, :2].min(), largest(s.size), *sides, "m: length and width must be positive"),
        ("size", s.size[:, 2].min(), 0, 0, MAX_SIZE, "m of height"),
        ("velocity", 0, largest(s.velocity), 0, MAX_SPEED, "m/s"),
        ("heading", 0, largest(s.heading), 0, MAX_HEADING, "rad"),
        ("position", 0, float(jumps(s).max(initial=0)), 0, MAX_JUMP, "m in a step"),
        ("position", 0, largest(s.position[..., 2]), 0, MAX_HEIGHT, "m of height"),
        ("signal_point", 0, largest(s.signal_point), 0, MAX_COORDINATE, "m from the origin"),
        ("origin", 0, largest(s.origin), 0, MAX_ORIGIN, "m"),
    )
    for name, low, high, lowest, highest, unit in plausible:
        fits = lowest <= low and high <= highest
        worst = low if low < lowest else high
        yield name, fits, f"{worst:.4g} {unit}, plausible are {lowest:g} to {highest:g}"


def _road_checks(road: RoadMap) -> Iterator[Check]:
    lanes = len(road.lanes)
    yield "road.lanes", lanes >= 1, "has no lanes"
    for name, least in (("lanes", 1), ("boundary", 2), ("marks", 1)):
        yield from _polylines(f"road.{name}", getattr(road, name), least)
    yield from _array("road.lane_id", road.lane_id, (lanes,), np.int64)
    yield "road.lane_id", len(np.unique(road.lane_id)) == lanes, "ids are not unique"
    yield from _array("road.lane_type", road.lane_type, (lanes,), np.uint8, len(LaneType))
    for name, most in (("speed_limit", MAX_SPEED), ("lane_width", MAX_WIDTH)):
        array = getattr(road, name)
        yield f"road.{name}", array.shape == (lanes,) and array.dtype == np.float32, "must be float32 [L]"
        fits = np.isnan(array) | ((array > 0) & (array <= most))
        yield f"road.{name}", bool(fits.all()), f"must be NaN or positive and at most {most:g}"
    for name in ("successors", "left_neighbors", "right_neighbors"):
        array = getattr(road, name)
        yield from _array(f"road.{name}", array, (len(array), 2), np.int32, lanes)
    yield from _array("road.mark_type", road.mark_type, (len(road.marks),), np.uint8, len(MarkType))
    length = sum(line_lengths(lines).sum() for lines in (road.lanes, road.boundary, road.marks))
    yield "road", length <= MAX_LENGTH, f"{length:.4g} m of lines, at most {MAX_LENGTH:g}"


def _polylines(name: str, lines: Polylines, least: int) -> Iterator[Check]:
    yield name, lines.offsets.dtype == np.int64, "offsets must be int64"
    ends = lines.offsets[0] == 0 and lines.offsets[-1] == len(lines.points)
    # Compared, not subtracted: differences of damaged offsets can overflow and look like counts.
    ordered = bool((lines.offsets[1:] >= lines.offsets[:-1]).all())
    yield name, bool(ends) and ordered, "offsets do not match the points"
    short = np.flatnonzero(np.diff(lines.offsets) < least)
    yield name, len(short) == 0, f"line {short[:1]} has fewer than {least} points"
    yield from _array(name, lines.points, (len(lines.points), 3), np.float32)
    far, height = largest(lines.points[:, :2]), largest(lines.points[:, 2])
    fits = far <= MAX_COORDINATE and height <= MAX_HEIGHT
    most = f"at most {MAX_COORDINATE:g} and {MAX_HEIGHT:g}"
    yield name, fits, f"{far:.4g} m from the origin or {height:.4g} m of height, {most}"


def _array(
    name: str, array: NDArray[Any], shape: tuple[int, ...], dtype: Any, below: int | None = None
) -> Iterator[Check]:
    # Messages are slow to form, and every array of every segment comes through here.
    if array.dtype != dtype or array.shape != shape:
        found = f"is {array.dtype} {list(array.shape)}, expected {np.dtype(dtype)} {list(shape)}"
        yield name, False, found
    if below is not None:
        yield name, bool(((array >= 0) & (array < below)).all()), f"values outside 0 … {below - 1}"
    elif not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))
        yield name, False, f"{len(bad)} numbers that are not finite, first at index {bad[:1].tolist()}"


def jumps(s: RunSegment) -> NDArray[np.float64]:
    """Return [A, T - 1] metres from each step to the next, 0 where an agent is not valid at both."""
    way = np.hypot(*np.moveaxis(np.diff(s.position[..., :2].astype(np.float64), axis=1), -1, 0))
    return np.where(s.valid[:, 1:] & s.valid[:, :-1], way, 0.0)


def line_lengths(lines: Polylines) -> NDArray[np.float64]:
    """Return [K] metres, the length of each line."""
    sides = np.hypot(*np.diff(lines.points[:, :2].astype(np.float64), axis=0).T)
    owner = lines.line_index
    within = owner[1:] == owner[:-1]
    return np.asarray(np.bincount(owner[1:][within], sides[within], minlength=len(lines)), np.float64)


def largest(array: NDArray[Any]) -> float:
    """Return the largest magnitude; 0 if there are no numbers."""
    return float(np.abs(array).max(initial=0))


def wrap(angle: Any) -> Any:
    """Return the same angles in [-π, π)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
