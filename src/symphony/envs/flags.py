"""Collision and off-road flags of agents at one step, one definition for simulation, log playback and search; and how
far positions are from the edge of the road.

Shapes: M rows (any flattened batch), N agents, K positions, R positions of all rows.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.envs.objects import Objects, rows_of
from symphony.envs.scene import SceneBatch, Tables
from symphony.geometry.boxes import boxes_overlap
from symphony.geometry.frames import levels_apart
from symphony.geometry.nearest import on_host, places
from symphony.geometry.polylines import distance_to, signed_distance

_SLACK = 0.1
"""Metres by which circles reach farther than the boxes inside them, far above the rounding of float32."""
_PAIRS = 1 << 20  # positions times edges that are measured at a time where the nearest is on another level


def collision_flags(objects: Objects, index: Int[Tensor, "M N"]) -> Bool[Tensor, "M N"]:
    """Return whether the oriented box of each agent ``index`` overlaps, not only touches, another on its level."""
    state, size, other = objects.state.detach()[:, None], objects.size[:, None], objects.others(index)
    own, own_size = (rows_of(value[:, 0], index)[:, :, None] for value in (state, size))
    if not on_host(index):
        hit = boxes_overlap(own[..., :2], own[..., 2], own_size, state[..., :2], state[..., 2], size)
        return (hit & other).any(-1)
    # Boxes can only overlap where the circles around them do: of all pairs few are left to look at closely.
    x, y = (state[..., k].contiguous() - own[..., k] for k in (0, 1))
    reach = 0.5 * (own_size.norm(dim=-1) + size.norm(dim=-1).amax(-1, keepdim=True)) + _SLACK
    row, n, a = (other & (x.square_().add_(y.square_()) <= reach.square())).nonzero(as_tuple=True)
    one, two = own[row, n, 0], state[row, 0, a]
    hit = boxes_overlap(one[:, :2], one[:, 2], own_size[row, n, 0], two[:, :2], two[:, 2], size[row, 0, a])
    return torch.zeros_like(index, dtype=torch.bool).index_put((row[hit], n[hit]), hit.new_ones(()))


def offroad_flags(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    position: Float[Tensor, "M N 2"],
    tables: Tables | None = None,
    height: Float[Tensor, "M N 2"] | None = None,
) -> Bool[Tensor, "M N"]:
    """Return whether each box centre lies off the drivable area (never in a scene without boundary).

    With ``tables``, which cost little to keep, the distance is measured only where a position's cell of the map does
    not decide. With heights and levels, edges on other levels do not count.
    """
    if tables is None or height is not None or not on_host(position) or scenes.edge_start.shape[1] == 0:
        return road_distance(scenes, scene, position, tables, height) > 0
    row, where = scene.repeat_interleave(position.shape[1]), position.detach().reshape(-1, 2)
    x, y = np.ascontiguousarray(where.numpy().T)
    cells = tables.edge_cells
    cell = cells.at(row.numpy(), x, y)
    sign = cells.sign[cell]
    off, asked = sign > 0, np.flatnonzero((sign == 0) & (cell >= 0))
    if len(asked):
        near = cells.nearest_edge(cell[asked], x[asked], y[asked])
        off[asked] = cells.right_of(near, x[asked], y[asked])
    far = torch.from_numpy(np.flatnonzero(cell < 0))
    flags = torch.from_numpy(off)
    if len(far):
        flags[far] = road_distance(scenes, row[far], where[far, None]).squeeze(1) > 0
    return flags.view(position.shape[:2])


def road_distance(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    position: Float[Tensor, "M K 2"],
    tables: Tables | None = None,
    height: Float[Tensor, "M K 2"] | None = None,
) -> Float[Tensor, "M K"]:
    """Return the signed distance in metres to the edge of the drivable area, positive off the road.

    Differentiable in the position. With ``tables`` the nearest edge is sought among those listed for the position's
    cell of the map; the distance is the same within rounding. With heights and levels, edges on other levels do not
    count (see :func:`symphony.geometry.levels_apart`).
    """
    if tables is None or not on_host(position) or not position.numel() or not scenes.edge_start.shape[1]:
        flat = _among_all(scenes, scene, position, scenes.edge_valid[scene])
        wrong = torch.ones_like(flat, dtype=torch.bool)
    else:
        nearest, inside = _nearest(tables, scene, position)
        flat = distance_to(position.reshape(1, -1, 2), **tables.edges, nearest=nearest[None])
        flat = flat.view(position.shape[:2])
        wrong = ~inside.view(flat.shape)
        if not inside.all():
            # Outside of the cells, or of a map that has none: rows that hold such a position, among all edges.
            some = wrong.any(1).nonzero().squeeze(-1)
            far = _among_all(scenes, scene[some], position[some], scenes.edge_valid[scene[some]])
            flat = torch.where(wrong, flat.index_copy(0, some, far), flat)
        if height is not None:
            wrong |= levels_apart(scenes.edge_height.flatten(0, 1)[nearest].view(*height.shape), height)
    if height is None:
        return flat
    row, at = places(wrong)
    parts, together = [flat.new_empty(0)], max(_PAIRS // max(scenes.edge_start.shape[1], 1), 1)
    # Every position by itself: which edges count depends on who asks.
    for m, k in zip(row.split(together), at.split(together), strict=True):
        there = scenes.edge_valid[scene[m]] & ~levels_apart(scenes.edge_height[scene[m]], height[m, k, None])
        parts.append(_among_all(scenes, scene[m], position[m, k, None], there).squeeze(1))
    return flat.index_put((row, at), torch.cat(parts))


def _nearest(
    tables: Tables, scene: Int[Tensor, " M"], position: Float[Tensor, "M K 2"]
) -> tuple[Int[Tensor, " R"], Bool[Tensor, " R"]]:
    """Return the edge nearest to each position among those of all scenes, and whether its cell decides."""
    x, y = np.ascontiguousarray(position.detach().reshape(-1, 2).numpy().T)
    cell = tables.edge_cells.at(scene.repeat_interleave(position.shape[1]).numpy(), x, y)
    nearest, known = np.zeros(len(cell), np.int64), np.flatnonzero(cell >= 0)
    if len(known):
        nearest[known] = tables.edge_cells.nearest_edge(cell[known], x[known], y[known])
    return torch.from_numpy(nearest), torch.from_numpy(cell >= 0)


def _among_all(
    scenes: SceneBatch, scene: Int[Tensor, " M"], position: Float[Tensor, "M K 2"], valid: Bool[Tensor, "M E"]
) -> Float[Tensor, "M K"]:
    start, end = scenes.edge_start[scene], scenes.edge_end[scene]
    links = scenes.edge_previous[scene], scenes.edge_following[scene]
    return signed_distance(position, start, end, valid, *links)
