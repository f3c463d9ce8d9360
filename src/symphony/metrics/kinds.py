"""The kinds of collisions: who ran into whom, and from where.

A rate alone does not tell a policy that brakes too late from one that is hit by playback vehicles, which can't react.

Metres, radians, seconds. Legend: A agents of the scene, N interactive agents, T simulated steps, T+1 states with the
first one, M collisions. A pose is x, y, heading, velocity x, velocity y.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from symphony.geometry import box_gap, contact_share, levels_apart, pose_at, rotate, wrap

SAME_WAY = math.radians(45)  # largest angle between the headings of two agents that go the same way
OPPOSITE_WAY = math.radians(135)  # smallest angle between the headings of two agents that go opposite ways
STANDING = 0.5  # speed in m/s up to which an agent counts as standing
_SLACK = 0.01


class CollisionKind(IntEnum):
    """Kinds of collision, from the agent's point of view.

    The headings before contact decide the way. Of two agents that go the same way the sides that met are those whose
    gap closed last, at the time of contact: ends (one ahead of the other) or flanks (one beside the other).
    """

    INTO_LEADER = 0  # same way, its front met the tail of one ahead
    ONCOMING = 1  # the other faces the opposite way
    CROSSING = 2  # the other faces across
    SIDESWIPE = 3  # same way, flank to flank, as after a lane change
    OTHER = 4  # same way, end to end, because one backed into the other, which stood or backed too
    REAR_ENDED = 5  # same way, its tail was met by the front of one behind
    PEDESTRIAN = 6  # the other is a pedestrian, wherever they came from
    CYCLIST = 7  # the other is a cyclist, wherever they came from


_RANK = (0, 1, 2, 3, 4, 7, 5, 6)
"""Place of each kind when two happen at the same step: being hit from behind comes last."""
_TYPES = {2: CollisionKind.PEDESTRIAN, 3: CollisionKind.CYCLIST}
"""Agent types (see ``symphony.data.segment.AgentType``) that are kinds of their own."""


class CollisionKinds(NamedTuple):
    """The first collision of every interactive agent, all `[..., N]`."""

    kind: Int[Tensor, "*lead N"]  # int64 :class:`CollisionKind`, -1 for no collision
    step: Int[Tensor, "*lead N"]  # int64 simulated step, from 0, -1 for no collision
    other: Int[Tensor, "*lead N"]  # int64 row of A of the agent it collided with, -1 for no collision
    playback: Bool[Tensor, "*lead N"]  # bool, whether that one is not an interactive agent

    def first(self) -> tuple[Int[Tensor, "*lead"], Bool[Tensor, "*lead"]]:
        """Return the kind (-1 for none) and `playback` of the first collision of each rollout.

        Of collisions at the same step, as when two interactive agents meet, the first of :class:`CollisionKind`
        counts, being rear-ended last: the agent that ran into the other, not the one that was hit.
        """
        number = len(CollisionKind)
        none = torch.iinfo(torch.int64).max
        rank = torch.tensor(_RANK, device=self.kind.device)
        # One number to take the least of, and to take apart again: step, then rank, then whether it is no playback.
        key = 2 * (number * self.step + rank[self.kind.clamp(min=0)]) + (~self.playback).long()
        key = torch.where(self.kind < 0, none, key)
        key = torch.cat([key, key.new_full((*key.shape[:-1], 1), none)], -1).amin(-1)
        happened = key != none
        kind = rank.argsort()[key // 2 % number]
        return torch.where(happened, kind, -1), happened & (key % 2 == 0)


def collision_kinds(
    collided: Bool[Tensor, "*#lead N T"],
    state: Float[Tensor, "*#lead N T+1 4"],
    exists: Bool[Tensor, "*#lead N T+1"],
    subject: Int[Tensor, "*#lead N"],
    log_state: Float[Tensor, "*#lead A T+1 5"],
    log_valid: Bool[Tensor, "*#lead A T+1"],
    size: Float[Tensor, "*#lead A 2"],
    agent_type: Int[Tensor, "*#lead A"],
    height: tuple[Float[Tensor, "*#lead N T+1 2"], Float[Tensor, "*#lead A T+1 2"]] | None = None,
) -> CollisionKinds:
    """Return with whom, when and how each interactive agent collides first. Leading dimensions broadcast.

    The other one is the valid agent whose box meets the agent's first within that step; of several at once the one
    that reaches deepest into it at its end. The states one step before and those at the time of contact decide the
    kind, as after the step fast boxes lie deep in each other or beyond; those after it if the other was not valid.

    Takes whether an agent collides in a step (see :func:`symphony.metrics.collisions`); x, y, heading and speed of
    the interactive agents, whether they are there, and their rows of A, where a negative one stands for no agent;
    poses and validity of all agents as logged, of which the rows of the interactive ones are not read; length and
    width, ``AgentType`` numbers, and heights and levels. Raises ValueError for a flagged agent that touches nobody.
    """
    ranks = ((collided, 2), (state, 3), (exists, 2), (subject, 1), (log_state, 3), (log_valid, 2), (size, 2))
    # One leading dimension more, so that there always is one.
    lead = (1, *torch.broadcast_shapes(*(value.shape[:-rank] for value, rank in ranks)))

    def expanded(value: Tensor, rank: int) -> Tensor:
        return value.expand(*lead, *value.shape[-rank:])

    collided, rows = expanded(collided, 2), expanded(subject, 1)
    hit = collided.any(-1)
    *where, who = hit.nonzero(as_tuple=True)
    step = collided.to(torch.uint8).argmax(-1)[hit]
    rows = rows[tuple(where)]
    agent = rows.gather(-1, who[:, None])[:, 0]

    def everyone(driven: Tensor, logged: Tensor, rank: int) -> tuple[Tensor, Tensor]:
        """Return for each collision the values [M, A, ...] of all agents before and after its step."""
        driven, logged = (expanded(value, rank).movedim(-rank + 1, -rank) for value in (driven, logged))
        before, after = (_placed(logged[at], driven[at], rows) for at in ((*where, step), (*where, step + 1)))
        return before, after

    direction = torch.stack([state[..., 2].cos(), state[..., 2].sin()], -1)
    poses = torch.cat([state[..., :3], state[..., 3:] * direction], -1).to(log_state.dtype)
    boxes = expanded(size, 2)[tuple(where)]
    levels = None if height is None else everyone(*height, 3)
    other, share, before, after = _first_met(
        everyone(poses, log_state, 3), everyone(exists, log_valid, 2), boxes, agent, levels
    )
    one, two = ((torch.arange(len(row), device=row.device), row) for row in (agent, other))
    ends = ((before[one], after[one]), (before[two], after[two]))
    kind = kind_of_contact(*ends, share, boxes[one], boxes[two])
    other_type = expanded(agent_type, 1)[tuple(where)].gather(-1, other[:, None])[:, 0]
    for number, named in _TYPES.items():
        kind = torch.where(other_type == number, int(named), kind)
    playback = ~(other[:, None] == rows).any(-1)

    def filled(values: Int[Tensor, " M"]) -> Int[Tensor, "*_"]:
        return torch.full(hit.shape, -1, device=hit.device).masked_scatter(hit, values)[0]

    return CollisionKinds(filled(kind), filled(step), filled(other), filled(playback.long()) == 1)


def _placed(
    values: Shaped[Tensor, "M A *e"], driven: Shaped[Tensor, "M N *e"], rows: Int[Tensor, "M N"]
) -> Shaped[Tensor, "M A *e"]:
    """Return values [M, A, ...] with those of the interactive agents [M, N, ...] in their rows."""
    count = values.shape[1]
    # Padding goes to a row more, which is dropped.
    values = torch.cat([values, torch.zeros_like(values[:, :1])], 1)
    index = torch.where(rows < 0, count, rows)
    index = index.reshape(index.shape + (1,) * (values.ndim - 2)).expand_as(driven)
    return values.scatter(1, index, driven)[:, :count]


def _first_met(
    poses: tuple[Float[Tensor, "M A 5"], Float[Tensor, "M A 5"]],
    valid: tuple[Bool[Tensor, "M A"], Bool[Tensor, "M A"]],
    boxes: Float[Tensor, "M A 2"],
    agent: Int[Tensor, " M"],
    height: tuple[Float[Tensor, "M A 2"], Float[Tensor, "M A 2"]] | None,
) -> tuple[Int[Tensor, " M"], Float[Tensor, " M"], Float[Tensor, "M A 5"], Float[Tensor, "M A 5"]]:
    """Return whom each agent [M] meets first in a step, after which share of it, and all poses before and after.

    Where the agent and the other were not both there before the step, the poses before it are those after it. Poses,
    validity and heights are given before and after the step.
    """
    me = torch.arange(len(agent), device=agent.device), agent
    before, after = poses
    seen = valid[0] & valid[0][me][:, None]
    start = torch.where(seen[..., None], before, after)
    mine, mine_after = (torch.where(seen[..., None], before[me][:, None], after[me][:, None]), after[me][:, None])
    others = valid[1] & (torch.arange(boxes.shape[1], device=agent.device) != agent[:, None])
    if height is not None:
        apart, apart_after = (levels_apart(level, level[me][:, None]) for level in height)
        others &= ~(apart_after & (apart | ~seen))
    share = contact_share(
        torch.stack([mine[..., :2], mine_after[..., :2].expand_as(mine[..., :2])], -2),
        torch.stack([mine[..., 2], mine_after[..., 2].expand_as(mine[..., 2])], -1),
        boxes[me][:, None],
        torch.stack([start[..., :2], after[..., :2]], -2),
        torch.stack([start[..., 2], after[..., 2]], -1),
        boxes,
    )
    gap = box_gap(mine_after[..., :2], mine_after[..., 2], boxes[me][:, None], after[..., :2], after[..., 2], boxes)
    share, gap = (torch.where(others, value, torch.inf) for value in (share, gap))
    first = share.amin(-1, keepdim=True)
    # Flags of states may differ by rounding from what is found between them.
    least, other = torch.where((share <= first + 1e-6) | first.isinf(), gap, torch.inf).min(-1)
    first = first[:, 0]
    if bool((first.isinf() & (least > _SLACK)).any()):
        raise ValueError(
            f"an agent that is said to collide is {float(least[first.isinf()].max()):.2f} m away from all others: "
            "flags and states do not belong together"
        )
    both = seen.gather(1, other[:, None])[..., None]
    return other, first.clamp(max=1.0), torch.where(both, before, after), after


def kind_of_contact(
    one: tuple[Float[Tensor, "M 5"], Float[Tensor, "M 5"]],
    two: tuple[Float[Tensor, "M 5"], Float[Tensor, "M 5"]],
    share: Float[Tensor, " M"],
    size_one: Float[Tensor, "M 2"],
    size_two: Float[Tensor, "M 2"],
) -> Int[Tensor, " M"]:
    """Return the :class:`CollisionKind` [M] of contacts from the point of view of the first agent. Takes the poses of
    both before and after the step, the share of it until they overlap, and their boxes.
    """
    sizes = size_one, size_two
    turn = wrap(two[0][:, 2] - one[0][:, 2])
    away, along, across = _separations(one[0], two[0], *sizes)
    _, along_hit, across_hit = _separations(_at_contact(*one, share), _at_contact(*two, share), *sizes)
    ends = _closing(along, along_hit) >= _closing(across, across_hit)
    ahead = away > 0
    axis = one[0][:, 2] + 0.5 * turn
    forward, forward_other = (rotate(pose[0][:, 3:], -axis)[..., 0] for pose in (one, two))
    back, front = torch.where(ahead, forward, forward_other), torch.where(ahead, forward_other, forward)
    backing = (front < -STANDING) & (back < STANDING)
    kind = torch.where(ahead, int(CollisionKind.INTO_LEADER), int(CollisionKind.REAR_ENDED))
    kind = torch.where(backing, int(CollisionKind.OTHER), kind)
    kind = torch.where(ends, kind, int(CollisionKind.SIDESWIPE))
    kind = torch.where(turn.abs() > SAME_WAY, int(CollisionKind.CROSSING), kind)
    return torch.where(turn.abs() >= OPPOSITE_WAY, int(CollisionKind.ONCOMING), kind)


def _at_contact(
    before: Float[Tensor, "M 5"], after: Float[Tensor, "M 5"], share: Float[Tensor, " M"]
) -> Float[Tensor, "M 3"]:
    """Return position and heading between two states."""
    ends = torch.stack([before, after], 1)
    position, heading = pose_at(ends[..., :2], ends[..., 2], share.to(ends.dtype))
    return torch.cat([position, heading[:, None]], -1)


def _separations(
    one: Float[Tensor, "M _"],
    two: Float[Tensor, "M _"],
    size_one: Float[Tensor, "M 2"],
    size_two: Float[Tensor, "M 2"],
) -> tuple[Float[Tensor, " M"], ...]:
    """Return how far two is ahead of one, and the gaps between their boxes along and across their mean heading."""
    half = 0.5 * wrap(two[:, 2] - one[:, 2])
    # The mean heading, not that of either: so the two agents always agree on what they did.
    delta = rotate(two[:, :2] - one[:, :2], -(one[:, 2] + half))
    reach = 0.5 * (size_one + size_two)
    cos, sin = half.cos().abs(), half.sin().abs()
    along = delta[..., 0].abs() - (cos * reach[..., 0] + sin * reach[..., 1])
    across = delta[..., 1].abs() - (sin * reach[..., 0] + cos * reach[..., 1])
    return delta[..., 0], along, across


def _closing(gap: Float[Tensor, " M"], gap_hit: Float[Tensor, " M"]) -> Float[Tensor, " M"]:
    """Return the share of the step after which a gap is closed; where it was closed before, minus its depth."""
    return torch.where(gap > 0, gap / (gap - gap_hit).clamp(min=1e-6), gap)
