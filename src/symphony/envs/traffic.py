"""Open traffic: who is there, and who can enter.

Shapes: M rows (any flattened batch), N driven agents, n of them, A agents of the scene.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor
from torch.nn.functional import pad

from symphony.envs.objects import Objects
from symphony.geometry.boxes import box_gap
from symphony.geometry.levels import levels_apart
from symphony.geometry.nearest import on_host

CLEAR = 1.0
"""Metres that an agent which enters keeps from all others."""
FORESEEN = (0.5, 1.0)
"""Seconds ahead at which its box would meet no other, were everyone to keep speed and course."""


@torch.no_grad()
def entering(objects: Objects, index: Int[Tensor, "M N"], ready: Bool[Tensor, "M N"]) -> Bool[Tensor, "M N"]:
    """Which agents that are ready can enter, far enough from all others.

    Of several that are ready at once the earlier slot goes first: a later one is kept away from where it is, even if
    that one can't enter either.

    Args:
        objects: everyone, those that are ready at the places where they enter.
        index: rows of A of the driven agents.
        ready: who wants to enter.
    """
    agents = objects.valid.shape[1]
    slot = torch.arange(index.shape[1], device=index.device).expand(index.shape)
    # The place of an agent among those that are ready; all others are there already.
    order = torch.full_like(pad(objects.valid, (0, 1)), -1, dtype=torch.int64)
    order = order.scatter(1, torch.where(ready, index, agents), slot)[:, :agents]
    if not on_host(ready):
        return ready & ~_blocked(objects, order, index, slot)
    row, place = ready.nonzero(as_tuple=True)
    one = place[:, None]
    height = None if objects.height is None else objects.height[row]
    some = Objects(objects.state[row], objects.valid[row], objects.size[row], objects.kind[row], height)
    found = torch.zeros_like(ready)
    found[row, place] = ~_blocked(some, order[row], index[row].gather(1, one), one).squeeze(1)
    return found


def _blocked(
    objects: Objects, order: Int[Tensor, "M A"], agent: Int[Tensor, "M n"], slot: Int[Tensor, "M n"]
) -> Bool[Tensor, "M n"]:
    """Whether anybody who is there, or goes first, is in the way of agents with these slots."""
    everyone = torch.arange(objects.valid.shape[1], device=agent.device)
    there = objects.valid[:, None] & (everyone != agent[..., None]) & (order[:, None] < slot[..., None])
    own, size = (
        value.gather(1, agent[..., None].expand(*agent.shape, value.shape[-1]))[:, :, None]
        for value in (objects.state, objects.size)
    )
    state, sizes = objects.state[:, None], objects.size[:, None]
    if objects.height is not None:
        mine = objects.height.gather(1, agent[..., None].expand(*agent.shape, 2))
        there &= ~levels_apart(objects.height[:, None], mine[:, :, None])
    blocked = torch.zeros_like(there)
    for seconds, least in ((0.0, CLEAR), *((t, 0.0) for t in FORESEEN)):
        here, others = (value[..., :2] + seconds * value[..., 3:] for value in (own, state))
        gap = box_gap(here, own[..., 2], size, others, state[..., 2], sizes)
        blocked |= there & (gap < least)
    return blocked.any(-1)
