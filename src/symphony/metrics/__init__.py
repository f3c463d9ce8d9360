"""Realism and diversity of rollouts."""

from __future__ import annotations

from symphony.metrics.kinds import CollisionKind, CollisionKinds, collision_kinds
from symphony.metrics.overlaps import collisions, meetings
from symphony.metrics.summary import (
    RolloutMetrics,
    curvature_histogram,
    jensen_shannon,
    sampled_divergence,
    sampling_floor,
)

__all__ = [
    "CollisionKind", "CollisionKinds", "RolloutMetrics", "collision_kinds", "collisions", "curvature_histogram",
    "jensen_shannon", "meetings", "sampled_divergence", "sampling_floor",
]  # fmt: skip
