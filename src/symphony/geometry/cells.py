"""The grids of several maps end to end, and exact queries of many positions at once. For the CPU only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.geometry.grid import CellGrid
from symphony.geometry.nearest import smallest

Reals = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]

ROWS = 64
"""Positions whose candidates are looked at together, so that they stay in the cache."""


class Cells:
    """Grids of B maps; one without a grid has no cells.

    Args:
        grids: one per map.
        stride: elements per map, padding included: element i of map b is number ``b * stride + i`` of all.
    """

    def __init__(self, grids: Sequence[CellGrid | None], stride: int) -> None:
        self.stride = stride
        self.origin = np.array([(0.0, 0.0) if g is None else g.origin for g in grids])
        self.size = np.array([1.0 if g is None else g.size for g in grids])
        self.shape = np.array([(0, 0) if g is None else g.shape for g in grids])
        some = [grid for grid in grids if grid is not None]
        cells = [0 if g is None else len(g.sign) for g in grids]
        items = np.cumsum([0] + [len(grid.items) for grid in some])
        self.first = np.cumsum([0, *cells])[:-1]
        none = np.zeros(0, np.int64)
        self.items: NDArray[Any] = np.concatenate([grid.items for grid in some]) if some else none
        self.begin: Indices = np.concatenate(
            [grid.begin[:-1] + offset for grid, offset in zip(some, items, strict=False)] or [none]
        )
        self.count: Indices = np.concatenate([np.diff(grid.begin) for grid in some] or [none]).astype(
            np.int64
        )
        self.sign = np.concatenate([grid.sign for grid in some] or [np.zeros(0, np.int8)])

    def locate(self, scene: Indices, x: Reals, y: Reals) -> Indices:
        """Number of the cell in which each position [R] of map ``scene`` [R] lies, -1 outside of its grid."""
        size = self.size[scene]
        column, row = (np.floor((v - self.origin[scene, k]) / size) for k, v in ((0, x), (1, y)))
        columns, rows = self.shape[scene].T
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        cell = np.where(inside, row * columns + column, 0).astype(np.int64) + self.first[scene]
        return np.where(inside, cell, -1)

    def nearest_points(
        self, scene: Indices, cell: Indices, x: Reals, y: Reals, points: tuple[Reals, Reals], count: int
    ) -> Indices:
        """Numbers [R, count] of the points nearest to positions [R], ascending.

        Args:
            scene: [R].
            cell: [R], none of them -1.
            x: [R] of the positions.
            y: [R].
            points: x and y of all points of all maps.
            count: at most what the grids were made for.
        """
        found = np.empty((len(cell), count), np.int64)
        for a in range(0, len(cell), ROWS):
            rows = slice(a, a + ROWS)
            held = self.count[cell[rows], None]
            place = np.arange(held.max())
            listed = self.begin[cell[rows], None] + place
            candidate = self.items.take(listed, mode="clip").astype(np.int64)
            candidate += (self.stride * scene[rows])[:, None]
            squared, across = points[0].take(candidate), points[1].take(candidate)
            squared -= x[rows, None]
            across -= y[rows, None]
            np.square(squared, out=squared)
            squared += np.square(across, out=across)
            np.copyto(squared, np.inf, where=place >= held)
            found[rows] = candidate.ravel()[smallest(squared, count)].reshape(-1, count)
        return found

    def nearest_edge(self, scene: Indices, cell: Indices, x: Reals, y: Reals, edges: Edges) -> Indices:
        """Number [R] of the edge nearest to each position [R]; arguments as for :meth:`nearest_points`."""
        held = self.count[cell]
        first = np.cumsum(held) - held
        # Pairs of a position and a candidate, position by position.
        owner = np.repeat(np.arange(len(cell)), held)
        listed = np.arange(len(owner)) + np.repeat(self.begin[cell] - first, held)
        candidate = self.items[listed] + self.stride * scene[owner]
        away_x, away_y = x[owner] - edges.x[candidate], y[owner] - edges.y[candidate]
        unit_x, unit_y, half = edges.unit_x[candidate], edges.unit_y[candidate], edges.half[candidate]
        beyond = np.maximum(np.abs(away_x * unit_x + away_y * unit_y - half) - half, 0)
        squared = np.square(beyond) + np.square(away_x * unit_y - away_y * unit_x)
        hit = np.flatnonzero(squared == np.minimum.reduceat(squared, first)[owner])[::-1]
        nearest = candidate[first]
        # Written from the last to the first, so the first of equally near ones stays.
        nearest[owner[hit]] = candidate[hit]
        return nearest


class Edges(NamedTuple):
    """All edges of all maps, component by component [B * E].

    Attributes:
        x: of the start.
        y: of the start.
        unit_x: direction.
        unit_y: direction.
        half: half the length.
        previous: number of the edge that ends where this one starts, -1 if none that has a length.
        following: number of the edge that starts where this one ends, likewise.
    """

    x: Reals
    y: Reals
    unit_x: Reals
    unit_y: Reals
    half: Reals
    previous: Indices
    following: Indices

    def right_of(self, nearest: Indices, x: Reals, y: Reals) -> NDArray[np.bool_]:
        """Whether positions [R] lie to the right of their nearest edges: the sign of
        :func:`symphony.geometry.signed_distance` without the distance.
        """
        along, right = self._side(nearest, x, y)
        corners = (self.previous, along < 0, False), (self.following, along > 2 * self.half[nearest], True)
        result = right.copy()
        for neighbor, beyond, ahead in corners:
            at = np.flatnonzero(beyond)
            at = at[neighbor[nearest[at]] >= 0]
            here, other = nearest[at], neighbor[nearest[at]]
            _, beside = self._side(other, x[at], y[at])
            first, second = (here, other) if ahead else (other, here)
            turn = self.unit_x[first] * self.unit_y[second] - self.unit_y[first] * self.unit_x[second]
            result[at] = np.where(turn > 0, right[at] | beside, right[at] & beside)
        return result

    def _side(self, edge: Indices, x: Reals, y: Reals) -> tuple[Reals, NDArray[np.bool_]]:
        away_x, away_y = x - self.x[edge], y - self.y[edge]
        unit_x, unit_y = self.unit_x[edge], self.unit_y[edge]
        return away_x * unit_x + away_y * unit_y, away_x * unit_y - away_y * unit_x > 0

    @classmethod
    def of(
        cls, start: Reals, end: Reals, valid: NDArray[np.bool_], previous: Indices, following: Indices
    ) -> Edges:
        """From first and last points [B * E, 2], which edges exist and have a length, and their neighbours."""
        along = end - start
        length = np.hypot(along[:, 0], along[:, 1])
        unit = along / np.where(length > 0, length, 1)[:, None]
        x, y, unit_x, unit_y, half = (
            np.ascontiguousarray(part, dtype=start.dtype)
            for part in (start[:, 0], start[:, 1], unit[:, 0], unit[:, 1], 0.5 * length)
        )
        before, after = (np.where((link >= 0) & valid[link], link, -1) for link in (previous, following))
        return cls(x, y, unit_x, unit_y, half, before, after)
