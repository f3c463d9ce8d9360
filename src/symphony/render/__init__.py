"""Pictures of run segments, rollouts and training."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.render.curves import plot_curvature, plot_curves
    from symphony.render.plots import Clip, plot_grid, plot_rollout, plot_routes, plot_segment, saved_clip
    from symphony.render.video import animate_rollouts, draw_clips

__all__ = [
    "Clip", "animate_rollouts", "draw_clips", "plot_curvature", "plot_curves", "plot_grid", "plot_rollout",
    "plot_routes", "plot_segment", "saved_clip",
]  # fmt: skip

__getattr__, __dir__ = lazily(__name__)
