"""What a training consists of: stretches of updates, and their learning rates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from tensordict import TensorDictBase

Updates = Iterator[tuple[str, TensorDictBase]]
"""Losses one by one, each with the name of the optimizer that descends it before the next is computed. What has no
optimizer of its name is recorded only.
"""
Rates = Callable[[int], Mapping[str, float]]
"""Learning rates by optimizer at an update."""


@dataclass(frozen=True)
class Phase:
    """A stretch of updates of one kind.

    Attributes:
        until: the first update, counted from the start of the run, that no longer belongs to it.
        update: computes the losses of an update; see :data:`Updates`.
        rates: of the optimizers.
    """

    until: int
    update: Callable[[int], Updates]
    rates: Rates


def cosine(rates: Mapping[str, float], end: int, begin: int = 0) -> Rates:
    """Rates that fall to a tenth along a cosine, from update ``begin`` to ``end``."""

    def at(step: int) -> Mapping[str, float]:
        share = 0.5 * (1 + math.cos(math.pi * (step - begin) / (end - begin)))
        return {name: rate * (0.1 + 0.9 * share) for name, rate in rates.items()}

    return at
