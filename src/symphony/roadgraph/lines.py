"""Which of a set of polylines pass near given points, where along them, and in which direction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]
Bools = NDArray[np.bool_]


class Near(NamedTuple):
    """Pairs of a point and a line within reach of it, each [K].

    Attributes:
        point: index of the point.
        line: index of the line.
        distance: metres between the two.
        along: metres from the line's start to its nearest place.
        heading: direction of the line there, radians.
    """

    point: Indices
    line: Indices
    distance: Reals
    along: Reals
    heading: Reals

    def only(self, keep: Bools | Indices) -> Near:
        """Some of the pairs."""
        point, line, distance, along, heading = self
        return Near(point[keep], line[keep], distance[keep], along[keep], heading[keep])


class LineIndex:
    """Spatial index over polylines.

    Args:
        lines: arrays [P_k, 2] in metres, without repeated points.
    """

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
        """All pairs of a point [n, 2] and a line at most ``reach`` metres apart, sorted by point, then line."""
        geometry = shapely.points(points)
        point, line = self._tree.query(geometry, predicate="dwithin", distance=reach)
        order = np.lexsort((line, point))
        point, line = point[order], line[order]
        distance = shapely.distance(self.geometry[line], geometry[point])
        along = shapely.line_locate_point(self.geometry[line], geometry[point])
        return Near(point, line, distance, along, self.heading(line, along))

    def heading(self, line: NDArray[Any], along: Reals) -> Reals:
        """Direction of lines [K] at ``along`` [K] metres from their start."""
        segment = np.searchsorted(self._begin, self._base[line] + along, side="right") - 1
        return self._heading[np.clip(segment, self._first[line], self._first[line + 1] - 1)]


def arc_lengths(line: Reals) -> Reals:
    """Metres [P] from the beginning of a line to each of its points."""
    way = line[1:] - line[:-1]
    arc = np.zeros(len(line))
    np.cumsum(np.hypot(way[:, 0], way[:, 1]), out=arc[1:])
    return arc


def line_strings(lines: Sequence[Reals]) -> NDArray[Any]:
    """[lines] shapely geometries of polylines [P_k, 2], all made at once."""
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    return shapely.linestrings(np.concatenate([*lines, np.zeros((0, 2))]), indices=owner)


def turn_between(a: Reals, b: Reals) -> Reals:
    """Absolute difference of two headings, in [0, pi]."""
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)
