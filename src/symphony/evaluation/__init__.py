"""The one evaluator, its records, and the tables and comparisons made of them."""

from __future__ import annotations

from symphony.evaluation.evaluator import EvaluatedBatch, Evaluation, evaluate

__all__ = ["EvaluatedBatch", "Evaluation", "evaluate"]
