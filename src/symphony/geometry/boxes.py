"""Oriented rectangles: corners, overlap, signed distance, and when moving ones first meet.

A box is a centre [..., 2] in metres, a heading [...] in radians counter-clockwise from +x, and a size
[..., 2] in metres: length along the heading, width across. Leading dimensions broadcast.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from symphony.geometry.frames import constant, wrap

Pairs = Float[Tensor, "*#batch 2"]
Angles = Float[Tensor, "*#batch"]
Reals = Float[Tensor, "*batch"]

_TURNED = 0.005
"""Metres by which a corner may be out of place: in each part of a step headings stay as in its middle."""
_MOST_PARTS = 64
_SLOW = 1e-9


def meeting_time(
    way: Pairs, speed: Pairs, heading_a: Angles, size_a: Pairs, heading_b: Angles, size_b: Pairs
) -> Reals:
    """Return when boxes that keep velocity and heading first overlap: 0 for now, infinity for never.

    On each of the four face normals their shadows overlap from one time to another; the boxes do where all four do
    (the separating-axis test of moving boxes). Boxes that only touch do not meet.

    Takes the way from a's centre to b's, and the speed of b relative to a, in metres per unit of time.
    """
    pair = relation(way[..., 0], way[..., 1], heading_a, heading_b)
    gains = (*turned(speed[..., 0], speed[..., 1], heading_a), *turned(speed[..., 0], speed[..., 1], heading_b))
    begin, end = torch.zeros_like(pair.in_a[0]), torch.full_like(pair.in_a[0], math.inf)
    for at, gain, cover in zip((*pair.in_a, *pair.in_b), gains, covers(pair.turn, size_a, size_b), strict=True):
        slow = gain.abs() < _SLOW
        rate = torch.where(slow, 1.0, gain)
        one, two = (-cover - at) / rate, (cover - at) / rate
        low, high = torch.minimum(one, two), torch.maximum(one, two)
        apart = slow & (at.abs() >= cover)
        begin = torch.maximum(begin, torch.where(apart, math.inf, torch.where(slow, -math.inf, low)))
        end = torch.minimum(end, torch.where(slow, math.inf, high))
    return torch.where(begin < end, begin, math.inf)


def contact_share(
    center_a: Float[Tensor, "*#batch 2 2"],
    heading_a: Pairs,
    size_a: Pairs,
    center_b: Float[Tensor, "*#batch 2 2"],
    heading_b: Pairs,
    size_b: Pairs,
) -> Reals:
    """Return the share of a step, from 0 to 1, after which two boxes first overlap; infinity where they don't.

    Centres move straight and headings turn evenly from the first of two poses to the second. Boxes that overlap at
    both poses are in contact from the first on; those that overlap at the first only part in this step, and their
    contact belongs to the step before. An agent that was not there before gets the second pose twice.

    A box turns the shorter way to a heading or its opposite, which is the same box.
    """
    shape = torch.broadcast_shapes(
        center_a.shape[:-2], center_b.shape[:-2], heading_a.shape[:-1], heading_b.shape[:-1],
        size_a.shape[:-1], size_b.shape[:-1],
    )  # fmt: skip
    center_a, center_b = (value.expand(*shape, 2, 2).reshape(-1, 2, 2) for value in (center_a, center_b))
    heading_a, heading_b = (value.expand(*shape, 2).reshape(-1, 2) for value in (heading_a, heading_b))
    size_a, size_b = (value.expand(*shape, 2).reshape(-1, 2) for value in (size_a, size_b))
    before, after = (
        boxes_overlap(center_a[:, k], heading_a[:, k], size_a, center_b[:, k], heading_b[:, k], size_b)
        for k in (0, 1)
    )
    way = center_b - center_a
    turn_a, turn_b = (0.5 * wrap(2.0 * (heading[:, 1] - heading[:, 0])) for heading in (heading_a, heading_b))
    corner = 0.5 * (turn_a.abs() * size_a.norm(dim=-1) + turn_b.abs() * size_b.norm(dim=-1))
    # A heading that is not finite is that of no box, and makes no parts.
    count = (corner / (2.0 * _TURNED)).nan_to_num(0.0, 0.0).ceil().clamp(1, _MOST_PARTS).long()
    pair = torch.arange(len(count), device=count.device).repeat_interleave(count)
    number = torch.arange(len(pair), device=count.device) - (count.cumsum(0) - count)[pair]
    width = 1.0 / count[pair].to(way.dtype)
    begin, middle = number * width, (number + 0.5) * width
    speed = (way[:, 1] - way[:, 0])[pair]
    first = begin + meeting_time(
        way[pair, 0] + begin[:, None] * speed,
        speed,
        heading_a[pair, 0] + middle * turn_a[pair],
        size_a[pair],
        heading_b[pair, 0] + middle * turn_b[pair],
        size_b[pair],
    )
    first = torch.where(first < begin + width, first, math.inf)
    share = torch.full_like(way[:, 0, 0], math.inf).scatter_reduce(0, pair, first, "amin")
    share = torch.where(after, share.clamp(max=1.0), share)
    share = torch.where(before, torch.where(after, 0.0, math.inf), share)
    return share.reshape(shape)


def pose_at(
    center: Float[Tensor, "*batch 2 2"], heading: Float[Tensor, "*batch 2"], share: Reals
) -> tuple[Float[Tensor, "*batch 2"], Reals]:
    """Return centre and heading after a share of a step, as :func:`contact_share` moves boxes."""
    turn = 0.5 * wrap(2.0 * (heading[..., 1] - heading[..., 0]))
    place = center[..., 0, :] + share[..., None] * (center[..., 1, :] - center[..., 0, :])
    return place, heading[..., 0] + share * turn


_CORNER_SIGNS = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))


def box_corners(center: Pairs, heading: Angles, size: Pairs) -> Float[Tensor, "*batch 4 2"]:
    """Return corners counter-clockwise: front left, rear left, rear right, front right."""
    local = 0.5 * size[..., None, :] * constant(_CORNER_SIGNS, size.dtype, size.device)
    cos, sin = torch.cos(heading)[..., None], torch.sin(heading)[..., None]
    x, y = local[..., 0], local[..., 1]
    return center[..., None, :] + torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def boxes_overlap(
    center_a: Pairs, heading_a: Angles, size_a: Pairs, center_b: Pairs, heading_b: Angles, size_b: Pairs
) -> Bool[Tensor, "*batch"]:
    """Return whether the two boxes overlap, by the separating-axis test.

    Boxes that only touch do not overlap. A box without area (a point or a line) overlaps another one if it
    reaches strictly inside that one; two coincident points do not overlap. The result is the same with the
    boxes swapped, and true exactly where :func:`box_gap` is negative.
    """
    pair = relation(*_way(center_a, center_b), heading_a, heading_b)
    return _separations(pair, size_a, size_b) < 0


def box_gap(
    center_a: Pairs, heading_a: Angles, size_a: Pairs, center_b: Pairs, heading_b: Angles, size_b: Pairs
) -> Reals:
    """Return the signed distance between two boxes, in metres.

    Apart: the Euclidean gap. Overlapping: minus the penetration depth, the length of the shortest translation
    that separates them. Differentiable in every argument, with finite gradients everywhere.
    """
    return gap_between(*_way(center_a, center_b), heading_a, size_a, heading_b, size_b)


def gap_between(x: Angles, y: Angles, heading_a: Angles, size_a: Pairs, heading_b: Angles, size_b: Pairs) -> Reals:
    """Return :func:`box_gap` of boxes whose centres are ``x`` and ``y`` metres apart, seen from a."""
    pair = relation(x, y, heading_a, heading_b)
    separation, back = _separations(pair, size_a, size_b), (-pair.in_b[0], -pair.in_b[1])
    # Of two disjoint convex polygons the nearest points include a corner of one of them.
    apart = torch.minimum(
        _corner_distance(pair.in_a, pair.turn, size_a, size_b),
        _corner_distance(back, (pair.turn[0], -pair.turn[1]), size_b, size_a),
    )
    return torch.where(separation <= 0, separation, apart)


_Plane = tuple[Angles, Angles]
"""Two components that belong together, each a tensor of its own: operations on a last dimension of 2 are slow."""


class _Pair(NamedTuple):
    """The pose of box b relative to box a, so that large coordinates cost no precision.

    Attributes:
        in_a: the way from a's centre to b's, along and across a.
        in_b: the same way, along and across b.
        turn: cosine and sine of b's heading relative to a's.
    """

    in_a: _Plane
    in_b: _Plane
    turn: _Plane


def _way(center_a: Pairs, center_b: Pairs) -> _Plane:
    return center_b[..., 0] - center_a[..., 0], center_b[..., 1] - center_a[..., 1]


def relation(x: Angles, y: Angles, heading_a: Angles, heading_b: Angles) -> _Pair:
    """Return the relation of box a to one whose centre is ``x`` and ``y`` metres from its own."""
    turn = heading_b - heading_a
    return _Pair(turned(x, y, heading_a), turned(x, y, heading_b), (torch.cos(turn), torch.sin(turn)))


def turned(x: Angles, y: Angles, heading: Angles) -> _Plane:
    """Return the parts of a vector along and across a heading."""
    cos, sin = torch.cos(heading), torch.sin(heading)
    return cos * x + sin * y, cos * y - sin * x


def _separations(pair: _Pair, size_a: Pairs, size_b: Pairs) -> Tensor:
    """Return largest separation along the four face normals: negative where the boxes overlap."""
    # Each box's axes are treated alike, so that swapping the boxes gives the same bits.
    cover = covers(pair.turn, size_a, size_b)
    places = (pair.in_a[0], pair.in_a[1], pair.in_b[0], pair.in_b[1])
    gaps = [place.abs() - reach for place, reach in zip(places, cover, strict=True)]
    return torch.maximum(torch.maximum(gaps[0], gaps[2]), torch.maximum(gaps[1], gaps[3]))


def covers(turn: _Plane, size_a: Pairs, size_b: Pairs) -> tuple[Tensor, ...]:
    """Return how far apart centres may be for the boxes to overlap, along and across a, and along and across b."""
    cos, sin = (part.abs() for part in turn)
    length_a, width_a = 0.5 * size_a[..., 0], 0.5 * size_a[..., 1]
    length_b, width_b = 0.5 * size_b[..., 0], 0.5 * size_b[..., 1]
    return (
        length_a + (length_b * cos + width_b * sin),
        width_a + (length_b * sin + width_b * cos),
        length_b + (length_a * cos + width_a * sin),
        width_b + (length_a * sin + width_a * cos),
    )


def _corner_distance(way: _Plane, turn: _Plane, size: Pairs, other_size: Pairs) -> Tensor:
    """Return smallest distance of the other box's corners from this box (0 inside). Takes the way to the other's
    centre, along and across this one, and cosine and sine of its relative heading.
    """
    (x, y), (cos, sin) = way, turn
    half_length, half_width = 0.5 * size[..., 0], 0.5 * size[..., 1]
    length, width = 0.5 * other_size[..., 0], 0.5 * other_size[..., 1]
    x_of_length, x_of_width, y_of_length, y_of_width = cos * length, sin * width, sin * length, cos * width
    near_x, far_x = x_of_length - x_of_width, x_of_length + x_of_width
    near_y, far_y = y_of_length - y_of_width, y_of_length + y_of_width
    corners = ((x + near_x, y + far_y), (x - far_x, y - near_y), (x - near_x, y - far_y), (x + far_x, y + near_y))
    squared = [
        (along.abs() - half_length).clamp(min=0).square() + (across.abs() - half_width).clamp(min=0).square()
        for along, across in corners
    ]
    nearest = reduce(torch.minimum, squared)
    positive = nearest != 0  # NaN stays NaN
    # The square root of a stand-in keeps the gradient finite where the distance is 0.
    return torch.where(positive, torch.where(positive, nearest, 1.0).sqrt(), 0.0)
