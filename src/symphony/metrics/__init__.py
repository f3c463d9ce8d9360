"""Realism and diversity of rollouts."""

from __future__ import annotations

from symphony.metrics.curvature import curvature_histogram, jensen_shannon
from symphony.metrics.realism import collisions, displacement, offroad
from symphony.metrics.summary import RolloutMetrics, SegmentResult

__all__ = [
    "RolloutMetrics",
    "SegmentResult",
    "collisions",
    "curvature_histogram",
    "displacement",
    "jensen_shannon",
    "offroad",
]
