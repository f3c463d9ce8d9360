"""Numbers that tell whether run segments mean what the schema says: units, frames, sides and directions.

:func:`validate` sees shapes and ranges only; metres per second that are miles per hour fit the schema as well. These
numbers are pooled over all segments given, so that the odd spike of a real log does not count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
import torch
from numpy.typing import NDArray

from symphony.data.resample import wrap
from symphony.data.segment import AgentType, RunSegment
from symphony.geometry import segments_of, signed_distance

Doubles = NDArray[np.float64]

SLOW, MOVING = 2.0, 3.0
"""m/s above which speeds and headings are compared."""
SPAN = 1.0
"""Seconds over which positions and velocities are compared."""
BESIDE = 2.5
"""Metres within which a moving vehicle should find a lane that runs its way."""
MAX_SAMPLES = 2000
"""Vehicle states per segment that are compared with the map."""


@dataclass(frozen=True)
class Range:
    """Where a number must lie.

    Attributes:
        check: the check it belongs to.
        low, high: smallest and largest plausible value.
        says: what the number is.
        optional: whether there may be nothing to take it from.
    """

    check: str
    low: float
    high: float
    says: str
    optional: bool = False


RANGES: dict[str, Range] = {
    "dt_min": Range("time step", 0.01, 1.0, "shortest time step in s"),
    "dt_max": Range("time step", 0.01, 1.0, "longest time step in s"),
    "ego_from_origin": Range(
        "re-centred", 0, 1000, "largest distance of an ego's first position from 0 in m"
    ),
    "leftovers": Range("masked", 0, 0, "numbers other than 0 where an agent is not valid"),
    "speed_ratio": Range("speed", 0.9, 1.1, "median of (distance covered / time) / speed"),
    "speed_mismatch": Range("speed", 0, 0.2, "share of spans whose velocity is not that of the positions"),
    "speed_p99": Range("speed", 0, 60, "99th percentile of the speed in m/s"),
    "heading_error": Range("heading", 0, 0.15, "median angle between heading and motion of vehicles in rad"),
    "heading_mismatch": Range(
        "heading", 0, 0.1, "share of moving vehicles that point over 0.5 rad elsewhere"
    ),
    "vehicle_length": Range("size", 3, 9, "median length of vehicles in m"),
    "vehicle_width": Range("size", 1.2, 3, "median width of vehicles in m"),
    "vehicle_slender": Range("size", 0.9, 1, "share of vehicles at least as long as wide"),
    "vehicle_height": Range("size", 0.8, 4, "median height of vehicles in m where known", optional=True),
    "pedestrian_width": Range("size", 0.2, 1.5, "median width of pedestrians in m", optional=True),
    "cyclist_length": Range("size", 1, 3, "median length of cyclists in m", optional=True),
    "lane_loops": Range("successors", 0, 0, "lanes that succeed themselves"),
    "lane_gap": Range("successors", 0, 0.1, "share of successors that start over 3 m from their lane's end"),
    "neighbor_side": Range("neighbours", 0.9, 1, "share of neighbours on the side named", optional=True),
    "neighbor_along": Range("neighbours", 0.95, 1, "share of neighbours of like direction", optional=True),
    "lane_width": Range("lanes", 1, 8, "median width of lanes in m where known", optional=True),
    "speed_limit": Range("lanes", 2, 45, "median speed limit in m/s where known", optional=True),
    "off_lane": Range("lanes", 0, 0.5, "share of moving vehicles with no lane along their way within 2.5 m"),
    "off_road": Range("boundary", 0, 0.2, "share of moving vehicles on the side that is not drivable"),
}
"""Every number of :func:`measure` and where it must lie; checks by several numbers hold if all do."""


def measure(segments: Sequence[RunSegment]) -> dict[str, float]:
    """The numbers of :data:`RANGES` over valid segments; NaN where there is nothing to take one from."""
    moving = [_moving(segment) for segment in segments]
    parts: list[dict[str, Any]] = [
        {**_frame(s), **_motion(s), **_sizes(s), **_graph(s), **_on_map(s, m)}
        for s, m in zip(segments, moving, strict=True)
    ]
    pooled = {name: np.concatenate([np.atleast_1d(part[name]) for part in parts]) for name in _POOL}
    return {name: float(_POOL[name](values)) if len(values) else np.nan for name, values in pooled.items()}


def implausible(numbers: dict[str, float]) -> dict[str, list[str]]:
    """Check -> what is wrong, for the numbers outside their range, and those missing that may not be."""
    found: dict[str, list[str]] = {}
    for name, limits in RANGES.items():
        value = numbers[name]
        if np.isnan(value) and limits.optional:
            continue
        if not limits.low <= value <= limits.high:
            # NaN lands here too: a check that had nothing to look at has not been passed.
            what = "could not be taken: nothing to look at" if np.isnan(value) else f"is {value:.4g}"
            message = f"{name} ({limits.says}) {what}, expected {limits.low:g} to {limits.high:g}"
            found.setdefault(limits.check, []).append(message)
    return found


def _p99(values: Doubles) -> float:
    return float(np.percentile(values, 99))


_POOL: dict[str, Callable[[Any], Any]] = {
    "dt_min": np.min,
    "dt_max": np.max,
    "ego_from_origin": np.max,
    "leftovers": np.sum,
    "speed_ratio": np.median,
    "speed_mismatch": np.mean,
    "speed_p99": _p99,
    "heading_error": np.median,
    "heading_mismatch": np.mean,
    "vehicle_length": np.median,
    "vehicle_width": np.median,
    "vehicle_slender": np.mean,
    "vehicle_height": np.median,
    "pedestrian_width": np.median,
    "cyclist_length": np.median,
    "lane_loops": np.sum,
    "lane_gap": np.mean,
    "neighbor_side": np.mean,
    "neighbor_along": np.mean,
    "lane_width": np.median,
    "speed_limit": np.median,
    "off_lane": np.mean,
    "off_road": np.mean,
}


def _moving(s: RunSegment) -> NDArray[np.bool_]:
    """[A, T] states of vehicles that move."""
    vehicle = (s.agent_type == AgentType.VEHICLE)[:, None]
    return s.valid & vehicle & (np.hypot(s.velocity[..., 0], s.velocity[..., 1]) > MOVING)


def _frame(s: RunSegment) -> dict[str, Any]:
    first = s.position[s.ego, np.argmax(s.valid[s.ego])]
    left = (np.count_nonzero(array[~s.valid]) for array in (s.position, s.heading, s.velocity))
    return {
        "dt_min": s.dt,
        "dt_max": s.dt,
        "ego_from_origin": np.linalg.norm(first.astype(np.float64)),
        "leftovers": sum(left),
    }


def _motion(s: RunSegment) -> dict[str, Any]:
    covered, velocity = _spans(s)
    speed, logged = np.hypot(*covered.T), np.hypot(*velocity.T)
    fast = np.maximum(speed, logged) > SLOW
    apart = np.hypot(*(covered - velocity).T) > np.maximum(1.0, 0.3 * np.maximum(speed, logged))
    driving = _moving(s)
    course = np.arctan2(s.velocity[driving][:, 1], s.velocity[driving][:, 0])
    angle = np.abs(wrap((course - s.heading[driving]).astype(np.float64)))
    return {
        "speed_ratio": speed[fast] / np.maximum(logged[fast], 1e-6),
        "speed_mismatch": apart[fast],
        "speed_p99": np.hypot(*s.velocity[s.valid].T),
        "heading_error": angle,
        "heading_mismatch": angle > 0.5,
    }


def _spans(s: RunSegment) -> tuple[Doubles, Doubles]:
    """(distance covered / time, mean logged velocity) [N, 2] over spans of :data:`SPAN`, or all there is.

    From one step to the next, real positions jitter by more than velocities differ between units.
    """
    lag = int(np.clip(round(SPAN / s.dt), 1, s.num_steps - 1))
    velocity = s.velocity.astype(np.float64)
    means = np.cumsum((velocity[:, 1:] + velocity[:, :-1]) / 2, axis=1)
    means = np.pad(means, ((0, 0), (1, 0), (0, 0)))
    seen = np.pad(np.cumsum(s.valid, axis=1), ((0, 0), (1, 0)))
    throughout: NDArray[np.bool_] = seen[:, lag + 1 :] - seen[:, : -lag - 1] == lag + 1
    covered = (s.position[:, lag:, :2].astype(np.float64) - s.position[:, :-lag, :2]) / (lag * s.dt)
    return covered[throughout], ((means[:, lag:] - means[:, :-lag]) / lag)[throughout]


def _sizes(s: RunSegment) -> dict[str, Any]:
    vehicles, walkers, riders = (
        s.size[s.agent_type == kind] for kind in (AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.CYCLIST)
    )
    return {
        "vehicle_length": vehicles[:, 0],
        "vehicle_width": vehicles[:, 1],
        "vehicle_slender": vehicles[:, 0] >= vehicles[:, 1],
        "vehicle_height": vehicles[vehicles[:, 2] > 0, 2],
        "pedestrian_width": walkers[:, 1],
        "cyclist_length": riders[:, 0],
    }


def _graph(s: RunSegment) -> dict[str, Any]:
    road = s.road
    points, offsets = road.lanes.points[:, :2].astype(np.float64), road.lanes.offsets
    before, after = road.successors.T
    gap = np.hypot(*(points[offsets[after]] - points[offsets[before + 1] - 1]).T)
    beside = [_beside(s, a, b, 1.0) for a, b in road.left_neighbors.tolist()]
    beside += [_beside(s, a, b, -1.0) for a, b in road.right_neighbors.tolist()]
    found = np.array([pair for pair in beside if pair is not None], np.bool_).reshape(-1, 2)
    return {
        "lane_loops": (before == after).sum(),
        "lane_gap": gap > 3.0,
        "neighbor_side": found[:, 0],
        "neighbor_along": found[:, 1],
        "lane_width": road.lane_width[np.isfinite(road.lane_width)],
        "speed_limit": road.speed_limit[np.isfinite(road.speed_limit)],
    }


def _beside(s: RunSegment, lane: int, other: int, sign: float) -> tuple[bool, bool] | None:
    """Whether the other lane is on that side and runs the same way, at the middle of the shorter of the two."""
    lines = [shapely.LineString(p) if len(p) > 1 else None for p in (_line(s, lane), _line(s, other))]
    mine, theirs = lines
    if mine is None or theirs is None or min(mine.length, theirs.length) == 0:
        return None
    spot = min(mine, theirs, key=lambda line: line.length).interpolate(0.5, normalized=True)
    (here, along), (there, onward) = (_foot(line, spot) for line in (mine, theirs))
    across = there - here
    return bool(sign * (along[0] * across[1] - along[1] * across[0]) > 0), bool(along @ onward > 0)


def _line(s: RunSegment, lane: int) -> Doubles:
    return s.road.lanes[lane][:, :2].astype(np.float64)


def _foot(line: shapely.LineString, spot: shapely.Point) -> tuple[Doubles, Doubles]:
    """(nearest point [2], step of the line around it [2])."""
    at = line.project(spot)
    points = [line.interpolate(np.clip(at + step, 0, line.length)) for step in (0, -0.5, 0.5)]
    here, before, after = (np.array(point.coords[0]) for point in points)
    return here, after - before


def _on_map(s: RunSegment, moving: NDArray[np.bool_]) -> dict[str, Any]:
    every = max(1, int(np.ceil(moving.sum() / MAX_SAMPLES)))
    spots = s.position[moving][::every, :2]
    heading = s.heading[moving][::every].astype(np.float64)
    return {"off_lane": ~_near_lane(s, spots, heading), "off_road": _off_road(s, spots)}


def _near_lane(s: RunSegment, spots: NDArray[np.float32], heading: Doubles) -> NDArray[np.bool_]:
    """[M] a lane within :data:`BESIDE` runs along the heading (within 0.6 rad)."""
    start, end, _, _ = segments_of(s.road.lanes.points.astype(np.float64), s.road.lanes.offsets)
    tree = shapely.STRtree(shapely.linestrings(np.stack([start, end], axis=1)))
    spot, lane = tree.query(shapely.points(spots.astype(np.float64)), predicate="dwithin", distance=BESIDE)
    angle = np.arctan2(*(end - start)[lane].T[::-1])
    found = np.zeros(len(spots), np.bool_)
    found[spot[np.abs(wrap(angle - heading[spot])) < 0.6]] = True
    return found


def _off_road(s: RunSegment, spots: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[M] on the right of the nearest boundary; nothing at all where there is no boundary."""
    if not len(s.road.boundary):
        return np.zeros(0, np.bool_)
    cut = segments_of(s.road.boundary.points, s.road.boundary.offsets)
    start, end, before, after = (torch.as_tensor(part)[None] for part in cut)
    known = torch.ones(start.shape[:2], dtype=torch.bool)
    found = [
        signed_distance(torch.as_tensor(spots[k : k + 500].copy())[None], start, end, known, before, after)[0]
        for k in range(0, len(spots), 500)
    ]
    return torch.cat(found).numpy() > 0 if found else np.zeros(0, np.bool_)
