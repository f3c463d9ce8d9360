"""Checks that a reader keeps its contract: :func:`check_reader`, for our readers and for others.

:func:`~symphony.data.segment.validate` sees shapes and ranges only; speeds in miles per hour fit the schema as well.
Here segments are checked for what the schema means: units, frames, sides and directions, in numbers that are pooled
over all segments given, so that a rare spike in a real log does not count.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.data.odd import MOVING, spans, speed_ratios
from symphony.data.segment import AgentType, Polylines, RunSegment, content_hash, validate, wrap
from symphony.data.sources.base import Item, Reader, UnexpectedError
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError

Doubles = NDArray[np.float64]

BESIDE = 2.5  # metres within which a moving vehicle should find a lane that runs its way, within 0.6 rad

RANGES: dict[str, tuple[str, float, float, Any, str]] = {
    "dt": ("time step", 0.01, 1.0, np.median, "median time step in s"),
    "ego_from_origin": ("re-centred", 0, 1000, np.max, "metres from the origin to an ego's first position"),
    "leftovers": ("masked", 0, 0, np.sum, "numbers other than 0 where an agent is not valid"),
    "speed_ratio": ("speed", 0.9, 1.1, np.median, "median of (distance covered / time) / speed"),
    "speed_mismatch": ("speed", 0, 0.2, np.mean, "share of spans whose velocity is not their positions'"),
    "heading_mismatch": ("heading", 0, 0.1, np.mean, "share of moving vehicles that point elsewhere"),
    "vehicle_length": ("size", 3, 9, np.median, "median length of vehicles in m"),
    "vehicle_width": ("size", 1.2, 3, np.median, "median width of vehicles in m"),
    "lane_gap": ("successors", 0, 0.1, np.mean, "share of successors over 3 m from their lane's end"),
    "neighbor_side": ("neighbours", 0.9, 1, np.mean, "share of neighbours on the side named"),
    "neighbor_along": ("neighbours", 0.95, 1, np.mean, "share of neighbours of like direction"),
    "lane_width": ("lanes", 1, 8, np.median, "median width of lanes in m where known"),
    "speed_limit": ("lanes", 2, 45, np.median, "median speed limit in m/s where known"),
    "off_lane": ("lanes", 0, 0.5, np.mean, "share of moving vehicles on no lane that runs their way"),
    "off_road": ("boundary", 0, 0.2, np.mean, "share of moving vehicles on the side not drivable"),
}
"""Numbers taken over all segments: check, least and most, how values are pooled, and what the number is."""
OPTIONAL = ("neighbor_side", "neighbor_along", "lane_width", "speed_limit")
"""Numbers for which a format may have nothing to take them from."""


@dataclass
class Conformance:
    """The findings of a check of a reader or of segments."""

    segments: int = 0  # how many were checked
    skipped: list[DataError] = field(default_factory=list)  # what the reader gave for records instead
    numbers: dict[str, float] = field(default_factory=dict)  # those of RANGES; NaN where there is none
    failures: dict[str, list[str]] = field(default_factory=dict)  # check -> what is wrong

    def fail(self, check: str, message: str) -> None:
        """Record a failure."""
        self.failures.setdefault(check, []).append(message)

    def passed(self) -> Conformance:
        """Return this object, or raise a :class:`ConformanceError` that names every check that failed."""
        if self.failures:
            raise ConformanceError(self)
        return self


class ConformanceError(AssertionError):
    """A reader or its segments break the contract; ``report`` says how."""

    def __init__(self, report: Conformance) -> None:
        self.report = report
        lines = [f"  {check}: {message}" for check, found in report.failures.items() for message in found]
        super().__init__("\n".join([f"{report.segments} segments, {len(report.skipped)} skipped", *lines]))


def check_segments(segments: Sequence[RunSegment]) -> Conformance:
    """Check run segments of one source, whatever made them.

    Checks: ``schema`` (validation), ``ids`` (unique), ``store`` (survives the store unchanged), and those of
    :data:`RANGES`, some of which need segments in which vehicles move. Raises a :class:`ConformanceError`.
    """
    return _inspected(segments, Conformance()).passed()


def check_reader(reader: Reader, files: Iterable[str | Path]) -> Conformance:
    """Check a reader with a few good files of its format, with moving vehicles.

    Beside :func:`check_segments`: ``errors`` (reading raises nothing but :class:`DataError`, which names the file),
    ``source`` (segments name format and file) and ``determinism`` (reading again, in another order, gives equal
    content). Errors of single records are allowed and reported. A :class:`ConformanceError` names all that failed.
    """
    paths = [Path(file) for file in files]
    report = Conformance()
    first = {path: _read(reader, path, report) for path in paths}
    found = [item for items in first.values() for item in items]
    report.skipped = [item for item in found if isinstance(item, DataError)]
    _inspected([item for item in found if isinstance(item, RunSegment)], report)
    for path, items in first.items():
        for segment in items:
            if isinstance(segment, RunSegment) and (segment.source, segment.file) != (reader.name, path.name):
                report.fail("source", f"{path}: names {segment.source!r} and {segment.file!r}")
    for path in reversed(paths):
        if _hashes(first[path]) != _hashes(_read(reader, path, report)):
            report.fail("determinism", f"{path} read again gives something else")
    return report.passed()


def _read(reader: Reader, path: Path, report: Conformance) -> list[Item]:
    """Return what a file yields, and report everything that it must never yield."""
    items: list[Item] = []
    try:
        items.extend(reader.read(path))
    except Exception as error:  # whatever it is, it is the finding
        report.fail("errors", f"{path}: raises {type(error).__name__}: {error}")
    named = {str(path), *map(str, reader.companions(path))}
    for item in items:
        if isinstance(item, UnexpectedError) or (isinstance(item, DataError) and str(item.file) not in named):
            report.fail("errors", f"{path}: gives an error of the file {item.file}: {item.message}")
    if not items:
        report.fail("errors", f"{path}: gives neither a segment nor an error")
    return items


def _hashes(items: Iterable[Item]) -> list[str]:
    """Return the content hash and group of each segment, and an empty text for each error."""
    segments = (item if isinstance(item, RunSegment) else None for item in items)
    return ["" if s is None else f"{content_hash(s)} {s.group or s.segment_id}" for s in segments]


def _inspected(segments: Sequence[RunSegment], report: Conformance) -> Conformance:
    report.segments = len(segments)
    sound = bool(segments)
    if not segments:
        report.fail("segments", "there are none to check")
    for segment in segments:
        try:
            validate(segment)
        except DataError as error:
            report.fail("schema", str(error))
            sound = False
    ids = [segment.segment_id for segment in segments]
    for name in sorted({name for name in ids if ids.count(name) > 1}):
        report.fail("ids", f"{ids.count(name)} segments are called {name!r}")
        sound = False
    if not sound:
        return report  # whatever follows takes the schema, and the store unique names, for granted
    with tempfile.TemporaryDirectory(prefix="symphony-conformance-") as folder:
        with StoreWriter(Path(folder) / "store") as writer:
            for segment in segments:
                writer.append(segment)
        if _hashes(segments) != _hashes(SegmentStore(Path(folder) / "store")):
            report.fail("store", "a segment comes back changed")
    parts: list[dict[str, Any]] = [{**_motion(s), **_graph(s), **_on_map(s)} for s in segments]
    for name, (check, low, high, pool, says) in RANGES.items():
        values = np.concatenate([np.atleast_1d(part[name]) for part in parts])
        value = report.numbers[name] = float(pool(values)) if len(values) else np.nan
        # NaN is no value inside: a check that had nothing to look at has not been passed.
        if not (low <= value <= high or (np.isnan(value) and name in OPTIONAL)):
            report.fail(check, f"{name} ({says}) is {value:.4g}, expected {low:g} to {high:g}")
    return report


def _moving(s: RunSegment) -> NDArray[np.bool_]:
    """Return [A, T] which states are of moving vehicles."""
    vehicle = (s.agent_type == AgentType.VEHICLE)[:, None]
    return s.valid & vehicle & (np.hypot(s.velocity[..., 0], s.velocity[..., 1]) > MOVING)


def _motion(s: RunSegment) -> dict[str, Any]:
    covered, logged = spans(s)
    faster = np.maximum(np.hypot(*covered.T), np.hypot(*logged.T))
    velocity = s.velocity.astype(np.float64)
    driving = _moving(s)
    course = np.arctan2(velocity[driving][:, 1], velocity[driving][:, 0])
    vehicles = s.size[s.agent_type == AgentType.VEHICLE]
    return {
        "dt": s.dt,
        "ego_from_origin": np.linalg.norm(s.position[s.ego, np.argmax(s.valid[s.ego])]),
        "leftovers": sum(np.count_nonzero(array[~s.valid]) for array in (s.position, s.heading, s.velocity)),
        "speed_ratio": speed_ratios(covered, logged),
        "speed_mismatch": np.hypot(*(covered - logged).T) > np.maximum(1.0, 0.3 * faster),
        "heading_mismatch": np.abs(wrap(course - s.heading[driving])) > 0.3,
        "vehicle_length": vehicles[:, 0],
        "vehicle_width": vehicles[:, 1],
    }


def _graph(s: RunSegment) -> dict[str, Any]:
    road = s.road
    points, offsets = road.lanes.points[:, :2].astype(np.float64), road.lanes.offsets
    before, after = road.successors.T
    gap = np.hypot(*(points[offsets[after]] - points[offsets[before + 1] - 1]).T)
    pairs = [(a, b, 1.0) for a, b in road.left_neighbors] + [(a, b, -1.0) for a, b in road.right_neighbors]
    long = np.diff(offsets) > 1
    fine = (pair for pair in pairs if long[pair[0]] and long[pair[1]])
    found = np.array([_beside(road.lanes, *pair) for pair in fine], np.bool_).reshape(-1, 2)
    return {
        "lane_gap": (gap > 3.0) | (before == after),
        "neighbor_side": found[:, 0],
        "neighbor_along": found[:, 1],
        "lane_width": road.lane_width[np.isfinite(road.lane_width)],
        "speed_limit": road.speed_limit[np.isfinite(road.speed_limit)],
    }


def _beside(lanes: Polylines, lane: int, other: int, sign: float) -> tuple[bool, bool]:
    """Return whether the other lane is on that side of the middle of the one, and runs the same way there."""
    mine, theirs = (lanes[k][:, :2].astype(np.float64) for k in (lane, other))
    middle = len(mine) // 2
    nearest = int(np.hypot(*(theirs - mine[middle]).T).argmin())
    along, onward = np.gradient(mine, axis=0)[middle], np.gradient(theirs, axis=0)[nearest]
    across = theirs[nearest] - mine[middle]
    return bool(sign * (along[0] * across[1] - along[1] * across[0]) > 0), bool(along @ onward > 0)


def _on_map(s: RunSegment) -> dict[str, Any]:
    """Return which moving vehicles find no lane along their heading, or are right of the nearest edge."""
    moving = _moving(s)
    place = s.position[moving][:, :2].astype(np.float64)
    spots = shapely.points(place)
    start, way = _edges(s.road.lanes)
    tree = shapely.STRtree(shapely.linestrings(np.stack([start, start + way], axis=1)))
    spot, lane = tree.query(spots, predicate="dwithin", distance=BESIDE)
    off_lane = np.ones(len(spots), np.bool_)
    course = np.arctan2(way[lane, 1], way[lane, 0])
    off_lane[spot[np.abs(wrap(course - s.heading[moving][spot])) < 0.6]] = False
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
    """Return (start, vector to its end) [N, 2] of the edges of all lines."""
    points = lines.points[:, :2].astype(np.float64)
    start = np.setdiff1d(np.arange(len(points)), lines.offsets[1:] - 1)
    return points[start], points[start + 1] - points[start]
