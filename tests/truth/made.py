"""The parts of scenes with known values: ways, a road, and segments of them.

A road along +x with two lanes east (y = -1.75 and -5.25) and one west (y = 1.75), and one across to the north at
x = 165. Lights of the eastern lanes are at x = 150. All boxes of cars are 4.5 m by 1.8 m. Metres, seconds, radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from helpers_segments import make_road, make_segment
from symphony.data.segment import AgentType, LaneType, RoadMap, RunSegment, SignalState

SECONDS = 8.0
OWN, RIGHT, WEST, NORTH = -1.75, -5.25, 1.75, math.pi / 2
STOP = 150.0
CAR, WALKER = (4.5, 1.8), (0.6, 0.6)
GREEN, RED = SignalState.GO, SignalState.STOP


@dataclass(frozen=True)
class Track:
    """A way: straight at constant speed, but for braking (or speeding up) and going aside, each in a span of time."""

    x: float  # at time 0
    y: float
    speed: float  # along the heading at time 0, negative for backwards
    heading: float = 0.0  # of the whole way; going aside turns it by no more than its angle
    change: tuple[float, float, float] = (0.0, 0.0, 0.0)  # begin, end, m/s^2 of the speed
    aside: tuple[float, float, float] = (0.0, 1.0, 0.0)  # begin, end, metres to the left
    turned: bool = True  # whether the heading follows when it goes aside
    size: tuple[float, float] = CAR
    kind: AgentType = AgentType.VEHICLE
    there: tuple[float, float] = (-1.0, 99.0)  # seconds from and until which it is seen
    z: float = 0.0  # of the road below it

    def at(self, time: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Positions [T, 2], headings [T] and velocities [T, 2]."""
        begin, end, rate = self.change
        spent = np.clip(time - begin, 0, end - begin)
        speed = self.speed + rate * spent
        along = self.speed * time + rate * (0.5 * spent**2 + spent * np.clip(time - end, 0, None))
        begin, end, left = self.aside
        share = np.clip((time - begin) / (end - begin), 0, 1)
        sideways = np.where((time >= begin) & (time < end), left / (end - begin), 0.0)
        forward = np.array([math.cos(self.heading), math.sin(self.heading)])
        across = np.array([-forward[1], forward[0]])
        place = np.array([self.x, self.y]) + along[:, None] * forward + (left * share)[:, None] * across
        velocity = speed[:, None] * forward + sideways[:, None] * across
        turn = np.arctan2(sideways, speed) if self.turned and left else np.zeros_like(time)
        return place, self.heading + turn, velocity


@dataclass(frozen=True)
class Case:
    """A scene, and what must be said of it and why."""

    name: str  # cases of several speeds end with theirs
    why: str
    ego: Track  # its box is a car's unless it says otherwise
    others: tuple[Track, ...] = ()
    right: dict[str, Any] = field(default_factory=dict)  # by the name of the number, see test_truth.check
    log: Track | None = None  # what the ego does in the log; by default the same
    light: tuple[tuple[float, SignalState], ...] = ()  # of the eastern lanes: second and state
    lanes: bool = True  # whether the map has lanes that cars drive in
    boundary: bool = True
    bridge: float = 0.0  # height of the road across over the other one
    deck: float = 0.0  # height of a road to the west above the own lane; 0 for none


def _line(*ends: tuple[float, float]) -> NDArray[Any]:
    first, last = np.array(ends, float)
    count = max(2, round(float(np.hypot(*(last - first))) / 4) + 1)
    return first + np.linspace(0, 1, count)[:, None] * (last - first)


@cache
def road(lanes: bool, boundary: bool, bridge: float, deck: float) -> RoadMap:
    """The one of all scenes; its eastern lanes are cut at the lights."""
    paved = shapely.box(-100, -7, 500, 3.5), shapely.box(163.25, -120, 166.75, 120)
    areas = [*zip(paved, (0.0, bridge), strict=True)] if bridge else [(shapely.union(*paved), 0.0)]
    areas += [(shapely.box(-100, -3.5, 500, 0), deck)] if deck else []
    rings = [shapely.force_3d(shapely.geometry.polygon.orient(area, 1.0), z) for area, z in areas]
    edges = [shapely.get_coordinates(ring, include_z=True) for ring in rings]
    east = [_line((x0, y), (x1, y)) for y in (OWN, RIGHT) for x0, x1 in ((-100.0, STOP), (STOP, 500.0))]
    across = _line((165, -120), (165, 120))
    lines = [*east, _line((500, WEST), (-100, WEST)), np.insert(across, 2, bridge, axis=1)]
    lines += [np.insert(_line((500, OWN), (-100, OWN)), 2, deck, axis=1)] if deck else []
    joined = [(0, 1), (2, 3)], [(2, 0), (3, 1)], [(0, 2), (1, 3)]  # ahead, to the left, to the right
    found = make_road(lines, *joined, boundary=edges if boundary else [])
    # Nobody drives on lanes for bikes.
    return found if lanes else replace(found, lane_type=np.full(len(lines), LaneType.BIKE_LANE, np.uint8))


def segment_of(case: Case, dt: float, phase: float) -> tuple[RunSegment, NDArray[Any]]:
    """The log of a case and what the ego does instead, states [U, 4], at times ``(k + phase) * dt``."""
    time = (np.arange(round(SECONDS / dt) + 1) + phase) * dt
    tracks = [case.log or case.ego, *case.others]
    parts = [track.at(time) for track in tracks]
    position, heading, velocity = (np.stack(part) for part in zip(*parts, strict=True))
    middle = np.array([track.z + 0.8 for track in tracks])[:, None, None]
    position = np.concatenate([position, np.broadcast_to(middle, (*position.shape[:2], 1))], -1)
    seen = np.stack([(time >= track.there[0]) & (time <= track.there[1]) for track in tracks])
    changes: dict[str, Any] = {
        "valid": seen,
        "size": np.array([(*track.size, 1.6) for track in tracks], np.float32),
        "agent_type": np.array([track.kind for track in tracks], np.uint8),
    }
    if case.light:
        begins = np.array([begin for begin, _ in case.light])
        state = np.array([state for _, state in case.light], np.uint8)
        now = state[np.searchsorted(begins, time, side="right") - 1]
        changes |= {
            "signal_lane": np.array([0, 2], np.int32),
            "signal_point": np.array([[STOP, OWN, 0], [STOP, RIGHT, 0]], np.float32),
            "signal_state": np.stack([now, now]),
        }
    for part in (position, velocity, heading):
        part[~seen] = 0
    made = make_segment(
        road(case.lanes, case.boundary, case.bridge, case.deck), position, heading, velocity, dt, case.name,
        **changes,
    )  # fmt: skip
    place, turn, moved = case.ego.at(time)
    speed = (moved * np.stack([np.cos(turn), np.sin(turn)], -1)).sum(-1)
    return made, np.concatenate([place, turn[:, None], speed[:, None]], -1)
