"""Signed distance to the road edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.wosac.scorer.boxes import corners

NOWHERE = -1e10  # distance, in metres, of an object that is not valid
STRETCH = 3.0  # weight of height in choosing the nearest edge, so that one on another level is not taken
CLOSED = 1.0  # square metres between the ends of a line below which it is closed
_CELL = 1.0  # metres. A choice of speed, as is the next one: results don't depend on them.
_TOGETHER = 1 << 16  # points processed together


@dataclass(frozen=True)
class Edges:
    """S segments of oriented polylines."""

    start: Float[Tensor, "S 3"]  # first point, metres
    along: Float[Tensor, "S 3"]  # from the first point to the last
    squared: Float[Tensor, " S"]  # squared length in the plane
    previous: Int[Tensor, " S"]  # the segment before on the same line, -1 for none
    following: Int[Tensor, " S"]  # the one after
    tree: shapely.STRtree  # of the segments in the plane

    @classmethod
    def of(cls, lines: Sequence[Any]) -> Edges:
        """Cut lines [P, 3] into segments, float32; lines of one point have none.

        A closed line's last segment is followed by its first one only if no line has more points, as in the official
        scorer, where padding separates the two otherwise.
        """
        arrays = [np.asarray(line, np.float32) for line in lines if len(line) >= 2]
        longest = max(map(len, arrays))
        previous, following, first = [], [], 0
        for line in arrays:
            own = np.arange(first, first := first + len(line) - 1)
            closed = len(line) == longest and np.square(line[0] - line[-1]).sum() < CLOSED
            previous.append(np.append(own[-1] if closed else -1, own[:-1]))
            following.append(np.append(own[1:], own[0] if closed else -1))
        start = torch.from_numpy(np.concatenate([line[:-1] for line in arrays]))
        along = torch.from_numpy(np.concatenate([line[1:] - line[:-1] for line in arrays]))
        ends = torch.stack([start, start + along], 1)[..., :2].double()
        return cls(
            start,
            along,
            along[:, 0] * along[:, 0] + along[:, 1] * along[:, 1],
            torch.from_numpy(np.concatenate(previous)),
            torch.from_numpy(np.concatenate(following)),
            shapely.STRtree(shapely.linestrings(ends.numpy())),
        )

    def offset(
        self, points: Float[Tensor, "M 3"], segment: Int[Tensor, " M"]
    ) -> tuple[Float[Tensor, "M 3"], Float[Tensor, " M"]]:
        """Return the vector from the nearest place of a segment, in the plane, to each point; and where along the
        segment's line the point is, 0 at the first point and 1 at the last.
        """
        away, along, squared = points - self.start[segment], self.along[segment], self.squared[segment]
        share = away[:, 0] * along[:, 0] + away[:, 1] * along[:, 1]
        share = torch.where(squared == 0, 0.0, share / torch.where(squared == 0, 1.0, squared))
        return away - share.clamp(0, 1)[:, None] * along, share

    def distance(
        self, points: Float[Tensor, "M 3"], segment: Int[Tensor, " M"], stretch: float
    ) -> Float[Tensor, " M"]:
        """Return the distance that decides which segment is nearest, with heights multiplied by ``stretch``."""
        x, y, z = self.offset(points, segment)[0].unbind(-1)
        z = z * stretch
        return (x * x + y * y + z * z).sqrt()

    def nearest(self, points: Float[Tensor, "M 3"], stretch: float) -> Int[Tensor, " M"]:
        """Return the index of the nearest segment to each point; of several, the first one.

        Points share a cell. The segment that is nearest to one of them in the plane gives a bound for all of them;
        only segments within it, and within the cell's size more, are measured for each point.
        """
        index = (points[:, :2] / _CELL).floor().long()
        key, cell = torch.unique((index[:, 0] << 32) + index[:, 1], return_inverse=True)
        rows = torch.arange(len(points))
        member = points[torch.zeros_like(key).scatter_(0, cell, rows), :2].double()
        centres = shapely.points(member.numpy())
        guess = torch.from_numpy(self.tree.nearest(centres))[cell]
        bound = self.distance(points, guess, stretch).double()
        bound = torch.zeros(len(key), dtype=bound.dtype).scatter_reduce_(0, cell, bound, "amax")
        # Between points of a cell there is at most its diagonal; the rest is for rounding.
        bound += _CELL * 2**0.5 + 1e-3 + 1e-6 * member.abs().amax(-1)
        owner, near = torch.from_numpy(self.tree.query(centres, "dwithin", bound.numpy()))
        count = owner.bincount(minlength=len(key))
        # Every point with all that may be nearest in its cell, one after the other.
        row = rows.repeat_interleave(count[cell])
        begin = (count.cumsum(0) - count)[cell] - (count[cell].cumsum(0) - count[cell])
        segment = near[torch.arange(len(row)) + begin[row]]
        return first_of_least(row, segment, self.distance(points[row], segment, stretch), len(points))

    def side(self, points: Float[Tensor, "M 3"], segment: Int[Tensor, " M"]) -> Float[Tensor, " M"]:
        """Return 1 to the right of the line through the segment, -1 to its left, 0 on it."""
        return cross(points - self.start[segment], self.along[segment]).sign()


def first_of_least(
    row: Int[Tensor, " Q"], segment: Int[Tensor, " Q"], distance: Float[Tensor, " Q"], count: int
) -> Int[Tensor, " M"]:
    """Return the segment at the smallest distance in each of M rows, the first of several."""
    least = torch.full((count,), torch.inf).scatter_reduce_(0, row, distance, "amin")
    tied = distance == least[row]
    found = torch.full((count,), torch.iinfo(torch.int64).max)
    return found.scatter_reduce_(0, row[tied], segment[tied], "amin")


def cross(a: Float[Tensor, "*shape 3"], b: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape"]:
    """Return the cross product in the plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def signed_distance_to_edges(
    points: Float[Tensor, "M 3"], edges: Edges, stretch: float = STRETCH
) -> Float[Tensor, " M"]:
    """Return the plane distance to the nearest edge: positive to its right (off the road), negative to its left.

    The nearest is chosen with heights multiplied by ``stretch``. Where the nearest place is an end that two segments
    share, the side is that of both: right of either where the line turns left, of both where it turns right.
    """
    return torch.cat([_signed_distance(part, edges, stretch) for part in points.split(_TOGETHER)])


