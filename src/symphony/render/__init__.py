"""Pictures of run segments, rollouts, searches and training."""

from symphony.render.curves import plot_curves
from symphony.render.genealogy import plot_genealogy, plot_search
from symphony.render.histograms import plot_curvature
from symphony.render.plots import plot_grid, plot_rollout, plot_segment
from symphony.render.routes import plot_routes
from symphony.render.tree import SearchTree, plot_tree
from symphony.render.video import Clip, animate_rollouts

__all__ = [
    "Clip",
    "SearchTree",
    "animate_rollouts",
    "plot_curvature",
    "plot_curves",
    "plot_genealogy",
    "plot_grid",
    "plot_rollout",
    "plot_routes",
    "plot_search",
    "plot_segment",
    "plot_tree",
]
