"""The lane graph of one map and the choices it offers. Metres, radians counter-clockwise, the map's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.errors import DataError

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]
Bools = NDArray[np.bool_]


class Near(NamedTuple):
    """Pairs of a point and a line within reach of it, each [K]."""

    point: Indices  # index of the point
    line: Indices  # index of the line
    distance: Reals  # metres between the two
    along: Reals  # metres from the line's start to its nearest place
    heading: Reals  # direction of the line there, radians

    def only(self, keep: Bools | Indices) -> Near:
        """Return some of the pairs."""
        point, line, distance, along, heading = self
        return Near(point[keep], line[keep], distance[keep], along[keep], heading[keep])


class LineIndex:
    """A spatial index over polylines [P_k, 2] in metres, without repeated points."""

    def __init__(self, lines: Sequence[Reals]) -> None:
        self.geometry = line_strings(lines)
        self._tree = shapely.STRtree(self.geometry)
        steps = [np.diff(line, axis=0) for line in lines]
        lengths = [np.hypot(*step.T) for step in steps]
        counts = np.array([len(step) for step in steps], dtype=np.int64)
        self._first = np.concatenate(([0], np.cumsum(counts)))
        step = np.concatenate(steps) if steps else np.zeros((0, 2))
        self._heading = np.arctan2(step[:, 1], step[:, 0])
        total = np.array([length.sum() for length in lengths], dtype=np.float64)
        self._base = np.concatenate(([0.0], np.cumsum(total)))[:-1]
        begins = [base + np.cumsum(length) - length for base, length in zip(self._base, lengths, strict=True)]
        self._begin = np.concatenate(begins) if begins else np.zeros(0)

    def near(self, points: Reals, reach: float) -> Near:
        """Return all pairs of a point [n, 2] and a line at most ``reach`` metres apart, by point, then line."""
        geometry = shapely.points(points)
        point, line = self._tree.query(geometry, predicate="dwithin", distance=reach)
        order = np.lexsort((line, point))
        point, line = point[order], line[order]
        distance = shapely.distance(self.geometry[line], geometry[point])
        along = shapely.line_locate_point(self.geometry[line], geometry[point])
        return Near(point, line, distance, along, self.heading(line, along))

    def heading(self, line: NDArray[Any], along: Reals) -> Reals:
        """Return the direction of lines [K] at ``along`` [K] metres from their start."""
        segment = np.searchsorted(self._begin, self._base[line] + along, side="right") - 1
        return self._heading[np.clip(segment, self._first[line], self._first[line + 1] - 1)]


def arc_lengths(line: Reals) -> Reals:
    """Return the metres [P] from the beginning of a line to each of its points."""
    way = line[1:] - line[:-1]
    arc = np.zeros(len(line))
    np.cumsum(np.hypot(way[:, 0], way[:, 1]), out=arc[1:])
    return arc


def line_strings(lines: Sequence[Reals]) -> NDArray[Any]:
    """Return [lines] shapely geometries of polylines [P_k, 2], all made at once."""
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    return shapely.linestrings(np.concatenate([*lines, np.zeros((0, 2))]), indices=owner)


def turn_between(a: Reals, b: Reals) -> Reals:
    """Return the absolute difference of two headings, in [0, pi]."""
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)


FAR = 5.0  # metres between lanes from which on a link says that the map lacks what is between them: none leads there
BIKE_LANE = 3  # the lane type that vehicles keep off (see ``LaneType``)


@dataclass(frozen=True)
class Regions:
    """Branching regions: the alternatives at each place where a lane has more than one successor. Two regions with
    one parent are alternatives of a choice. A lane is a region once for each branching predecessor.
    """

    lane: Indices  # [R] the lane that is the region
    parent: Indices  # [R] the lane before it, at whose end the choice is made
    curvature: Reals  # [R] average signed curvature of the lane, 1/m, positive to the left
    entry: Reals  # [R, 2] first point of the lane
    entry_heading: Reals  # [R] direction of the lane there

    def __len__(self) -> int:
        return len(self.lane)


class LaneGraph:
    """Lanes, how they connect, and their shapes; built once per map.

    Lanes for bicycles, and those that are a single point (WOMD has some, as stubs), keep their index but are
    not connected to anything and match no position. Takes a :class:`symphony.data.segment.RoadMap`, and raises a
    :class:`DataError` for a connection to a lane that does not exist.

    Attributes:
        lines: centre lines [P_k, 2], float64, repeated points dropped.
        arc: per lane, the metres [P_k] from its start to each of its points.
        usable: [L] whether the lane is none of those.
        length: [L] metres.
        curvature: [L] average signed curvature, total change of heading / length, 1/m, positive to the left.
        start_heading: [L] direction of the first piece of each lane (of a single point: 0, as its curvature).
        successors: per lane, the lanes its traffic flows into, ascending.
        predecessors: per lane, the lanes that flow into it, ascending.
        left: per lane, the lanes a change to the left reaches.
        right: per lane, the lanes a change to the right reaches.
        regions: the branching regions, by parent, then by lane.
        followed: lines [P, 2] of pairs of a lane and its successor already sought, see :func:`.paths.followed`.
        gentle: results for lanes that were checked already, see :func:`symphony.roadgraph.paths.gentle`.
    """

    def __init__(self, road: Any) -> None:
        points, offsets = np.asarray(road.lanes.points, dtype=np.float64)[:, :2], road.lanes.offsets
        new = np.insert((points[1:] != points[:-1]).any(1), 0, True)
        new[offsets[:-1]] = True
        self.lines = [points[a:b][new[a:b]] for a, b in pairwise(offsets)]
        self.arc = [arc_lengths(line) for line in self.lines]
        self.length: Reals = np.array([arc[-1] for arc in self.arc], dtype=np.float64)
        self.usable: Bools = (np.asarray(road.lane_type) != BIKE_LANE) & (self.length > 0)
        after = self._adjacency(road.successors, "road.successors")
        links = np.array([(lane, k) for lane, each in enumerate(after) for k in each], np.int64).reshape(-1, 2)
        ends = shapely.points(np.array([self.lines[lane][-1] for lane in links[:, 0]]).reshape(-1, 2))
        links = links[shapely.distance(ends, line_strings([self.lines[k] for k in links[:, 1]])) <= FAR]
        self.successors = self._adjacency(links, "road.successors")
        self.predecessors = self._adjacency(links[:, ::-1], "road.successors")
        self.left = self._adjacency(road.left_neighbors, "road.left_neighbors")
        self.right = self._adjacency(road.right_neighbors, "road.right_neighbors")
        headings = [np.arctan2(*np.diff(line, axis=0).T[::-1]) for line in self.lines]
        self.start_heading = np.array([heading[0] if len(heading) else 0 for heading in headings], np.float64)
        turns = [((np.diff(heading) + np.pi) % (2 * np.pi) - np.pi).sum() for heading in headings]
        self.curvature: Reals = np.array(turns, dtype=np.float64) / np.where(self.length > 0, self.length, 1)
        self.regions = self._branching()
        self.followed: dict[tuple[int, int], Reals] = {}
        self.gentle: dict[int, bool] = {}

    def __len__(self) -> int:
        return len(self.lines)

    @cached_property
    def usable_lanes(self) -> Indices:
        """Indices of the usable lanes."""
        return np.flatnonzero(self.usable)

    @cached_property
    def drops(self) -> dict[int, tuple[int, ...]]:
        """Lanes that end beside lanes which go on, and these: one that is to get any farther must change to them."""
        ends = (lane for lane in self.usable_lanes.tolist() if not self.successors[lane])
        beside = {lane: (*self.left[lane], *self.right[lane]) for lane in ends}
        found = {lane: tuple(k for k in others if self.successors[k]) for lane, others in beside.items()}
        return {lane: others for lane, others in found.items() if others}

    @cached_property
    def index(self) -> LineIndex:
        """Spatial index over the usable lanes (line k is lane ``usable_lanes[k]``)."""
        return LineIndex([self.lines[k] for k in self.usable_lanes])

    @cached_property
    def lane_points(self) -> tuple[Reals, Reals]:
        """Points [P, 2] of all usable lanes, and unit vectors [P, 2] along the lanes there."""
        ways = [np.gradient(self.lines[k], axis=0) for k in self.usable_lanes]
        way = np.concatenate([np.zeros((0, 2)), *ways])
        points = np.concatenate([np.zeros((0, 2)), *(self.lines[k] for k in self.usable_lanes)])
        return points, way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9)

    @cached_property
    def region_index(self) -> LineIndex:
        """Spatial index over the branching regions."""
        return LineIndex([self.lines[k] for k in self.regions.lane])

    @cached_property
    def entry_tree(self) -> shapely.STRtree:
        """Spatial index over the entry points of the branching regions."""
        return shapely.STRtree(shapely.points(self.regions.entry))

    def _adjacency(self, pairs: NDArray[Any], field: str) -> list[tuple[int, ...]]:
        pairs = np.asarray(pairs, dtype=np.int64).reshape(-1, 2)
        if len(pairs) and (pairs.min() < 0 or pairs.max() >= len(self)):
            raise DataError(f"names a lane outside the {len(self)} lanes", field=field)
        # A circuit leads into itself, but no lane lies beside itself.
        fits = (pairs[:, 0] != pairs[:, 1]) | (field == "road.successors")
        pairs = np.unique(pairs[self.usable[pairs].all(1) & fits], axis=0)
        ends = np.searchsorted(pairs[:, 0], np.arange(len(self) + 1))
        return [tuple(pairs[a:b, 1].tolist()) for a, b in pairwise(ends)]

    def _branching(self) -> Regions:
        pairs = [(parent, k) for parent, after in enumerate(self.successors) if len(after) > 1 for k in after]
        parent, lane = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        entry = np.array([self.lines[k][0] for k in lane], dtype=np.float64).reshape(-1, 2)
        return Regions(lane, parent, self.curvature[lane], entry, self.start_heading[lane])
