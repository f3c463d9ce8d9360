"""Does a reader do what it promises? :func:`check_reader` finds out, for our readers and for anybody's.

:func:`~symphony.data.segment.validate` sees shapes and ranges only; metres per second that are miles per hour fit the
schema as well. Here segments are looked at for what the schema means: units, frames, sides and directions, in numbers
that are pooled over all segments given, so that the odd spike of a real log does not count.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.data.resample import wrap
from symphony.data.segment import AgentType, Polylines, RunSegment, content_hash, validate
from symphony.data.sources.base import Item, Reader, UnexpectedError
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError

SHOWN = 3
"""Cases of one failure that a report spells out."""

Doubles = NDArray[np.float64]
Bools = NDArray[np.bool_]

SLOW, MOVING = 2.0, 3.0
"""m/s above which speeds and headings are compared."""
SPAN = 1.0
"""Seconds over which positions and velocities are compared."""
BESIDE = 2.5
"""Metres within which a moving vehicle should find a lane that runs its way."""
MAX_SAMPLES = 2000
"""Vehicle states per segment that are compared with the map."""


@dataclass
class Conformance:
    """What a check of a reader or of segments has found.

    Attributes:
        segments: how many were checked.
        skipped: records the reader gave an error for instead.
        numbers: those of :data:`RANGES`.
        failures: check -> what is wrong; empty if all is well.
    """

    segments: int = 0
    skipped: list[DataError] = field(default_factory=list)
    numbers: dict[str, float] = field(default_factory=dict)
    failures: dict[str, list[str]] = field(default_factory=dict)

    def fail(self, check: str, message: str) -> None:
        """Note a failure."""
        self.failures.setdefault(check, []).append(message)

    def passed(self) -> Conformance:
        """The same, or a :class:`ConformanceError` that names every check that failed."""
        if self.failures:
            raise ConformanceError(self)
        return self

    def __str__(self) -> str:
        lines = [f"{self.segments} segments, {len(self.skipped)} skipped"]
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
    :data:`RANGES`, some of which need segments in which vehicles move.

    Raises:
        ConformanceError: naming every check that failed.
    """
    return _inspected(segments).passed()


def check_reader(reader: Reader, files: Iterable[str | Path]) -> Conformance:
    """Check a reader with a few good files of its format, with moving vehicles.

    Besides the checks of :func:`check_segments`: ``errors`` (nothing but :class:`DataError` comes of reading, and
    it names the file), ``source`` (segments name format and file) and ``determinism`` (reading again, in another
    order, gives equal content). Errors of single records are allowed and reported.

    Raises:
        ConformanceError: naming every check that failed.
    """
    paths = [Path(file) for file in files]
    read = Conformance()
    first = {path: _read(reader, path, read) for path in paths}
    found = [item for items in first.values() for item in items]
    report = _inspected([item for item in found if isinstance(item, RunSegment)])
    report.skipped = [item for item in found if isinstance(item, DataError)]
    report.failures = read.failures | report.failures
    for path, items in first.items():
        for segment in items:
            if isinstance(segment, RunSegment) and (segment.source, segment.file) != (reader.name, path.name):
                report.fail("source", f"{path}: names {segment.source!r} and {segment.file!r}")
    for path in reversed(paths):
        if _hashes(first[path]) != _hashes(_read(reader, path, report)):
            report.fail("determinism", f"{path} read again gives something else")
    return report.passed()


def _inspected(segments: Sequence[RunSegment]) -> Conformance:
    report = Conformance(segments=len(segments))
    if not segments:
        report.fail("segments", "there are none to check")
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
        with tempfile.TemporaryDirectory(prefix="symphony-conformance-") as folder:
            with StoreWriter(Path(folder) / "store") as writer:
                for segment in segments:
                    writer.append(segment)
            if _hashes(segments) != _hashes(SegmentStore(Path(folder) / "store")):
                report.fail("store", "a segment comes back changed")
        report.numbers = measure(segments)
        report.failures |= implausible(report.numbers)
    return report


def _read(reader: Reader, path: Path, report: Conformance) -> list[Item]:
    """What a file gives, with everything it must never give noted."""
    items: list[Item] = []
    try:
        items.extend(reader.read(path))
    except Exception as error:  # whatever it is, it is the finding
        report.fail("errors", f"{path}: raises {type(error).__name__}: {error}")
    named = {str(path), *map(str, reader.companions(path))}
    for item in items:
        if isinstance(item, UnexpectedError):
            report.fail("errors", f"{path}: raises {item.message}")
        if isinstance(item, DataError) and str(item.file) not in named:
            report.fail("errors", f"{path}: the error names the file {item.file}: {item.message}")
    if not items:
        report.fail("errors", f"{path}: gives neither a segment nor an error")
    return items


def _hashes(items: Iterable[Item]) -> list[str]:
    """Content hash and group per segment, an empty text per error."""
    segments = (item if isinstance(item, RunSegment) else None for item in items)
    return ["" if s is None else f"{content_hash(s)} {s.group or s.segment_id}" for s in segments]


