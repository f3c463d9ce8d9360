"""Every setting in one typed place; field docstrings are the command line's help.

Imports nothing heavy, so that ``--help`` answers at once. Only recipes and the command line read the configuration
of a training; what an agent is and how it is simulated travels with the agent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.config.agent import AgentConfig, AgentSpec, DiscriminatorConfig, Score, SearchConfig
    from symphony.config.evaluation import EvaluateConfig, PaperData, Setting, TableColumns, TableFormat
    from symphony.config.files import read_json, to_json
    from symphony.config.profiles import Profile
    from symphony.config.training import (
        METHODS,
        Method,
        MGAILConfig,
        PerturbConfig,
        PreviewConfig,
        RunConfig,
        TrainConfig,
        ValidationConfig,
    )
    from symphony.config.wosac import WosacSettings

__all__ = [
    "METHODS",
    "AgentConfig",
    "AgentSpec",
    "DiscriminatorConfig",
    "EvaluateConfig",
    "MGAILConfig",
    "Method",
    "PaperData",
    "PerturbConfig",
    "PreviewConfig",
    "Profile",
    "RunConfig",
    "Score",
    "SearchConfig",
    "Setting",
    "TableColumns",
    "TableFormat",
    "TrainConfig",
    "ValidationConfig",
    "WosacSettings",
    "read_json",
    "to_json",
]

__getattr__, __dir__ = lazily(__name__)
