"""Policies that need no learning."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from symphony import keys
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.errors import ConfigError


class ConstantVelocity(TensorDictModuleBase):
    """Keeps speed and heading: the weakest prediction a learned agent has to beat.

    Args:
        dynamics: action space to act in.
        dt: seconds per step; needed for displacements only.
    """

    in_keys = [keys.STATE]  # noqa: RUF012 - the type TensorDictModuleBase declares
    out_keys = [keys.ACTION]  # noqa: RUF012

    def __init__(self, dynamics: Bicycle | Displacement, dt: float | None = None) -> None:
        super().__init__()
        if dt is None and not isinstance(dynamics, Bicycle):
            raise ConfigError("to keep a speed by displacements, the time step must be known")
        self.dynamics, self.dt = dynamics, dt

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action [..., N] or [..., N, 2]."""
        speed = tensordict.get(keys.STATE)[..., 3]
        if isinstance(self.dynamics, Bicycle):
            action = torch.full_like(speed, self.dynamics.num_actions // 2, dtype=torch.int64)
        else:
            action = torch.stack([speed * self.dt, torch.zeros_like(speed)], -1)
        return tensordict.set(keys.ACTION, action)


class RandomActions(TensorDictModuleBase):
    """Accelerates and steers at random, every action as likely as any other.

    Args:
        dynamics: action space to act in.
    """

    in_keys = [keys.NOISE]  # noqa: RUF012
    out_keys = [keys.ACTION]  # noqa: RUF012

    def __init__(self, dynamics: Bicycle) -> None:
        super().__init__()
        self.count = dynamics.num_actions

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action [..., N]."""
        action = (tensordict.get(keys.NOISE) * self.count).long()
        return tensordict.set(keys.ACTION, action.clamp(max=self.count - 1))
