"""Signed distances to oriented polylines, such as the edge of the road, and places along a line."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from symphony.geometry.nearest import on_host

NO_BOUNDARY = -1e6
"""Signed distance, in metres, where a scene has no boundary at all: nothing is off the road there."""
CLOSED_WITHIN = 1e-3  # metres between the ends of two lines (or of one line) below which they count as joined
_BLOCK = 1 << 18  # distances held at a time on the CPU, so that the temporaries stay in the cache
_FAR = 1e15  # offset of a segment that is not there


def signed_distance(
    points: Float[Tensor, "B M 2"],
    start: Float[Tensor, "B E 2"],
    end: Float[Tensor, "B E 2"],
    valid: Bool[Tensor, "B E"],
    previous: Int[Tensor, "B E"] | None = None,
    following: Int[Tensor, "B E"] | None = None,
) -> Float[Tensor, "B M"]:
    """Return the signed distance to the nearest oriented segment: positive on its right, negative on its left.

    With the drivable side on the left (see ``RoadMap.boundary``) positive means off the road. The absolute
    value is the Euclidean distance. Segments of no length and those not valid are ignored; a scene without
    segments gives :data:`NO_BOUNDARY`. A point that is not finite has no finite distance and changes nothing for
    others. Differentiable in ``points`` (the nearest segment is held fixed).

    Takes the ends of the segments, which of them exist, and the indices [B, E] of those that end where one starts and
    start where it ends, -1 if none: with them the sign is right at corners, too, which two segments share.
    """
    if start.shape[1] == 0:
        return points.sum(-1) * 0 + NO_BOUNDARY
    with torch.no_grad():
        valid = valid & has_length(start, end)
        nearest = _nearest_segment(points.detach(), start, end, valid)
    distance = distance_to(points, start, end, valid, previous, following, nearest)
    return torch.where(valid.any(-1, keepdim=True), distance, NO_BOUNDARY)


def has_length(start: Float[Tensor, "B E 2"], end: Float[Tensor, "B E 2"]) -> Bool[Tensor, "B E"]:
    """Return which segments are longer than a point."""
    return (start[..., 0] != end[..., 0]) | (start[..., 1] != end[..., 1])


def distance_to(
    points: Float[Tensor, "B M 2"],
    start: Float[Tensor, "B E 2"],
    end: Float[Tensor, "B E 2"],
    valid: Bool[Tensor, "B E"],
    previous: Int[Tensor, "B E"] | None,
    following: Int[Tensor, "B E"] | None,
    nearest: Int[Tensor, "B M"],
) -> Float[Tensor, "B M"]:
    """Return :func:`signed_distance` where the nearest segments are known; ``valid`` ones have a length."""
    here = _Side(points, _take(start, nearest), _take(end, nearest))
    sign = here.sign
    for neighbor, beyond, ahead in ((previous, here.fraction < 0, False), (following, here.fraction > 1, True)):
        # Most positions lie beside their segment; on the CPU it pays to see whether any lies past a corner.
        if neighbor is not None and not (on_host(points) and not bool(beyond.any())):
            corner = _corner_sign(points, start, end, valid, neighbor, nearest, here, ahead)
            sign = torch.where(beyond, corner, sign)
    inner = (here.fraction >= 0) & (here.fraction <= 1)
    return torch.where(inner, here.offset, sign * here.to_end)


class _Side:
    """The position of points [B, M, 2] relative to one segment each."""

    def __init__(
        self, points: Float[Tensor, "B M 2"], start: Float[Tensor, "B M 2"], end: Float[Tensor, "B M 2"]
    ) -> None:
        self.direction = end - start
        # Component by component: sums over a last dimension of 2 are slow.
        (along_x, along_y), (x, y) = self.direction.unbind(-1), (points - start).unbind(-1)
        squared = along_x.square() + along_y.square()
        squared = torch.where(squared > 0, squared, 1.0)
        self.fraction = ((x * along_x + y * along_y) / squared).detach()
        # Positive to the right of the direction of travel.
        self.offset = (x * along_y - y * along_x) * squared.rsqrt()
        self._away = x, y, along_x, along_y

    @property
    def to_end(self) -> Float[Tensor, "B M"]:
        """The distance to the nearer end."""
        x, y, along_x, along_y = self._away
        beyond = self.fraction > 0.5
        gap = (x - beyond * along_x).square() + (y - beyond * along_y).square()
        apart = gap != 0  # NaN stays NaN
        return torch.where(apart, torch.where(apart, gap, 1.0).sqrt(), 0.0)

    @property
    def sign(self) -> Float[Tensor, "B M"]:
        """+1 on the right, -1 on the left and on the line itself."""
        return 2.0 * (self.offset.detach() > 0).to(self.offset.dtype) - 1.0


@torch.no_grad()
def _corner_sign(
    points: Float[Tensor, "B M 2"],
    start: Float[Tensor, "B E 2"],
    end: Float[Tensor, "B E 2"],
    valid: Bool[Tensor, "B E"],
    neighbor: Int[Tensor, "B E"],
    nearest: Int[Tensor, "B M"],
    here: _Side,
    ahead: bool,
) -> Float[Tensor, "B M"]:
    """Return the sign at a corner: right of either segment if the line turns left, of both if it turns right."""
    index = neighbor.gather(1, nearest).long()
    exists = (index >= 0) & valid.gather(1, index.clamp(min=0))
    index = index.clamp(min=0)
    other = _Side(points, _take(start, index), _take(end, index))
    first, second = (here, other) if ahead else (other, here)
    a, b, one, two = first.direction, second.direction, here.sign, other.sign
    left = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0] > 0
    both = torch.where(left, torch.maximum(one, two), torch.minimum(one, two))
    return torch.where(exists, both, one)


def _take(values: Float[Tensor, "B E 2"], index: Int[Tensor, "B M"]) -> Float[Tensor, "B M 2"]:
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))


def _nearest_segment(
    points: Float[Tensor, "B M 2"],
    start: Float[Tensor, "B E 2"],
    end: Float[Tensor, "B E 2"],
    valid: Bool[Tensor, "B E"],
) -> Int[Tensor, "B M"]:
    """Return index [B, M] of the nearest valid segment."""
    batch, count, _ = points.shape
    # Coordinates relative to a point of the map keep float32 rounding well below a millimetre: halfway between the
    # outermost valid starts, 0 where there are none, so that no position has a say in it.
    low, high = (start.masked_fill(~valid[..., None], torch.inf), start.masked_fill(~valid[..., None], -torch.inf))
    center = (0.5 * (low.amin(1, keepdim=True) + high.amax(1, keepdim=True))).nan_to_num(0.0)
    x, y = (points - center)[..., None].unbind(2)
    axes = _segment_axes(start, end, valid, center)[:, :, None]
    group, most = batch, count
    if points.device.type == "cpu":
        most = max(1, min(count, _BLOCK // start.shape[1]))
        group = max(1, _BLOCK // max(most * start.shape[1], 1))
    result = torch.empty(batch, count, dtype=torch.long, device=points.device)
    for b, m in product(range(0, batch, max(group, 1)), range(0, count, max(most, 1))):
        part = slice(b, b + group), slice(m, m + most)
        unit_x, unit_y, along, across, half = axes[:, part[0]]
        beyond = torch.addcmul(along, x[part], unit_x).addcmul_(y[part], unit_y)
        beyond.abs_().sub_(half).clamp_(min=0).square_()
        side = torch.addcmul(across, x[part], unit_y).addcmul_(y[part], unit_x, value=-1)
        result[part] = beyond.addcmul_(side, side).argmin(-1)
    return result


def _segment_axes(
    start: Float[Tensor, "B E 2"],
    end: Float[Tensor, "B E 2"],
    valid: Bool[Tensor, "B E"],
    center: Float[Tensor, "B 1 2"],
) -> Float[Tensor, "5 B E"]:
    """Return each segment's unit vector, offsets along (from its middle) and across, and half length: [5, B, E].
    Component by component: operations on a last dimension of 2 are ten times slower.
    """
    # Padding may hold anything, NaN included.
    (x0, y0), (x1, y1) = (
        torch.where(valid[..., None], end_point - center, 0.0).unbind(-1) for end_point in (start, end)
    )
    unit_x, unit_y = x1 - x0, y1 - y0
    length = torch.hypot(unit_x, unit_y)
    inverse = torch.where(valid, length, 1.0).reciprocal()
    unit_x, unit_y = unit_x * inverse, unit_y * inverse
    x, y = -0.5 * (x0 + x1), -0.5 * (y0 + y1)
    along = torch.addcmul(x * unit_x, y, unit_y)
    across = torch.addcmul(x * unit_y, y, unit_x, value=-1).masked_fill(~valid, _FAR)
    return torch.stack([unit_x, unit_y, along, across, 0.5 * length])


def segments_of(
    points: NDArray[Any], offsets: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.int64], NDArray[np.int64]]:
    """Cut ragged polylines into the segments :func:`signed_distance` takes.

    Line k is ``points[offsets[k]:offsets[k + 1]]``. A line whose last point lies within :data:`CLOSED_WITHIN` of its
    first one is a ring; a line that starts where exactly one other line ends continues it. Repeated points are
    dropped. Returns start [E, 2], end [E, 2], and the indices [E] of previous and following segments (-1: none).
    """
    points = np.asarray(points)[:, :2]
    counts = np.diff(offsets)
    line = np.repeat(np.arange(len(counts)), counts)
    joined = np.flatnonzero((line[1:] == line[:-1]) & (points[1:] != points[:-1]).any(-1))
    start, end, line = points[joined], points[joined + 1], line[joined]
    number = np.arange(len(line))
    same = np.append(line[1:] == line[:-1], False)[: len(line)]
    following = np.where(same, number + 1, -1)
    previous = np.where(np.roll(same, 1), number - 1, -1)
    first, last = np.flatnonzero(previous < 0), np.flatnonzero(following < 0)
    meet = np.abs(end[last, None] - start[None, first]).max(-1) <= CLOSED_WITHIN
    own = meet & (line[last, None] == line[None, first])
    # A ring's own ends come first; other lines are joined only where the match is one to one.
    other = meet & ~own.any(1)[:, None] & ~own.any(0)[None]
    other &= (other.sum(1) == 1)[:, None] & (other.sum(0) == 1)[None]
    tail, head = np.nonzero(own | other)
    following[last[tail]] = first[head]
    previous[first[head]] = last[tail]
    return start, end, previous.astype(np.int64), following.astype(np.int64)


Reals = NDArray[np.float64]

NEAR = 1.0
"""Metres by which an earlier pass may be farther away than the nearest and is still where a path begins."""
_SLACK = 3.0  # metres along the line, besides the distance driven, within which the next place is sought
_CUT = 1.5  # metres along the line to a metre driven: cutting a corner is faster
_TOGETHER = 1 << 15  # distances of points to pieces that are found together


def stations_along(
    lines: Float[NDArray[np.float64], "R P 2"],
    path: Float[NDArray[np.float64], "R U 2"],
    valid: Bool[NDArray[np.bool_], "R U"],
) -> Float[NDArray[np.float64], "R U"]:
    """Return the metres along each line of the points of a path that follows it; NaN where it is not valid.

    A path begins at the earliest place that is nearest to it, or nearly so, and goes on from there: a step leads at
    most as far along the line as was driven, and some metres.

    Shorter lines repeat their last point. A ValueError names line and step where a point that exists is not finite.
    """
    wrong = np.argwhere(valid & ~np.isfinite(path).all(-1))
    if len(wrong):
        raise ValueError(f"path {wrong[0, 0]}, step {wrong[0, 1]}: a point that exists is not finite")
    way = np.diff(lines, axis=1)
    length = np.linalg.norm(way, axis=-1)
    direction = way / np.maximum(length, np.finfo(np.float64).tiny)[..., None]
    arc = np.concatenate([np.zeros_like(length[:, :1]), length.cumsum(1)], 1)
    row, found = np.arange(len(lines)), np.full(valid.shape, np.nan)
    first, reach = valid.argmax(1), _reach(path, valid)
    station = np.zeros(len(lines))
    block = max(1, _TOGETHER // max(1, length.size))
    for a in range(0, path.shape[1], block):
        part = path[:, a : a + block, None]
        share, _, distance = to_pieces(lines[:, None, :-1], direction[:, None], length[:, None], part)
        # Each step depends on the one before; all that does not is known by now.
        for k in range(part.shape[1]):
            step, near = a + k, distance[:, k]
            low, high = (station - reach[:, step])[:, None], (station + reach[:, step])[:, None]
            inside = (arc[:, 1:] >= low) & (arc[:, :-1] <= high)
            piece = np.where(inside, near, np.inf).argmin(1)
            begins = np.flatnonzero(first == step)
            if len(begins):
                piece[begins] = earliest_pass(near[begins])
            station = np.where(valid[:, step], arc[row, piece] + share[row, k, piece], station)
            found[:, step] = station
    return np.where(valid, found, np.nan)


def _reach(
    path: Float[NDArray[np.float64], "R U 2"], valid: Bool[NDArray[np.bool_], "R U"]
) -> Float[NDArray[np.float64], "R U"]:
    """Return metres along the line within which the next place is sought, from the last point that exists."""
    steps = np.arange(path.shape[1])
    before = np.maximum.accumulate(np.where(valid, steps, 0), 1)[:, :-1]
    last = np.take_along_axis(path, before[..., None], 1)
    driven = np.linalg.norm(path[:, 1:] - last, axis=-1)
    return _CUT * np.pad(driven, ((0, 0), (1, 0))) + _SLACK


def earliest_pass(distance: Float[NDArray[np.float64], "*b pieces"]) -> NDArray[np.int64]:
    """Return the first piece of a line that is nearer than those beside it, and nearly the nearest of all."""
    beside = np.pad(distance, [(0, 0)] * (distance.ndim - 1) + [(1, 1)], constant_values=np.inf)
    lowest = (distance <= beside[..., :-2]) & (distance <= beside[..., 2:])
    return (lowest & (distance <= distance.min(-1, keepdims=True) + NEAR)).argmax(-1)


def to_pieces(
    start: Reals, direction: Reals, length: Reals, point: NDArray[np.floating]
) -> tuple[Reals, Reals, Reals]:
    """Return metres along each piece of a line to its place nearest to a point, and the vector [..., 2] and distance
    between the two. Pieces have a start [..., 2], a unit direction (zero for no length) and a length [...].
    """
    # Component by component: sums over a last dimension of 2 are slow.
    x, y = (point[..., k] - start[..., k] for k in (0, 1))
    along_x, along_y = direction[..., 0], direction[..., 1]
    share = (x * along_x + y * along_y).clip(0.0, length)
    x, y = x - share * along_x, y - share * along_y
    return share, np.stack([x, y], -1), np.sqrt(x * x + y * y)
