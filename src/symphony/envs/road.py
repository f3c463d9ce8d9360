"""How far positions are from the edge of the drivable area."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from symphony.envs.scene import SceneBatch
from symphony.envs.tables import Tables
from symphony.geometry.levels import levels_apart
from symphony.geometry.nearest import on_host
from symphony.geometry.polylines import distance_to, signed_distance

_PAIRS = 1 << 20
"""Positions times edges that are measured at a time where the nearest is on another level."""


def road_distance(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    position: Float[Tensor, "M K 2"],
    tables: Tables | None = None,
    height: Float[Tensor, "M K 2"] | None = None,
) -> Float[Tensor, "M K"]:
    """Signed distance in metres to the edge of the drivable area, positive off the road.

    Differentiable in the position. With ``tables`` the nearest edge is looked for among those listed for the
    position's cell of the map; the distance is the same within rounding. With heights and levels, edges on other
    levels do not count (see :func:`symphony.geometry.levels_apart`).
    """
    if height is not None:
        return _on_levels(scenes, scene, position, height, tables)
    if tables is not None and on_host(position) and position.numel() and scenes.edge_start.shape[1]:
        return _by_cells(scenes, scene, position, tables)
    return _among_all(scenes, scene, position, scenes.edge_valid[scene])


def _among_all(scenes: SceneBatch, scene: Tensor, position: Tensor, valid: Tensor) -> Float[Tensor, "M K"]:
    return signed_distance(
        position,
        scenes.edge_start[scene],
        scenes.edge_end[scene],
        valid,
        scenes.edge_previous[scene],
        scenes.edge_following[scene],
    )


def _on_levels(
    scenes: SceneBatch, scene: Tensor, position: Tensor, height: Tensor, tables: Tables | None
) -> Float[Tensor, "M K"]:
    """The distance to the nearest edge, put right where that edge is on another level."""
    flat = road_distance(scenes, scene, position, tables)
    row = scene.repeat_interleave(position.shape[1])
    where, level = position.flatten(0, 1), height.flatten(0, 1)
    wrong = torch.arange(len(row), device=row.device)
    if on_host(position) and tables is not None:
        nearest, inside = _nearest(tables, row.numpy(), where.detach().numpy())
        apart = levels_apart(scenes.edge_height.flatten(0, 1)[torch.from_numpy(nearest)], level)
        wrong = wrong[apart | ~torch.from_numpy(inside)]
    if not len(wrong):
        return flat
    parts = []
    # Every position by itself: which edges count depends on who asks.
    for some in wrong.split(max(_PAIRS // max(scenes.edge_start.shape[1], 1), 1)):
        line = row[some]
        there = scenes.edge_valid[line] & ~levels_apart(scenes.edge_height[line], level[some, None])
        parts.append(_among_all(scenes, line, where[some, None], there).squeeze(1))
    return flat.flatten().index_copy(0, wrong, torch.cat(parts)).view(flat.shape)


def _nearest(
    tables: Tables, row: NDArray[np.int64], where: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """[R] the edge nearest to each position [R, 2] among those of all scenes, and whether its cell tells."""
    x, y = np.ascontiguousarray(where.T)
    cell = tables.edge_cells.at(row, x, y)
    inside, nearest = cell >= 0, np.zeros(len(row), np.int64)
    known = np.flatnonzero(inside)
    if len(known):
        nearest[known] = tables.edge_cells.nearest_edge(cell[known], x[known], y[known])
    return nearest, inside


def _by_cells(scenes: SceneBatch, scene: Tensor, position: Tensor, tables: Tables) -> Float[Tensor, "M K"]:
    flat = position.detach().reshape(-1, 2).numpy()
    nearest, inside = _nearest(tables, np.repeat(scene.numpy(), position.shape[1]), flat)
    distance = distance_to(
        position.reshape(1, -1, 2), **tables.edges, nearest=torch.from_numpy(nearest)[None]
    ).view(position.shape[:2])
    if inside.all():
        return distance
    # Outside of the cells, or of a map that has none: rows that hold such a position, among all edges.
    listed = torch.from_numpy(inside).view(position.shape[:2])
    some = (~listed).any(1).nonzero().squeeze(-1)
    far = road_distance(scenes, scene[some], position[some])
    return torch.where(listed, distance, distance.index_copy(0, some, far))
