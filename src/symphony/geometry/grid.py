"""Square cells over a map, each with a list of the only elements that can matter to a position inside it.

A position q in a cell lies within half the cell's diagonal h of its centre c, so any distance from q differs by at
most h from that from c: what is more than 2 h farther from c than the k-th nearest element is not among the k
nearest of q.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

POINT_CELL = 8.0
"""Metres of a cell's side, for points."""
EDGE_CELL = 4.0
"""Metres of a cell's side, for the edges of the road."""

_MARGIN = 8.0
"""Metres of the grid beyond the outermost element."""
_SLACK = 0.02
"""Metres by which lists reach farther than they need to, far above the rounding of float32."""
_CELLS = 1 << 14
"""Most cells of a grid; larger maps get larger cells."""
_BLOCK = 1 << 17
"""Distances held at a time while a grid is made."""
_WORTH = 0.6
"""Share of all elements above which a list saves nothing."""


@dataclass(frozen=True)
class CellGrid:
    """Lists of elements by cell; cell (column, row) is number ``row * columns + column``.

    Attributes:
        origin: x and y of the lower left corner, whole metres.
        shape: columns and rows.
        size: side of a cell in metres.
        begin: [C + 1] where each cell's list begins.
        items: [L] the lists, ascending within each.
        sign: [C] int8; 1 or -1 where every position of the cell is off or on the road, 0 where it depends on the
            position. Zeros for grids of points.
    """

    origin: tuple[float, float]
    shape: tuple[int, int]
    size: float
    begin: NDArray[np.int32]
    items: NDArray[Any]
    sign: NDArray[np.int8]

    @property
    def nbytes(self) -> int:
        """Memory in bytes."""
        return self.begin.nbytes + self.items.nbytes + self.sign.nbytes


def point_grid(points: NDArray[Any], count: int, size: float = POINT_CELL) -> CellGrid | None:
    """Lists of the points that can be among the ``count`` nearest; None where they would save nothing.

    Args:
        points: [P, 2] metres.
        count: K.
        size: least side of a cell, metres.
    """
    total = len(points)
    if not 0 < count < total:
        return None
    # Many neighbours lie far away, where the size of a cell matters less.
    size = size if count <= 256 else 2 * size
    origin, shape, size, centers = _layout(points, size)
    reach = math.sqrt(2.0) * size + _SLACK
    counts, items = np.zeros(len(centers), np.int32), []
    for begin, away in _blocks(centers, total):
        block = _squared(away, points)
        cut = np.sqrt(np.partition(block, count - 1, axis=-1)[:, count - 1 : count]) + reach
        near = block <= np.square(cut)
        counts[begin : begin + len(away)] = near.sum(1)
        items.append((np.flatnonzero(near) % total).astype(_kind(total)))
        if begin == 0 and counts[: len(away)].mean() > _WORTH * total:
            return None
    return CellGrid(
        origin, shape, size, _begin(counts), np.concatenate(items), np.zeros(len(counts), np.int8)
    )


def edge_grid(
    start: NDArray[Any],
    end: NDArray[Any],
    previous: NDArray[Any],
    following: NDArray[Any],
    size: float = EDGE_CELL,
) -> CellGrid | None:
    """Lists of the edges that can be nearest, and the cells of one sign; None where there is no edge.

    Args:
        start: [E, 2] metres.
        end: [E, 2].
        previous: [E] the edge that ends where this one starts, -1 if none.
        following: [E] the edge that starts where this one ends, -1 if none.
        size: least side of a cell, metres.
    """
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    real = (start != end).any(-1)
    kept = np.flatnonzero(real)
    if len(kept) == 0:
        return None
    edges = _Edges(start, end, real, np.asarray(previous), np.asarray(following))
    origin, shape, size, centers = _layout(np.concatenate([start[kept], end[kept]]), size)
    reach = math.sqrt(2.0) * size + _SLACK
    counts, items = np.zeros(len(centers), np.int32), []
    for begin, centre in _blocks(centers, len(kept)):
        distance = edges.squared(centre, kept)
        near = distance <= np.square(np.sqrt(distance.min(1, keepdims=True)) + reach)
        counts[begin : begin + len(centre)] = near.sum(1)
        items.append(kept[np.flatnonzero(near) % len(kept)])
    listed = np.concatenate(items)
    sign = edges.signs(centers, counts, listed, 0.5 * size)
    return CellGrid(origin, shape, size, _begin(counts), listed.astype(_kind(len(start))), sign)


