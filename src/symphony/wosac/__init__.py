"""The Waymo Open Sim Agents Challenge: its scorer, rollouts for it, and submissions to it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.wosac.evaluate import WosacEvaluation, evaluate_wosac, log_playback, wosac_scenario, wosac_window
    from symphony.wosac.files import read_rollouts, score_files
    from symphony.wosac.records import logged_scenario
    from symphony.wosac.scorer import CHALLENGES, SimulatedRollouts, WosacScenario, score
    from symphony.wosac.simulate import constant_velocity, wosac_rollouts
    from symphony.wosac.submission import SubmissionMeta, check_submission, write_submission

__all__ = [
    "CHALLENGES", "SimulatedRollouts", "SubmissionMeta", "WosacEvaluation", "WosacScenario",
    "check_submission", "constant_velocity", "evaluate_wosac", "log_playback", "logged_scenario",
    "read_rollouts", "score", "score_files", "wosac_rollouts", "wosac_scenario", "wosac_window",
    "write_submission",
]  # fmt: skip

__getattr__, __dir__ = lazily(__name__)
