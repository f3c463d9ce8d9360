"""Agents in their log: their states, the routes they took, and what an agent would observe among them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from tensordict import TensorDict
from torch import Tensor

from symphony import keys
from symphony.envs.objects import objects_at
from symphony.envs.observation import ObservationConfig, observe
from symphony.envs.routes import FollowedRoutes, RouteTable, RouteWindow
from symphony.envs.scene import SceneBatch
from symphony.geometry.frames import with_speed


def logged_routes(tables: Sequence[RouteTable], row: Int[Tensor, " M"]) -> FollowedRoutes:
    """The routes that experts took, one expert in each row [M, 1]."""
    none = np.zeros((0, 2), np.float32)
    lines = [table.line(table.logged) if table.logged >= 0 else none for table in tables]
    count = torch.tensor([len(line) for line in lines])
    begin = count.cumsum(0) - count
    return FollowedRoutes(torch.from_numpy(np.concatenate(lines)), begin[row][:, None], count[row][:, None])


def logged(scenes: SceneBatch) -> tuple[Float[Tensor, "B T N 4"], Bool[Tensor, "B T N"]]:
    """The states of the interactive agents in the log, and where they are valid."""
    steps = scenes.log_valid.shape[1]
    index = scenes.interactive[:, None].expand(-1, steps, -1)
    log = scenes.log_state.gather(2, index[..., None].expand(*index.shape, 5))
    valid = scenes.log_valid.gather(2, index) & scenes.interactive_valid[:, None]
    return with_speed(log), valid


def logged_heights(scenes: SceneBatch) -> Float[Tensor, "B T N 2"] | None:
    """Height and level of the interactive agents in the log; None where no scene has levels."""
    if not scenes.agent_height.shape[1]:
        return None
    return scenes.agent_height.take_along_dim(scenes.interactive[:, None, :, None], 2)


def expert_batch(
    scenes: SceneBatch,
    scene_of: Int[Tensor, " M"],
    step: Int[Tensor, " M"],
    agent: Int[Tensor, " M"],
    state: Float[Tensor, "M 4"],
    observation: ObservationConfig,
    *,
    action: Tensor | None = None,
    routes: RouteWindow | None = None,
) -> TensorDict:
    """Observations of agents [M] in given states [M, 4], everyone else as logged; beside them their actions and what
    they see of their routes, where given.
    """
    index, here = agent[:, None], state[:, None]
    real = torch.ones_like(index, dtype=torch.bool)
    objects = objects_at(scenes, scene_of, step, here, index, real)
    seen = observe(scenes, scene_of, step, objects, index, observation, routes=routes)
    batch = TensorDict({}, batch_size=[len(step)], device=state.device)
    batch.set(keys.VALID, real)
    batch.set(keys.STATE, here)
    if observation.persona:
        batch.set(keys.PERSONA, scenes.persona[scene_of, agent][:, None])
    for name, value in seen.items():
        batch.set(("agents", "observation", name), value)
    if action is not None:
        batch.set(keys.ACTION, action[:, None])
    return batch
