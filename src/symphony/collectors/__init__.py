"""Beam search over simulated futures, as a function and as a TorchRL collector. Works with any environment."""

from __future__ import annotations

from symphony.collectors.beam_search import beam_search, branch
from symphony.collectors.collector import BeamSearchCollector, with_rows
from symphony.collectors.result import BeamSearchResult, lineage
from symphony.collectors.rules import GroupRule, KeepAll, KeepBest, PruningRule, ReplaceBad, Systematic
from symphony.collectors.scores import Aggregate, KeyScore, max_then_sum, mean_then_sum

__all__ = [
    "Aggregate",
    "BeamSearchCollector",
    "BeamSearchResult",
    "GroupRule",
    "KeepAll",
    "KeepBest",
    "KeyScore",
    "PruningRule",
    "ReplaceBad",
    "Systematic",
    "beam_search",
    "branch",
    "lineage",
    "max_then_sum",
    "mean_then_sum",
    "with_rows",
]
