"""How far positions are from the edge of the drivable area."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from symphony.envs.scene import SceneBatch
from symphony.envs.tables import Tables
from symphony.geometry.nearest import on_host
from symphony.geometry.polylines import NO_BOUNDARY, distance_to, signed_distance


def road_distance(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    position: Float[Tensor, "M K 2"],
    tables: Tables | None = None,
) -> Float[Tensor, "M K"]:
    """Signed distance in metres to the edge of the drivable area, positive off the road.

    Differentiable in the position. With ``tables`` the nearest edge is looked for among those listed for the
    position's cell of the map; the distance is the same within rounding.
    """
    if tables is not None and on_host(position) and position.numel() and scenes.edge_start.shape[1]:
        return _by_cells(scenes, scene, position, tables)
    return signed_distance(
        position,
        scenes.edge_start[scene],
        scenes.edge_end[scene],
        scenes.edge_valid[scene],
        scenes.edge_previous[scene],
        scenes.edge_following[scene],
    )


def _by_cells(scenes: SceneBatch, scene: Tensor, position: Tensor, tables: Tables) -> Float[Tensor, "M K"]:
    flat = position.detach().reshape(-1, 2).numpy()
    x, y = np.ascontiguousarray(flat.T)
    row = np.repeat(scene.numpy(), position.shape[1])
    cells = tables.edge_cells
    cell = cells.locate(row, x, y)
    inside = cell >= 0
    everywhere = bool(inside.all())
    known = slice(None) if everywhere else inside
    cells.listed(row[known], cell[known])
    nearest = np.zeros(len(row), np.int64)
    if inside.any():
        nearest[known] = cells.nearest_edge(cell[known], x[known], y[known])
    distance = distance_to(
        position.reshape(1, -1, 2), **tables.edges, nearest=torch.from_numpy(nearest)[None]
    ).view(position.shape[:2])
    if everywhere:
        return distance  # a map with cells has a boundary
    distance = torch.where(tables.bounded[scene][:, None], distance, NO_BOUNDARY)
    # Outside of the cells, or of a map that has none: rows that hold such a position, among all edges.
    listed = torch.from_numpy(inside).view(position.shape[:2])
    some = (~listed).any(1).nonzero().squeeze(-1)
    far = road_distance(scenes, scene[some], position[some])
    return torch.where(listed, distance, distance.index_copy(0, some, far))
