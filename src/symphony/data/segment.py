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

from symphony.data import bounds
from symphony.errors import DataError

Floats = NDArray[np.float32]
Ints = NDArray[np.integer[Any]]
Bools = NDArray[np.bool_]
Check = tuple[str, bool, str]
"""Field, whether it holds, and what is wrong if it doesn't."""


class AgentType(IntEnum):
    """What a track is (WOMD's numbering)."""

    UNSET = 0
    VEHICLE = 1
    PEDESTRIAN = 2
    CYCLIST = 3
    OTHER = 4


class LaneType(IntEnum):
    """What a lane is (WOMD's numbering)."""

    UNDEFINED = 0
    FREEWAY = 1
    SURFACE_STREET = 2
    BIKE_LANE = 3


class MarkType(IntEnum):
    """Map features that are neither lanes nor road boundary."""

    UNDEFINED = 0
    ROAD_LINE = 1
    CROSSWALK = 2
    SPEED_BUMP = 3
    DRIVEWAY = 4
    STOP_SIGN = 5


class SignalState(IntEnum):
    """State of a traffic light for one lane (WOMD's numbering)."""

    UNKNOWN = 0
    ARROW_STOP = 1
    ARROW_CAUTION = 2
    ARROW_GO = 3
    STOP = 4
    CAUTION = 5
    GO = 6
    FLASHING_STOP = 7
    FLASHING_CAUTION = 8


