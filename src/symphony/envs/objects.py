"""All objects at a step, which agents can enter, and what an agent observes of the nearest others.

Shapes: M rows (any flattened batch), N observing agents, A agents of the scene, O objects.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from symphony.envs.routes import RouteWindow, along_route
from symphony.envs.scene import AGENT_FEATURES, SceneBatch, Tables
from symphony.geometry.boxes import box_gap, gap_between
from symphony.geometry.frames import constant, levels_apart, wrap
from symphony.geometry.nearest import nearest, places

OBJECT_FEATURES = 8 + AGENT_FEATURES
CLEAR = 1.0  # metres that an agent which enters keeps from all others
FORESEEN, LONGER = (0.5, 1.0), (1.5, 2.0)
"""Seconds ahead at which an entering agent's box must meet no other if all keep speed and course, and more of them
past the log."""
HEADWAY = (0.25, 0.5, 0.75, 1.0)  # seconds for which that one could go on if all others stood
_PLACES = 1 << 22  # positions times logged steps that are processed together


class Objects(NamedTuple):
    """All agents of a scene at one step."""

    state: Tensor  # [M, A, 5] x, y, heading, velocity x, velocity y
    valid: Tensor  # [M, A]
    size: Tensor  # [M, A, 2]
    # [M, A, 2] height and level, see symphony.data.levels; None where no scene has levels
    height: Tensor | None = None

    def others(self, index: Int[Tensor, "M N"]) -> Bool[Tensor, "M N A"]:
        """Return which agents ``index`` can meet: all others that are present, on their level."""
        place = torch.arange(self.valid.shape[1], device=index.device)
        other = self.valid[:, None] & (place != index[..., None])
        if self.height is None:
            return other
        return other & ~levels_apart(self.height[:, None], rows_of(self.height, index)[:, :, None])


class Observers(NamedTuple):
    """Agents that observe at a step."""

    scene: Tensor  # [M] rows of the scene batch
    step: Tensor  # [M] logged step
    agent: Tensor  # [M, N] their rows among all agents
    state: Tensor  # [M, N, 5] x, y, heading, velocity x, velocity y
    size: Tensor  # [M, N, 2]
    height: Tensor | None  # [M, N, 2] height and level; None where no scene has levels
    origin: Tensor  # [M, N, 2] positions in state
    heading: Tensor  # [M, N] headings in state
    speed: Tensor  # [M, N] along the heading, m/s

    @classmethod
    def of(cls, objects: Objects, scene: Tensor, step: Tensor, index: Tensor) -> Observers:
        """Return the agents ``index`` among ``objects`` as observers."""
        state, size = rows_of(objects.state, index), rows_of(objects.size, index)
        height = None if objects.height is None else rows_of(objects.height, index)
        heading = state[..., 2]
        turn = -heading
        speed = turn.cos() * state[..., 3] - turn.sin() * state[..., 4]
        return cls(scene, step, index, state, size, height, state[..., :2], heading, speed)


def frame(heading: Float[Tensor, "*b"]) -> Callable[..., tuple[Tensor, Tensor]]:
    """Return a function that turns vectors x, y into the frame of agents with these headings and may scale them."""
    # Component by component: operations on a last dimension of 2 are slow.
    turn = -heading
    cos, sin = turn.cos(), turn.sin()

    def turned(x: Tensor, y: Tensor, scale: float | None = None) -> tuple[Tensor, Tensor]:
        x, y = cos * x - sin * y, sin * x + cos * y
        return (x, y) if scale is None else (x / scale, y / scale)

    return turned


def rows_of(values: Float[Tensor, "M A F"], index: Int[Tensor, "M K"]) -> Float[Tensor, "M K F"]:
    """Return each row's values at its own index."""
    return values.gather(1, index[..., None].expand(*index.shape, values.shape[-1]))


