"""Collision and off-road flags of agents at one step; one definition for simulation, log playback and search."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.envs.objects import Objects
from symphony.envs.road import road_distance
from symphony.envs.scene import SceneBatch
from symphony.envs.tables import Tables
from symphony.geometry.boxes import boxes_overlap
from symphony.geometry.levels import levels_apart
from symphony.geometry.nearest import on_host

_SLACK = 0.1
"""Metres by which circles reach farther than the boxes inside them, far above the rounding of float32."""


def collision_flags(objects: Objects, index: Int[Tensor, "M N"]) -> Bool[Tensor, "M N"]:
    """Whether the oriented box of each agent ``index`` overlaps any other valid box on its level (touching does not
    count).
    """
    wide, everyone = index[..., None], torch.arange(objects.valid.shape[1], device=index.device)
    state = objects.state.detach()
    own, own_size = (
        value.gather(1, wide.expand(*index.shape, value.shape[-1]))[:, :, None]
        for value in (state, objects.size)
    )
    other = objects.valid[:, None] & (everyone != wide)
    if objects.height is not None:
        mine = objects.height.gather(1, wide.expand(*index.shape, 2))
        other &= ~levels_apart(objects.height[:, None], mine[:, :, None])
    state, size = state[:, None], objects.size[:, None]
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
    """Whether each box centre lies off the drivable area (nowhere, in a scene without boundary).

    With ``tables``, which cost little to keep, the distance is measured only where a position's cell of the map does
    not tell. With heights and levels, edges on other levels do not count.
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