@dataclass(frozen=True)
class Polylines:
    """Ragged polylines: line k is ``points[offsets[k]:offsets[k + 1]]``.

    Attributes:
        points: [P, 3] x, y, z in metres (z = 0 where the source has none), float32.
        offsets: [K + 1] int64, rising from 0 to P.
    """

    points: Floats
    offsets: Ints

    @classmethod
    def of(cls, lines: Sequence[NDArray[Any]]) -> Polylines:
        """Build from arrays [P_k, 2 or 3], one per line."""
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
        """[P] the line each point belongs to."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))


@dataclass(frozen=True)
class RoadMap:
    """Lane graph, road boundary and markings.

    Attributes:
        lanes: centre lines in the direction of travel (single points where the source has no more).
        lane_id: [L] int64, the source's own ids (unique).
        lane_type: [L] uint8, :class:`LaneType`.
        speed_limit: [L] float32 m/s, NaN where unknown.
        lane_width: [L] float32 metres, NaN where unknown.
        successors: [E, 2] int32 lane indices (from, to): traffic flows from the end of one into the other.
            Predecessors are the same pairs read backwards.
        left_neighbors: [E', 2] int32 (lane, the lane on its left that a lane change may reach, same direction).
        right_neighbors: [E'', 2] int32 (lane, the one on its right).
        boundary: edge of the drivable area, *oriented: the drivable side is on the left*. Closed rings repeat
            their first point.
        marks: other features (lines, crosswalks, stop signs; a sign is a line of one point).
        mark_type: [K] uint8, :class:`MarkType`.
    """

    lanes: Polylines
    lane_id: Ints
    lane_type: Ints
    speed_limit: Floats
    lane_width: Floats
    successors: Ints
    left_neighbors: Ints
    right_neighbors: Ints
    boundary: Polylines
    marks: Polylines
    mark_type: Ints


@dataclass(frozen=True)
class RunSegment:
    """A stretch of logged driving: agents, map and lights, at a fixed time step.

    Attributes:
        segment_id: unique name, stable between conversions.
        source: format it came from, such as ``womd``.
        dt: seconds between steps.
        ego: index of the ego agent (the recording vehicle, or the one picked by the reader).
        agent_id: [A] int64, the source's ids (unique).
        agent_type: [A] uint8, :class:`AgentType`.
        size: [A, 3] float32 length, width, height of the box (height 0 where unknown).
        position: [A, T, 3] float32 box centre x, y, z; 0 where not valid.
        heading: [A, T] float32, as logged (not wrapped); 0 where not valid.
        velocity: [A, T, 2] float32, world frame; 0 where not valid.
        valid: [A, T] bool.
        road: the map, in the same frame.
        signal_lane: [Q] int32 index of the lane each light controls.
        signal_point: [Q, 3] float32 its stop point.
        signal_state: [Q, T] uint8, :class:`SignalState` (``UNKNOWN`` where unobserved).
        origin: [3] float64, what was subtracted from the logged coordinates.
        current_step: step up to which the log counts as history (0 where the source has no such notion).
        interest: [I] int32 agents the source marks as interacting.
        predict: [J] int32 agents the source marks for prediction.
        file: name of the file it was read from, without folder.
        group: the recording it is part of. Segments of one recording share it, may overlap in time and are no
            independent samples; empty if unknown, which stands for ``segment_id``. No part of the content hash.
        joined_gaps: links between lanes that conversion has added (see :mod:`symphony.data.joins`); a store keeps it
            as a tag. No part of the content hash.
        odd: what is unusual, or was left out (see :mod:`symphony.data.odd`): kind -> example. A store keeps it as a
            tag. No part of the content hash.
    """

    segment_id: str
    source: str
    dt: float
    ego: int
    agent_id: Ints
    agent_type: Ints
    size: Floats
    position: Floats
    heading: Floats
    velocity: Floats
    valid: Bools
    road: RoadMap
    signal_lane: Ints
    signal_point: Floats
    signal_state: Ints
    origin: NDArray[np.float64]
    current_step: int = 0
    interest: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    predict: Ints = field(default_factory=lambda: np.zeros(0, np.int32))
    file: str = ""
    group: str = field(default="", metadata={"hashed": False})
    joined_gaps: int = field(default=0, metadata={"hashed": False})
    odd: Mapping[str, str] = field(default_factory=dict, metadata={"hashed": False})

    @property
    def num_agents(self) -> int:
        """The number of agents, A."""
        return len(self.agent_id)

    @property
    def num_steps(self) -> int:
        """The number of steps, T."""
        return self.position.shape[1]

    def replace(self, **changes: Any) -> RunSegment:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)


def content_hash(segment: RunSegment) -> str:
    """SHA-256 over every field but ``group``, array dtypes and shapes included; equal content, equal hashes."""
    digest = hashlib.sha256()
    _feed(digest, segment)
    return digest.hexdigest()


def _feed(digest: Any, value: Any) -> None:
    if dataclasses.is_dataclass(value):
        for item in dataclasses.fields(value):
            if not item.metadata.get("hashed", True):
                continue
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

    Returns:
        The segment itself.

    Raises:
        DataError: naming the segment and the first field that breaks the schema.
    """
    for name, ok, message in _checks(segment):
        if not ok:
            raise DataError(message, file=segment.file or None, segment=segment.segment_id, field=name)
    return segment


def _checks(s: RunSegment) -> Iterator[Check]:
    agents, steps = s.num_agents, s.valid.shape[1] if s.valid.ndim == 2 else -1
    yield "segment_id", bool(s.segment_id) and "/" not in s.segment_id, "must be a non-empty name without '/'"
    # The counts come before anything that is slow on large arrays.
    yield "valid", steps <= bounds.MAX_STEPS, f"{steps} steps, at most {bounds.MAX_STEPS}: cut the log"
    yield "agent_id", agents <= bounds.MAX_AGENTS, f"{agents} agents, at most {bounds.MAX_AGENTS}"
    states = agents * steps
    yield "valid", states <= bounds.MAX_STATES, f"{states} states, at most {bounds.MAX_STATES}: cut the log"
    for name in ("segment_id", "source", "file", "group"):
        text = getattr(s, name)
        yield name, len(text) <= bounds.MAX_NAME, f"{len(text)} characters, at most {bounds.MAX_NAME}"
        yield name, not text or text.isprintable(), "holds characters that can't be printed"
    points = sum(len(lines.points) for lines in (s.road.lanes, s.road.boundary, s.road.marks))
    yield "road", points <= bounds.MAX_POINTS, f"{points} map points, at most {bounds.MAX_POINTS}"
    yield "dt", np.isfinite(s.dt) and s.dt > 0, f"must be positive, is {s.dt}"
    yield "valid", s.valid.dtype == np.bool_ and s.valid.shape == (agents, steps), "must be bool [A, T]"
    yield "valid", steps >= 2, f"needs at least 2 steps, has {steps}"
    yield "agent_id", agents >= 1, "has no agents"
    yield "agent_id", len(np.unique(s.agent_id)) == agents, "ids are not unique"
    yield from _array("agent_type", s.agent_type, (agents,), np.uint8, len(AgentType))
    yield from _array("size", s.size, (agents, 3), np.float32)
    yield "size", bool((s.size[:, :2] > 0).all()), "length and width must be positive"
    yield "size", bool((s.size < bounds.MAX_SIZE).all()), f"a side of {bounds.MAX_SIZE:g} m or more"
    yield from _array("position", s.position, (agents, steps, 3), np.float32)
    yield from _array("heading", s.heading, (agents, steps), np.float32)
    yield from _array("velocity", s.velocity, (agents, steps, 2), np.float32)
    far = largest(s.position[..., :2])
    yield "position", far < bounds.MAX_COORDINATE, f"{far:.0f} m from the origin: not re-centred"
    yield "ego", 0 <= s.ego < agents, f"index {s.ego} outside the {agents} agents"
    yield "ego", bool(s.valid[s.ego].any()), "the ego is valid at no step"
    yield from _road_checks(s.road)
    lights = len(s.signal_lane)
    yield from _array("signal_lane", s.signal_lane, (lights,), np.int32, len(s.road.lane_id))
    yield from _array("signal_point", s.signal_point, (lights, 3), np.float32)
    yield from _array("signal_state", s.signal_state, (lights, steps), np.uint8, len(SignalState))
    yield from _array("interest", s.interest, (len(s.interest),), np.int32, agents)
    yield from _array("predict", s.predict, (len(s.predict),), np.int32, agents)
    finite = s.origin.dtype == np.float64 and s.origin.shape == (3,) and bool(np.isfinite(s.origin).all())
    yield "origin", finite, "must be 3 finite numbers, float64"
    yield "current_step", 0 <= s.current_step < steps, f"{s.current_step} outside the {steps} steps"
    yield from _value_checks(s)


def _road_checks(road: RoadMap) -> Iterator[Check]:
    lanes = len(road.lanes)
    yield "road.lanes", lanes >= 1, "has no lanes"
    for name in ("lanes", "boundary", "marks"):
        yield from _polylines(f"road.{name}", getattr(road, name), 2 if name == "boundary" else 1)
    yield "road.lane_id", road.lane_id.shape == (lanes,), "must be [L]"
    yield "road.lane_id", len(np.unique(road.lane_id)) == lanes, "ids are not unique"
    yield from _array("road.lane_type", road.lane_type, (lanes,), np.uint8, len(LaneType))
    for name, most in (("speed_limit", bounds.MAX_SPEED), ("lane_width", bounds.MAX_WIDTH)):
        array = getattr(road, name)
        yield f"road.{name}", array.shape == (lanes,) and array.dtype == np.float32, "must be float32 [L]"
        yield f"road.{name}", bool((np.isnan(array) | (array > 0)).all()), "must be positive or NaN"
        yield f"road.{name}", not (array > most).any(), f"more than {most:g}"
    for name in ("successors", "left_neighbors", "right_neighbors"):
        array = getattr(road, name)
        yield from _array(f"road.{name}", array, (len(array), 2), np.int32, lanes)
    yield from _array("road.mark_type", road.mark_type, (len(road.marks),), np.uint8, len(MarkType))
    length = sum(line_lengths(lines).sum() for lines in (road.lanes, road.boundary, road.marks))
    yield "road", length <= bounds.MAX_LENGTH, f"{length:.4g} m of lines, at most {bounds.MAX_LENGTH:g}"


def _polylines(name: str, lines: Polylines, least: int) -> Iterator[Check]:
    ends = lines.offsets[0] == 0 and lines.offsets[-1] == len(lines.points)
    # Compared, not subtracted: differences of damaged offsets can overflow and look like counts.
    ordered = bool((lines.offsets[1:] >= lines.offsets[:-1]).all())
    yield name, bool(ends) and ordered, "offsets do not match the points"
    short = np.flatnonzero(np.diff(lines.offsets) < least)
    yield name, len(short) == 0, f"line {short[:1]} has fewer than {least} points"
    yield from _array(name, lines.points, (len(lines.points), 3), np.float32)
    far, height = largest(lines.points[:, :2]), largest(lines.points[:, 2])
    message = f"{far:.4g} m from the origin, at most {bounds.MAX_COORDINATE:g}"
    yield name, far <= bounds.MAX_COORDINATE, message
    yield name, height <= bounds.MAX_HEIGHT, f"a height of {height:.4g} m, at most {bounds.MAX_HEIGHT:g}"


def _array(
    name: str, array: NDArray[Any], shape: tuple[int, ...], dtype: Any, below: int | None = None
) -> Iterator[Check]:
    # Names of types are slow to form, and every array of every segment comes through here.
    if array.dtype != dtype:
        yield name, False, f"dtype {array.dtype}, expected {np.dtype(dtype)}"
    if array.shape != shape:
        yield name, False, f"shape {array.shape}, expected {shape}"
    if below is not None:
        yield name, bool(((array >= 0) & (array < below)).all()), f"values outside 0 … {below - 1}"
    elif not np.isfinite(array).all():
        bad = np.argwhere(~np.isfinite(array))
        yield name, False, f"{len(bad)} numbers that are not finite, first at index {bad[:1].tolist()}"


def _value_checks(s: RunSegment) -> Iterator[Check]:
    """What is plausible, once shapes and dtypes are right and numbers finite."""
    least, most = bounds.MIN_DT, bounds.MAX_DT
    yield "dt", least <= s.dt <= most, f"{s.dt:g} s, expected {least:g} to {most:g}"
    small = bool((s.size[:, :2] < bounds.MIN_SIZE).any())
    yield "size", not small, f"a side of less than {bounds.MIN_SIZE:g} m"
    yield "size", bool((s.size[:, 2] >= 0).all()), "a height below 0"
    for name, found, most, unit in (
        ("velocity", largest(s.velocity), bounds.MAX_SPEED, "m/s"),
        ("heading", largest(s.heading), bounds.MAX_HEADING, "rad"),
        ("position", float(jumps(s).max(initial=0)), bounds.MAX_JUMP, "m in a step"),
        ("position", largest(s.position[..., 2]), bounds.MAX_HEIGHT, "m of height"),
        ("signal_point", largest(s.signal_point), bounds.MAX_COORDINATE, "m from the origin"),
        ("origin", largest(s.origin), bounds.MAX_ORIGIN, "m"),
    ):
        yield name, found <= most, f"{found:.4g} {unit}, at most {most:g} is plausible"


def jumps(s: RunSegment) -> NDArray[np.float64]:
    """[A, T - 1] metres from each step to the next, 0 where an agent is not valid at both."""
    way = np.hypot(*np.moveaxis(np.diff(s.position[..., :2].astype(np.float64), axis=1), -1, 0))
    return np.where(s.valid[:, 1:] & s.valid[:, :-1], way, 0.0)


def line_lengths(lines: Polylines) -> NDArray[np.float64]:
    """[K] metres of each line."""
    sides = np.hypot(*np.diff(lines.points[:, :2].astype(np.float64), axis=0).T)
    owner = lines.line_index
    within = owner[1:] == owner[:-1]
    return np.asarray(np.bincount(owner[1:][within], sides[within], minlength=len(lines)), np.float64)


def largest(array: NDArray[Any]) -> float:
    """The largest magnitude; 0 of no numbers."""
    return float(np.abs(array).max(initial=0))
