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
        self.x, self.y = (np.array([0.0 if g is None else g.origin[k] for g in grids]) for k in (0, 1))
        # Sides are powers of two, so to multiply is to divide.
        self.per_metre = np.array([1.0 if g is None else 1.0 / g.size for g in grids])
        self.columns, self.rows = (
            np.array([0.0 if g is None else g.shape[k] for g in grids]) for k in (0, 1)
        )
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
        """Number of the cell in which each position of map ``scene`` lies, -1 outside of its grid.

        Args:
            scene: any shape that broadcasts against the positions.
            x: of the positions.
            y: likewise.
        """
        per_metre, columns = self.per_metre.take(scene), self.columns.take(scene)
        column = np.floor((x - self.x.take(scene)) * per_metre)
        row = np.floor((y - self.y.take(scene)) * per_metre)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < self.rows.take(scene))
        return np.where(inside, row * columns + column + self.first.take(scene), -1.0).astype(np.int64)

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
        held = self.count.take(cell)
        first = np.cumsum(held) - held
        # Pairs of a position and a candidate, position by position.
        candidate = np.arange(len(cell) and first[-1] + held[-1]) + np.repeat(
            self.begin.take(cell) - first, held
        )
        candidate = self.items.take(candidate) + np.repeat(self.stride * scene, held)
        start_x, start_y, unit_x, unit_y, half = edges.rows.take(candidate, axis=0).T
        away_x, away_y = np.repeat(x, held) - start_x, np.repeat(y, held) - start_y
        beyond = away_x * unit_x
        beyond += away_y * unit_y
        beyond -= half
        np.abs(beyond, out=beyond)
        beyond -= half
        np.maximum(beyond, 0, out=beyond)
        away_x *= unit_y
        away_y *= unit_x
        away_x -= away_y
        squared = np.square(beyond, out=beyond) + np.square(away_x, out=away_x)
        hit = np.flatnonzero(squared == np.repeat(np.minimum.reduceat(squared, first), held))[::-1]
        nearest = candidate[first]
        # Written from the last to the first, so the first of equally near ones stays.
        nearest[np.repeat(np.arange(len(cell)), held)[hit]] = candidate[hit]
        return nearest


class Edges(NamedTuple):
    """All edges of all maps, component by component [B * E].

    Attributes:
        rows: [B * E, 5] the first five of these side by side, for what reads all of them.
        x: of the start.
        y: of the start.
        unit_x: direction.
        unit_y: direction.
        half: half the length.
        previous: number of the edge that ends where this one starts, -1 if none that has a length.
        following: number of the edge that starts where this one ends, likewise.
    """

    rows: Reals
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
        parts = (start[:, 0], start[:, 1], unit[:, 0], unit[:, 1], 0.5 * length)
        x, y, unit_x, unit_y, half = (np.ascontiguousarray(part, dtype=start.dtype) for part in parts)
        before, after = (np.where((link >= 0) & valid[link], link, -1) for link in (previous, following))
        return cls(np.stack([x, y, unit_x, unit_y, half], -1), x, y, unit_x, unit_y, half, before, after)
