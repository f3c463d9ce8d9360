"""Angles, planar frames and levels of a map, and small constants. Angles in radians counter-clockwise from +x."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import torch
from jaxtyping import Bool, Float, Num
from torch import Tensor


def wrap(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Wrap an angle to [-pi, pi); one already there comes back bit for bit. The gradient is 1 everywhere."""
    turns = torch.floor((angle.detach() + math.pi) / (2 * math.pi))
    wrapped = angle - turns * (2 * math.pi)
    # Rounding can leave the result one turn off at either end of the interval.
    wrapped = torch.where(wrapped < -math.pi, wrapped + 2 * math.pi, wrapped)
    return torch.where(wrapped >= math.pi, wrapped - 2 * math.pi, wrapped)


def rotate(vectors: Float[Tensor, "*batch 2"], angle: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch 2"]:
    """Turn vectors counter-clockwise by ``angle``; leading dimensions broadcast."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return torch.stack((cos * x - sin * y, sin * x + cos * y), dim=-1)


def forward_speed(velocity: Float[Tensor, "*batch 2"], heading: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
    """Return the component of a velocity along a heading, m/s; negative when reversing."""
    return velocity[..., 0] * heading.cos() + velocity[..., 1] * heading.sin()


def with_speed(moving: Float[Tensor, "*batch 5"]) -> Float[Tensor, "*batch 4"]:
    """Turn x, y, heading and velocity into x, y, heading and speed along the heading."""
    speed = forward_speed(moving[..., 3:], moving[..., 2])
    return torch.cat([moving[..., :3], speed[..., None]], -1)


LEVEL = 2.5
"""Metres of height, at one place, from which on two things are on different levels."""


def levels_apart(one: Float[Tensor, "*#b 2"], other: Float[Tensor, "*#b 2"]) -> Bool[Tensor, "*b"]:
    """Return whether two places, given by height and level (0 for none), are on different levels."""
    levels = (one[..., 1] != other[..., 1]) & (one[..., 1] > 0) & (other[..., 1] > 0)
    return levels & ((one[..., 0] - other[..., 0]).abs() >= LEVEL)


def constant(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Num[Tensor, "*_"]:
    """Return a tensor of (nested tuples of) numbers; it is shared, so never write to it."""
    if torch.compiler.is_compiling():
        return torch.tensor(values, dtype=dtype, device=device)
    return made(values, dtype, device)


@cache
def made(values: tuple[Any, ...], dtype: torch.dtype, device: torch.device) -> Num[Tensor, "*_"]:
    """Create the tensor that :func:`constant` keeps."""
    # Made outside of inference mode, or autograd could not save it.
    with torch.inference_mode(False), torch.no_grad():
        return torch.tensor(values, dtype=dtype).to(device)
