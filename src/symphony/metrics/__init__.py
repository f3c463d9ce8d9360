"""Realism and diversity of rollouts."""

from __future__ import annotations

from symphony.metrics.agents import AgentResult, AgentSteps
from symphony.metrics.choices import Choice, Standing, choices, route_turns, standing_at_end
from symphony.metrics.curvature import (
    Divergence,
    curvature_histogram,
    jensen_shannon,
    sampled_divergence,
    sampling_floor,
)
from symphony.metrics.kinds import CollisionKind, CollisionKinds, collision_kinds
from symphony.metrics.order import OrderStatistics, order_statistics, passing_gap
from symphony.metrics.rates import SegmentResult
from symphony.metrics.realism import Meetings, collisions, displacement, meetings, offroad
from symphony.metrics.summary import RolloutMetrics

__all__ = [
    "AgentResult",
    "AgentSteps",
    "Choice",
    "CollisionKind",
    "CollisionKinds",
    "Divergence",
    "Meetings",
    "OrderStatistics",
    "RolloutMetrics",
    "SegmentResult",
    "Standing",
    "choices",
    "collision_kinds",
    "collisions",
    "curvature_histogram",
    "displacement",
    "jensen_shannon",
    "meetings",
    "offroad",
    "order_statistics",
    "passing_gap",
    "route_turns",
    "sampled_divergence",
    "sampling_floor",
    "standing_at_end",
]
