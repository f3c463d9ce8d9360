"""When moving rectangles first meet: within a step, or if they go on as they do.

Boxes are those of :mod:`symphony.geometry.boxes`. Shapes: P pairs, ``*batch`` any leading dimensions.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from symphony.geometry.boxes import boxes_overlap, covers, relation, turned
from symphony.geometry.frames import wrap

_TURNED = 0.005
"""Metres that a corner may move by turning in one part of a step; in each part headings stay as they are."""
_MOST_PARTS = 64
_SLOW = 1e-9


def meeting_time(
    way: Float[Tensor, "*#batch 2"],
    speed: Float[Tensor, "*#batch 2"],
    heading_a: Float[Tensor, "*#batch"],
    size_a: Float[Tensor, "*#batch 2"],
    heading_b: Float[Tensor, "*#batch"],
    size_b: Float[Tensor, "*#batch 2"],
) -> Float[Tensor, "*batch"]:
    """When boxes that keep velocity and heading first overlap: 0 for now, infinity for never.

    On each of the four face normals their shadows overlap from one time to another; the boxes do where all four do
    (the separating-axis test of moving boxes). Boxes that only touch do not meet.

    Args:
        way: metres from a's centre to b's.
        speed: metres per unit of time of b relative to a.
        heading_a: of a.
        size_a: length and width.
        heading_b: of b.
        size_b: length and width.
    """
    pair = relation(way[..., 0], way[..., 1], heading_a, heading_b)
    gains = (
        *turned(speed[..., 0], speed[..., 1], heading_a),
        *turned(speed[..., 0], speed[..., 1], heading_b),
    )
    begin, end = torch.zeros_like(pair.in_a[0]), torch.full_like(pair.in_a[0], math.inf)
    for at, gain, cover in zip(
        (*pair.in_a, *pair.in_b), gains, covers(pair.turn, size_a, size_b), strict=True
    ):
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
    heading_a: Float[Tensor, "*#batch 2"],
    size_a: Float[Tensor, "*#batch 2"],
    center_b: Float[Tensor, "*#batch 2 2"],
    heading_b: Float[Tensor, "*#batch 2"],
    size_b: Float[Tensor, "*#batch 2"],
) -> Float[Tensor, "*batch"]:
    """Share of a step, from 0 to 1, after which two boxes first overlap; infinity where they don't.

    Centres move straight and headings turn evenly from the first of two poses to the second. Boxes that overlap at
    both poses are in contact from the first on; those that overlap at the first only part in this step, and what they
    did counts for the step before. Who was not there before gets the second pose twice.

    Args:
        center_a: [..., 2 poses, 2].
        heading_a: [..., 2 poses]; a box turns the shorter way to a heading or its opposite, which is the same box.
        size_a: length and width.
        center_b: of b.
        heading_b: of b.
        size_b: of b.
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
    center: Float[Tensor, "*batch 2 2"], heading: Float[Tensor, "*batch 2"], share: Float[Tensor, "*batch"]
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    """Centre and heading after a share of a step, as :func:`contact_share` moves boxes."""
    turn = 0.5 * wrap(2.0 * (heading[..., 1] - heading[..., 0]))
    place = center[..., 0, :] + share[..., None] * (center[..., 1, :] - center[..., 0, :])
    return place, heading[..., 0] + share * turn
