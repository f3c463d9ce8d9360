"""What an agent observes of others: who is nearest, where, how fast, and how far apart their boxes are.

Shapes: M rows (any flattened batch), N observing agents, A agents of the scene, O objects.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from symphony.envs.routes import RouteWindow, along_route
from symphony.envs.scene import SceneBatch
from symphony.envs.tables import AGENT_FEATURES, Tables
from symphony.geometry.boxes import gap_between
from symphony.geometry.constants import constant
from symphony.geometry.frames import wrap
from symphony.geometry.levels import levels_apart
from symphony.geometry.nearest import nearest

OBJECT_FEATURES = 8 + AGENT_FEATURES
_PLACES = 1 << 22
"""Positions times logged steps that are looked at together."""


class Objects(NamedTuple):
    """All agents of a scene at one step.

    Attributes:
        state: [M, A, 5] x, y, heading, velocity x, velocity y.
        valid: [M, A].
        size: [M, A, 2].
        kind: [M, A] int64, ``AgentType``.
        height: [M, A, 2] height and level, see :mod:`symphony.data.levels`; None where no scene has levels.
    """

    state: Tensor
    valid: Tensor
    size: Tensor
    kind: Tensor
    height: Tensor | None = None


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
    steps, agents = scenes.log_valid.shape[1:]
    row = scene * steps + step.clamp(max=steps - 1)
    logged, valid, size, kind = (
        table.index_select(0, place)
        for table, place in (
            (scenes.log_state.flatten(0, 1), row),
            (scenes.log_valid.flatten(0, 1), row),
            (scenes.box_size, scene),
            (scenes.agent_type, scene),
        )
    )
    valid = valid & (step <= scenes.last_step.index_select(0, scene))[:, None]
    has_height = scenes.agent_height.shape[1] > 0
    height = scenes.agent_height.flatten(0, 1).index_select(0, row) if has_height else None
    if state is None or index is None or index_valid is None:
        return Objects(logged, valid, size, kind, height)
    if height is not None:
        wide = index[..., None].expand(*index.shape, 2)
        height = height.scatter(1, wide, _height(scenes, scene, state.detach()[..., :2], index))
    x, y, heading, speed = state.unbind(-1)
    simulated = torch.stack([x, y, heading, speed * heading.cos(), speed * heading.sin()], -1)
    # Those not there are written to a column past the last one, which is cut off again.
    column = torch.where(index_valid, index, agents)
    wide = column[..., None].expand(*index.shape, 5)
    logged = pad(logged, (0, 0, 0, 1)).scatter(1, wide, simulated)[:, :agents]
    valid = pad(valid, (0, 1)).scatter(1, column, True)[:, :agents]
    return Objects(logged, valid, size, kind, height)


def everyone_at(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    state: Float[Tensor, "M N 4"],
    valid: Bool[Tensor, "M N"],
) -> Objects:
    """Everyone at a step: interactive agents in their states where they are ``valid``, all others as logged. In open
    traffic one that has left, or not entered yet, is not played back.
    """
    index = scenes.interactive.index_select(0, scene)
    found = objects_at(scenes, scene, step, state, index, valid)
    if not scenes.open_traffic:
        return found
    agents = found.valid.shape[1]
    column = torch.where(scenes.interactive_valid[scene] & ~valid, index, agents)
    return found._replace(valid=pad(found.valid, (0, 1)).scatter(1, column, False)[:, :agents])


def _height(
    scenes: SceneBatch, scene: Int[Tensor, " M"], position: Float[Tensor, "M N 2"], index: Int[Tensor, "M N"]
) -> Float[Tensor, "M N 2"]:
    row, agent = scene[:, None], index
    step = nearest_logged(scenes.log_state[row, :, agent, :2], scenes.log_valid[row, :, agent], position)
    return scenes.agent_height[row, step, agent]


def nearest_logged(
    log: Float[Tensor, "*#b T 2"], valid: Bool[Tensor, "*#b T"], position: Float[Tensor, "*#b 2"]
) -> Int[Tensor, "*b"]:
    """Step of the log at which an agent came nearest to a position."""
    away = (log - position[..., None, :]).square().sum(-1)
    return away.masked_fill(~valid, torch.inf).argmin(-1)


def rollout_heights(
    scenes: SceneBatch, state: Float[Tensor, "B K T N 4"], scene: Int[Tensor, " B"] | None = None
) -> Float[Tensor, "B K T N 2"] | None:
    """Height and level of the interactive agents in states of rollouts; None where no scene has levels.

    Args:
        scenes: the static part.
        state: of the interactive agents.
        scene: rows of ``scenes``; by default all of them.
    """
    if not scenes.agent_height.shape[1]:
        return None
    row = torch.arange(len(scenes), device=state.device) if scene is None else scene
    row, place = row.repeat_interleave(state[0, ..., 0, 0].numel()), state[..., :2].flatten(0, 2)
    each = max(1, _PLACES // (state.shape[3] * scenes.log_state.shape[1]))
    parts = zip(row.split(each), place.split(each), strict=True)
    found = [_height(scenes, part, at, scenes.interactive[part]) for part, at in parts]
    return torch.cat(found).unflatten(0, state.shape[:3])


def observed_objects(
    tables: Tables,
    scene: Int[Tensor, " M"],
    objects: Objects,
    index: Int[Tensor, "M N"],
    own: Float[Tensor, "M N 5"],
    own_size: Float[Tensor, "M N 2"],
    routes: RouteWindow | None,
) -> dict[str, Tensor]:
    """What agents ``index`` in states ``own`` see of the nearest others, by the distance between centres.

    The result holds the entries of :class:`symphony.envs.observation.Observation` that are asked for.
    """
    config, agents = tables.config, objects.valid.shape[1]
    chosen, mask = _nearest(objects, index, own, config.num_objects)
    # Places among all agents there are now, and among those of all scenes.
    now = chosen + torch.arange(0, objects.valid.numel(), agents, device=chosen.device)[:, None, None]
    row = chosen + (scene * agents)[:, None, None]
    # Whoever is not seen may hold anything, and neither its numbers nor their gradient may get through.
    state = objects.state.flatten(0, 1).index_select(0, now.flatten()).unflatten(0, now.shape)
    state = torch.where(mask[..., None], state, 0.0)
    seen = {"objects": _features(tables, state, row, mask, own), "objects_mask": mask}
    size = objects.size.flatten(0, 1).index_select(0, now.flatten()).unflatten(0, now.shape)
    if config.along and routes is not None:
        seen["along"] = along_route(own, own_size, state, size, routes) * mask[..., None]
    if config.clearance or config.gaps:
        gap = _gaps(config.foresight, own, own_size, state, size)
        gap = torch.where(mask[..., None], gap, 0.0)
        seen["gap"] = gap[..., 0]
        if config.foresight:
            seen["gap_ahead"] = gap[..., 1:]
    return seen


@torch.no_grad()
def _nearest(
    objects: Objects, index: Int[Tensor, "M N"], own: Float[Tensor, "M N 5"], count: int
) -> tuple[Int[Tensor, "M N O"], Bool[Tensor, "M N O"]]:
    """Places in the scene of the nearest others, and which of them exist."""
    x, y = (objects.state[:, None, :, k] - own[..., k, None] for k in (0, 1))
    place = torch.arange(objects.valid.shape[1], device=index.device)
    hidden = ~objects.valid[:, None] | (place == index[..., None])
    if objects.height is not None:
        mine = objects.height.gather(1, index[..., None].expand(*index.shape, 2))
        hidden |= levels_apart(objects.height[:, None], mine[:, :, None])
    return nearest((x.square() + y.square()).masked_fill(hidden, torch.inf), count)


def _features(
    tables: Tables,
    state: Float[Tensor, "M N O 5"],
    row: Int[Tensor, "M N O"],
    mask: Bool[Tensor, "M N O"],
    own: Float[Tensor, "M N 5"],
) -> Float[Tensor, "M N O F"]:
    """Features of objects in states, rows of the table of all agents."""
    config = tables.config
    static = tables.agents.index_select(0, row.flatten()).unflatten(0, row.shape)
    # Component by component: operations on a last dimension of 2 are slow.
    origin_x, origin_y, heading, own_x, own_y = own[..., None, :].unbind(-1)
    cos, sin = (-heading).cos(), (-heading).sin()

    def turned(x: Float[Tensor, "M N O"], y: Float[Tensor, "M N O"], scale: float) -> list[Tensor]:
        return [(cos * x - sin * y) / scale, (sin * x + cos * y) / scale]

    x, y, course, speed_x, speed_y = state.unbind(-1)
    relative = wrap(course - heading)
    dynamic = [
        *turned(x - origin_x, y - origin_y, config.distance_scale),
        relative.cos(),
        relative.sin(),
        *turned(speed_x, speed_y, config.speed_scale),
        # Elements are encoded one by one, so each must tell how fast it is approached.
        *turned(speed_x - own_x, speed_y - own_y, config.speed_scale),
    ]
    return torch.cat([torch.stack(dynamic, -1), static], -1) * mask.to(own.dtype)[..., None]


def _gaps(
    foresight: tuple[float, ...],
    own: Float[Tensor, "M N 5"],
    own_size: Float[Tensor, "M N 2"],
    state: Float[Tensor, "M N O 5"],
    size: Float[Tensor, "M N O 2"],
) -> Float[Tensor, "M N O H"]:
    """Gaps between boxes now and at times ahead, were everyone to keep speed and course."""
    # Times come first, and components apart, so that operations run along everything else.
    times = constant((0.0, *foresight), own.dtype, own.device)[:, None, None, None]
    wide = own[..., None, :]
    x, y = (
        (state[..., k] + times * state[..., 3 + k]) - (wide[..., k] + times * wide[..., 3 + k])
        for k in (0, 1)
    )
    gap = gap_between(x, y, wide[..., 2], own_size[..., None, :], state[..., 2], size)
    return gap.movedim(0, -1).contiguous()
