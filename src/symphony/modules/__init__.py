"""Encoders and policy heads as TensorDict modules."""

from __future__ import annotations

from symphony.modules.encoder import ElementGroup, SceneEncoder, SceneNetwork, scene_module
from symphony.modules.policy import NoiseSampler, discrete_policy
from symphony.modules.pooling import pool_elements
from symphony.modules.rows import in_blocks, mlp
from symphony.modules.sampling import inverse_cdf

__all__ = [
    "ElementGroup",
    "NoiseSampler",
    "SceneEncoder",
    "SceneNetwork",
    "discrete_policy",
    "in_blocks",
    "inverse_cdf",
    "mlp",
    "pool_elements",
    "scene_module",
]
