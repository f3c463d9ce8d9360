"""Beam search over simulated futures, and backtracking in them, as a function, a TorchRL collector and a planner.

They work with environments that keep all of their state in the TensorDict, whatever they simulate; not with those
that wrap a simulator of their own (GymEnv, VmasEnv) or run in other processes (ParallelEnv).
"""

from __future__ import annotations

from symphony.collectors.backtracking import Backtrack
from symphony.collectors.beam_search import BeamSearchResult, beam_search, lineage
from symphony.collectors.branching import branch, check_branching, with_rows
from symphony.collectors.collector import BeamSearchCollector
from symphony.collectors.planner import BeamSearchPlanner
from symphony.collectors.rules import (
    Aggregate,
    KeepAll,
    KeepBest,
    KeyScore,
    PruningRule,
    ReplaceBad,
    Systematic,
    max_then_sum,
    mean_then_sum,
)

__all__ = [
    "Aggregate", "Backtrack", "BeamSearchCollector", "BeamSearchPlanner", "BeamSearchResult", "KeepAll", "KeepBest",
    "KeyScore", "PruningRule", "ReplaceBad", "Systematic", "beam_search", "branch", "check_branching", "lineage",
    "max_then_sum", "mean_then_sum", "with_rows",
]  # fmt: skip
