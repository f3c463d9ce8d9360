"""Open traffic: who is there, and who can enter.

Shapes: M rows (any flattened batch), N driven agents, A agents of the scene.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor
from torch.nn.functional import pad

from symphony.envs.objects import Objects
from symphony.geometry.boxes import box_gap

CLEAR = 1.0
"""Metres that an agent which enters keeps from all others."""
FORESEEN = (0.5, 1.0)
"""Seconds ahead at which its box would meet no other, were everyone to keep speed and course."""


def without(objects: Objects, index: Int[Tensor, "M N"], absent: Bool[Tensor, "M N"]) -> Objects:
    """The same agents without those of ``index`` that are absent."""
    agents = objects.valid.shape[1]
    column = torch.where(absent, index, agents)
    return objects._replace(valid=pad(objects.valid, (0, 1)).scatter(1, column, False)[:, :agents])


def entering(objects: Objects, index: Int[Tensor, "M N"], ready: Bool[Tensor, "M N"]) -> Bool[Tensor, "M N"]:
    """Which agents that are ready can enter, far enough from all others.

    Of several that are ready at once the earlier slot goes first: a later one is kept away from where it is, even if
    that one can't enter either.

    Args:
        objects: everyone, those that are ready at the places where they enter.
        index: rows of A of the driven agents.
        ready: who wants to enter.
    """
    row, slot = ready.nonzero(as_tuple=True)
    agent = index[row, slot]
    everyone = torch.arange(objects.valid.shape[1], device=index.device)
    # The place of an agent among those that are ready; all others are there already.
    order = torch.full_like(objects.valid, -1, dtype=torch.int64)
    order[row, agent] = slot
    there = objects.valid[row] & (everyone != agent[:, None]) & (order[row] < slot[:, None])
    own, size = objects.state[row, agent], objects.size[row, agent]
    state, sizes = objects.state[row], objects.size[row]
    blocked = torch.zeros_like(there)
    for seconds, least in ((0.0, CLEAR), *((t, 0.0) for t in FORESEEN)):
        gap = box_gap(
            (own[:, :2] + seconds * own[:, 3:])[:, None],
            own[:, None, 2],
            size[:, None],
            state[..., :2] + seconds * state[..., 3:],
            state[..., 2],
            sizes,
        )
        blocked |= there & (gap < least)
    found = torch.zeros_like(ready)
    found[row, slot] = ~blocked.any(-1)
    return found
