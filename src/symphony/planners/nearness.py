"""The nearness of the ego to a collision."""

from __future__ import annotations

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from symphony import keys
from symphony.envs.driving import DrivingEnv
from symphony.geometry import box_gap, levels_apart

AHEAD, FAR = 3.0, 8.0
"""Seconds and metres from a collision beyond which nobody is near."""
_HIT = "hit"


class Nearness(TensorDictModuleBase):
    """The nearness of the ego to hitting another agent if all keep speed and course, as a value of states that a
    search lowers. Once the ego has hit somebody it stays as near as can be; the state remembers that.

    Args:
        env: the environment.
        start: [...] states at which rollouts begin.
        strength: how much likelier, as a logarithm, a branch goes on in which the ego hits somebody than one in which
            nobody is near.
    """

    in_keys = [keys.SCENE, keys.STEP, keys.STATE, keys.VALID, _HIT]  # noqa: RUF012 - the type declared
    out_keys = [_HIT]  # noqa: RUF012

    def __init__(self, env: DrivingEnv, start: TensorDictBase, strength: float = 5.0) -> None:
        super().__init__()
        self.env, self.strength = env, strength
        start.set(_HIT, torch.zeros(*start.shape, 1, device=start.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write whether the ego has hit somebody yet [..., 1]."""
        return tensordict.set(_HIT, (self.near(tensordict) >= 1.0).to(torch.float32)[..., None])

    def value(self, state: TensorDictBase) -> Float[Tensor, "*b"]:
        """Return minus the nearness, times the strength."""
        return -self.strength * self.near(state)

    def near(self, state: TensorDictBase) -> Float[Tensor, "*b"]:
        """Return from 0 (nobody is near) to 1 (the ego hits somebody who is not behind it, or has done so)."""
        row = state.get(keys.SCENE).flatten()
        moves, valid = (state.get(key).flatten(0, state.ndim - 1) for key in (keys.STATE, keys.VALID))
        now = self.env.objects(row, state.get(keys.STEP).flatten(), moves, valid)
        ego = self.env.scenes.interactive[row, :1]
        own = now.state.gather(1, ego[..., None].expand(-1, 1, 5))
        size = now.size.gather(1, ego[..., None].expand(-1, 1, 2))
        way, speed = now.state[..., :2] - own[..., :2], now.state[..., 3:] - own[..., 3:]
        cos, sin = own[..., 2].cos(), own[..., 2].sin()
        along, aside = way[..., 0] * cos + way[..., 1] * sin, way[..., 1] * cos - way[..., 0] * sin
        reach = 0.5 * (now.size.norm(dim=-1) + size.norm(dim=-1))
        # Who drives into whom is open where two merge, so those beside the ego count; a follower does not.
        ahead = (along > 0) | ((along > -reach) & (aside.abs() > 0.5 * size[..., 1]))
        there = ahead & now.valid & (torch.arange(way.shape[1], device=ego.device) != ego)
        if now.height is not None:
            mine = now.height.gather(1, ego[..., None].expand(-1, 1, now.height.shape[-1]))
            there &= ~levels_apart(now.height, mine)
        there &= way.norm(dim=-1) - reach < FAR + AHEAD * speed.norm(dim=-1)
        m, a = there.nonzero(as_tuple=True)
        later = torch.linspace(0.0, AHEAD, 7, device=ego.device)
        place = way[m, a, None] + later[:, None] * speed[m, a, None]
        other, box = now.state[m, a, None, 2], now.size[m, a, None]
        gap = box_gap(torch.zeros_like(place), own[m, :, 2], size[m], place, other, box)
        near = 1.0 - (gap.clamp_min(0.0) / FAR + later / AHEAD).amin(-1)
        most = torch.zeros_like(ego[:, 0], dtype=near.dtype).scatter_reduce(0, m, near, "amax")
        return torch.maximum(most.reshape(state.shape), state.get(_HIT)[..., 0])
