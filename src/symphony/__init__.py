"""Symphony: realistic and diverse traffic agents learned from logged driving.

What is named here is the public interface; it is imported when it is asked for, as torch takes seconds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony._version import __version__
from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.agents.agent import load_agent
    from symphony.collectors import BeamSearchCollector, beam_search
    from symphony.config.evaluation import EvaluateConfig
    from symphony.config.training import TrainConfig
    from symphony.data.builtin import builtin_store
    from symphony.data.store import SegmentStore
    from symphony.envs.driving import DrivingEnv
    from symphony.envs.observation import ObservationConfig
    from symphony.evaluation.evaluator import evaluate
    from symphony.objectives.bc import BCLoss
    from symphony.objectives.discriminator import DiscriminatorLoss
    from symphony.objectives.distillation import DistillationLoss
    from symphony.objectives.goal import GoalLoss
    from symphony.objectives.mgail import MGAILLoss
    from symphony.recipes import train
    from symphony.rollouts.unroll import simulate

__all__ = [
    "BCLoss",
    "BeamSearchCollector",
    "DiscriminatorLoss",
    "DistillationLoss",
    "DrivingEnv",
    "EvaluateConfig",
    "GoalLoss",
    "MGAILLoss",
    "ObservationConfig",
    "SegmentStore",
    "TrainConfig",
    "__version__",
    "beam_search",
    "builtin_store",
    "evaluate",
    "load_agent",
    "simulate",
    "train",
]

__getattr__, __dir__ = lazily(__name__)
