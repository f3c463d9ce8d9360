"""Demonstrations from logs, rollouts with and without search, and what is learned from them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.simulation.demonstrations import SceneDataset
    from symphony.simulation.replay import SearchReplay, with_survivors
    from symphony.simulation.rollouts import Rollouts, simulate

__all__ = ["Rollouts", "SceneDataset", "SearchReplay", "simulate", "with_survivors"]

__getattr__, __dir__ = lazily(__name__)
