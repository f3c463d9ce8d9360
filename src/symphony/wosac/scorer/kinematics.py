"""Speeds and accelerations by central differences."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from symphony.wosac.scorer.config import DT


def central_difference(values: Float[Tensor, "*batch T"]) -> Float[Tensor, "*batch T"]:
    """Half the difference between the next step and the one before; NaN at both ends."""
    result = torch.full_like(values, math.nan)
    result[..., 1:-1] = (values[..., 2:] - values[..., :-2]) / 2
    return result


def wrap(angle: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The same direction in [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def speed(*coordinates: Float[Tensor, "*batch T"], dt: float = DT) -> Float[Tensor, "*batch T"]:
    """m/s along any number of axes in metres."""
    squared = torch.zeros_like(coordinates[0])
    for axis in coordinates:
        squared = squared + central_difference(axis).square()
    # On the CPU, PyTorch's square root is correctly rounded in float64 only.
    return squared.double().sqrt().to(squared.dtype) / dt


def acceleration(speed: Float[Tensor, "*batch T"], dt: float = DT) -> Float[Tensor, "*batch T"]:
    """m/s², negative where it brakes."""
    return central_difference(speed) / dt


def angular(
    heading: Float[Tensor, "*batch T"], dt: float = DT
) -> tuple[Float[Tensor, "*batch T"], Float[Tensor, "*batch T"]]:
    """(rad/s, rad/s²); each difference over two steps is taken the short way round."""
    turn = wrap(central_difference(heading) * 2) / 2
    return turn / dt, wrap(central_difference(turn) * 2) / 2 / (dt * dt)


def speed_mask(valid: Bool[Tensor, "*batch T"]) -> Bool[Tensor, "*batch T"]:
    """Where the steps before and after are valid; the step itself may be not. False at both ends.

    Applied to itself it is the mask of the acceleration.
    """
    result = torch.zeros_like(valid)
    result[..., 1:-1] = valid[..., 2:] & valid[..., :-2]
    return result
