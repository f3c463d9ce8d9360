"""Collision and off-road flags of agents at one step; one definition for simulation, log playback and search."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.envs.observation import Objects
from symphony.envs.road import road_distance
from symphony.envs.scene import SceneBatch
from symphony.envs.tables import Tables
from symphony.geometry.boxes import boxes_overlap
from symphony.geometry.nearest import on_host

_SLACK = 1e-2
"""Metres by which circles reach farther than the boxes inside them, far above the rounding of float32."""


def collision_flags(objects: Objects, index: Int[Tensor, "M N"]) -> Bool[Tensor, "M N"]:
    """Whether the oriented box of each agent ``index`` overlaps any other valid box (touching does not count)."""
    wide = index[..., None]
    state = objects.state.gather(1, wide.expand(*index.shape, 5))
    size = objects.size.gather(1, wide.expand(*index.shape, 2))
    other = objects.valid[:, None] & (torch.arange(objects.valid.shape[1], device=index.device) != wide)
    if on_host(state):
        return _where_circles_meet(objects, state, size, other)
    hit = boxes_overlap(
        state[:, :, None, :2],
        state[:, :, None, 2],
        size[:, :, None],
        objects.state[:, None, :, :2],
        objects.state[:, None, :, 2],
        objects.size[:, None],
    )
    return (hit & other).any(-1)


def _where_circles_meet(
    objects: Objects,
    state: Float[Tensor, "M N 5"],
    size: Float[Tensor, "M N 2"],
    other: Bool[Tensor, "M N A"],
) -> Bool[Tensor, "M N"]:
    """Boxes can only overlap where the circles around them do: of all pairs few are left to look at closely."""
    reach = 0.5 * size.norm(dim=-1)[..., None] + (0.5 * objects.size.norm(dim=-1) + _SLACK)[:, None]
    x, y = (state[..., k, None] - objects.state[:, None, :, k] for k in (0, 1))
    near = x.square_().add_(y.square_()) <= reach.square_()
    # One flat index, because finding all coordinates of each pair would cost more than the test.
    pair = (near & other).view(-1).nonzero().squeeze(-1)
    subjects, agents = state.shape[1], objects.state.shape[1]
    # Of a place in [M, N, A] the one in [M, N], and that of the agent in [M, A] of the same row.
    who = torch.div(pair, agents, rounding_mode="floor")
    whom = torch.div(who, subjects, rounding_mode="floor") * agents + pair % agents
    one, two = state.view(-1, 5)[who], objects.state.reshape(-1, 5)[whom]
    hit = boxes_overlap(
        one[:, :2],
        one[:, 2],
        size.view(-1, 2)[who],
        two[:, :2],
        two[:, 2],
        objects.size.reshape(-1, 2)[whom],
    )
    result = torch.zeros(state.shape[:2], dtype=torch.bool)
    result.view(-1)[who[hit]] = True
    return result


def offroad_flags(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    position: Float[Tensor, "M N 2"],
    tables: Tables | None = None,
) -> Bool[Tensor, "M N"]:
    """Whether each box centre lies off the drivable area (nowhere, in a scene without boundary).

    With ``tables``, which cost little to keep, the distance is measured only where a position's cell of the map does
    not tell.
    """
    if tables is None or not on_host(position) or scenes.edge_start.shape[1] == 0:
        return road_distance(scenes, scene, position, tables) > 0
    cells = tables.edge_grids(position.shape[0] * position.shape[1])
    if cells is None:
        return road_distance(scenes, scene, position) > 0
    flat, row = position.reshape(-1, 2), scene.repeat_interleave(position.shape[1])
    x, y = (np.ascontiguousarray(flat[:, k].numpy()) for k in (0, 1))
    owner = row.numpy()
    cell = cells.locate(owner, x, y)
    sign = np.where(cell >= 0, cells.sign[cell], 0) if len(cells.sign) else np.zeros(len(cell), np.int8)
    off, near = sign > 0, np.flatnonzero((sign == 0) & (cell >= 0))
    if len(near):
        place, edges = (cell[near], x[near], y[near]), tables.segments
        off[near] = edges.right_of(cells.nearest_edge(owner[near], *place, edges), *place[1:])
    far = np.flatnonzero(cell < 0)
    if len(far):
        outside = road_distance(scenes, row[far], flat[far][:, None])
        off[far] = (outside[:, 0] > 0).numpy()
    return torch.from_numpy(off).view(position.shape[:2])
