"""Losses as TorchRL loss modules."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.objectives.bc import BCLoss
    from symphony.objectives.discriminator import DiscriminatorLoss
    from symphony.objectives.distillation import DistillationLoss
    from symphony.objectives.goal import GoalLoss
    from symphony.objectives.mgail import MGAILLoss
    from symphony.objectives.statistics import auc

__all__ = ["BCLoss", "DiscriminatorLoss", "DistillationLoss", "GoalLoss", "MGAILLoss", "auc"]

__getattr__, __dir__ = lazily(__name__)