class _Edges:
    """Where cells lie relative to directed edges."""

    def __init__(
        self,
        start: NDArray[np.float64],
        end: NDArray[np.float64],
        real: NDArray[np.bool_],
        previous: NDArray[Any],
        following: NDArray[Any],
    ) -> None:
        along = end - start
        self.length = np.hypot(*along.T)
        self.start, self.real = start, real
        self.unit = along / np.where(self.length > 0, self.length, 1.0)[:, None]
        self.previous, self.following = previous, following

    def squared(self, centers: NDArray[np.float64], kept: NDArray[np.int64]) -> NDArray[np.float32]:
        """Squared metres [C, E] from cell centres to the edges ``kept``."""
        # Relative to the block's middle, so that float32 is enough.
        middle = centers.mean(0)
        here = (centers - middle).astype(np.float32)
        unit, half = self.unit[kept].astype(np.float32), (0.5 * self.length[kept]).astype(np.float32)
        start = self.start[kept] - middle
        along = (start * self.unit[kept]).sum(-1).astype(np.float32) + half
        across = (start[:, 0] * self.unit[kept, 1] - start[:, 1] * self.unit[kept, 0]).astype(np.float32)
        beyond = here[:, :1] * unit[:, 0] + here[:, 1:] * unit[:, 1]
        beyond -= along
        np.abs(beyond, out=beyond)
        beyond -= half
        np.maximum(beyond, 0.0, out=beyond)
        side = here[:, :1] * unit[:, 1] - here[:, 1:] * unit[:, 0]
        side -= across
        return np.square(beyond, out=beyond) + np.square(side, out=side)

    def _place(
        self, where: NDArray[np.float64], edge: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Metres along an edge from its start, and to its right."""
        x, y = (where[..., k] - self.start[edge, k] for k in (0, 1))
        unit_x, unit_y = self.unit[edge, 0], self.unit[edge, 1]
        return x * unit_x + y * unit_y, x * unit_y - y * unit_x

    def _sides(
        self, where: NDArray[np.float64], edge: NDArray[np.int64], half: float
    ) -> tuple[NDArray[np.int8], NDArray[np.bool_], NDArray[np.bool_]]:
        """Side of an edge on which a whole cell lies (0: on both), and whether any of it lies before or past it."""
        along, across = self._place(where, edge)
        spread_along = half * np.abs(self.unit[edge]).sum(-1) + _SLACK
        # The normal has the same components as the direction, so the cell spreads as far across as along.
        side = (across > spread_along).astype(np.int8) - (across < -spread_along)
        return side, along < spread_along, along > self.length[edge] - spread_along

    def signs(
        self,
        centers: NDArray[np.float64],
        counts: NDArray[np.int32],
        listed: NDArray[np.int64],
        half: float,
    ) -> NDArray[np.int8]:
        """1 or -1 for cells [C] on one side of every edge listed and of each neighbour that decides at a corner."""
        cell = np.repeat(np.arange(len(centers)), counts)
        side, before, past = self._sides(centers[cell], listed, half)
        lowest, highest = side.copy(), side.copy()
        for neighbor, decides in ((self.previous, before), (self.following, past)):
            other = neighbor[listed]
            pair = np.flatnonzero(decides & (other >= 0))
            pair = pair[self.real[other[pair]]]
            beside, _, _ = self._sides(centers[cell[pair]], other[pair], half)
            lowest[pair] = np.minimum(lowest[pair], beside)
            highest[pair] = np.maximum(highest[pair], beside)
        first = _begin(counts)[:-1]
        lowest, highest = np.minimum.reduceat(lowest, first), np.maximum.reduceat(highest, first)
        return np.where(lowest == highest, lowest, 0).astype(np.int8)


def _layout(
    points: NDArray[Any], size: float
) -> tuple[tuple[float, float], tuple[int, int], float, NDArray[np.float64]]:
    low = np.floor(points.min(0).astype(np.float64) - _MARGIN)
    extent = points.max(0) + _MARGIN - low
    while np.prod(np.ceil(extent / size)) > _CELLS:
        size *= 2.0
    columns, rows = (int(n) for n in np.maximum(np.ceil(extent / size), 1))
    x, y = (low[k] + (np.arange(n) + 0.5) * size for k, n in ((0, columns), (1, rows)))
    centers = np.stack([np.tile(x, rows), np.repeat(y, columns)], -1)
    return (float(low[0]), float(low[1])), (columns, rows), size, centers


def _blocks(centers: NDArray[np.float64], width: int) -> list[tuple[int, NDArray[np.float64]]]:
    step = max(1, _BLOCK // max(width, 1))
    return [(begin, centers[begin : begin + step]) for begin in range(0, len(centers), step)]


def _squared(centers: NDArray[np.float64], points: NDArray[Any]) -> NDArray[np.float32]:
    # Relative to the block's middle, so that float32 is enough.
    middle = centers.mean(0)
    here, there = ((v - middle).astype(np.float32) for v in (centers, points))
    return np.square(here[:, None, 0] - there[:, 0]) + np.square(here[:, None, 1] - there[:, 1])


def _begin(counts: NDArray[np.int32]) -> NDArray[np.int32]:
    return np.concatenate(([0], np.cumsum(counts))).astype(np.int32)


def _kind(total: int) -> type[np.signedinteger[Any]]:
    return np.int16 if total <= np.iinfo(np.int16).max else np.int32
