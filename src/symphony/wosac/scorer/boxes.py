"""Boxes in the plane, to the last bit as the official scorer rounds them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_SIGNS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))


def corners(
    center: Float[Tensor, "*batch 2"], heading: Float[Tensor, "*batch"], size: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch 4 2"]:
    """Corners counter-clockwise: front left, rear left, rear right, front right.

    In float32, which rounds them to millimetres far from the origin: unlike :func:`symphony.geometry.box_corners`,
    sine and cosine are correctly rounded, so that this rounding is always the same.
    """
    x, y = (0.5 * size[..., None, :] * torch.tensor(_SIGNS, dtype=size.dtype, device=size.device)).unbind(-1)
    wide = heading.double()[..., None]
    cos, sin = wide.cos().to(heading.dtype), wide.sin().to(heading.dtype)
    return center[..., None, :] + torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def rectangle_gap(a: Float[Tensor, "M 4 2"], b: Float[Tensor, "M 4 2"]) -> Float[Tensor, " M"]:
    """Signed distance of rectangles, given by their corners counter-clockwise.

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
    squared = side_x.square() + side_y.square()
    share = ((x * side_x + y * side_y) / squared).clamp(0, 1)
    away = torch.hypot(x - share * side_x, y - share * side_y).amin(1)
    return torch.where(inside, -away, away)


_BY_TURNS = ([0, 1, 1, 2, 2, 3, 3, 0], [0, 0, 1, 1, 2, 2, 3, 3])
"""Corners of either rectangle that each corner of the octagon is made of."""


def _from_the_lowest(corners: Tensor) -> Tensor:
    index = (corners[..., 1].argmin(1, keepdim=True) + torch.arange(4, device=corners.device)) % 4
    return corners.gather(1, index[..., None].expand(-1, -1, 2))
