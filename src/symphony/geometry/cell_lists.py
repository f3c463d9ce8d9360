"""Lists of a map's cells as whole numbers that can be kept in a file and put together with those of other maps.

What can be nearest to a position are pieces of a few lines, whose points and edges follow each other: a list is kept
as some runs of consecutive numbers, a tenth of its elements. For the CPU only.

Shapes: B maps, C cells with lists, R runs of all of them, W whole numbers: a head, then cells [C], runs in each [C],
signs [C], first elements [R], elements in each run [R].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.geometry.edges import Bools, Indices, Reals
from symphony.geometry.spans import spans

Whole = NDArray[np.int32]

_HEAD = 9
_WANTED, _TOTAL, _X, _Y, _SIDE, _COLUMNS, _ROWS, _CELLS, _RUNS = range(_HEAD)


class Frame(NamedTuple):
    """Where the cells of maps [B] lie: lower left corner and side in metres, and how many there are."""

    x: Reals
    y: Reals
    side: Reals
    columns: Reals
    rows: Reals


def packed(
    frame: Frame,
    cell: Indices,
    count: Indices,
    items: Indices,
    sign: NDArray[np.int8],
    *,
    total: int,
    wanted: int,
) -> Whole:
    """Lists of one map as whole numbers [W].

    Args:
        frame: of this map only.
        cell: [C] numbers of the cells.
        count: [C] elements of each list, at least one.
        items: all lists, one after the other, ascending within each.
        sign: [C] see :class:`symphony.geometry.cells.Lists`.
        total: elements of the map.
        wanted: how many were looked for.
    """
    first = np.zeros(len(items), np.bool_)
    first[count.cumsum() - count] = True
    begin = np.flatnonzero(first | (np.diff(items, prepend=-2) != 1))
    length = np.diff(begin, append=len(items))
    # Each list ends in an empty run beyond the map, for what a scene has beside it.
    of = np.repeat(np.arange(len(cell)), count)[begin]
    runs = np.bincount(of, minlength=len(cell))
    ends = runs.cumsum()
    start, length = np.insert(items[begin], ends, total), np.insert(length, ends, 0)
    head = [wanted, total, *(value.item() for value in frame), len(cell), len(start)]
    return np.concatenate([head, cell, runs + 1, sign, start, length]).astype(np.int32)


def is_packed(whole: Whole, total: int) -> bool:
    """Whether whole numbers can be the lists of a map with so many elements."""
    if whole.ndim != 1 or len(whole) < _HEAD or whole.dtype != np.int32:
        return False
    return bool(
        whole[_TOTAL] == total
        and min(whole[_CELLS], whole[_RUNS]) >= 0
        and len(whole) == _HEAD + 3 * whole[_CELLS] + 2 * whole[_RUNS]
    )


class JoinedLists:
    """The kept lists of B maps, some of which have none.

    Args:
        whole: [B, W] each map's, padded with zeros.
        number: [B] elements of each scene: those of its map first, then what it has beside it.
        total: elements per map, padding included.
        wanted: how many are looked for. Lists made for fewer don't count.

    Attributes:
        some: [B] which maps have lists.
        frame: of all maps.
        scene: [C] map of each cell with a list.
        cell: [C] its number in that map.
        sign: [C] see :class:`symphony.geometry.cells.Lists`.
    """

    def __init__(self, whole: Whole, number: Indices, *, total: int, wanted: int) -> None:
        head = whole[:, :_HEAD].astype(np.int64)
        self.some: Bools = (head[:, _CELLS] > 0) & (head[:, _WANTED] >= wanted)
        self.frame = Frame(*head.T[_X : _ROWS + 1].astype(np.float64))
        cells = np.where(self.some, head[:, _CELLS], 0)
        first = np.arange(len(whole)) * whole.shape[1] + _HEAD
        self.scene = np.repeat(np.arange(len(whole)), cells)
        # Fields follow each other with as many numbers as their map has cells, then runs.
        at, step = spans(first, cells), cells[self.scene]
        self._whole = whole.reshape(-1)
        self.cell, self._runs = (self._whole[at + k * step].astype(np.int64) for k in (0, 1))
        self.sign = self._whole[at + 2 * step].astype(np.int8)
        before = self._runs.cumsum() - self._runs
        of_map = np.append(before, 0)[cells.cumsum() - cells]
        self._first = before + (first + 3 * cells - of_map)[self.scene]
        self._all_runs, self._beside, self._total = head[:, _RUNS], number - head[:, _TOTAL], total

    def lists(self, place: Indices) -> tuple[Indices, Indices]:
        """Elements of each of some lists, given by their place among all, and all of these one after the other."""
        runs, scene = self._runs[place], self.scene[place]
        of, at = np.repeat(scene, runs), spans(self._first[place], runs)
        start = self._whole[at] + of * self._total
        length = self._whole[at + self._all_runs[of]].astype(np.int64)
        ends = runs.cumsum()
        length[ends - 1] = self._beside[scene]
        return np.add.reduceat(length, ends - runs), spans(start, length)
