"""How far positions are from the edge of the drivable area."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from numpy.typing import NDArray
from torch import Tensor

from symphony.envs.scene import SceneBatch
from symphony.envs.tables import Tables
from symphony.geometry.levels import levels_apart
from symphony.geometry.nearest import on_host
from symphony.geometry.polylines import NO_BOUNDARY, distance_to, signed_distance

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
        flat = road_distance(scenes, scene, position, tables)
        return on_levels(scenes, scene, position, height, flat, tables)
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


def on_levels(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    position: Float[Tensor, "M K 2"],
    height: Float[Tensor, "M K 2"],
    flat: Shaped[Tensor, "M K"],
    tables: Tables | None = None,
    of: Callable[[Tensor], Tensor] = lambda away: away,
) -> Shaped[Tensor, "M K"]:
    """What was made of the distance to the nearest edge, put right where that edge is on another level.

    Args:
        scenes: the static part.
        scene: rows of ``scenes``.
        position: as in :func:`road_distance`.
        height: of the positions.
        flat: what was made of the distance.
        tables: as in :func:`road_distance`.
        of: what is made of the distance.
    """
    row, where, level = (
        scene.repeat_interleave(position.shape[1]),
        position.flatten(0, 1),
        height.flatten(0, 1),
    )
    wrong = torch.arange(len(row), device=row.device)
    if on_host(position):
        wrong = (scenes.edge_height[..., 1] > 0).any(1)[row].nonzero().squeeze(-1)
        if tables is not None and len(wrong):
            nearest, inside = _nearest(tables, row[wrong].numpy(), where[wrong].detach().numpy())
            nearest_height = scenes.edge_height.flatten(0, 1)[torch.from_numpy(nearest)]
            wrong = wrong[levels_apart(nearest_height, level[wrong]) | ~torch.from_numpy(inside)]
    if not len(wrong):
        return flat
    parts = []
    # Every position by itself: which edges count depends on who asks.
    for some in wrong.split(max(_PAIRS // max(scenes.edge_start.shape[1], 1), 1)):
        line = row[some]
        there = scenes.edge_valid[line] & ~levels_apart(scenes.edge_height[line], level[some, None])
        ends, links = (
            (one[line], two[line])
            for one, two in (
                (scenes.edge_start, scenes.edge_end),
                (scenes.edge_previous, scenes.edge_following),
            )
        )
        parts.append(signed_distance(where[some, None], *ends, there, *links).squeeze(1))
    return flat.flatten().index_copy(0, wrong, of(torch.cat(parts))).view(flat.shape)


def _nearest(
    tables: Tables, row: NDArray[np.int64], where: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """[R] the edge nearest to each position [R, 2] among those of all scenes, and whether its cell tells."""
    x, y = np.ascontiguousarray(where.T)
    cells = tables.edge_cells
    cell = cells.locate(row, x, y)
    inside = cell >= 0
    known = slice(None) if inside.all() else inside
    cells.listed(row[known], cell[known])
    nearest = np.zeros(len(row), np.int64)
    if inside.any():
        nearest[known] = cells.nearest_edge(cell[known], x[known], y[known])
    return nearest, inside


def _by_cells(scenes: SceneBatch, scene: Tensor, position: Tensor, tables: Tables) -> Float[Tensor, "M K"]:
    flat = position.detach().reshape(-1, 2).numpy()
    nearest, inside = _nearest(tables, np.repeat(scene.numpy(), position.shape[1]), flat)
    everywhere = bool(inside.all())
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
