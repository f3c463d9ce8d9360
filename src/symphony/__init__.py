"""Symphony: realistic and diverse traffic agents learned from logged driving.

What is named here is the public interface; it is imported when it is asked for, as torch takes seconds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.agents.agent import load_agent as load_agent
    from symphony.collectors import BeamSearchCollector as BeamSearchCollector
    from symphony.collectors import BeamSearchPlanner as BeamSearchPlanner
    from symphony.collectors.beam_search import beam_search as beam_search
    from symphony.config.evaluation import EvaluateConfig as EvaluateConfig
    from symphony.config.training import TrainConfig as TrainConfig
    from symphony.data.builtin import builtin_store as builtin_store
    from symphony.data.store import SegmentStore as SegmentStore
    from symphony.envs.driving import DrivingEnv as DrivingEnv
    from symphony.envs.observation import ObservationConfig as ObservationConfig
    from symphony.evaluation.evaluator import evaluate as evaluate
    from symphony.objectives.base import BCLoss as BCLoss
    from symphony.objectives.base import DistillationLoss as DistillationLoss
    from symphony.objectives.discriminator import DiscriminatorLoss as DiscriminatorLoss
    from symphony.objectives.goal import GoalLoss as GoalLoss
    from symphony.objectives.mgail import MGAILLoss as MGAILLoss
    from symphony.recipes import train as train
    from symphony.rollouts.unroll import simulate as simulate

__version__ = "0.1.0"
__getattr__, __dir__ = lazily(__name__)
__all__ = __dir__()  # noqa: PLE0605
