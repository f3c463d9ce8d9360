"""Data to learn from: demonstrations prepared from logs, and rollouts found by a search."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.learning.demonstrations import GOALS, SceneDataset, transitions
    from symphony.learning.replay import SearchReplay, with_survivors

__all__ = ["GOALS", "SceneDataset", "SearchReplay", "transitions", "with_survivors"]

__getattr__, __dir__ = lazily(__name__)
