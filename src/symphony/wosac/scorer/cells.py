"""The nearest of many segments to each of many points, without looking at every pair.

Points are grouped into small cells, consecutive segments into blocks. For all points of a cell at once, bounds of
the distance tell first which blocks, then which of their segments can be the nearest at all; only those are measured
for each point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

CELL = 3.0
"""Metres. A choice of speed, as are the next two: results don't depend on them."""
_BLOCK = 32
"""Segments in a block."""
_PAIRS = 1 << 17
"""Pairs of a cell or a point and a segment that are held at a time."""
_INDICES = 1 << 20


@dataclass(frozen=True)
class Boxes:
    """Axis-parallel boxes around K things in D dimensions, metres."""

    low: Float[Tensor, "K D"]
    high: Float[Tensor, "K D"]

    def __getitem__(self, rows: slice | Tensor) -> Boxes:
        return Boxes(self.low[rows], self.high[rows])

    @property
    def slack(self) -> Float[Tensor, " K"]:
        """Metres of rounding that bounds have to allow for."""
        return 0.05 + 1e-6 * torch.maximum(self.low.abs(), self.high.abs()).amax(-1)


Bounds = Callable[[Boxes, Tensor], tuple[Tensor, Tensor]]
"""From boxes of points and indices [Q] of segments to (lower, upper) bounds [Q] of the distance of any such point."""
Measure = Callable[[Tensor, Tensor], Tensor]
"""From indices [Q] of points and of segments to distances [Q]."""


def nearest(
    points: Float[Tensor, "M D"],
    segments: Boxes,
    weights: Float[Tensor, " D"],
    bounds: Bounds,
    measure: Measure,
) -> Int[Tensor, " M"]:
    """Index of the nearest segment to each point; of several, the first one.

    Args:
        points: in metres.
        segments: boxes around the segments, of which there is at least one; no point is nearer to a segment than to
            its box.
        weights: of the dimensions in the distance to a box.
        bounds: of the distances to a segment.
        measure: the distance itself.
    """
    order, sizes, cells = _group(points)
    blocks = _blocks(segments)
    result = points.new_empty(len(points), dtype=torch.long)
    done = 0
    step = max(1, 16 * _PAIRS // (_BLOCK * len(blocks.low)))
    for start in range(0, len(sizes), step):
        here = sizes[start : start + step]
        cell, segment = _candidates(cells[start : start + step], segments, blocks, weights, bounds)
        members = order[done : done + int(here.sum())]
        done += len(members)
        result[members] = _first(members, here, segment, torch.bincount(cell, minlength=len(here)), measure)
    return result


def _group(points: Tensor) -> tuple[Tensor, Tensor, Boxes]:
    """(points ordered by cell, number of points per cell, box around the points of each cell)."""
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
    return cell.argsort(stable=True), sizes, Boxes(low, high)


def _blocks(segments: Boxes) -> Boxes:
    missing = -len(segments.low) % _BLOCK
    low = functional.pad(segments.low, (0, 0, 0, missing), value=torch.inf)
    high = functional.pad(segments.high, (0, 0, 0, missing), value=-torch.inf)
    return Boxes(low.unflatten(0, (-1, _BLOCK)).amin(1), high.unflatten(0, (-1, _BLOCK)).amax(1))


def _candidates(
    cells: Boxes, segments: Boxes, blocks: Boxes, weights: Tensor, bounds: Bounds
) -> tuple[Tensor, Tensor]:
    """Pairs (cell, segment) of what can be nearest, in ascending order."""
    device = cells.low.device
    count, width = len(cells.low), len(blocks.low)
    gap = torch.zeros(count, width, device=device)
    for axis, weight in enumerate(weights):
        below = blocks.low[:, axis] - cells.high[:, None, axis]
        above = cells.low[:, None, axis] - blocks.high[:, axis]
        gap += (torch.maximum(below, above).clamp_(min=0) * weight).square_()
    gap = gap.sqrt_() - cells.slack[:, None]
    # One segment of each block is enough for a first bound from above.
    cell = torch.arange(count, device=device).repeat_interleave(width)
    middle = (torch.arange(width, device=device) * _BLOCK + _BLOCK // 2).clamp(max=len(segments.low) - 1)
    most = bounds(cells[cell], middle.repeat(count))[1].view(count, width).amin(1)
    cell, block = (gap <= most[:, None]).nonzero(as_tuple=True)
    cell = cell.repeat_interleave(_BLOCK)
    segment = (block[:, None] * _BLOCK + torch.arange(_BLOCK, device=device)).flatten()
    there = segment < len(segments.low)
    cell, segment = cell[there], segment[there]
    lower, upper = bounds(cells[cell], segment)
    most = torch.segment_reduce(upper, "min", lengths=torch.bincount(cell, minlength=count))
    kept = lower <= most[cell]
    return cell[kept], segment[kept]


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
