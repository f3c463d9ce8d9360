"""The nearest map and light points as an agent observes them.

Shapes: M rows (any flattened batch), N observing agents, K points each observes, P points of a scene.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.envs.tables import LIGHT_COLUMN, POINT_FEATURES, Tables
from symphony.geometry.levels import levels_apart
from symphony.geometry.nearest import nearest, on_host

REPAID = 2
"""Positions in a cell that repay a list of its points."""
_DISTANCES = 1 << 16
"""Distances held at a time."""


def observed_points(
    tables: Tables,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    origin: Float[Tensor, "M N 2"],
    heading: Float[Tensor, "M N"],
    speed: Float[Tensor, "M N"],
    height: Float[Tensor, "M N 2"] | None = None,
) -> tuple[Float[Tensor, "M N K F"], Bool[Tensor, "M N K"]]:
    """Features of the nearest points in each agent's frame, on its level, and which of them exist."""
    flat, mask = nearest_points(tables, scene, origin.detach(), height)
    return _features(tables, scene, step, flat, mask, origin, heading, speed), mask


def observed_lights(
    tables: Tables,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    origin: Float[Tensor, "M N 2"],
    heading: Float[Tensor, "M N"],
    speed: Float[Tensor, "M N"],
    height: Float[Tensor, "M N 2"] | None = None,
) -> tuple[Float[Tensor, "M N L F"], Bool[Tensor, "M N L"]]:
    """Features of the nearest lights in each agent's frame, however far, on its level, and which of them exist."""
    count, position, number = tables.config.num_lights, *tables.light_points
    if position.shape[1] == 0:
        shape = (*origin.shape[:2], count)
        return origin.new_zeros(*shape, POINT_FEATURES), torch.zeros(
            shape, dtype=torch.bool, device=origin.device
        )
    with torch.no_grad():
        squared = (position[scene][:, None] - origin[..., None, :]).square().sum(-1)
        if height is not None:
            lights = tables.scenes.point_height.flatten(0, 1)[number[scene]]
            squared = squared.masked_fill(levels_apart(lights[:, None], height[:, :, None]), torch.inf)
        chosen, mask = nearest(squared, count)
        flat = number[scene].gather(1, chosen.flatten(1)).unflatten(1, chosen.shape[1:])
    return _features(tables, scene, step, flat, mask, origin, heading, speed), mask


@torch.no_grad()
def nearest_points(
    tables: Tables,
    scene: Int[Tensor, " M"],
    origin: Float[Tensor, "M N 2"],
    height: Float[Tensor, "M N 2"] | None = None,
) -> tuple[Int[Tensor, "M N K"], Bool[Tensor, "M N K"]]:
    """Numbers of the nearest points among all points of all scenes, and which of them exist.

    With heights and levels, points on other levels do not (see :func:`symphony.geometry.levels_apart`).
    """
    count, total = tables.config.num_points, tables.position[0].shape[1]
    if not on_host(origin) or total <= count:
        return _among_all(tables, scene, origin, height)
    row, here = scene.repeat_interleave(origin.shape[1]), origin.reshape(-1, 2)
    level = None if height is None else height.reshape(-1, 1, 2)
    x, y = np.ascontiguousarray(here.numpy().T)
    cell = tables.point_cells.at(row.numpy(), x, y, REPAID)
    known = np.flatnonzero(cell >= 0)
    flat = torch.zeros(len(row), count, dtype=torch.int64)
    flat.numpy()[known] = tables.point_cells.nearest_points(cell[known], x[known], y[known])
    mask = tables.scenes.point_valid.flatten()[flat]
    rest = torch.from_numpy(cell < 0)
    if level is not None:
        # Cells do not know of levels: where one of the nearest is on another, all are looked at.
        rest |= levels_apart(tables.scenes.point_height.flatten(0, 1)[flat], level).any(1)
    for some in rest.nonzero().squeeze(-1).split(max(_DISTANCES // total, 1)):
        own = None if level is None else level[some]
        found = _among_all(tables, row[some], here[some, None], own)
        flat[some], mask[some] = (value.squeeze(1) for value in found)
    return flat.view(*origin.shape[:2], count), mask.view(*origin.shape[:2], count)


def _among_all(
    tables: Tables, scene: Int[Tensor, " M"], origin: Float[Tensor, "M N 2"], height: Tensor | None
) -> tuple[Int[Tensor, "M N K"], Bool[Tensor, "M N K"]]:
    """What :func:`nearest_points` gives, from the distances to all points of a scene."""
    x, y = tables.position
    squared = (x[scene][:, None] - origin[..., :1]).square() + (y[scene][:, None] - origin[..., 1:]).square()
    if height is not None:
        away = levels_apart(tables.scenes.point_height[scene][:, None], height[:, :, None])
        squared = squared.masked_fill(away, torch.inf)
    index, mask = nearest(squared, tables.config.num_points)
    return index + (scene * x.shape[1])[:, None, None], mask


def _features(
    tables: Tables,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    flat: Int[Tensor, "M N K"],
    mask: Bool[Tensor, "M N K"],
    origin: Float[Tensor, "M N 2"],
    heading: Float[Tensor, "M N"],
    speed: Float[Tensor, "M N"],
) -> Float[Tensor, "M N K F"]:
    """Features of the points ``flat``, for agents at a position, with a heading and a speed."""
    config, index = tables.config, flat.flatten()
    cos, sin = (f(-heading)[..., None] for f in (torch.cos, torch.sin))
    # A copy of the rows, which nobody else has yet: what depends on the agent is written over it. That takes half of
    # the time of putting columns together.
    seen = tables.points.index_select(0, index).unflatten(0, flat.shape)
    x, y = seen[..., 0] - origin[..., :1], seen[..., 1] - origin[..., 1:]
    # Kept apart, as a gradient may still ask for it.
    ahead_x, ahead_y = seen[..., 2:4].clone().unbind(-1)
    written = [
        (cos * x - sin * y) / config.distance_scale,
        (sin * x + cos * y) / config.distance_scale,
        cos * ahead_x - sin * ahead_y,
        sin * ahead_x + cos * ahead_y,
    ]
    for column, values in enumerate(written):
        seen[..., column] = values
    seen[..., 5] = (speed / config.speed_scale)[..., None]
    if tables.light is not None:
        light = tables.light.index_select(0, index).unflatten(0, flat.shape).long()
        now = _light_now(tables, scene, step)
        state = now.gather(1, light.clamp_min(0).flatten(1)).unflatten(1, light.shape[1:])
        shown = (light >= 0).to(seen.dtype)[..., None]
        dark = torch.zeros_like(seen[..., LIGHT_COLUMN:])
        seen[..., LIGHT_COLUMN:] = dark.scatter(-1, state[..., None], shown)
    # Most maps have enough points, and then there is nothing to mask.
    return seen if on_host(mask) and bool(mask.all()) else seen * mask[..., None]


def _light_now(tables: Tables, scene: Int[Tensor, " M"], step: Int[Tensor, " M"]) -> Int[Tensor, "M Q"]:
    """State [M, Q] int64 of the lights of each row."""
    scenes = tables.scenes
    # Places in the flattened [B, steps]; after the log its last state stays.
    row = scene * scenes.light.shape[1] + torch.minimum(step, scenes.last_step[scene])
    return scenes.light.flatten(0, 1).index_select(0, row).long()
