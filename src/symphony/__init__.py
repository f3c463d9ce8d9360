"""Symphony: realistic and diverse traffic agents learned from logged driving."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from symphony._version import __version__

if TYPE_CHECKING:
    from symphony.agents import load_agent
    from symphony.collectors import BeamSearchCollector
    from symphony.config import EvaluateConfig, TrainConfig
    from symphony.data.builtin import builtin_store
    from symphony.data.store import SegmentStore
    from symphony.envs import DrivingEnv
    from symphony.evaluation import evaluate
    from symphony.recipes import train

_ROOMS = {
    "BeamSearchCollector": "symphony.collectors",
    "DrivingEnv": "symphony.envs",
    "EvaluateConfig": "symphony.config",
    "SegmentStore": "symphony.data.store",
    "TrainConfig": "symphony.config",
    "builtin_store": "symphony.data.builtin",
    "evaluate": "symphony.evaluation",
    "load_agent": "symphony.agents",
    "train": "symphony.recipes",
}
"""Where the names that this package exports are from; imported when they are asked for, as torch takes seconds."""

__all__ = [
    "BeamSearchCollector",
    "DrivingEnv",
    "EvaluateConfig",
    "SegmentStore",
    "TrainConfig",
    "__version__",
    "builtin_store",
    "evaluate",
    "load_agent",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in _ROOMS:
        raise AttributeError(f"module 'symphony' has no attribute '{name}'")
    return getattr(importlib.import_module(_ROOMS[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