def objects_at(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    state: Float[Tensor, "M N 4"],
    index: Int[Tensor, "M N"],
    index_valid: Bool[Tensor, "M N"],
) -> Objects:
    """Return the agents of each row's scene at a logged step: as logged (past the end of the log none is valid), but
    in the rows ``index`` the simulated agents, where ``index_valid``.
    """
    steps, agents = scenes.log_valid.shape[1:]
    row = scene * steps + step.clamp(max=steps - 1)
    logged, valid = (table.flatten(0, 1).index_select(0, row) for table in (scenes.log_state, scenes.log_valid))
    size = scenes.box_size.index_select(0, scene)
    valid = valid & (step <= scenes.last_step.index_select(0, scene))[:, None]
    height = None
    # Absent ones are written to a column past the last one, which is cut off again.
    column = torch.where(index_valid, index, agents)
    if scenes.agent_height.shape[1]:
        own = _height(scenes, scene, state.detach()[..., :2], index)
        height = scenes.agent_height.flatten(0, 1).index_select(0, row)
        height = pad(height, (0, 0, 0, 1)).scatter(1, column[..., None].expand(*index.shape, 2), own)[:, :agents]
    x, y, heading, speed = state.unbind(-1)
    simulated = torch.stack([x, y, heading, speed * heading.cos(), speed * heading.sin()], -1)
    wide = column[..., None].expand(*index.shape, 5)
    logged = pad(logged, (0, 0, 0, 1)).scatter(1, wide, simulated)[:, :agents]
    valid = pad(valid, (0, 1)).scatter(1, column, True)[:, :agents]
    return Objects(logged, valid, size, height)


def everyone_at(
    scenes: SceneBatch,
    scene: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    state: Float[Tensor, "M N 4"],
    valid: Bool[Tensor, "M N"],
) -> Objects:
    """Return all objects at a step: interactive agents in their states where they are ``valid``, all others as
    logged. In open traffic one that has left, or not entered yet, is not played back.
    """
    index = scenes.interactive.index_select(0, scene)
    found = objects_at(scenes, scene, step, state, index, valid)
    if not scenes.open_traffic:
        return found
    agents = found.valid.shape[1]
    column = torch.where(scenes.interactive_valid[scene] & ~valid, index, agents)
    return found._replace(valid=pad(found.valid, (0, 1)).scatter(1, column, False)[:, :agents])


def _height(
    scenes: SceneBatch, scene: Int[Tensor, " M"], position: Float[Tensor, "M N 2"], agent: Int[Tensor, "M N"]
) -> Float[Tensor, "M N 2"]:
    """Return height and level of agents where the log has them nearest to positions."""
    row = scene[:, None]
    away = (scenes.log_state[row, :, agent, :2] - position[..., None, :]).square().sum(-1)
    step = away.masked_fill(~scenes.log_valid[row, :, agent], torch.inf).argmin(-1)
    return scenes.agent_height[row, step, agent]