class Range(NamedTuple):
    """Where a number must lie.

    Attributes:
        check: the check it belongs to; a check by several numbers holds if all do.
        low: the smallest plausible value.
        high: the largest plausible value.
        pool: how the values of all segments become one number.
        says: what the number is.
        optional: whether there may be nothing to take it from.
    """

    check: str
    low: float
    high: float
    pool: Any
    says: str
    optional: bool = False


_P99 = partial(np.percentile, q=99)
RANGES: dict[str, Range] = {
    "dt_min": Range("time step", 0.01, 1.0, np.min, "shortest time step in s"),
    "dt_max": Range("time step", 0.01, 1.0, np.max, "longest time step in s"),
    "ego_from_origin": Range(
        "re-centred", 0, 1000, np.max, "largest distance of an ego's first position in m"
    ),
    "leftovers": Range("masked", 0, 0, np.sum, "numbers other than 0 where an agent is not valid"),
    "speed_ratio": Range("speed", 0.9, 1.1, np.median, "median of (distance covered / time) / speed"),
    "speed_mismatch": Range(
        "speed", 0, 0.2, np.mean, "share of spans whose velocity is not their positions'"
    ),
    "speed_p99": Range("speed", 0, 60, _P99, "99th percentile of the speed in m/s"),
    "heading_error": Range("heading", 0, 0.15, np.median, "median angle of heading and motion in rad"),
    "heading_mismatch": Range("heading", 0, 0.1, np.mean, "share of moving vehicles that point elsewhere"),
    "vehicle_length": Range("size", 3, 9, np.median, "median length of vehicles in m"),
    "vehicle_width": Range("size", 1.2, 3, np.median, "median width of vehicles in m"),
    "vehicle_slender": Range("size", 0.9, 1, np.mean, "share of vehicles at least as long as wide"),
    "vehicle_height": Range("size", 0.8, 4, np.median, "median height of vehicles in m where known", True),
    "pedestrian_width": Range("size", 0.2, 1.5, np.median, "median width of pedestrians in m", True),
    "cyclist_length": Range("size", 1, 3, np.median, "median length of cyclists in m", True),
    "lane_loops": Range("successors", 0, 0, np.sum, "lanes that succeed themselves"),
    "lane_gap": Range("successors", 0, 0.1, np.mean, "share of successors over 3 m from their lane's end"),
    "neighbor_side": Range("neighbours", 0.9, 1, np.mean, "share of neighbours on the side named", True),
    "neighbor_along": Range("neighbours", 0.95, 1, np.mean, "share of neighbours of like direction", True),
    "lane_width": Range("lanes", 1, 8, np.median, "median width of lanes in m where known", True),
    "speed_limit": Range("lanes", 2, 45, np.median, "median speed limit in m/s where known", True),
    "off_lane": Range("lanes", 0, 0.5, np.mean, "share of moving vehicles on no lane that runs their way"),
    "off_road": Range(
        "boundary", 0, 0.2, np.mean, "share of moving vehicles on the side that is not drivable"
    ),
}
"""Every number of :func:`measure` and where it must lie."""


def measure(segments: Sequence[RunSegment]) -> dict[str, float]:
    """The numbers of :data:`RANGES` over valid segments; NaN where there is nothing to take one from."""
    parts: list[dict[str, Any]] = [{**_motion(s), **_sizes(s), **_graph(s), **_on_map(s)} for s in segments]
    pooled = {name: np.concatenate([np.atleast_1d(part[name]) for part in parts]) for name in RANGES}
    return {name: float(RANGES[name].pool(v)) if len(v) else np.nan for name, v in pooled.items()}


def implausible(numbers: dict[str, float]) -> dict[str, list[str]]:
    """Check -> what is wrong, for the numbers outside their range, and those missing that may not be."""
    found: dict[str, list[str]] = {}
    for name, limits in RANGES.items():
        value = numbers[name]
        # NaN is no value inside: a check that had nothing to look at has not been passed.
        if not (limits.low <= value <= limits.high or (np.isnan(value) and limits.optional)):
            what = "could not be taken: nothing to look at" if np.isnan(value) else f"is {value:.4g}"
            message = f"{name} ({limits.says}) {what}, expected {limits.low:g} to {limits.high:g}"
            found.setdefault(limits.check, []).append(message)
    return found


def _moving(s: RunSegment) -> Bools:
    """[A, T] states of vehicles that move."""
    vehicle = (s.agent_type == AgentType.VEHICLE)[:, None]
    return s.valid & vehicle & (np.hypot(s.velocity[..., 0], s.velocity[..., 1]) > MOVING)


