"""The driving environment: dynamics, observation, routes, scenes and the interactive agents."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.envs.scene import SceneBatch, SceneSource, collate, scene
from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.envs.driving import DrivingEnv
    from symphony.envs.dynamics import Bicycle, ConstantVelocity, Displacement
    from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES, ObservationConfig
    from symphony.envs.routes import CHOICE_FEATURES, ROUTE_FEATURES

__all__ = [
    "CHOICE_FEATURES", "OBJECT_FEATURES", "POINT_FEATURES", "ROUTE_FEATURES", "SELF_FEATURES", "Bicycle",
    "ConstantVelocity", "Displacement", "DrivingEnv", "ObservationConfig", "SceneBatch", "SceneSource",
    "collate", "scene",
]  # fmt: skip

__getattr__, __dir__ = lazily(__name__)
