"""The driving environment: dynamics, observation, who drives whom."""

from symphony.envs.baselines import ConstantVelocity
from symphony.envs.driving import DrivingEnv
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import ObservationConfig
from symphony.envs.scene import SceneBatch, collate, scene

__all__ = [
    "Bicycle",
    "ConstantVelocity",
    "Displacement",
    "DrivingEnv",
    "ObservationConfig",
    "SceneBatch",
    "collate",
    "scene",
]
