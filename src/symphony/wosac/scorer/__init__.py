"""The realism score of the Waymo Open Sim Agents Challenge (WOSAC), from its published definitions; no official code.

The definitions are in ``docs/wosac.md``, with the legal notice that goes with the metric.
"""

from __future__ import annotations

from symphony.wosac.scorer.config import CHALLENGES, Component, WosacConfig
from symphony.wosac.scorer.features import WosacFeatures, compute_features
from symphony.wosac.scorer.scenario import SimulatedRollouts, WosacScenario
from symphony.wosac.scorer.scoring import check_scored, mean_scores, object_scores, score, score_features

__all__ = [
    "CHALLENGES", "Component", "SimulatedRollouts", "WosacConfig", "WosacFeatures", "WosacScenario",
    "check_scored", "compute_features", "mean_scores", "object_scores", "score", "score_features",
]  # fmt: skip
