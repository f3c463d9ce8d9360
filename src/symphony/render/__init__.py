"""Pictures of run segments and rollouts."""

from symphony.render.plots import plot_grid, plot_rollout, plot_segment

__all__ = ["plot_grid", "plot_rollout", "plot_segment"]
