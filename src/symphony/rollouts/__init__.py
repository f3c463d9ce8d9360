"""Closed-loop simulation: who drives whom, with and without a search, on one process or several."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.rollouts.unroll import Rollouts, RouteGoals, simulate

__all__ = ["Rollouts", "RouteGoals", "simulate"]

__getattr__, __dir__ = lazily(__name__)
