"""Realism and diversity of rollouts."""

from __future__ import annotations

from symphony.metrics.agents import AgentResult, AgentSteps
from symphony.metrics.curvature import curvature_histogram, jensen_shannon
from symphony.metrics.kinds import CollisionKind, CollisionKinds, collision_kinds
from symphony.metrics.order import OrderStatistics, order_statistics, passing_gap
from symphony.metrics.realism import collisions, displacement, offroad
from symphony.metrics.summary import RolloutMetrics, SegmentResult

__all__ = [
    "AgentResult",
    "AgentSteps",
    "CollisionKind",
    "CollisionKinds",
    "OrderStatistics",
    "RolloutMetrics",
    "SegmentResult",
    "collision_kinds",
    "collisions",
    "curvature_histogram",
    "displacement",
    "jensen_shannon",
    "offroad",
    "order_statistics",
    "passing_gap",
]
