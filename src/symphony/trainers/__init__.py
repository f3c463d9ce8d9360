"""The training loop, the evaluator and checkpoints."""

from symphony.trainers.agents import Agent, load_agent
from symphony.trainers.evaluation import Evaluation, evaluate
from symphony.trainers.simulate import Rollouts, simulate
from symphony.trainers.training import train

__all__ = ["Agent", "Evaluation", "Rollouts", "evaluate", "load_agent", "simulate", "train"]
