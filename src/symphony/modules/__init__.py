"""Encoders and policy heads as TensorDict modules."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.modules.bounded import BoundedDisplacement, DisplacementHistogram, inverse_cdf
    from symphony.modules.encoder import FORESIGHT, ElementGroup, SceneEncoder, SceneNetwork, mlp, scene_module
    from symphony.modules.policy import (
        NoiseSampler,
        RouteScores,
        SeededNoise,
        discrete_policy,
        displacement_policy,
        drawn_goals,
        goal_policy,
    )
    from symphony.modules.pooling import pool_elements
    from symphony.modules.realism import Discriminator, discriminator

__all__ = [
    "FORESIGHT", "BoundedDisplacement", "Discriminator", "DisplacementHistogram", "ElementGroup",
    "NoiseSampler", "RouteScores", "SceneEncoder", "SceneNetwork", "SeededNoise", "discrete_policy",
    "discriminator", "displacement_policy", "drawn_goals", "goal_policy", "inverse_cdf", "mlp",
    "pool_elements", "scene_module",
]  # fmt: skip

__getattr__, __dir__ = lazily(__name__)
