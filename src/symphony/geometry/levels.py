"""Which places are on different levels of a map; where levels come from: :mod:`symphony.data.levels`."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

LEVEL = 2.5
"""Metres of height, at one place, from which on two things are on different levels."""


def levels_apart(one: Float[Tensor, "*#b 2"], other: Float[Tensor, "*#b 2"]) -> Bool[Tensor, "*b"]:
    """Whether two places, by height and level (0 for none), are on two of them."""
    levels = (one[..., 1] != other[..., 1]) & (one[..., 1] > 0) & (other[..., 1] > 0)
    return levels & ((one[..., 0] - other[..., 0]).abs() >= LEVEL)
