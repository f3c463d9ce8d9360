"""Where the map of a scene ends.

Shapes: M rows (any flattened batch), N driven agents, X exits, H sides of the hull.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from symphony.roadgraph import LaneGraph

MARGIN = 5.0
"""Metres beyond the convex hull of the lanes that still belong to the map."""
BESIDE = 2.5
"""Metres to either side of the end of a lane within which an agent leaves by it."""


class MapEdge(NamedTuple):
    """Where a map ends."""

    exits: NDArray[np.float32]  # [X, 4] ends of lanes that go nowhere: x, y and the direction of travel
    # [H, 3] outward normal and offset of the sides of the convex hull of all lanes, MARGIN added: a point p
    # is beyond where normal @ p > offset for one of them
    hull: NDArray[np.float32]


def map_edge(graph: LaneGraph) -> MapEdge:
    """Where the map of a lane graph ends.

    A lane goes nowhere if neither it nor a lane beside it has a successor: one that ends beside others, as on a ramp,
    is left by a lane change.
    """
    exits = []
    for lane in graph.usable_lanes.tolist():
        together = (lane, *graph.left[lane], *graph.right[lane])
        if not any(graph.successors[other] for other in together):
            before, end = graph.lines[lane][-2:]
            exits.append(np.concatenate([end, (end - before) / np.linalg.norm(end - before)]))
    outline = shapely.MultiPoint(graph.lane_points[0]).convex_hull.buffer(
        MARGIN, join_style="mitre", cap_style="square"
    )
    corners = np.asarray(shapely.orient_polygons(outline).exterior.coords)
    side = np.diff(corners, axis=0)
    normal = np.stack([side[:, 1], -side[:, 0]], -1) / np.linalg.norm(side, axis=-1, keepdims=True)
    hull = np.concatenate([normal, (normal * corners[:-1]).sum(-1, keepdims=True)], -1)
    return MapEdge(np.array(exits, np.float32).reshape(-1, 4), hull.astype(np.float32))


def beyond(position: NDArray[np.floating], edge: MapEdge) -> NDArray[np.bool_]:
    """Whether positions [..., 2] lie outside of the hull."""
    return np.asarray((position @ edge.hull[:, :2].T > edge.hull[:, 2]).any(-1))


def leaving(
    before: Float[Tensor, "M N 2"],
    after: Float[Tensor, "M N 2"],
    exits: Float[Tensor, "M X 4"],
    hull: Float[Tensor, "M H 3"],
) -> Bool[Tensor, "M N"]:
    """Whether a step led out of the map: over the end of an exit, or out of the hull. Padding is all zeros."""
    end, ahead = exits[:, None, :, :2], exits[:, None, :, 2:]
    start, stop = before[:, :, None] - end, after[:, :, None] - end
    along, along_after = (start * ahead).sum(-1), (stop * ahead).sum(-1)
    crosses = (along <= 0) & (along_after > 0)
    share = along / torch.where(crosses, along - along_after, -torch.ones_like(along))
    where = start + share[..., None] * (stop - start)
    aside = where[..., 0] * ahead[..., 1] - where[..., 1] * ahead[..., 0]
    outside = (after[:, :, None] * hull[:, None, :, :2]).sum(-1) > hull[:, None, :, 2]
    return (crosses & (aside.abs() <= BESIDE)).any(-1) | outside.any(-1)