def _motion(s: RunSegment) -> dict[str, Any]:
    first = s.position[s.ego, np.argmax(s.valid[s.ego])]
    covered, velocity = _spans(s)
    speed, logged = np.hypot(*covered.T), np.hypot(*velocity.T)
    fast = np.maximum(speed, logged) > SLOW
    apart = np.hypot(*(covered - velocity).T) > np.maximum(1.0, 0.3 * np.maximum(speed, logged))
    driving = _moving(s)
    course = np.arctan2(s.velocity[driving][:, 1], s.velocity[driving][:, 0])
    angle = np.abs(wrap((course - s.heading[driving]).astype(np.float64)))
    return {
        "dt_min": s.dt,
        "dt_max": s.dt,
        "ego_from_origin": np.linalg.norm(first.astype(np.float64)),
        "leftovers": sum(np.count_nonzero(array[~s.valid]) for array in (s.position, s.heading, s.velocity)),
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
    throughout: Bools = seen[:, lag + 1 :] - seen[:, : -lag - 1] == lag + 1
    covered = (s.position[:, lag:, :2].astype(np.float64) - s.position[:, :-lag, :2]) / (lag * s.dt)
    return covered[throughout], ((means[:, lag:] - means[:, :-lag]) / lag)[throughout]


def _sizes(s: RunSegment) -> dict[str, Any]:
    vehicles = s.size[s.agent_type == AgentType.VEHICLE]
    return {
        "vehicle_length": vehicles[:, 0],
        "vehicle_width": vehicles[:, 1],
        "vehicle_slender": vehicles[:, 0] >= vehicles[:, 1],
        "vehicle_height": vehicles[vehicles[:, 2] > 0, 2],
        "pedestrian_width": s.size[s.agent_type == AgentType.PEDESTRIAN, 1],
        "cyclist_length": s.size[s.agent_type == AgentType.CYCLIST, 0],
    }


def _graph(s: RunSegment) -> dict[str, Any]:
    road = s.road
    points, offsets = road.lanes.points[:, :2].astype(np.float64), road.lanes.offsets
    before, after = road.successors.T
    gap = np.hypot(*(points[offsets[after]] - points[offsets[before + 1] - 1]).T)
    sides = [(a, b, 1.0) for a, b in road.left_neighbors] + [(a, b, -1.0) for a, b in road.right_neighbors]
    beside = [pair for side in sides if (pair := _beside(s, *side)) is not None]
    found = np.array(beside, np.bool_).reshape(-1, 2)
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
    points = [s.road.lanes[k][:, :2].astype(np.float64) for k in (lane, other)]
    if min(map(len, points)) < 2:
        return None
    mine, theirs = map(shapely.LineString, points)
    if min(mine.length, theirs.length) == 0:
        return None
    spot = min(mine, theirs, key=lambda line: line.length).interpolate(0.5, normalized=True)
    (here, along), (there, onward) = (_foot(line, spot) for line in (mine, theirs))
    across = there - here
    return bool(sign * (along[0] * across[1] - along[1] * across[0]) > 0), bool(along @ onward > 0)


def _foot(line: shapely.LineString, spot: shapely.Point) -> tuple[Doubles, Doubles]:
    """(nearest point [2], step of the line around it [2])."""
    at = line.project(spot)
    points = [line.interpolate(np.clip(at + step, 0, line.length)) for step in (0, -0.5, 0.5)]
    here, before, after = (np.array(point.coords[0]) for point in points)
    return here, after - before


def _on_map(s: RunSegment) -> dict[str, Any]:
    """Which moving vehicles find no lane along their heading (within 0.6 rad), or are right of the nearest edge."""
    moving = _moving(s)
    every = max(1, int(np.ceil(moving.sum() / MAX_SAMPLES)))
    place = s.position[moving][::every, :2].astype(np.float64)
    heading = s.heading[moving][::every].astype(np.float64)
    spots = shapely.points(place)
    start, way = _edges(s.road.lanes)
    tree = shapely.STRtree(shapely.linestrings(np.stack([start, start + way], axis=1)))
    spot, lane = tree.query(spots, predicate="dwithin", distance=BESIDE)
    off_lane = np.ones(len(spots), np.bool_)
    off_lane[spot[np.abs(wrap(np.arctan2(*way[lane].T[::-1]) - heading[spot])) < 0.6]] = False
    start, way = _edges(s.road.boundary)
    if not len(start) or not len(spots):
        return {"off_lane": off_lane, "off_road": np.zeros(0, np.bool_)}
    tree = shapely.STRtree(shapely.linestrings(np.stack([start, start + way], axis=1)))
    spot, edge = tree.query_nearest(spots)
    away = place[spot] - start[edge]
    left = (way[edge, 0] * away[:, 1] - way[edge, 1] * away[:, 0]) / np.maximum(np.hypot(*way[edge].T), 1e-9)
    # At a corner two edges are equally near: the one that it lies farther beside says on which side it is.
    order = np.lexsort((-np.abs(left), spot))
    _, first = np.unique(spot[order], return_index=True)
    return {"off_lane": off_lane, "off_road": left[order][first] < 0}


def _edges(lines: Polylines) -> tuple[Doubles, Doubles]:
    """(start, way to its end) [N, 2] of the edges of all lines; a line of one point is an edge of no length."""
    points = lines.points[:, :2].astype(np.float64)
    last = np.isin(np.arange(len(points)), lines.offsets[1:] - 1)
    alone = last & np.isin(np.arange(len(points)), lines.offsets[:-1])
    start = np.flatnonzero(~last | alone)
    return points[start], points[np.where(alone[start], start, start + 1)] - points[start]
