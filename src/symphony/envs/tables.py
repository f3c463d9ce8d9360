"""What can be said of a batch of scenes once, so that a step only looks it up.

Shapes: B scenes, P points, A agents, E boundary segments.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from symphony.data.segment import AgentType, SignalState
from symphony.envs.scene import PointType, SceneBatch
from symphony.geometry.cells import EdgeCells, PointCells
from symphony.geometry.polylines import has_length

if TYPE_CHECKING:
    from symphony.envs.observation import ObservationConfig

LIGHTS = len(SignalState)
POINT_FEATURES = 6 + len(PointType) + LIGHTS
AGENT_FEATURES = 2 + len(AgentType)
LIGHT_COLUMN = 6 + len(PointType)


class Tables:
    """Rows of features, flat indices and cells of the scenes of a batch, each made when first used.

    Args:
        scenes: the static part; must not change afterwards.
        config: of the observation.
    """

    def __init__(self, scenes: SceneBatch, config: ObservationConfig) -> None:
        self.scenes, self.config = scenes, config

    def __reduce__(self) -> tuple[type[Tables], tuple[SceneBatch, ObservationConfig]]:
        # A copy, or what travels to another process, makes its own when it needs them.
        return Tables, (self.scenes, self.config)

    @cached_property
    def points(self) -> Float[Tensor, "BP 23"]:
        """[B P, 23] a point's features, with its position and direction in the frame of the world, in metres, in
        the first four columns and zeros where they depend on the agent or the time.
        """
        scenes = self.scenes
        point = scenes.point.flatten(0, 1)
        rows = point.new_zeros(len(point), POINT_FEATURES)
        rows[:, :2] = point
        rows[:, 2:4] = scenes.point_direction.flatten(0, 1)
        rows[:, 4] = scenes.point_speed.flatten() / self.config.speed_scale
        rows.scatter_(1, 6 + scenes.point_type.flatten().long()[:, None], 1.0)
        return rows

    @cached_property
    def light(self) -> Int[Tensor, " BP"] | None:
        """[B * P] int16 row of the lights, -1 for other points; None if there are no lights."""
        return self.scenes.point_light.flatten() if self.scenes.light.shape[2] else None

    @cached_property
    def light_points(self) -> tuple[Tensor, Tensor]:
        """Positions [B, Q, 2] of the points that are lights, infinity where a scene has fewer, and their numbers
        [B, Q] among all points; Q is at least 1.
        """
        scenes = self.scenes
        is_light = (scenes.point_light >= 0) & scenes.point_valid
        # A light is one point; lights come first, each kind in the order of the scene.
        most = max(1, scenes.light.shape[2])
        order = is_light.to(torch.int8).argsort(stable=True, dim=1, descending=True)[:, :most]
        position = scenes.point.gather(1, order[..., None].expand(*order.shape, 2))
        position = position.masked_fill(~is_light.gather(1, order)[..., None], torch.inf)
        first = torch.arange(len(order), device=order.device)[:, None] * scenes.point.shape[1]
        return position, order + first

    @cached_property
    def position(self) -> tuple[Tensor, Tensor]:
        """x and y [B, P] of the points; infinity where there is none."""
        x, y = self.scenes.point.masked_fill(~self.scenes.point_valid[..., None], torch.inf).unbind(-1)
        return x.contiguous(), y.contiguous()

    @cached_property
    def agents(self) -> Float[Tensor, "BA 7"]:
        """[B * A, 7] size and kind of agents as they are seen."""
        scenes = self.scenes
        size = scenes.box_size.flatten(0, 1) / self.config.size_scale
        rows = size.new_zeros(len(size), AGENT_FEATURES)
        rows[:, :2] = size
        return rows.scatter_(1, 2 + scenes.agent_type.flatten().long()[:, None], 1.0)

    @cached_property
    def edges(self) -> dict[str, Shaped[Tensor, "1 BE ..."]]:
        """The boundary as one scene of B * E segments: start, end, valid, previous, following."""
        scenes = self.scenes
        count, each = scenes.edge_valid.shape
        base = each * torch.arange(count, device=scenes.edge_valid.device)[:, None]

        def flat(index: Int[Tensor, "B E"]) -> Int[Tensor, "1 BE"]:
            return torch.where(index >= 0, index + base, -1).flatten()[None]

        start, end = scenes.edge_start, scenes.edge_end
        return {
            "start": start.flatten(0, 1)[None],
            "end": end.flatten(0, 1)[None],
            "valid": (scenes.edge_valid & has_length(start, end)).flatten()[None],
            "previous": flat(scenes.edge_previous),
            "following": flat(scenes.edge_following),
        }

    @cached_property
    def point_cells(self) -> PointCells:
        """Cells for the nearest points (CPU)."""
        x, y = self.position
        return PointCells(x.numpy(), y.numpy(), self.config.num_points)

    @cached_property
    def edge_cells(self) -> EdgeCells:
        """Cells for the nearest edge of the road (CPU)."""
        start, end, valid, previous, following = (value[0].numpy() for value in self.edges.values())
        return EdgeCells(start, end, valid.reshape(self.scenes.edge_valid.shape), previous, following)
