"""Oriented rectangles: corners, overlap, signed distance.

A box is a centre [..., 2] in metres, a heading [...] in radians counter-clockwise from +x, and a size
[..., 2] in metres: length along the heading, width across. Leading dimensions broadcast.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from symphony.geometry.constants import constant

_CORNER_SIGNS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))


def box_corners(
    center: Float[Tensor, "*#batch 2"], heading: Float[Tensor, "*#batch"], size: Float[Tensor, "*#batch 2"]
) -> Float[Tensor, "*batch 4 2"]:
    """Corners counter-clockwise: front left, rear left, rear right, front right."""
    local = _local_corners(size)
    cos, sin = torch.cos(heading)[..., None], torch.sin(heading)[..., None]
    x, y = local[..., 0], local[..., 1]
    return center[..., None, :] + torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def boxes_overlap(
    center_a: Float[Tensor, "*#batch 2"],
    heading_a: Float[Tensor, "*#batch"],
    size_a: Float[Tensor, "*#batch 2"],
    center_b: Float[Tensor, "*#batch 2"],
    heading_b: Float[Tensor, "*#batch"],
    size_b: Float[Tensor, "*#batch 2"],
) -> Bool[Tensor, "*batch"]:
    """Whether the two boxes overlap, by the separating-axis test.

    Boxes that only touch do not overlap. A box without area (a point or a line) overlaps another one if it
    reaches strictly inside that one; two coincident points do not overlap. The result is the same with the
    boxes swapped, and true exactly where :func:`box_gap` is negative.
    """
    return _separations(center_a, heading_a, size_a, center_b, heading_b, size_b) < 0


def box_gap(
    center_a: Float[Tensor, "*#batch 2"],
    heading_a: Float[Tensor, "*#batch"],
    size_a: Float[Tensor, "*#batch 2"],
    center_b: Float[Tensor, "*#batch 2"],
    heading_b: Float[Tensor, "*#batch"],
    size_b: Float[Tensor, "*#batch 2"],
) -> Float[Tensor, "*batch"]:
    """Signed distance between two boxes, in metres.

    Apart: the Euclidean gap. Overlapping: minus the penetration depth, the length of the shortest translation
    that separates them. Differentiable in every argument, with finite gradients everywhere.
    """
    separation = _separations(center_a, heading_a, size_a, center_b, heading_b, size_b)
    # Of two disjoint convex polygons the nearest points include a corner of one of them.
    apart = torch.minimum(
        _corner_distance(center_a, heading_a, size_a, center_b, heading_b, size_b),
        _corner_distance(center_b, heading_b, size_b, center_a, heading_a, size_a),
    )
    return torch.where(separation <= 0, separation, apart)


def _local_corners(size: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 4 2"]:
    signs = constant(_CORNER_SIGNS, size.dtype, size.device)
    return 0.5 * size[..., None, :] * signs


def _separations(
    center_a: Float[Tensor, "*#b 2"],
    heading_a: Float[Tensor, "*#b"],
    size_a: Float[Tensor, "*#b 2"],
    center_b: Float[Tensor, "*#b 2"],
    heading_b: Float[Tensor, "*#b"],
    size_b: Float[Tensor, "*#b 2"],
) -> Float[Tensor, "*b"]:
    """Largest separation along the four face normals: negative where the boxes overlap."""
    # Everything is relative (centre difference, heading difference), so large coordinates cost no precision,
    # and each box's axes are treated alike, so that swapping the boxes gives the same bits.
    delta = center_b - center_a
    turn = heading_b - heading_a
    cos, sin = torch.cos(turn).abs(), torch.sin(turn).abs()
    along_a, across_a = _projections(delta, heading_a)
    along_b, across_b = _projections(delta, heading_b)
    length_a, width_a = 0.5 * size_a[..., 0], 0.5 * size_a[..., 1]
    length_b, width_b = 0.5 * size_b[..., 0], 0.5 * size_b[..., 1]
    front = torch.maximum(
        along_a - (length_a + (length_b * cos + width_b * sin)),
        along_b - (length_b + (length_a * cos + width_a * sin)),
    )
    side = torch.maximum(
        across_a - (width_a + (length_b * sin + width_b * cos)),
        across_b - (width_b + (length_a * sin + width_a * cos)),
    )
    return torch.maximum(front, side)


def _projections(
    delta: Float[Tensor, "*#b 2"], heading: Float[Tensor, "*#b"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    cos, sin = torch.cos(heading), torch.sin(heading)
    x, y = delta[..., 0], delta[..., 1]
    return (cos * x + sin * y).abs(), (cos * y - sin * x).abs()


def _corner_distance(
    center: Float[Tensor, "*#b 2"],
    heading: Float[Tensor, "*#b"],
    size: Float[Tensor, "*#b 2"],
    other: Float[Tensor, "*#b 2"],
    other_heading: Float[Tensor, "*#b"],
    other_size: Float[Tensor, "*#b 2"],
) -> Float[Tensor, "*b"]:
    """Smallest distance of the other box's corners from this box (0 inside)."""
    delta, turn = other - center, other_heading - heading
    cos, sin = torch.cos(heading), torch.sin(heading)
    x, y = delta[..., 0], delta[..., 1]
    x, y = cos * x + sin * y, cos * y - sin * x
    half_length, half_width = 0.5 * size[..., 0], 0.5 * size[..., 1]
    # The corners in this box's frame, component by component: operations on last dimensions of 2 and 4 are slow.
    cos, sin = torch.cos(turn), torch.sin(turn)
    length, width = 0.5 * other_size[..., 0], 0.5 * other_size[..., 1]
    x_of_length, x_of_width, y_of_length, y_of_width = cos * length, sin * width, sin * length, cos * width
    near_x, far_x = x_of_length - x_of_width, x_of_length + x_of_width
    near_y, far_y = y_of_length - y_of_width, y_of_length + y_of_width
    corners = (
        (x + near_x, y + far_y),
        (x - far_x, y - near_y),
        (x - near_x, y - far_y),
        (x + far_x, y + near_y),
    )
    squared = torch.stack(
        [
            (along.abs() - half_length).clamp(min=0).square()
            + (across.abs() - half_width).clamp(min=0).square()
            for along, across in corners
        ]
    ).amin(0)
    positive = squared > 0
    # The square root of a stand-in keeps the gradient finite where the distance is 0.
    return torch.where(positive, torch.where(positive, squared, 1.0).sqrt(), 0.0)
