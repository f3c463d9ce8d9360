"""The one trainer: loop, resume, validation, previews, alarms, logging, processes."""

from __future__ import annotations

from symphony.training.phases import Phase, Updates, cosine
from symphony.training.processes import Processes, processes
from symphony.training.trainer import Trainer

__all__ = ["Phase", "Processes", "Trainer", "Updates", "cosine", "processes"]
