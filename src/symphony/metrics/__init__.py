"""Realism and diversity of rollouts."""

from symphony.metrics.curvature import curvature_histogram, jensen_shannon
from symphony.metrics.summary import RolloutMetrics, SegmentResult

__all__ = ["RolloutMetrics", "SegmentResult", "curvature_histogram", "jensen_shannon"]
