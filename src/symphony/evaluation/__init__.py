"""The one evaluator, its records, and the tables and comparisons made of them."""

from __future__ import annotations

from symphony.evaluation.evaluator import Evaluation, evaluate

__all__ = ["Evaluation", "evaluate"]
