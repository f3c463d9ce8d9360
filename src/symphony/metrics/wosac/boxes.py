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


def quadrilateral_gap(a: Float[Tensor, "M 4 2"], b: Float[Tensor, "M 4 2"]) -> Float[Tensor, " M"]:
    """Signed distance of convex quadrilaterals with counter-clockwise corners.

    The Euclidean gap, or minus the length of the shortest translation that separates them.
    """
    separation = torch.maximum(_separation(a, b), _separation(b, a))
    apart = torch.minimum(_to_sides(a, b), _to_sides(b, a))
    return torch.where(separation <= 0, separation, apart)


def _separation(a: Tensor, b: Tensor) -> Tensor:
    """How far b is outside of a, along the normal of a's side where that is most."""
    x, y = (a.roll(-1, 1) - a).unbind(-1)
    # [M, side of a, corner of b]; to the right of a side is outside.
    away = b[:, None] - a[:, :, None]
    outside = (away[..., 0] * y[..., None] - away[..., 1] * x[..., None]) / torch.hypot(x, y)[..., None]
    return outside.amin(-1).amax(-1)


def _to_sides(a: Tensor, b: Tensor) -> Tensor:
    """Smallest distance of a corner of b to a side of a."""
    side = (a.roll(-1, 1) - a)[:, :, None]
    away = b[:, None] - a[:, :, None]
    share = ((away * side).sum(-1) / side.square().sum(-1)).clamp(0, 1)
    offset = away - share[..., None] * side
    return torch.hypot(offset[..., 0], offset[..., 1]).flatten(1).amin(-1)
