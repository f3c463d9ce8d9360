"""Collision and off-road flags of agents at one step; one definition for simulation, log playback and search."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.envs.observation import Objects, road_distance
from symphony.envs.scene import SceneBatch
from symphony.geometry.boxes import boxes_overlap


def collision_flags(objects: Objects, index: Int[Tensor, "M N"]) -> Bool[Tensor, "M N"]:
    """Whether the oriented box of each agent ``index`` overlaps any other valid box (touching does not count)."""
    wide = index[..., None]
    state = objects.state.gather(1, wide.expand(*index.shape, 5))
    size = objects.size.gather(1, wide.expand(*index.shape, 2))
    other = objects.valid[:, None] & (torch.arange(objects.valid.shape[1], device=index.device) != wide)
    hit = boxes_overlap(
        state[:, :, None, :2],
        state[:, :, None, 2],
        size[:, :, None],
        objects.state[:, None, :, :2],
        objects.state[:, None, :, 2],
        objects.size[:, None],
    )
    return (hit & other).any(-1)


def offroad_flags(
    scenes: SceneBatch, scene: Int[Tensor, " M"], position: Float[Tensor, "M N 2"]
) -> Bool[Tensor, "M N"]:
    """Whether each box centre lies off the drivable area (nowhere, in a scene without boundary)."""
    return road_distance(scenes, scene, position) > 0
