"""Collision and off-road flags of agents at one step; one definition for simulation, log playback and search."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from symphony.envs.objects import Objects
from symphony.envs.road import on_levels, road_distance
from symphony.envs.scene import SceneBatch
from symphony.envs.tables import Tables
from symphony.geometry.boxes import boxes_overlap
from symphony.geometry.levels import levels_apart
from symphony.geometry.nearest import on_host

_SLACK = 1e-2
"""Metres by which circles reach farther than the boxes inside them, far above the rounding of float32."""
_ROUNDING = 4e-6
"""Share of squared positions by which a squared distance may be wrong that is made of them."""


def collision_flags(objects: Objects, index: Int[Tensor, "M N"]) -> Bool[Tensor, "M N"]:
    """Whether the oriented box of each agent ``index`` overlaps any other valid box on its level (touching does not
    count).
    """
    if on_host(objects.state):
        return torch.from_numpy(_where_circles_meet(objects, index.numpy()))
    wide = index[..., None]
    state = objects.state.gather(1, wide.expand(*index.shape, 5))
    size = objects.size.gather(1, wide.expand(*index.shape, 2))
    other = objects.valid[:, None] & (torch.arange(objects.valid.shape[1], device=index.device) != wide)
    if objects.height is not None:
        mine = objects.height.gather(1, wide.expand(*index.shape, 2))
        other &= ~levels_apart(objects.height[:, None], mine[:, :, None])
    hit = boxes_overlap(
        state[:, :, None, :2],
        state[:, :, None, 2],
        size[:, :, None],
        objects.state[:, None, :, :2],
        objects.state[:, None, :, 2],
        objects.size[:, None],
    )
    return (hit & other).any(-1)


def _where_circles_meet(objects: Objects, index: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Boxes can only overlap where the circles around them do: of all pairs few are left to look at closely."""
    state, size = objects.state.detach().flatten(0, 1), objects.size.flatten(0, 1)
    (rows, subjects), agents = index.shape, objects.valid.shape[1]
    who = (index + np.arange(0, rows * agents, agents)[:, None]).ravel()
    states = state.numpy().reshape(rows, agents, 5)
    # Whoever is not there may hold anything, and a place that is not finite is met by nobody. Relative to the first
    # agent, rounding matters little.
    there = objects.valid.numpy() & np.isfinite(states[..., :2]).all(-1)
    origin = np.where(there[:, :1, None], states[:, :1, :2], 0.0)
    place = np.where(there[..., None], states[..., :2] - origin, 0.0)
    radius = np.where(there, 0.5 * np.hypot(*size.numpy().T).reshape(there.shape), 0.0)
    squared = np.square(place).sum(-1)
    own_squared, own_radius = (value.take(who).reshape(index.shape) for value in (squared, radius))
    centre = place.reshape(-1, 2).take(who, axis=0).reshape(rows, subjects, 2)
    # |a - b|^2 - |a|^2 of all pairs, by one product.
    apart = np.matmul(-2.0 * centre, place.swapaxes(1, 2))
    apart += np.where(there, squared, np.inf)[:, None]
    reach = np.square(own_radius + radius.max(1, keepdims=True) + _SLACK) - own_squared
    reach += _ROUNDING * (own_squared + squared.max(1, keepdims=True))
    near = apart <= reach[..., None]
    near.reshape(-1, agents)[np.arange(len(who)), index.ravel()] = False
    result = np.zeros(len(who), np.bool_)
    pair = np.flatnonzero(near)
    if len(pair):
        # Of a place in [M, N, A] the one in [M, N], and that of the other agent in [M, A] of the same row.
        subject = pair // agents
        other = torch.from_numpy(subject // subjects * agents + pair % agents)
        own = torch.from_numpy(who[subject])
        one, two = state.index_select(0, own), state.index_select(0, other)
        hit = boxes_overlap(
            one[:, :2],
            one[:, 2],
            size.index_select(0, own),
            two[:, :2],
            two[:, 2],
            size.index_select(0, other),
        )
        if objects.height is not None:
            height = objects.height.flatten(0, 1)
            hit &= ~levels_apart(height.index_select(0, own), height.index_select(0, other))
        result[subject[hit.numpy()]] = True
    return result.reshape(index.shape)


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
    if height is not None:
        flat = offroad_flags(scenes, scene, position, tables)
        return on_levels(scenes, scene, position, height, flat, tables, lambda away: away > 0)
    if tables is None or not on_host(position) or scenes.edge_start.shape[1] == 0:
        return road_distance(scenes, scene, position, tables) > 0
    cells = tables.edge_cells
    where, row = position.detach().numpy(), np.repeat(scene.numpy(), position.shape[1])
    x, y = np.ascontiguousarray(where.reshape(-1, 2).T)
    cell = cells.locate(row, x, y)
    inside = cell >= 0
    cells.listed(row[inside], cell[inside])
    sign = np.zeros(len(cell), np.int8)
    sign[inside] = cells.sign[cell[inside]]
    off = sign > 0
    asked = np.flatnonzero(sign == 0)
    if len(asked):
        near, far = asked[inside[asked]], asked[~inside[asked]]
        if len(near):
            nearest = cells.nearest_edge(cell[near], x[near], y[near])
            off[near] = cells.edges.right_of(nearest, x[near], y[near])
        if len(far):
            rows, places = torch.from_numpy(far // position.shape[1]), torch.from_numpy(far)
            outside = road_distance(scenes, scene[rows], position.reshape(-1, 1, 2)[places])
            off[far] = (outside[:, 0] > 0).numpy()
    return torch.from_numpy(off).view(position.shape[:2])
