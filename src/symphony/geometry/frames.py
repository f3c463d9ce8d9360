"""Angles and planar frames. Angles in radians counter-clockwise from +x, any leading dimensions."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def wrap(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The same angle in [-pi, pi); one already there comes back bit for bit. The gradient is 1 everywhere."""
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


def forward_speed(
    velocity: Float[Tensor, "*batch 2"], heading: Float[Tensor, "*#batch"]
) -> Float[Tensor, "*batch"]:
    """Component of a velocity along a heading, m/s; negative when reversing."""
    return velocity[..., 0] * heading.cos() + velocity[..., 1] * heading.sin()


def with_speed(moving: Float[Tensor, "*batch 5"]) -> Float[Tensor, "*batch 4"]:
    """From x, y, heading and velocity to x, y, heading and speed along the heading."""
    speed = forward_speed(moving[..., 3:], moving[..., 2])
    return torch.cat([moving[..., :3], speed[..., None]], -1)
