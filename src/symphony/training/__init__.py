"""The one trainer: loop, resume, alarms, logging, processes, and hooks that validate and preview."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.training.processes import Processes
    from symphony.training.trainer import Phase, Trainer, Updates, cosine

__all__ = ["Phase", "Processes", "Trainer", "Updates", "cosine"]

__getattr__, __dir__ = lazily(__name__)
