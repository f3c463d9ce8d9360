"""Losses as TorchRL loss modules: imitation, a discriminator, and adversarial imitation through a model.

Each takes the entries it reads as settable keys. By default they lie under ``"agents"``, one entry per agent.
"""

from __future__ import annotations

from symphony.objectives.bc import BCLoss
from symphony.objectives.discriminator import DiscriminatorLoss
from symphony.objectives.distillation import DistillationLoss
from symphony.objectives.goal import GoalLoss
from symphony.objectives.mgail import MGAILLoss
from symphony.objectives.statistics import auc

__all__ = ["BCLoss", "DiscriminatorLoss", "DistillationLoss", "GoalLoss", "MGAILLoss", "auc"]
