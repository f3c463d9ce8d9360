"""The one trainer: loop, resume, validation, previews, alarms, logging, processes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.training.phases import Phase, Updates, cosine
    from symphony.training.processes import Processes
    from symphony.training.trainer import Trainer

__all__ = ["Phase", "Processes", "Trainer", "Updates", "cosine"]

__getattr__, __dir__ = lazily(__name__)