def rollout_heights(
    scenes: SceneBatch, state: Float[Tensor, "B K T N 4"], scene: Int[Tensor, " B"] | None = None
) -> Float[Tensor, "B K T N 2"] | None:
    """Return height and level of interactive agents in states of rollouts; None where no scene has levels."""
    if not scenes.agent_height.shape[1]:
        return None
    row = torch.arange(len(scenes), device=state.device) if scene is None else scene
    row, place = row.repeat_interleave(state[0, ..., 0, 0].numel()), state[..., :2].flatten(0, 2)
    each = max(1, _PLACES // (state.shape[3] * scenes.log_state.shape[1]))
    parts = zip(row.split(each), place.split(each), strict=True)
    found = [_height(scenes, part, at, scenes.interactive[part]) for part, at in parts]
    return torch.cat(found).unflatten(0, state.shape[:3])


@torch.no_grad()
def entering(
    objects: Objects, index: Int[Tensor, "M N"], ready: Bool[Tensor, "M N"], late: Bool[Tensor, "M N"] | None = None
) -> Bool[Tensor, "M N"]:
    """Return which of the ready agents are far enough from all others to enter. Those that come ``late``, past the
    log, must be farther away, as no log shows that it went well.

    Of several that are ready the earlier slot goes first; a later one keeps away from it even if it can't enter.
    In ``objects``, ready agents are where they would enter; ``index`` are the driven agents' rows of A.
    """
    agents = objects.valid.shape[1]
    slot = torch.arange(index.shape[1], device=index.device).expand(index.shape)
    # The place of an agent among those that are ready; all others are there already.
    order = torch.full_like(pad(objects.valid, (0, 1)), -1, dtype=torch.int64)
    order = order.scatter(1, torch.where(ready, index, agents), slot)[:, :agents]
    row, slot = places(ready)
    height = None if objects.height is None else objects.height[row]
    some = Objects(objects.state[row], objects.valid[row], objects.size[row], height)
    agent = index[row, slot]
    there = some.others(agent[:, None])[:, 0] & (order[row] < slot[:, None])
    own, own_size = objects.state[row, agent][:, None], objects.size[row, agent][:, None]
    blocked, wary = torch.zeros_like(there), there if late is None else there & late[row, slot][:, None]
    looks = [(0.0, 0.0, CLEAR, there), *((t, t, 0.0, there) for t in FORESEEN)]
    if late is not None:
        looks += [*((t, t, 0.0, wary) for t in LONGER), *((t, 0.0, 0.0, wary) for t in HEADWAY)]
    for mine, theirs, least, who in looks:
        here, others = own[..., :2] + mine * own[..., 3:], some.state[..., :2] + theirs * some.state[..., 3:]
        gap = box_gap(here, own[..., 2], own_size, others, some.state[..., 2], some.size)
        blocked |= who & (gap < least)
    return ready.index_put((row, slot), ready[row, slot] & ~blocked.any(-1))


def observed_objects(
    tables: Tables, objects: Objects, who: Observers, routes: RouteWindow | None
) -> dict[str, Tensor]:
    """Return what agents see of the nearest others, by the distance between centres: the configured entries."""
    config, agents = tables.config, objects.valid.shape[1]
    chosen, mask = _nearest(objects, who, config.num_objects)
    # Places among all agents there are now, and among those of all scenes.
    now = chosen + torch.arange(0, objects.valid.numel(), agents, device=chosen.device)[:, None, None]
    row = chosen + (who.scene * agents)[:, None, None]
    # An agent that is not seen may hold anything, and neither its numbers nor their gradient may get through.
    state = objects.state.flatten(0, 1).index_select(0, now.flatten()).unflatten(0, now.shape)
    state = torch.where(mask[..., None], state, 0.0)
    seen = {"objects": _features(tables, who, state, row, mask), "objects_mask": mask}
    size = objects.size.flatten(0, 1).index_select(0, now.flatten()).unflatten(0, now.shape)
    if config.along and routes is not None:
        seen["along"] = along_route(who.state, who.size, state, size, routes) * mask[..., None]
    if config.clearance or config.gaps:
        gap = torch.where(mask[..., None], _gaps(config.foresight, who, state, size), 0.0)
        seen["gap"] = gap[..., 0]
        if config.foresight:
            seen["gap_ahead"] = gap[..., 1:]
    return seen


@torch.no_grad()
def _nearest(objects: Objects, who: Observers, count: int) -> tuple[Int[Tensor, "M N O"], Bool[Tensor, "M N O"]]:
    """Return places in the scene of the nearest others, and which of them exist."""
    x, y = (objects.state[:, None, :, k] - who.state[..., k, None] for k in (0, 1))
    return nearest(torch.where(objects.others(who.agent), x.square() + y.square(), torch.inf), count)


def _features(
    tables: Tables,
    who: Observers,
    state: Float[Tensor, "M N O 5"],
    row: Int[Tensor, "M N O"],
    mask: Bool[Tensor, "M N O"],
) -> Float[Tensor, "M N O F"]:
    """Return features of objects in states, rows of the table of all agents."""
    config = tables.config
    static = tables.agents.index_select(0, row.flatten()).unflatten(0, row.shape)
    origin_x, origin_y, heading, own_x, own_y = who.state[..., None, :].unbind(-1)
    x, y, course, speed_x, speed_y = state.unbind(-1)
    relative, turned = wrap(course - heading), frame(heading)
    dynamic = [
        *turned(x - origin_x, y - origin_y, config.distance_scale),
        relative.cos(),
        relative.sin(),
        *turned(speed_x, speed_y, config.speed_scale),
        # Elements are encoded one by one, so each must tell how fast it is approached.
        *turned(speed_x - own_x, speed_y - own_y, config.speed_scale),
    ]
    return torch.cat([torch.stack(dynamic, -1), static], -1) * mask.to(state.dtype)[..., None]


def _gaps(foresight: tuple[float, ...], who: Observers, state: Tensor, size: Tensor) -> Float[Tensor, "M N O H"]:
    """Return gaps to boxes [M, N, O] now and at times ahead, if all keep speed and course."""
    # Times come first, and components apart, so that operations run along everything else.
    times = constant((0.0, *foresight), state.dtype, state.device)[:, None, None, None]
    own = who.state[..., None, :]
    now, later = ([part[..., k] + times * part[..., 3 + k] for k in (0, 1)] for part in (own, state))
    x, y = later[0] - now[0], later[1] - now[1]
    gap = gap_between(x, y, own[..., 2], who.size[..., None, :], state[..., 2], size)
    return gap.movedim(0, -1).contiguous()
