"""The step of an environment, written down as plainly as possible: all pairs, no lists, no tables."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from symphony.data.segment import SignalState
from symphony.envs.objects import Objects
from symphony.envs.observation import ObservationConfig
from symphony.envs.scene import PointType, SceneBatch
from symphony.geometry import boxes_overlap, rotate, signed_distance


def nearest_first(squared: Tensor, count: int) -> Tensor:
    """Index of the ``count`` smallest of the last dimension, the first of equal ones, ascending."""
    return squared.sort(dim=-1, stable=True).indices[..., :count].sort(-1).values


def nearest_points(scenes: SceneBatch, scene: Tensor, origin: Tensor, count: int) -> Tensor:
    """Points [M, N, K] of each row's scene nearest to positions [M, N, 2]."""
    where = scenes.point[scene][:, None]
    squared = (where[..., 0] - origin[..., :1]).square() + (where[..., 1] - origin[..., 1:]).square()
    return nearest_first(squared.masked_fill(~scenes.point_valid[scene][:, None], torch.inf), count)


def observed_points(
    scenes: SceneBatch, scene: Tensor, step: Tensor, chosen: Tensor, state: Tensor, config: ObservationConfig
) -> tuple[Tensor, Tensor]:
    """Features [M, N, K, F] of points [M, N, K] and which of them exist; state [M, N, 4]."""
    row = scene[:, None, None].expand(chosen.shape)
    origin, angle = state[..., None, :2], -state[..., 2:3]
    light = scenes.point_light[row, chosen].long()
    features = [
        rotate(scenes.point[row, chosen] - origin, angle) / config.distance_scale,
        rotate(scenes.point_direction[row, chosen], angle),
        (scenes.point_speed[row, chosen] / config.speed_scale)[..., None],
        (state[..., 3] / config.speed_scale)[..., None, None].expand(*chosen.shape, 1),
        one_hot(scenes.point_type[row, chosen].long(), len(PointType)),
    ]
    if scenes.light.shape[2]:
        time = step.clamp(max=scenes.light.shape[1] - 1)[:, None, None].expand(chosen.shape)
        shown = scenes.light[row, time, light.clamp_min(0)].long()
        features.append(one_hot(shown, len(SignalState)) * (light >= 0)[..., None])
    else:
        features.append(torch.zeros(*chosen.shape, len(SignalState)))
    mask = scenes.point_valid[row, chosen]
    return torch.cat([part.to(state.dtype) for part in features], -1) * mask[..., None], mask


def road_distance(scenes: SceneBatch, scene: Tensor, position: Tensor) -> Tensor:
    """Signed distance [M, K] of positions [M, K, 2] among all edges."""
    return signed_distance(
        position, scenes.edge_start[scene], scenes.edge_end[scene], scenes.edge_valid[scene],
        scenes.edge_previous[scene], scenes.edge_following[scene],
    )  # fmt: skip


def collisions(objects: Objects, index: Tensor) -> Tensor:
    """Whether the box of each agent [M, N] overlaps any other valid one."""
    row = torch.arange(len(index))[:, None]
    own, size = objects.state[row, index], objects.size[row, index]
    hit = boxes_overlap(
        own[:, :, None, :2], own[:, :, None, 2], size[:, :, None], objects.state[:, None, :, :2],
        objects.state[:, None, :, 2], objects.size[:, None],
    )  # fmt: skip
    other = objects.valid[:, None] & (torch.arange(objects.valid.shape[1]) != index[..., None])
    return (hit & other).any(-1)
