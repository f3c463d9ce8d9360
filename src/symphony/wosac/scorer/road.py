"""Signed distance to the road edge."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.wosac.scorer.boxes import corners
from symphony.wosac.scorer.cells import Bounds, Boxes, Measure, nearest
from symphony.wosac.scorer.scenario import Lines

NOWHERE = -1e10
"""Distance, in metres, of an object that is not valid."""
STRETCH = 3.0
"""Weight of height in choosing the nearest edge, so that one on another level is not taken."""
CLOSED = 1.0
"""Square metres between the ends of a line below which it is closed."""


@dataclass(frozen=True)
class Edges:
    """S segments of oriented polylines.

    Attributes:
        start: [S, 3] first point, metres.
        along: [S, 3] from the first point to the last.
        squared: [S] squared length in the plane.
        previous: [S] the segment before on the same line, -1 for none.
        following: [S] the one after.
    """

    start: Float[Tensor, "S 3"]
    along: Float[Tensor, "S 3"]
    squared: Float[Tensor, " S"]
    previous: Int[Tensor, " S"]
    following: Int[Tensor, " S"]

    @classmethod
    def of(cls, lines: Lines) -> Edges:
        """Cut lines into segments, float32; lines of one point have none.

        A closed line's last segment is followed by its first one only if no line has more points, as in the official
        scorer, where padding separates the two otherwise.
        """
        lines = lines.keep(lines.counts >= 2)
        points, counts = lines.points.float(), lines.counts
        line = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
        first = (line[1:] == line[:-1]).nonzero()[:, 0]
        start, along = points[first], points[first + 1] - points[first]
        line = line[first]
        ends = (counts - 1).cumsum(0)
        begins = ends - (counts - 1)
        number = torch.arange(len(line), device=counts.device)
        heads, tails = points[counts.cumsum(0) - counts], points[counts.cumsum(0) - 1]
        closed = ((heads - tails).square().sum(-1) < CLOSED) & (counts == counts.max())
        before, after = torch.where(closed, ends - 1, -1), torch.where(closed, begins, -1)
        return cls(
            start,
            along,
            along[:, 0] * along[:, 0] + along[:, 1] * along[:, 1],
            torch.where(number == begins[line], before[line], number - 1),
            torch.where(number == ends[line] - 1, after[line], number + 1),
        )

    def fraction(self, away: Float[Tensor, "M 3"], segment: Int[Tensor, " M"]) -> Float[Tensor, " M"]:
        """Where along each segment a point is nearest in the plane: 0 at the first point, 1 at the last.

        Args:
            away: from the segment's first point to the point.
            segment: index of the segment.
        """
        along, squared = self.along[segment], self.squared[segment]
        share = (away[:, 0] * along[:, 0] + away[:, 1] * along[:, 1]) / torch.where(
            squared == 0, 1.0, squared
        )
        return torch.where(squared == 0, 0.0, share)

    def side(self, points: Float[Tensor, "M 3"], segment: Int[Tensor, " M"]) -> Float[Tensor, " M"]:
        """1 to the right of the line through the segment, -1 to its left, 0 on it."""
        return cross(points - self.start[segment], self.along[segment]).sign()


def cross(a: Float[Tensor, "*shape 3"], b: Float[Tensor, "*shape 3"]) -> Float[Tensor, "*shape"]:
    """Cross product in the plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def signed_distance_to_edges(
    points: Float[Tensor, "M 3"], edges: Edges, stretch: float = STRETCH
) -> Float[Tensor, " M"]:
    """Distance in the plane to the nearest edge, positive to its right (off the road), negative to its left.

    The nearest is chosen with heights multiplied by ``stretch``. Where the nearest place is an end that two segments
    share, the side is that of both: right of either where the line turns left, of both where it turns right.
    """
    end = edges.start + edges.along
    boxes = Boxes(torch.minimum(edges.start, end), torch.maximum(edges.start, end))
    weights = points.new_tensor([1.0, 1.0, stretch])
    bounds, measure = _bounds(edges, boxes, stretch), _measure(points, edges, stretch)
    segment = nearest(points, boxes, weights, bounds, measure)
    away = points - edges.start[segment]
    fraction = edges.fraction(away, segment)
    offset = away - fraction.clamp(0, 1)[:, None] * edges.along[segment]
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


def _measure(points: Tensor, edges: Edges, stretch: float) -> Measure:
    def measure(point: Tensor, segment: Tensor) -> Tensor:
        away = points[point] - edges.start[segment]
        offset = away - edges.fraction(away, segment).clamp(0, 1)[:, None] * edges.along[segment]
        x, y, z = offset.unbind(-1)
        z = z * stretch
        return (x * x + y * y + z * z).sqrt()

    return measure


def _bounds(edges: Edges, boxes: Boxes, stretch: float) -> Bounds:
    inverse = torch.where(edges.squared > 0, edges.squared, 1.0).reciprocal()

    def bounds(cells: Boxes, segment: Tensor) -> tuple[Tensor, Tensor]:
        x, y, _ = ((cells.low + cells.high) / 2 - edges.start[segment]).unbind(-1)
        along_x, along_y, _ = edges.along[segment].unbind(-1)
        fraction = ((x * along_x + y * along_y) * inverse[segment]).clamp_(0, 1)
        away = torch.hypot(x - fraction * along_x, y - fraction * along_y)
        size_x, size_y, _ = (cells.high - cells.low).unbind(-1)
        radius = torch.hypot(size_x, size_y) / 2 + cells.slack
        below = boxes.low[segment, 2] - cells.high[:, 2]
        above = cells.low[:, 2] - boxes.high[segment, 2]
        apart = torch.maximum(below, above).clamp_(min=0)
        far = torch.maximum(
            boxes.high[segment, 2] - cells.low[:, 2], cells.high[:, 2] - boxes.low[segment, 2]
        )
        return (
            torch.hypot((away - radius).clamp_(min=0), apart * stretch),
            torch.hypot(away + radius, far * stretch),
        )

    return bounds


def distance_to_road_edge(
    center: Float[Tensor, "*batch 3"],
    heading: Float[Tensor, "*batch"],
    size: Float[Tensor, "*batch 3"],
    valid: Bool[Tensor, "*batch"],
    edges: Edges,
) -> Float[Tensor, "*batch"]:
    """Greatest signed distance of a box's four lower corners; :data:`NOWHERE` where it is not valid."""
    ground = corners(center[..., :2], heading, size[..., :2])
    bottom = center[..., 2] - size[..., 2] / 2
    points = torch.cat([ground, bottom[..., None, None].expand(*ground.shape[:-1], 1)], dim=-1)
    result = torch.full_like(heading, NOWHERE)
    distance = signed_distance_to_edges(points[valid].reshape(-1, 3), edges)
    result[valid] = distance.view(-1, 4).amax(-1)
    return result