def _signed_distance(points: Tensor, edges: Edges, stretch: float) -> Tensor:
    segment = edges.nearest(points, stretch)
    offset, fraction = edges.offset(points, segment)
    distance = (offset[:, 0] * offset[:, 0] + offset[:, 1] * offset[:, 1]).sqrt()
    own = edges.side(points, segment)
    before, after = edges.previous[segment], edges.following[segment]
    ahead = fraction > 1
    neighbour = torch.where(ahead, after, torch.where(fraction < 0, before, -1))
    other = neighbour.clamp(min=0)
    theirs = edges.side(points, other)
    turn = cross(edges.along[segment], edges.along[other])
    left = torch.where(ahead, turn, -turn) > 0
    both = torch.where(left, torch.maximum(own, theirs), torch.minimum(own, theirs))
    return torch.where(neighbour >= 0, both, own) * distance


def distance_to_road_edge(
    center: Float[Tensor, "*batch 3"],
    heading: Float[Tensor, "*batch"],
    size: Float[Tensor, "*batch 3"],
    valid: Bool[Tensor, "*batch"],
    edges: Edges,
) -> Float[Tensor, "*batch"]:
    """Return the greatest signed distance of a box's four lower corners; :data:`NOWHERE` where it is not valid."""
    ground = corners(center[..., :2], heading, size[..., :2])
    bottom = center[..., 2] - size[..., 2] / 2
    points = torch.cat([ground, bottom[..., None, None].expand(*ground.shape[:-1], 1)], dim=-1)
    result = torch.full_like(heading, NOWHERE)
    distance = signed_distance_to_edges(points[valid].reshape(-1, 3), edges)
    result[valid] = distance.view(-1, 4).amax(-1)
    return result
