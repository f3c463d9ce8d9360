"""Losses as TorchRL loss modules."""

from __future__ import annotations

from symphony.objectives.bc import BCLoss

__all__ = ["BCLoss"]
