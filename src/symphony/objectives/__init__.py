"""Losses as TorchRL loss modules: imitation, a discriminator, and adversarial imitation through a model.

Each takes the entries it reads as settable keys. By default they lie under ``"agents"``, one entry per agent.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from symphony.objectives.base import BCLoss, DistillationLoss
    from symphony.objectives.discriminator import DiscriminatorLoss
    from symphony.objectives.goal import GoalLoss
    from symphony.objectives.mgail import MGAILLoss
    from symphony.objectives.statistics import auc

__all__ = ["BCLoss", "DiscriminatorLoss", "DistillationLoss", "GoalLoss", "MGAILLoss", "auc"]


def __getattr__(name: str) -> Any:
    """Import the named loss, and no other."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    rooms = {"auc": "statistics", "BCLoss": "base", "DistillationLoss": "base"}
    room = rooms.get(name, name.removesuffix("Loss").lower())
    return getattr(importlib.import_module(f"{__name__}.{room}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
