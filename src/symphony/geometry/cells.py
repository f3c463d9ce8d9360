"""Square cells over the maps of a batch, with lists of the only elements that can matter to a position inside.

A position q in a cell lies within half the cell's diagonal h of its centre c, so any distance from q differs by at
most h from that from c: what is more than 2 h farther from c than the k-th nearest element is not among the k nearest
of q. A list is made when a position is in its cell. For the CPU only.

Shapes: B maps of P points or E edges, R positions. Element i of map b is number ``b * P + i`` of all.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.geometry.nearest import smallest, spans

Reals = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]
Bools = NDArray[np.bool_]

POINT_CELL = 8.0  # metres of a cell's side, for points
EDGE_CELL = 4.0  # metres of a cell's side, for the edges of the road
ROWS = 64  # positions whose candidates are processed together, so that they stay in the cache

_MARGIN = 8.0  # metres of cells beyond the outermost element
_SLACK = 0.02  # metres by which lists reach farther than they need to, far above the rounding of float32
_CELLS = 1 << 14  # most cells of a map; larger maps get larger cells
_BLOCK = 1 << 17  # distances held at a time while lists are made
_MANY = 256  # neighbours above which most of them lie far away, where the size of a cell matters less
_WORTH = 3  # elements of a map for each wanted one, below which a list saves nothing
_FILLING = Lock()


class Cells(ABC):
    """The cells of B maps, and lists for those in which positions were.

    Takes the corners [B, 2] of what is on each map in metres, whether it has cells at all [B], the least side of a
    cell, the elements per map, padding included, and how many are wanted.
    """

    def __init__(self, low: Reals, high: Reals, some: Bools, size: float, *, total: int, wanted: int = 1) -> None:
        self.total, self.wanted = total, wanted
        low, high = (np.where(some[:, None], value, 0.0).astype(np.float64) for value in (low, high))
        low = np.floor(low - _MARGIN)
        extent, side = high + _MARGIN - low, np.full(len(low), size)
        while (large := np.ceil(extent / side[:, None]).prod(1) > _CELLS).any():
            side[large] *= 2.0
        columns, rows = np.where(some, np.ceil(extent / side[:, None]).T, 0.0)
        own = low[:, 0], low[:, 1], side, columns, rows
        self.x, self.y, self.side, self.columns, self.rows = map(np.ascontiguousarray, own)
        # Sides are powers of two, so to multiply is to divide.
        self.per_metre = 1.0 / self.side
        ends = (self.columns * self.rows).cumsum().astype(np.int64)
        self.first, cells = np.concatenate([[0], ends[:-1]]), int(ends[-1]) if len(ends) else 0
        # Where a cell's list begins; -1 while it has none.
        self.begin, self.count = np.full(cells, -1), np.zeros(cells, np.int64)
        # One more, that is always 0, for positions in no cell, which is number -1.
        self.sign, self._asked = np.zeros(cells + 1, np.int8), np.zeros(cells, np.int64)
        self.items, self._used = np.zeros(1 << 12, np.int32), 0

    @abstractmethod
    def _squared(self, scene: Indices, x: Reals, y: Reals) -> Reals:
        """Return squared metres [C, elements of a map] from centres x and y [C, 1]; infinity without an element."""

    def _signs(self, x: Reals, y: Reals, count: Indices, item: Indices, half: Reals) -> NDArray[np.int8]:
        """Return 1 or -1 for cells [C] that lie off or on the road, 0 where it depends on the position."""
        return np.zeros(len(x), np.int8)

    def locate(self, scene: Indices, x: Reals, y: Reals) -> Indices:
        """Return the number of the cell in which each position of map ``scene`` lies, -1 outside its cells."""
        per_metre, columns = self.per_metre.take(scene), self.columns.take(scene)
        column = np.floor((x - self.x.take(scene)) * per_metre)
        row = np.floor((y - self.y.take(scene)) * per_metre)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < self.rows.take(scene))
        return np.where(inside, row * columns + column + self.first.take(scene), -1.0).astype(np.int64)

    def at(self, scene: Indices, x: Reals, y: Reals, repaid: int = 1) -> Indices:
        """Return the cells of :meth:`locate`, but -1 for those without a list: a cell gets one once ``repaid``
        positions [R] have been in it.
        """
        cell = self.locate(scene, x, y)
        inside = np.flatnonzero(cell >= 0)
        cell[inside[~self.listed(scene[inside], cell[inside], repaid)]] = -1
        return cell

    def listed(self, scene: Indices, cell: Indices, repaid: int = 1) -> Bools:
        """Return whether cells [R] of maps [R] have lists, as they do once ``repaid`` positions were in them."""
        new = np.flatnonzero(self.begin.take(cell) < 0)
        if len(new) == 0:
            return np.ones(len(cell), np.bool_)
        with _FILLING:
            number, place, times = np.unique(cell[new], return_index=True, return_counts=True)
            self._asked[number] += times
            due = (self.begin[number] < 0) & (self._asked[number] >= repaid)
            if due.any():
                self._fill(scene[new[place[due]]], number[due])
        return self.begin.take(cell) >= 0

    def _fill(self, scene: Indices, number: Indices) -> None:
        """Make the lists of cells [C] of maps [C]."""
        side, (row, column) = self.side[scene], np.divmod(number - self.first[scene], self.columns[scene])
        x, y = self.x[scene] + (column + 0.5) * side, self.y[scene] + (row + 0.5) * side
        counts, parts, step = [], [], max(1, _BLOCK // self.total)
        reach = (math.sqrt(2.0) * side + _SLACK).astype(np.float32)[:, None]
        for a in range(0, len(scene), step):
            rows = slice(a, a + step)
            squared = self._squared(scene[rows], *(v[rows, None].astype(np.float32) for v in (x, y)))
            last = np.partition(squared, self.wanted - 1, axis=1)[:, self.wanted - 1, None]
            near = squared <= np.square(np.sqrt(last) + reach[rows])
            counts.append(np.count_nonzero(near, axis=1))
            # From places in the block to numbers among all elements.
            shift = (scene[rows] - np.arange(len(near))) * self.total
            parts.append(np.flatnonzero(near) + np.repeat(shift, counts[-1]))
        count, items = np.concatenate(counts), np.concatenate(parts)
        end = self._used + len(items)
        if end > len(self.items):
            # Never shorter than what another thread may be reading.
            self.items = np.concatenate([self.items, np.zeros(2 * end - len(self.items), np.int32)])
        self.items[self._used : end] = items
        self.count[number], self.sign[number] = count, self._signs(x, y, count, items, 0.5 * side)
        self.begin[number] = self._used + count.cumsum() - count
        self._used = end


class PointCells(Cells):
    """Cells for the nearest points. Takes x and y of points [B, P], infinity for none, and how many are wanted: a map
    with few more has no cells.
    """

    def __init__(self, x: Reals, y: Reals, count: int) -> None:
        exists = np.isfinite(x)
        low, high = (
            np.stack([bound(v, 1, where=exists, initial=start) for v in (x, y)], -1)
            for bound, start in ((np.min, np.inf), (np.max, -np.inf))
        )
        some = exists.sum(1) >= max(_WORTH * count, 1)
        size = POINT_CELL if count <= _MANY else 2 * POINT_CELL
        super().__init__(low, high, some, size, total=x.shape[1], wanted=count)
        self.points = x, y

    def _squared(self, scene: Indices, x: Reals, y: Reals) -> Reals:
        points_x, points_y = (v.take(scene, 0) for v in self.points)
        return np.square(points_x - x) + np.square(points_y - y)

    def nearest_points(self, cell: Indices, x: Reals, y: Reals) -> Indices:
        """Return the numbers [R, K] of the points nearest to positions [R] in cells that have lists, ascending."""
        points_x, points_y = (points.ravel() for points in self.points)
        found = np.empty((len(cell), self.wanted), np.int64)
        for a in range(0, len(cell), ROWS):
            rows = slice(a, a + ROWS)
            held = self.count[cell[rows], None]
            place = np.arange(held.max())
            candidate = self.items.take(self.begin[cell[rows], None] + place, mode="clip")
            squared = np.square(points_x.take(candidate) - x[rows, None])
            squared += np.square(points_y.take(candidate) - y[rows, None])
            np.copyto(squared, np.inf, where=place >= held)
            found[rows] = candidate.ravel()[smallest(squared, self.wanted)].reshape(-1, self.wanted)
        return found


class EdgeCells(Cells):
    """Cells for the nearest edge of the road, and the side of it on which whole cells lie.

    Takes start and end of the directed edges of all maps [B * E, 2], which of them there are and have a length [B,
    E], and the numbers of the edges before and after each [B * E], -1 if none.
    """

    def __init__(self, start: Reals, end: Reals, exists: Bools, previous: Indices, following: Indices) -> None:
        along = end - start
        length = np.hypot(along[:, 0], along[:, 1])
        unit = along / np.where(length > 0, length, 1)[:, None]
        # x and y of the start, those of the direction, and half the length: for one edge side by side, and of all.
        parts = (start[:, 0], start[:, 1], unit[:, 0], unit[:, 1], 0.5 * length)
        self.edges = np.stack(parts, dtype=start.dtype, casting="same_kind")
        self.of_edge = np.ascontiguousarray(self.edges.T)
        self.exists, there = exists, exists.ravel()
        self.links = [np.where((link >= 0) & there[link], link, -1) for link in (previous, following)]
        low, high = (
            bound(of_two(start, end).reshape(*exists.shape, 2), 1, where=exists[..., None], initial=begin)
            for bound, of_two, begin in ((np.min, np.minimum, np.inf), (np.max, np.maximum, -np.inf))
        )
        super().__init__(low, high, np.asarray(exists.any(1)), EDGE_CELL, total=exists.shape[1])

    def _squared(self, scene: Indices, x: Reals, y: Reals) -> Reals:
        # Column by column, so that each lies in one piece.
        squared = _squared_to([part.reshape(-1, self.total).take(scene, 0) for part in self.edges], x, y)
        squared[~self.exists[scene]] = np.inf
        return squared

    def _signs(self, x: Reals, y: Reals, count: Indices, item: Indices, half: Reals) -> NDArray[np.int8]:
        # On one side of every edge listed, and of each neighbour that decides at a corner.
        cell = np.repeat(np.arange(len(x)), count)
        side, before, past = self._sides(x[cell], y[cell], item, half[cell])
        lowest, highest = side.copy(), side.copy()
        for link, decides in zip(self.links, (before, past), strict=True):
            other = link[item]
            pair = np.flatnonzero(decides & (other >= 0))
            at = cell[pair]
            beside, _, _ = self._sides(x[at], y[at], other[pair], half[at])
            lowest[pair] = np.minimum(lowest[pair], beside)
            highest[pair] = np.maximum(highest[pair], beside)
        first = count.cumsum() - count
        lowest, highest = np.minimum.reduceat(lowest, first), np.maximum.reduceat(highest, first)
        return np.where(lowest == highest, lowest, 0).astype(np.int8)

    def _sides(self, x: Reals, y: Reals, edge: Indices, half: Reals) -> tuple[NDArray[np.int8], Bools, Bools]:
        """Return the side of an edge on which a whole cell lies (0: both), and whether part is before or past it."""
        start_x, start_y, unit_x, unit_y, half_length = self.edges[:, edge]
        away_x, away_y = x - start_x, y - start_y
        along, across = away_x * unit_x + away_y * unit_y, away_x * unit_y - away_y * unit_x
        # The normal has the same components as the direction, so the cell spreads as far across as along.
        spread = half * (np.abs(unit_x) + np.abs(unit_y)) + _SLACK
        side = (across > spread).astype(np.int8) - (across < -spread)
        return side, along < spread, along > 2 * half_length - spread

    def nearest_edge(self, cell: Indices, x: Reals, y: Reals) -> Indices:
        """Return the number [R] of the edge nearest to each position [R] in a cell that has a list."""
        held = self.count.take(cell)
        first = np.cumsum(held) - held
        # Pairs of a position and a candidate, position by position.
        candidate = self.items.take(spans(self.begin.take(cell), held))
        squared = _squared_to(
            np.moveaxis(self.of_edge.take(candidate, axis=0), -1, 0), np.repeat(x, held), np.repeat(y, held)
        )
        hit = np.flatnonzero(squared == np.repeat(np.minimum.reduceat(squared, first), held))[::-1]
        nearest = candidate[first]
        # Written from the last to the first, so the first of equally near ones stays.
        nearest[np.repeat(np.arange(len(cell)), held)[hit]] = candidate[hit]
        return nearest.astype(np.int64)

    def right_of(self, nearest: Indices, x: Reals, y: Reals) -> Bools:
        """Return whether positions [R] lie to the right of their nearest edges, as the sign of
        :func:`symphony.geometry.signed_distance` says, in a third of the time.
        """
        along, right = self._beside(nearest, x, y)
        past = along > 2 * self.edges[4, nearest]
        for link, beyond, ahead in zip(self.links, (along < 0, past), (False, True), strict=True):
            at = np.flatnonzero(beyond & (link[nearest] >= 0))
            here, other = nearest[at], link[nearest[at]]
            _, also = self._beside(other, x[at], y[at])
            first, second = (self.edges[2:4, edge] for edge in ((here, other) if ahead else (other, here)))
            left = first[0] * second[1] - first[1] * second[0] > 0
            right[at] = np.where(left, right[at] | also, right[at] & also)
        return right

    def _beside(self, edge: Indices, x: Reals, y: Reals) -> tuple[Reals, Bools]:
        start_x, start_y, unit_x, unit_y, _ = self.edges[:, edge]
        away_x, away_y = x - start_x, y - start_y
        return away_x * unit_x + away_y * unit_y, away_x * unit_y - away_y * unit_x > 0


def _squared_to(edges: Sequence[Reals] | Reals, x: Reals, y: Reals) -> Reals:
    """Return squared metres from positions to edges [5, ...] as :class:`EdgeCells` keeps them."""
    start_x, start_y, unit_x, unit_y, half = edges
    away_x, away_y = x - start_x, y - start_y
    beyond = np.maximum(np.abs(away_x * unit_x + away_y * unit_y - half) - half, 0)
    return np.square(beyond) + np.square(away_x * unit_y - away_y * unit_x)
