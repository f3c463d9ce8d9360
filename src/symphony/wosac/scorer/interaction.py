"""Distance to the nearest object and time to collision with the vehicle ahead."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from symphony.wosac.scorer.boxes import corners, rectangle_gap

NONE = 1e10
"""Distance, in metres, where there is no other valid object."""
ROUNDING = 0.7
"""Share of half the shorter side by which the corners of a box are rounded."""
FAR_AHEAD = 5.0
"""Greatest time to collision, seconds."""
SAME_WAY = math.radians(75.0)
"""Heading difference up to which an object ahead is followed."""
NEARLY_SAME_WAY = math.radians(10.0)
"""Heading difference up to which an object that overlaps little sideways is followed."""
LITTLE_OVERLAP = 0.5
"""Metres of sideways overlap that are little."""

_SLACK, _RELATIVE_SLACK = 0.05, 1e-6
"""Rounding allowed for where pairs are left out: metres, and metres per metre from the origin."""
_PAIRS = 1 << 20
"""Pairs of an object and another one, per step, looked at together."""


def distance_to_nearest(
    position: Float[Tensor, "R n T 2"],
    heading: Float[Tensor, "R n T"],
    size: Float[Tensor, "R n T 2"],
    valid: Bool[Tensor, "R n T"],
    evaluated: int,
) -> Float[Tensor, "R E T"]:
    """Signed distance in the plane from each of the first E objects to the nearest other one.

    Boxes have rounded corners: a core, smaller by ``2 r`` in length and width, grown by ``r``, where ``r`` is
    :data:`ROUNDING` times half the shorter side. Negative is minus the depth of the overlap of the cores, less both
    radii. :data:`NONE` where the object or every other one is not valid.
    """
    rollouts = [
        _nearest(position[rows], heading[rows], size[rows], valid[rows], evaluated)
        for rows in _blocks(valid, evaluated)
    ]
    return torch.cat(rollouts)


def _blocks(valid: Tensor, evaluated: int) -> Iterator[slice]:
    """Rollouts to be looked at together."""
    step = max(1, _PAIRS // max(1, evaluated * valid[0].numel()))
    return (slice(start, start + step) for start in range(0, len(valid), step))


def _nearest(position: Tensor, heading: Tensor, size: Tensor, valid: Tensor, evaluated: int) -> Tensor:
    radius = ROUNDING * size.amin(-1) / 2
    core = size - 2 * radius[..., None]
    # The other object's box holds a circle and is held by one: of most pairs that is enough to know.
    inner, outer = size.amin(-1) / 2, core.norm(dim=-1) / 2 + radius
    delta = position[:, None] - position[:, :evaluated, None]
    away = torch.hypot(delta[..., 0], delta[..., 1])
    pairs = valid[:, None] & valid[:, :evaluated, None]
    own = torch.arange(evaluated, device=valid.device)
    pairs[:, own, own] = False
    most = torch.where(pairs, away - (inner[:, None] + inner[:, :evaluated, None]), NONE)
    least = away - (outer[:, None] + outer[:, :evaluated, None])
    slack = _SLACK + _RELATIVE_SLACK * position.abs().amax()
    pairs &= least <= most.amin(2, keepdim=True) + slack

    r, i, j, t = pairs.nonzero(as_tuple=True)
    # The corners are rounded where they lie, as in the official scorer: far from the origin that shows.
    mine = corners(position[r, i, t], heading[r, i, t], core[r, i, t])
    theirs = corners(position[r, j, t], heading[r, j, t], core[r, j, t])
    gap = rectangle_gap(mine, theirs)
    gap = gap - radius[r, i, t] - radius[r, j, t]
    result = torch.full_like(away[:, :, 0], NONE)
    flat = (r * evaluated + i) * valid.shape[-1] + t
    result.view(-1).scatter_reduce_(0, flat, gap, "amin")
    return result


def time_to_collision(
    position: Float[Tensor, "R n T 2"],
    heading: Float[Tensor, "R n T"],
    size: Float[Tensor, "R n T 2"],
    valid: Bool[Tensor, "R n T"],
    speed: Float[Tensor, "R n T"],
    evaluated: int,
) -> Float[Tensor, "R E T"]:
    """Seconds until each of the first E objects would hit the one it follows if both kept their speeds, at most 5.

    The difference of the headings is taken as it is, not brought into one turn, as the official scorer does: a pair
    whose headings are a turn apart has no follower.

    Args:
        position: box centres, metres.
        heading: radians.
        size: length and width, metres.
        valid: which others are there; that of the object itself is not looked at.
        speed: m/s in the plane, NaN where unknown.
        evaluated: E.
    """
    rollouts = [
        _time_to_collision(position[rows], heading[rows], size[rows], valid[rows], speed[rows], evaluated)
        for rows in _blocks(valid, evaluated)
    ]
    return torch.cat(rollouts)


def _time_to_collision(
    position: Tensor, heading: Tensor, size: Tensor, valid: Tensor, speed: Tensor, evaluated: int
) -> Tensor:
    mine = heading[:, :evaluated]
    turn = (heading[:, None] - mine[:, :, None]).abs()
    cos, sin = turn.cos().abs(), turn.sin().abs()
    half_length, half_width = size[..., 0] / 2, size[..., 1] / 2
    along = half_length[:, None] * cos + half_width[:, None] * sin
    across = half_length[:, None] * sin + half_width[:, None] * cos
    delta = position[:, None] - position[:, :evaluated, None]
    x, y = delta.unbind(-1)
    own_cos, own_sin = mine.cos()[:, :, None], mine.sin()[:, :, None]
    ahead = own_cos * x + own_sin * y
    aside = (own_cos * y - own_sin * x).abs()
    gap = ahead - half_length[:, :evaluated, None] - along
    overlap = aside - half_width[:, :evaluated, None] - across
    followed = (overlap < -LITTLE_OVERLAP) | ((overlap < 0) & (turn <= NEARLY_SAME_WAY))
    followed &= valid[:, None] & (gap > 0) & (turn <= SAME_WAY)
    gap, leader = torch.where(followed, gap, gap + NONE).min(2)
    theirs = speed.gather(1, leader)
    closing = speed[:, :evaluated] - theirs
    # Not a number, as at the last step, is not closing in.
    return torch.where(closing > 0, gap / closing, FAR_AHEAD).clamp(max=FAR_AHEAD)
