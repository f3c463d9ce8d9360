"""Directed edges of maps, component by component, and on which side of them positions lie. For the CPU only."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.floating[Any]]
Indices = NDArray[np.int64]
Bools = NDArray[np.bool_]


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

    def right_of(self, nearest: Indices, x: Reals, y: Reals) -> Bools:
        """Whether positions [R] lie to the right of their nearest edges: the sign of
        :func:`symphony.geometry.signed_distance` without the distance.
        """
        along, right = self._side(nearest, x, y)
        corners = (self.previous, along < 0, False), (self.following, along > 2 * self.half[nearest], True)
        result = right.copy()
        for neighbor, beyond, ahead in corners:
            at = np.flatnonzero(beyond)
            at = at[neighbor[nearest[at]] >= 0]
            if len(at) == 0:
                continue
            here, other = nearest[at], neighbor[nearest[at]]
            _, beside = self._side(other, x[at], y[at])
            first, second = (here, other) if ahead else (other, here)
            turn = self.unit_x[first] * self.unit_y[second] - self.unit_y[first] * self.unit_x[second]
            result[at] = np.where(turn > 0, right[at] | beside, right[at] & beside)
        return result

    def _side(self, edge: Indices, x: Reals, y: Reals) -> tuple[Reals, Bools]:
        away_x, away_y = x - self.x[edge], y - self.y[edge]
        unit_x, unit_y = self.unit_x[edge], self.unit_y[edge]
        return away_x * unit_x + away_y * unit_y, away_x * unit_y - away_y * unit_x > 0

    @classmethod
    def of(cls, start: Reals, end: Reals, valid: Bools, previous: Indices, following: Indices) -> Edges:
        """From first and last points [B * E, 2], which edges exist and have a length, and their neighbours."""
        along = end - start
        length = np.hypot(along[:, 0], along[:, 1])
        unit = along / np.where(length > 0, length, 1)[:, None]
        parts = (start[:, 0], start[:, 1], unit[:, 0], unit[:, 1], 0.5 * length)
        x, y, unit_x, unit_y, half = (np.ascontiguousarray(part, dtype=start.dtype) for part in parts)
        before, after = (np.where((link >= 0) & valid[link], link, -1) for link in (previous, following))
        return cls(np.stack([x, y, unit_x, unit_y, half], -1), x, y, unit_x, unit_y, half, before, after)


def squared_to(edges: Sequence[Reals] | Reals, x: Reals, y: Reals) -> Reals:
    """Squared metres from positions to edges [5, ...]: the columns of :attr:`Edges.rows`."""
    start_x, start_y, unit_x, unit_y, half = edges
    away_x, away_y = x - start_x, y - start_y
    beyond = away_x * unit_x
    beyond += away_y * unit_y
    beyond -= half
    np.abs(beyond, out=beyond)
    beyond -= half
    np.maximum(beyond, 0, out=beyond)
    away_x *= unit_y
    away_y *= unit_x
    away_x -= away_y
    return np.square(beyond, out=beyond) + np.square(away_x, out=away_x)
