"""The nearest of many segments to each of many points, without looking at every pair.

Points are grouped into small cells. For all points of a cell at once, a bound from below and one from above of each
segment's distance tell which segments can be the nearest at all; only those are measured for each point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

CELL = 4.0
"""Metres. A choice of speed: results don't depend on it."""
_PAIRS = 1 << 19
"""Pairs of a cell and a segment, or of a point and a segment, that are held at a time."""
_INDICES = 1 << 20


@dataclass(frozen=True)
class Cells:
    """C boxes, each around the points of one cell.

    Attributes:
        low: [C, D] smallest coordinates.
        high: [C, D] greatest coordinates.
    """

    low: Float[Tensor, "C D"]
    high: Float[Tensor, "C D"]

    @property
    def slack(self) -> Float[Tensor, "C 1"]:
        """Metres of rounding that bounds have to allow for."""
        return 0.05 + 1e-6 * torch.maximum(self.low.abs(), self.high.abs()).amax(-1, keepdim=True)

    def __getitem__(self, rows: slice) -> Cells:
        return Cells(self.low[rows], self.high[rows])


Bounds = Callable[[Cells], tuple[Tensor, Tensor]]
"""From cells to (lower, upper) bounds [C, S] of the distance of any of a cell's points to each of S segments."""
Measure = Callable[[Tensor, Tensor], Tensor]
"""From indices [Q] of points and of segments to distances [Q]."""


def nearest(
    points: Float[Tensor, "M D"], segments: int, bounds: Bounds, measure: Measure
) -> Int[Tensor, " M"]:
    """Index of the nearest segment to each point; of several, the first one.

    Args:
        points: in metres.
        segments: how many there are, at least one.
        bounds: of a cell's distances; a segment whose lower bound is above another one's upper bound is left out.
        measure: the distance itself.
    """
    order, sizes, cells = _group(points)
    result = points.new_empty(len(points), dtype=torch.long)
    done = 0
    step = max(1, _PAIRS // segments)
    for start in range(0, len(sizes), step):
        lower, upper = bounds(cells[start : start + step])
        cell, candidate = (lower <= upper.amin(1, keepdim=True)).nonzero(as_tuple=True)
        here = sizes[start : start + step]
        members = order[done : done + int(here.sum())]
        done += len(members)
        result[members] = _first(members, here, candidate, torch.bincount(cell, minlength=len(here)), measure)
    return result


def _group(points: Tensor) -> tuple[Tensor, Tensor, Cells]:
    """(points ordered by cell, number of points per cell, the cells)."""
    # A cell may be as large as it likes, its box is taken from its points: far away, many share one.
    index = (points / CELL).floor().clamp(-_INDICES, _INDICES - 1).long() + _INDICES
    key = torch.zeros_like(index[:, 0])
    for axis in index.unbind(-1):
        key = key * (2 * _INDICES) + axis
    _, cell, sizes = key.unique(return_inverse=True, return_counts=True)
    spread = cell[:, None].expand_as(points)
    shape = len(sizes), points.shape[-1]
    low = points.new_full(shape, torch.inf).scatter_reduce_(0, spread, points, "amin")
    high = points.new_full(shape, -torch.inf).scatter_reduce_(0, spread, points, "amax")
    return cell.argsort(stable=True), sizes, Cells(low, high)


def _first(points: Tensor, sizes: Tensor, candidate: Tensor, counts: Tensor, measure: Measure) -> Tensor:
    """Nearest candidate of each point; cell c has ``sizes[c]`` points and ``counts[c]`` candidates, in order."""
    cell = torch.arange(len(sizes), device=points.device).repeat_interleave(sizes)
    begin = (counts.cumsum(0) - counts)[cell]
    pairs = counts[cell]
    ends = pairs.cumsum(0)
    result = []
    start, used = 0, 0
    while start < len(points):
        stop = max(start + 1, int(torch.searchsorted(ends, used + _PAIRS, right=True)))
        rows = slice(start, stop)
        lengths = pairs[rows]
        row = torch.arange(len(lengths), device=points.device).repeat_interleave(lengths)
        offset = lengths.cumsum(0) - lengths
        # Pair q of this block is candidate number q - offset of its point.
        which = torch.arange(len(row), device=points.device) + (begin[rows] - offset)[row]
        segment = candidate[which]
        distance = measure(points[rows][row], segment)
        least = torch.segment_reduce(distance, "min", lengths=lengths)
        tied = (distance == least[row]).nonzero()[:, 0]
        best = torch.full_like(lengths, len(row)).scatter_reduce_(0, row[tied], tied, "amin")
        result.append(segment[best])
        start, used = stop, int(ends[stop - 1])
    return torch.cat(result)
