"""What an agent sees (paper, section IV-C): nearest objects and nearest map and light points, in its own frame.

Shapes: M rows (any flattened batch), N observing agents, A agents of the scene, O objects, P points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import one_hot, pad

from symphony.data.segment import AgentType, SignalState
from symphony.envs.scene import PointType, SceneBatch
from symphony.geometry.boxes import box_corners, box_gap
from symphony.geometry.frames import rotate, wrap
from symphony.geometry.polylines import signed_distance

SELF_FEATURES = 4
OBJECT_FEATURES = 10 + len(AgentType)
_LIGHTS = len(SignalState)
POINT_FEATURES = 6 + len(PointType) + _LIGHTS


@dataclass(frozen=True)
class ObservationConfig:
    """How much an agent sees and how it is scaled to numbers near one.

    Attributes:
        num_objects: nearest agents kept.
        num_points: nearest map and light points kept.
        distance_scale: metres that become 1.
        speed_scale: m/s that become 1.
        size_scale: metres of a box side that become 1.
        route: whether it sees the route that is its goal.
        clearance: whether it sees how far its box is from others and from the edge of the road.
        foresight: seconds ahead at which it also sees how far it would be from others, were everyone to keep
            speed and course; with ``clearance`` only.
    """

    num_objects: int = 16
    num_points: int = 1000
    distance_scale: float = 20.0
    speed_scale: float = 10.0
    size_scale: float = 5.0
    route: bool = False
    clearance: bool = False
    foresight: tuple[float, ...] = ()


class Objects(NamedTuple):
    """All agents of a scene at one step.

    Attributes:
        state: [M, A, 5] x, y, heading, velocity x, velocity y.
        valid: [M, A].
        size: [M, A, 2].
        kind: [M, A] int64, ``AgentType``.
    """

    state: Tensor
    valid: Tensor
    size: Tensor
    kind: Tensor


class Observation(NamedTuple):
    """Features of the observing agents; masked entries are zero.

    Attributes:
        own: [M, N, 4] speed, length, width, last logged step reached (0 or 1).
        objects: [M, N, O, 15].
        objects_mask: [M, N, O].
        points: [M, N, P, 23].
        points_mask: [M, N, P].
        gap: [M, N, O] metres between boxes, negative where they overlap, 0 where masked; None if not asked for.
        gap_ahead: [M, N, O, H] likewise at H times ahead; None if not asked for.
        road: [M, N, 5] metres of centre and corners off the road, negative on it; None if not asked for.
    """

    own: Tensor
    objects: Tensor
    objects_mask: Tensor
    points: Tensor
    points_mask: Tensor
    gap: Tensor | None = None
    gap_ahead: Tensor | None = None
    road: Tensor | None = None


def objects_at(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    state: Float[Tensor, "M N 4"] | None = None,
    index: Int[Tensor, "M N"] | None = None,
    index_valid: Bool[Tensor, "M N"] | None = None,
) -> Objects:
    """The agents of each row's scene at a step: log playback, with simulated ones put in their place.

    Args:
        scenes: the static part.
        scene: rows of ``scenes``.
        step: logged step (past the end of the log nothing is valid).
        state: x, y, heading, speed of the simulated agents.
        index: their rows among the scene's agents.
        index_valid: which of them are real.
    """
    steps = scenes.log_state.shape[1]
    row = scene * steps + step.clamp(max=steps - 1)
    logged = scenes.log_state.flatten(0, 1).index_select(0, row)
    valid = scenes.log_valid.flatten(0, 1).index_select(0, row)
    valid = valid & (step <= scenes.last_step[scene])[:, None]
    if state is not None and index is not None and index_valid is not None:
        heading, speed = state[..., 2], state[..., 3:]
        forward = torch.stack([heading.cos(), heading.sin()], -1)
        simulated = torch.cat([state[..., :3], speed * forward], -1)
        # Padded agents are written to a column past the last one, which is cut off again.
        agents = logged.shape[1]
        column = torch.where(index_valid, index, agents)
        wide = column[..., None].expand(*column.shape, 5)
        logged = pad(logged, (0, 0, 0, 1)).scatter(1, wide, simulated)[:, :agents]
        valid = pad(valid, (0, 1)).scatter(1, column, True)[:, :agents]
    return Objects(logged, valid, scenes.box_size[scene], scenes.agent_type[scene])


def observe(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    objects: Objects,
    index: Int[Tensor, "M N"],
    config: ObservationConfig,
) -> Observation:
    """Observation of the agents ``index`` among ``objects``.

    Nearness is the distance between centres. Lanes share their end points, so ties are common: on the CPU they go to
    the elements that come first, whatever the padding.
    """
    own = _take(objects.state, index)
    own_size = _take(objects.size, index)
    origin, heading = own[..., :2], own[..., 2]
    speed = rotate(own[..., 3:], -heading)[..., 0]
    ends = (step >= scenes.last_step[scene]).to(own.dtype)
    features = torch.cat(
        [
            (speed / config.speed_scale)[..., None],
            own_size / config.size_scale,
            ends[:, None, None].expand(*index.shape, 1),
        ],
        -1,
    )
    seen, seen_mask, gap, ahead = _see_objects(objects, index, own, own_size, config)
    points, points_mask = _see_points(scenes, scene, step, origin, heading, speed, config)
    road = None
    if config.clearance:
        corners = torch.cat([origin[..., None, :], box_corners(origin, heading, own_size)], -2)
        road = road_distance(scenes, scene, corners.flatten(1, 2)).unflatten(1, corners.shape[1:3])
    return Observation(features, seen, seen_mask, points, points_mask, gap, ahead, road)


def _see_objects(
    objects: Objects, index: Tensor, own: Tensor, own_size: Tensor, config: ObservationConfig
) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
    origin, heading = own[..., :2], own[..., 2]
    agents = objects.state.shape[1]
    with torch.no_grad():
        squared = (objects.state[:, None, :, :2] - origin[:, :, None]).square().sum(-1)
        hidden = ~objects.valid[:, None] | (torch.arange(agents, device=index.device) == index[..., None])
        squared = squared.masked_fill(hidden, torch.inf)
        nearest, chosen = _nearest(squared, config.num_objects)
        mask = nearest.isfinite()
    flat = chosen.flatten(1)
    state = _take(objects.state, flat).unflatten(1, chosen.shape[1:])
    size = _take(objects.size, flat).unflatten(1, chosen.shape[1:])
    kind = objects.kind.gather(1, flat).unflatten(1, chosen.shape[1:])
    angle = -heading[..., None]
    relative = wrap(state[..., 2] + angle)
    features = torch.cat(
        [
            rotate(state[..., :2] - origin[..., None, :], angle) / config.distance_scale,
            relative.cos()[..., None],
            relative.sin()[..., None],
            rotate(state[..., 3:], angle) / config.speed_scale,
            # Elements are encoded one by one, so each must tell how fast it is approached.
            rotate(state[..., 3:] - own[..., None, 3:], angle) / config.speed_scale,
            size / config.size_scale,
            one_hot(kind, len(AgentType)).to(state.dtype),
        ],
        -1,
    )
    features = features * mask[..., None]
    if not config.clearance:
        return features, mask, None, None
    times = torch.tensor((0.0, *config.foresight), dtype=origin.dtype, device=origin.device)[:, None]
    here = own[..., None, None, :2] + times * own[..., None, None, 3:]
    there = state[..., None, :2] + times * state[..., None, 3:]
    gap = box_gap(
        here,
        heading[..., None, None],
        own_size[..., None, None, :],
        there,
        state[..., 2, None],
        size[..., None, :],
    )
    gap = torch.where(mask[..., None], gap, 0.0)
    return features, mask, gap[..., 0], gap[..., 1:] if config.foresight else None


def road_distance(
    scenes: SceneBatch, scene: Int[Tensor, " M"], position: Float[Tensor, "M K 2"]
) -> Float[Tensor, "M K"]:
    """Signed distance in metres to the edge of the drivable area, positive off the road."""
    return signed_distance(
        position,
        scenes.edge_start[scene],
        scenes.edge_end[scene],
        scenes.edge_valid[scene],
        scenes.edge_previous[scene],
        scenes.edge_following[scene],
    )


def _see_points(
    scenes: SceneBatch,
    scene: Tensor,
    step: Tensor,
    origin: Tensor,
    heading: Tensor,
    speed: Tensor,
    config: ObservationConfig,
) -> tuple[Tensor, Tensor]:
    total = scenes.point.shape[1]
    with torch.no_grad():
        where = scenes.point[scene]
        squared = (where[:, None, :, 0] - origin[..., :1]).square() + (
            where[:, None, :, 1] - origin[..., 1:]
        ).square()
        squared = squared.masked_fill(~scenes.point_valid[scene][:, None], torch.inf)
        nearest, chosen = _nearest(squared, config.num_points)
        mask = nearest.isfinite()
        # One flat row index serves every table; index_select on rows is far cheaper than advanced indexing.
        flat = (scene[:, None, None] * total + chosen).flatten()
    shape = chosen.shape

    def look(table: Tensor) -> Tensor:
        return table.flatten(0, 1).index_select(0, flat).unflatten(0, shape)

    angle = -heading[..., None]
    light = look(scenes.point_light)
    kind = one_hot(look(scenes.point_type), len(PointType)).to(origin.dtype)
    features = torch.cat(
        [
            rotate(look(scenes.point) - origin[..., None, :], angle) / config.distance_scale,
            rotate(look(scenes.point_direction), angle),
            (look(scenes.point_speed) / config.speed_scale)[..., None],
            (speed / config.speed_scale)[..., None, None].expand(*shape, 1),
            kind,
            _light_states(scenes, scene, step, light).to(origin.dtype),
        ],
        -1,
    )
    return features * mask[..., None], mask


def _light_states(scenes: SceneBatch, scene: Tensor, step: Tensor, light: Tensor) -> Tensor:
    """One-hot state [..., 9] of the lights with these rows; zeros for rows of -1."""
    steps, lights = scenes.light.shape[1:]
    if lights == 0:
        return light.new_zeros(*light.shape, _LIGHTS)
    row = scene * steps + step.clamp(max=steps - 1)
    now = scenes.light.flatten(0, 1).index_select(0, row)
    state = now.gather(1, light.clamp_min(0).flatten(1)).unflatten(1, light.shape[1:])
    return one_hot(state, _LIGHTS) * (light >= 0)[..., None]


def _nearest(squared: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The ``count`` smallest of the last dimension, unsorted, and their indices; padded with infinity at index 0."""
    available = min(count, squared.shape[-1])
    if squared.device.type == "cpu" and available < squared.shape[-1]:
        # On the CPU NumPy's selection takes less than half the time of topk.
        index = torch.from_numpy(np.argpartition(squared.numpy(), available, axis=-1)[..., :available])
        values = squared.gather(-1, index)
        # Which of equal elements the selection takes depends on how many there are, hence on the batch.
        cut = values.amax(-1, keepdim=True)
        tied = ((squared <= cut).sum(-1) > available) & cut.isfinite().squeeze(-1)
        if bool(tied.any()):
            order = squared[tied].sort(dim=-1, stable=True)
            values[tied], index[tied] = order.values[..., :available], order.indices[..., :available]
    else:
        values, index = squared.topk(available, dim=-1, largest=False, sorted=False)
    if available < count:
        values = pad(values, (0, count - available), value=torch.inf)
        index = pad(index, (0, count - available))
    return values, index


def _take(values: Tensor, index: Tensor) -> Tensor:
    """values [M, A, F] at index [M, K] -> [M, K, F]."""
    return values.gather(1, index[..., None].expand(*index.shape, values.shape[-1]))
