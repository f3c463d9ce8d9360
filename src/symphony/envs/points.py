"""The nearest map and light points as an agent observes them.

Shapes: M rows (any flattened batch), N observing agents, K points each observes, P points of a scene.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.envs.objects import Observers, frame
from symphony.envs.scene import LIGHT_COLUMN, Tables
from symphony.geometry.frames import levels_apart
from symphony.geometry.nearest import nearest, on_host

REPAID = 2
"""Positions in a cell that repay a list of its points."""
_DISTANCES = 1 << 16
"""Distances held at a time."""


def observed_points(tables: Tables, who: Observers) -> tuple[Float[Tensor, "M N K F"], Bool[Tensor, "M N K"]]:
    """Features of the nearest points in each agent's frame, on its level, and which of them exist."""
    flat, mask = nearest_points(tables, who.scene, who.state.detach()[..., :2], who.height)
    return _features(tables, who, flat, mask), mask


def observed_lights(tables: Tables, who: Observers) -> tuple[Float[Tensor, "M N L F"], Bool[Tensor, "M N L"]]:
    """Features of the nearest lights in each agent's frame, however far, on its level, and which of them exist."""
    position, number = tables.light_points
    with torch.no_grad():
        squared = (position[who.scene][:, None] - who.state[..., None, :2]).square().sum(-1)
        if who.height is not None:
            lights = tables.scenes.point_height.flatten(0, 1)[number[who.scene]]
            squared = squared.masked_fill(levels_apart(lights[:, None], who.height[:, :, None]), torch.inf)
        chosen, mask = nearest(squared, tables.config.num_lights)
        flat = number[who.scene].gather(1, chosen.flatten(1)).unflatten(1, chosen.shape[1:])
    return _features(tables, who, flat, mask), mask


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
        found = _among_all(tables, row[some], here[some, None], None if level is None else level[some])
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
    tables: Tables, who: Observers, flat: Int[Tensor, "M N K"], mask: Bool[Tensor, "M N K"]
) -> Float[Tensor, "M N K F"]:
    """Features of the points ``flat`` as agents see them."""
    config, index = tables.config, flat.flatten()
    # A copy of the rows, which nobody else has yet: what depends on the agent is written over it. That takes half of
    # the time of putting columns together.
    seen = tables.points.index_select(0, index).unflatten(0, flat.shape)
    x, y = seen[..., 0] - who.origin[..., :1], seen[..., 1] - who.origin[..., 1:]
    # Directions are kept apart, as a gradient may still ask for them.
    ahead = seen[..., 2:4].clone().unbind(-1)
    turned = frame(who.heading[..., None])
    written = (*turned(x, y, config.distance_scale), *turned(*ahead))
    for column, values in enumerate(written):
        seen[..., column] = values
    seen[..., 5] = (who.speed / config.speed_scale)[..., None]
    if tables.light is not None:
        light = tables.light.index_select(0, index).unflatten(0, flat.shape).long()
        scenes = tables.scenes
        # Places in the flattened [B, steps]; after the log its last state stays.
        row = who.scene * scenes.light.shape[1] + torch.minimum(who.step, scenes.last_step[who.scene])
        now = scenes.light.flatten(0, 1).index_select(0, row).long()
        state = now.gather(1, light.clamp_min(0).flatten(1)).unflatten(1, light.shape[1:])
        shown = (light >= 0).to(seen.dtype)[..., None]
        dark = torch.zeros_like(seen[..., LIGHT_COLUMN:])
        seen[..., LIGHT_COLUMN:] = dark.scatter(-1, state[..., None], shown)
    # Most maps have enough points, and then there is nothing to mask.
    return seen if on_host(mask) and bool(mask.all()) else seen * mask[..., None]
