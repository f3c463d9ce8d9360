"""Closed-loop simulation without keeping what nobody reads afterwards."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from symphony import keys
from symphony.envs.driving import DrivingEnv


class Rollouts(NamedTuple):
    """What became of the interactive agents. T simulated steps, after the first state.

    Attributes:
        state: [..., T + 1, N, 4] x, y, heading, speed, the first state included.
        collision: [..., T, N].
        offroad: [..., T, N].
        counted: [..., T, N] steps that are judged: of real agents, up to the segment's last logged step.
    """

    state: Tensor
    collision: Tensor
    offroad: Tensor
    counted: Tensor


@torch.no_grad()
def simulate(
    env: DrivingEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    start: TensorDictBase,
    steps: int | None = None,
) -> Rollouts:
    """Roll a policy out from a start state.

    Only states and flags are kept: the observations of sixteen rollouts would take gigabytes.

    Args:
        env: the environment.
        policy: writes the action into the TensorDict it is given.
        start: as returned by :meth:`DrivingEnv.start`, any batch shape.
        steps: decisions; by default up to the last logged step of the longest scene.
    """
    horizon = env.scenes.last_step[start.get(keys.SCENE).squeeze(-1)]
    steps = int(horizon.max()) if steps is None else steps
    now, states, collisions, offroads, counted = start, [start.get(keys.STATE)], [], [], []
    with set_exploration_type(ExplorationType.RANDOM):
        for _ in range(steps):
            now = step_mdp(env.step(policy(now)), exclude_reward=True)
            states.append(now.get(keys.STATE))
            collisions.append(now.get(keys.COLLISION).squeeze(-1))
            offroads.append(now.get(keys.OFFROAD).squeeze(-1))
            counted.append((now.get(keys.STEP).squeeze(-1) <= horizon)[..., None] & now.get(keys.VALID))
    return Rollouts(
        torch.stack(states, -3),
        torch.stack(collisions, -2),
        torch.stack(offroads, -2),
        torch.stack(counted, -2),
    )
