"""Demonstrations from logs, and rollouts with and without search."""

from __future__ import annotations

from symphony.simulation.rollouts import Rollouts, simulate

__all__ = ["Rollouts", "simulate"]
