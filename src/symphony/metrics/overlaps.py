"""Collisions between states or at them (paper, section V).

Metres and radians. Legend: A agents, N interactive agents, U states, T steps, R worlds, E meetings.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.geometry import contact_share, levels_apart

_SLACK = 1e-3
_PAIRS = 1 << 22  # pairs of agents, times states, processed together: more would not stay in the cache


class Meetings(NamedTuple):
    """Boxes that touch in a step, in no particular order, all [E]."""

    row: Int[Tensor, " E"]  # of R worlds
    subject: Int[Tensor, " E"]  # of N subjects
    other: Int[Tensor, " E"]  # of A agents
    step: Int[Tensor, " E"]  # from state ``step`` to the next one; with ``at_states`` the state
    #: of the step after which they first overlap, see :func:`symphony.geometry.contact_share`
    share: Float[Tensor, " E"]


def meetings(
    position: Float[Tensor, "R A U 2"],
    heading: Float[Tensor, "R A U"],
    size: Float[Tensor, "R A 2"],
    valid: Bool[Tensor, "R A U"],
    subject: Int[Tensor, "R N"],
    height: Float[Tensor, "R A U 2"] | None = None,
    *,
    at_states: bool = False,
) -> Meetings:
    """Return which boxes of subjects and other agents overlap at some time of each step, or at each state.

    Between two states centres move straight and headings turn evenly; an agent that was not there at the first is
    taken where it is at the second. Boxes that only touch do not overlap.

    Takes box centres, headings, length and width, and what is valid: an invalid agent meets nobody, whatever its
    other numbers are. A negative row of A among the subjects stands for no agent. Agents on two levels both before
    and after a step, by their height and level, do not meet (:func:`symphony.geometry.levels_apart`).
    """
    last = slice(None) if at_states else slice(1, None)
    first = last if at_states else slice(-1)
    seen = valid[..., first] & valid[..., last]
    x, y = position.unbind(-1)
    # A circle around all that a box covers in a step.
    place = [torch.where(seen, 0.5 * (p[..., first] + p[..., last]), p[..., last]) for p in (x, y)]
    half = 0.5 * torch.hypot(x[..., last] - x[..., first], y[..., last] - y[..., first])
    reach = torch.where(seen, half, 0.0) + 0.5 * size.norm(dim=-1)[..., None] + 0.5 * _SLACK
    there, agents = valid[..., last], valid.shape[1]
    everyone = torch.arange(agents, device=valid.device)
    found = []
    steps = there.shape[-1]
    each = max(1, _PAIRS // max(1, subject.shape[1] * agents * steps))
    for begin in range(0, len(valid), each):
        rows = torch.arange(begin, min(begin + each, len(valid)), device=valid.device)[:, None]
        own = subject[rows[:, 0]]
        index = own.clamp(min=0)
        near = torch.zeros(*own.shape, agents, steps, device=valid.device, dtype=position.dtype)
        for part in place:
            near += (part[rows[:, 0], None] - part[rows, index][:, :, None]).square_()
        near = near <= (reach[rows[:, 0], None] + reach[rows, index][:, :, None]).square_()
        near &= there[rows[:, 0], None] & there[rows, index][:, :, None]
        near &= ((own[..., None] != everyone) & (own >= 0)[..., None])[..., None]
        row, who, other, step = near.nonzero(as_tuple=True)
        one = index[row, who]
        row = row + begin
        # An agent that was not there before stays where it is now, and so does one that meets it.
        both = seen[row, one, step] & seen[row, other, step]
        now = step if at_states else step + 1
        before = torch.where(both, step, now)
        times = torch.stack([before, now], -1)
        at = [(row[:, None], agent[:, None], times) for agent in (one, other)]
        share = contact_share(
            position[at[0]], heading[at[0]], size[row, one], position[at[1]], heading[at[1]], size[row, other]
        )
        hit = share < math.inf
        if height is not None:
            hit &= ~levels_apart(height[at[0]], height[at[1]]).all(-1)
        found.append(tuple(value[hit] for value in (row, who, other, step, share)))
    if not found:
        none = torch.zeros(0, dtype=torch.int64, device=valid.device)
        return Meetings(none, none, none, none, position.new_zeros(0))
    return Meetings(*(torch.cat(parts) for parts in zip(*found, strict=True)))


def collisions(
    position: Float[Tensor, "*#lead A U 2"],
    heading: Float[Tensor, "*#lead A U"],
    size: Float[Tensor, "*#lead A 2"],
    valid: Bool[Tensor, "*#lead A U"],
    subject: Int[Tensor, "*#lead N"],
    height: Float[Tensor, "*#lead A U 2"] | None = None,
    *,
    at_states: bool = False,
) -> Bool[Tensor, "*lead N T"]:
    """Return whether the oriented box of each subject overlaps any other agent's in each of the U - 1 steps between
    states, or with ``at_states`` at each of the U states (as the paper and WOSAC count), see :func:`meetings`, which
    takes the same. Leading dimensions broadcast.
    """
    lead = torch.broadcast_shapes(
        position.shape[:-3], heading.shape[:-2], size.shape[:-2], valid.shape[:-2], subject.shape[:-1]
    )
    parts = [(position, 3), (heading, 2), (size, 2), (valid, 2), (subject, 1)]
    parts += [] if height is None else [(height, 3)]
    flat = [value.expand(*lead, *value.shape[-inner:]).reshape(-1, *value.shape[-inner:]) for value, inner in parts]
    found = meetings(*flat, at_states=at_states)
    steps = valid.shape[-1] - (not at_states)
    result = torch.zeros(*flat[4].shape, steps, dtype=torch.bool, device=position.device)
    result[found.row, found.subject, found.step] = True
    return result.reshape(*lead, subject.shape[-1], steps)
