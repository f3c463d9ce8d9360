"""The one evaluator, its records, and the tables and comparisons made of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.evaluation.evaluator import Evaluation, evaluate

__all__ = ["Evaluation", "evaluate"]

__getattr__, __dir__ = lazily(__name__)
