"""Realism and diversity of rollouts."""

from __future__ import annotations

from symphony.metrics.choices import Choice, choices, route_turns
from symphony.metrics.kinds import CollisionKind, CollisionKinds, collision_kinds
from symphony.metrics.order import OrderStatistics, order_statistics, passing_gap
from symphony.metrics.overlaps import collisions, meetings
from symphony.metrics.summary import (
    RolloutMetrics,
    curvature_histogram,
    jensen_shannon,
    sampled_divergence,
    sampling_floor,
)

__all__ = [
    "Choice", "CollisionKind", "CollisionKinds", "OrderStatistics", "RolloutMetrics", "choices",
    "collision_kinds", "collisions", "curvature_histogram", "jensen_shannon", "meetings", "order_statistics",
    "passing_gap", "route_turns", "sampled_divergence", "sampling_floor",
]  # fmt: skip
