"""Every setting in one typed place; comments at the fields are the command line's help.

Imports nothing heavy, so that ``--help`` answers at once. Only recipes and the command line read the configuration
of a training; what an agent is and how it is simulated travels with the agent.
"""

from __future__ import annotations

from symphony.config.agent import AgentConfig, AgentSpec, DiscriminatorConfig, Score, SearchConfig
from symphony.config.evaluation import EvaluateConfig, PaperData, Setting, TableFormat, WosacSettings
from symphony.config.files import read_json, to_json
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

__all__ = [
    "METHODS", "AgentConfig", "AgentSpec", "DiscriminatorConfig", "EvaluateConfig", "MGAILConfig", "Method",
    "PaperData", "PerturbConfig", "PreviewConfig", "RunConfig", "Score", "SearchConfig", "Setting",
    "TableFormat", "TrainConfig", "ValidationConfig", "WosacSettings", "read_json", "to_json",
]  # fmt: skip
