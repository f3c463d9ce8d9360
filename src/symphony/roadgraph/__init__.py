"""Lanes, routes, branching regions and the road boundary."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily
from symphony.roadgraph.routes import Route, ground_truth_routes, route_errors, route_line, route_lines, routes

if TYPE_CHECKING:
    from symphony.roadgraph.branches import lane_of, starting_lanes, visited_curvatures, visited_regions
    from symphony.roadgraph.graph import LaneGraph, Regions
    from symphony.roadgraph.paths import blend, centre_line

__all__ = [
    "LaneGraph", "Regions", "Route", "blend", "centre_line", "ground_truth_routes", "lane_of", "route_errors",
    "route_line", "route_lines", "routes", "starting_lanes", "visited_curvatures", "visited_regions",
]  # fmt: skip

__getattr__, __dir__ = lazily(__name__)
