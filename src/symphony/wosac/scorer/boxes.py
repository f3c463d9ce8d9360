"""Boxes in the plane: the distance to the nearest one, and the time to collision with the one ahead."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

NONE = 1e10  # distance, in metres, where there is no other valid object
ROUNDING = 0.7  # share of half the shorter side by which the corners of a box are rounded
FAR_AHEAD = 5.0  # greatest time to collision, seconds
SAME_WAY, NEARLY_SAME_WAY = math.radians(75.0), math.radians(10.0)
"""Heading differences up to which an object ahead is followed, and one that overlaps little sideways."""
LITTLE_OVERLAP = 0.5  # metres of sideways overlap that are little
_PAIRS = 1 << 20  # pairs of an object and another one, per step, processed together
_SIGNS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
_BY_TURNS = ([0, 1, 1, 2, 2, 3, 3, 0], [0, 0, 1, 1, 2, 2, 3, 3])
"""Corners of either rectangle that each corner of the octagon of :func:`rectangle_gap` is made of."""


class Boxes(NamedTuple):
    """Boxes of n objects over T steps in R rollouts."""

    position: Float[Tensor, "R n T 2"]  # centres, metres
    heading: Float[Tensor, "R n T"]  # radians
    size: Float[Tensor, "R n T 2"]  # length and width, metres
    valid: Bool[Tensor, "R n T"]
    speed: Float[Tensor, "R n T"]  # m/s in the plane, NaN where unknown

    def blocks(self, evaluated: int) -> Iterator[Boxes]:
        """Yield a few rollouts at a time, as memory allows."""
        step = max(1, _PAIRS // max(1, evaluated * self.valid[0].numel()))
        for start in range(0, len(self.valid), step):
            yield Boxes(*(values[start : start + step] for values in self))


def corners(
    center: Float[Tensor, "*batch 2"], heading: Float[Tensor, "*batch"], size: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch 4 2"]:
    """Return corners counter-clockwise: front left, rear left, rear right, front right.

    In float32, which rounds them to millimetres far from the origin: unlike :func:`symphony.geometry.box_corners`,
    sine and cosine are correctly rounded, so that this rounding is always the official scorer's.
    """
    x, y = (0.5 * size[..., None, :] * torch.tensor(_SIGNS, dtype=size.dtype)).unbind(-1)
    wide = heading.double()[..., None]
    cos, sin = wide.cos().to(heading.dtype), wide.sin().to(heading.dtype)
    return center[..., None, :] + torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def rectangle_gap(a: Float[Tensor, "M 4 2"], b: Float[Tensor, "M 4 2"]) -> Float[Tensor, " M"]:
    """Return the signed distance of rectangles, given by their corners counter-clockwise.

    The Euclidean gap, or minus the length of the shortest translation that separates them: the distance of the origin
    to the edge of the octagon of all differences of a point of a and one of b, negative inside.

    In the octagon, sides of a and b follow each other by turns from its lowest corner on. Which of the two comes
    first is found once, from the corners as they are rounded, as in the official scorer: far from the origin, where
    they are rounded to millimetres, that shows for rectangles that are nearly parallel.
    """
    a, minus_b = _from_the_lowest(a), _from_the_lowest(-b)
    side_a, side_b = a[:, 1] - a[:, 0], minus_b[:, 1] - minus_b[:, 0]
    a_first = side_a[:, 0] * side_b[:, 1] - side_a[:, 1] * side_b[:, 0] >= 0
    one, other = _BY_TURNS
    corner = torch.where(a_first[:, None, None], a[:, one] + minus_b[:, other], a[:, other] + minus_b[:, one])
    side = corner.roll(-1, 1) - corner
    x, y = (-corner).unbind(-1)
    side_x, side_y = side.unbind(-1)
    # To the right of any side is outside.
    inside = (x * side_y - y * side_x <= 0).all(1)
    share = ((x * side_x + y * side_y) / (side_x.square() + side_y.square())).clamp(0, 1)
    away = torch.hypot(x - share * side_x, y - share * side_y).amin(1)
    return torch.where(inside, -away, away)


def _from_the_lowest(corners: Tensor) -> Tensor:
    index = (corners[..., 1].argmin(1, keepdim=True) + torch.arange(4)) % 4
    return corners.gather(1, index[..., None].expand(-1, -1, 2))


def distance_to_nearest(boxes: Boxes, evaluated: int) -> Float[Tensor, "R E T"]:
    """Return the signed distance in the plane from each of the first E objects to the nearest other one.

    Boxes have rounded corners: a core, smaller by ``2 r`` in length and width, grown by ``r``, where ``r`` is
    :data:`ROUNDING` times half the shorter side. Negative is minus the depth of the overlap of the cores, less both
    radii. :data:`NONE` where the object or every other one is not valid.
    """
    return torch.cat([_nearest(block, evaluated) for block in boxes.blocks(evaluated)])


def _nearest(boxes: Boxes, evaluated: int) -> Tensor:
    position, heading, size, valid, _ = boxes
    radius = ROUNDING * size.amin(-1) / 2
    core = size - 2 * radius[..., None]
    # Each box holds a circle and is held by one, which is enough to leave most pairs out; the slack is for rounding.
    inner, outer = size.amin(-1) / 2, core.norm(dim=-1) / 2 + radius
    delta = position[:, None] - position[:, :evaluated, None]
    away = torch.hypot(delta[..., 0], delta[..., 1])
    pairs = valid[:, None] & valid[:, :evaluated, None]
    own = torch.arange(evaluated)
    pairs[:, own, own] = False
    most = torch.where(pairs, away - (inner[:, None] + inner[:, :evaluated, None]), NONE)
    least = away - (outer[:, None] + outer[:, :evaluated, None])
    pairs &= least <= most.amin(2, keepdim=True) + 0.05 + 1e-6 * position.abs().amax()

    r, i, j, t = pairs.nonzero(as_tuple=True)
    # The corners are rounded where they lie, as in the official scorer: far from the origin that shows.
    mine = corners(position[r, i, t], heading[r, i, t], core[r, i, t])
    theirs = corners(position[r, j, t], heading[r, j, t], core[r, j, t])
    gap = rectangle_gap(mine, theirs) - radius[r, i, t] - radius[r, j, t]
    result = torch.full_like(away[:, :, 0], NONE)
    flat = (r * evaluated + i) * valid.shape[-1] + t
    result.view(-1).scatter_reduce_(0, flat, gap, "amin")
    return result


def time_to_collision(boxes: Boxes, evaluated: int) -> Float[Tensor, "R E T"]:
    """Return seconds until each of the first E objects would hit the one it follows at their speeds, at most 5.

    The difference of the headings is taken as it is, not brought into one turn, as the official scorer does: a pair
    whose headings are a turn apart has no follower. The validity of the object itself is ignored.
    """
    return torch.cat([_time_to_collision(block, evaluated) for block in boxes.blocks(evaluated)])


def _time_to_collision(boxes: Boxes, evaluated: int) -> Tensor:
    position, heading, size, valid, speed = boxes
    mine = heading[:, :evaluated]
    turn = (heading[:, None] - mine[:, :, None]).abs()
    cos, sin = turn.cos().abs(), turn.sin().abs()
    half_length, half_width = size[..., 0] / 2, size[..., 1] / 2
    along = half_length[:, None] * cos + half_width[:, None] * sin
    across = half_length[:, None] * sin + half_width[:, None] * cos
    x, y = (position[:, None] - position[:, :evaluated, None]).unbind(-1)
    own_cos, own_sin = mine.cos()[:, :, None], mine.sin()[:, :, None]
    ahead = own_cos * x + own_sin * y
    aside = (own_cos * y - own_sin * x).abs()
    gap = ahead - half_length[:, :evaluated, None] - along
    overlap = aside - half_width[:, :evaluated, None] - across
    followed = (overlap < -LITTLE_OVERLAP) | ((overlap < 0) & (turn <= NEARLY_SAME_WAY))
    followed &= valid[:, None] & (gap > 0) & (turn <= SAME_WAY)
    gap, leader = torch.where(followed, gap, gap + NONE).min(2)
    closing = speed[:, :evaluated] - speed.gather(1, leader)
    # Not a number, as at the last step, is not closing in.
    return torch.where(closing > 0, gap / closing, FAR_AHEAD).clamp(max=FAR_AHEAD)
