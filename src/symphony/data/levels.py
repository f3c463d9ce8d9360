"""Levels of a map: which of two roads above each other a place belongs to.

Heights alone do not tell: a car 60 m up a steep street is as high as one on a bridge. Where the lines of a map lie
above each other they are counted from below, and each number spreads along the surface it is on, up to where it meets
another. Two places are on different levels if their numbers differ, and their heights by :data:`LEVEL`: so cars that
follow each other up a ramp are never apart. Places that no such surface reaches have no level and see all others.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import Polylines, RunSegment

LEVEL = 2.5  # metres of height from which on two things at one place are on different levels
CELL = 5.0  # metres of the columns in which heights are compared
RISE = 1.5  # metres by which a surface may rise from one column to a neighbour, two columns away at most
SPACING = 2.0  # metres between the points that stand for the lines of a map, at most
NOWHERE = 99  # number of what is a level away from all lines at its place, as on a bridge the map lacks

_NEAR = sorted(product(range(-2, 3), repeat=2), key=lambda way: way[0] ** 2 + way[1] ** 2)
_WIDE = 1 << 20


class Levels:
    """The levels of a map, from points [P, 3] on its lines, close to each other; ``flat`` if it has none."""

    def __init__(self, points: NDArray[np.floating[Any]]) -> None:
        self.flat = True
        height = points[:, 2].astype(np.float64)
        if len(points) == 0 or np.ptp(height) < LEVEL:
            return
        key = _columns(points)
        order = np.argsort(key)
        first = np.flatnonzero(np.diff(key[order], prepend=-1))
        reach = np.maximum.reduceat(height[order], first) - np.minimum.reduceat(height[order], first)
        if reach.max() < LEVEL:
            return  # so for most maps, and quicker than what follows
        order = np.lexsort((height, key))
        key, height = key[order], height[order]
        # A surface in a column: points with no gap between them. In order of column and height.
        begins = np.flatnonzero((np.diff(key, prepend=-1) != 0) | (np.diff(height, prepend=-np.inf) >= LEVEL))
        ends = np.append(begins[1:], len(key)) - 1
        self._key, self._low, self._high = key[begins], height[begins], height[ends]
        first = np.searchsorted(self._key, self._key, side="left")
        several = np.searchsorted(self._key, self._key, side="right") - first > 1
        if not several.any():
            return
        self.flat = False
        self._most = int(np.unique(self._key, return_counts=True)[1].max())
        self._level = np.where(several, np.arange(len(begins)) - first + 1, 0)
        self._spread()

    def _spread(self) -> None:
        """Give each surface the number of the nearest numbered one, the lowest of equally near ones."""
        one, other = [], []
        for dx, dy in _NEAR[1:]:
            for row, found in self._among(self._key + dx * _WIDE + dy):
                high = np.minimum(self._high[row], self._high[found])
                near = np.maximum(self._low[row], self._low[found]) - high < RISE
                one.append(row[near])
                other.append(found[near])
        here, there = np.concatenate(one), np.concatenate(other)
        while True:
            new = (self._level[here] == 0) & (self._level[there] > 0)
            if not new.any():
                return
            found = np.full(len(self._level), NOWHERE)
            np.minimum.at(found, here[new], self._level[there[new]])
            self._level = np.where(found < NOWHERE, found, self._level)

    def _among(self, key: NDArray[np.int64]) -> Any:
        """Yield (rows of ``key``, surfaces of that column), the lowest of each column first."""
        first, last = (np.searchsorted(self._key, key, side=side) for side in ("left", "right"))
        for rank in range(self._most):
            row = np.flatnonzero(first + rank < last)
            yield row, first[row] + rank

    def at(self, points: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Return [..., 2] height and level (0 for none) of points [..., 3] on the ground, from their columns. Points
        in columns without lines are taken to those of the nearest one within 10 m.
        """
        place = points.reshape(-1, 3)
        level, known = np.zeros(len(place)), np.zeros(len(place), bool)
        key, height = _columns(place), place[:, 2].astype(np.float64)
        for dx, dy in _NEAR:
            rest = np.flatnonzero(~known)
            best = np.full(len(rest), np.inf)
            for row, found in self._among(key[rest] + dx * _WIDE + dy):
                z = height[rest[row]]
                away = np.maximum(np.maximum(self._low[found] - z, z - self._high[found]), 0)
                nearer = away < best[row]
                best[row[nearer]] = away[nearer]
                level[rest[row[nearer]]] = np.where(away < LEVEL, self._level[found], NOWHERE)[nearer]
            known[rest[np.isfinite(best)]] = True
        return np.stack([height, level], -1).astype(np.float32).reshape(*points.shape[:-1], 2)


def levels_of(segment: RunSegment) -> Levels:
    """Return the levels of a segment's lanes and boundary."""
    return Levels(np.concatenate([dense(lines) for lines in (segment.road.lanes, segment.road.boundary)]))


def ground(segment: RunSegment) -> NDArray[np.float32]:
    """Return [A, T, 3] the place below each agent, whose logged position is the middle of its box."""
    return segment.position - (segment.size * np.array([0, 0, 0.5], np.float32))[:, None]


def agent_heights(segment: RunSegment, levels: Levels | None = None) -> NDArray[np.float32]:
    """Return [T, A, 2] height and level of logged agents, no level if not seen; [0, 0, 2] for a flat map."""
    levels = levels_of(segment) if levels is None else levels
    if levels.flat:
        return np.zeros((0, 0, 2), np.float32)
    return np.where(segment.valid[..., None], levels.at(ground(segment)), 0).astype(np.float32).swapaxes(0, 1)


def dense(lines: Polylines) -> NDArray[np.float64]:
    """Return [P, 3] points of lines and of others between them: neighbours are at most :data:`SPACING` apart."""
    points = lines.points.astype(np.float64)
    if len(points) == 0 or np.ptp(points[:, 2]) == 0:
        return points  # one height: where along the lines does not matter
    step = np.diff(points, axis=0, append=points[-1:])
    step[lines.offsets[1:] - 1] = 0
    return divided(points, step, SPACING)


def divided(points: NDArray[np.float64], step: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Return points and, between each and what is a step away, others at most ``spacing`` apart in the plane."""
    count = np.maximum(np.ceil(np.linalg.norm(step[:, :2], axis=-1) / spacing), 1).astype(np.int64)
    point = np.repeat(np.arange(len(points)), count)
    share = (np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)) / np.repeat(count, count)
    return points[point] + share[:, None] * step[point]


def _columns(points: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
    """Return [P] the number of each point's column."""
    cell = np.floor(points[:, :2] / CELL).astype(np.int64) + _WIDE // 2
    return cell[:, 0] * _WIDE + cell[:, 1]
