"""The one trainer: loop, resume, validation, previews, alarms, logging, processes."""

from __future__ import annotations

from symphony.training.trainer import train

__all__ = ["train"]
