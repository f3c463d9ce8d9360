"""What kind of collision: who ran into whom, and from where.

A rate alone doesn't tell a policy that brakes too late from one that is hit by playback vehicles, which can't react.

Metres, radians, seconds. Legend: A agents of the scene, N interactive agents, T simulated steps, T+1 states with the
first one.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from symphony.geometry import box_gap, contact_share, levels_apart, pose_at, rotate, wrap

SAME_WAY = math.radians(45)
"""Largest angle between the headings of two agents that go the same way."""
OPPOSITE_WAY = math.radians(135)
"""Smallest angle between the headings of two agents that go opposite ways."""
STANDING = 0.5
"""Speed in m/s up to which an agent counts as standing."""
_SLACK = 0.01


class CollisionKind(IntEnum):
    """Kinds of collision, from the agent's point of view.

    The headings before contact decide the way. Of two agents that go the same way the sides that met are those whose
    gap closed last, at the time of contact: ends (one ahead of the other) or flanks (one beside the other).

    Attributes:
        INTO_LEADER: same way, its front met the tail of one ahead.
        ONCOMING: the other faces the opposite way.
        CROSSING: the other faces across.
        SIDESWIPE: same way, flank to flank, as after a lane change.
        OTHER: same way, end to end, because one backed into the other, which stood or backed too.
        REAR_ENDED: same way, its tail was met by the front of one behind.
        PEDESTRIAN: the other is a pedestrian, wherever they came from.
        CYCLIST: the other is a cyclist, likewise.
    """

    INTO_LEADER = 0
    ONCOMING = 1
    CROSSING = 2
    SIDESWIPE = 3
    OTHER = 4
    REAR_ENDED = 5
    PEDESTRIAN = 6
    CYCLIST = 7


_RANK = (0, 1, 2, 3, 4, 7, 5, 6)
"""Place of each kind when two happen at the same step: who was hit from behind comes last."""
_TYPES = {2: CollisionKind.PEDESTRIAN, 3: CollisionKind.CYCLIST}
"""Agent types (see ``symphony.data.segment.AgentType``) that are kinds of their own."""


class CollisionKinds(NamedTuple):
    """The first collision of every interactive agent, all `[..., N]`.

    Attributes:
        kind: int64 :class:`CollisionKind`, -1 for no collision.
        step: int64 simulated step, from 0, -1 for no collision.
        other: int64 row of A of the agent it collided with, -1 for no collision.
        playback: bool, whether that one is no interactive agent.
    """

    kind: Int[Tensor, "*lead N"]
    step: Int[Tensor, "*lead N"]
    other: Int[Tensor, "*lead N"]
    playback: Bool[Tensor, "*lead N"]

    def first(self) -> tuple[Int[Tensor, "*lead"], Bool[Tensor, "*lead"]]:
        """Kind (-1 for none) and `playback` of the first collision of each rollout.

        Of collisions at the same step, as when two interactive agents meet, the first of :class:`CollisionKind`
        counts, being rear-ended last: the one who ran into the other, not the one who was hit.
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


class _Poses(NamedTuple):
    """Position [M, A, 2], heading [M, A], velocity [M, A, 2] and validity [M, A]."""

    position: Float[Tensor, "M *A 2"]
    heading: Float[Tensor, "M ..."]
    velocity: Float[Tensor, "M *A 2"]
    valid: Bool[Tensor, "M ..."]

    def of(self, row: Int[Tensor, " M"]) -> _Poses:
        """Of one agent [M] each."""
        return _Poses(*(value[torch.arange(len(row), device=row.device), row] for value in self))


def collision_kinds(
    collided: Bool[Tensor, "*#lead N T"],
    state: Float[Tensor, "*#lead N T+1 4"],
    exists: Bool[Tensor, "*#lead N T+1"],
    subject: Int[Tensor, "*#lead N"],
    log_state: Float[Tensor, "*#lead A T+1 5"],
    log_valid: Bool[Tensor, "*#lead A T+1"],
    size: Float[Tensor, "*#lead A 2"],
    agent_type: Int[Tensor, "*#lead A"] | None = None,
    height: tuple[Float[Tensor, "*#lead N T+1 2"], Float[Tensor, "*#lead A T+1 2"]] | None = None,
) -> CollisionKinds:
    """With whom, when and how each interactive agent collides first. Leading dimensions broadcast.

    The other one is the valid agent whose box meets the agent's first within that step; of several at once the one
    that reaches deepest into it at its end. The states one step before and those at the time of contact decide the
    kind, because after the step fast boxes lie far inside each other, or beyond; where the other is not valid before,
    those after it.

    Args:
        collided: [..., N, T] whether an agent collides in a step, as :func:`symphony.metrics.collisions` finds it.
        state: [..., N, T+1, 4] x, y, heading, speed of the interactive agents.
        exists: [..., N, T+1] whether they are there.
        subject: [..., N] their rows of A; a negative one stands for no agent.
        log_state: [..., A, T+1, 5] x, y, heading, velocity x, velocity y of all agents as logged; the rows of the
            interactive agents are not read.
        log_valid: [..., A, T+1].
        size: [..., A, 2] length and width.
        agent_type: [..., A] ``AgentType`` numbers; without them all count as vehicles, and a pedestrian who is run
            over as crossing, say.
        height: and level, of the interactive agents and of all as logged; nobody meets another on another level, as
            :func:`symphony.metrics.collisions` has it.

    Raises:
        ValueError: for shapes that do not fit together, or a flagged agent that touches nobody.
    """
    # One leading dimension more, so that there always is one.
    lead = (1, *_lead(collided, state, exists, subject, log_state, log_valid, size, agent_type))
    collided = collided.expand(*lead, *collided.shape[-2:])
    subject = subject.expand(*lead, subject.shape[-1])
    hit = collided.any(-1)
    *where, who = hit.nonzero(as_tuple=True)
    step = collided.to(torch.uint8).argmax(-1)[hit]
    rows = subject[tuple(where)]
    agent = rows.gather(-1, who[:, None])[:, 0]
    if bool((agent < 0).any()):
        raise ValueError("collided is True for a subject that stands for no agent")

    def poses(index: Int[Tensor, " M"]) -> _Poses:
        at = (*where, index)
        logged = log_state.expand(*lead, *log_state.shape[-3:]).transpose(-3, -2)[at]
        valid = log_valid.expand(*lead, *log_valid.shape[-2:]).transpose(-2, -1)[at]
        driven = state.expand(*lead, *state.shape[-3:]).transpose(-3, -2)[at]
        there = exists.expand(*lead, *exists.shape[-2:]).transpose(-2, -1)[at]
        direction = torch.stack([driven[..., 2].cos(), driven[..., 2].sin()], -1)
        driven = torch.cat([driven[..., :3], driven[..., 3:] * direction], -1).to(logged.dtype)
        logged, valid = _placed(logged, driven, rows), _placed(valid, there, rows)
        return _Poses(logged[..., :2], logged[..., 2], logged[..., 3:], valid)

    def levels(driven: Float[Tensor, "*_"], logged: Float[Tensor, "*_"]) -> list[Float[Tensor, "M A 2"]]:
        driven, logged = (part.expand(*lead, *part.shape[-3:]).transpose(-3, -2) for part in (driven, logged))
        return [_placed(logged[at], driven[at], rows) for at in ((*where, step), (*where, step + 1))]

    boxes = size.expand(*lead, *size.shape[-2:])[tuple(where)]
    heights = [] if height is None else levels(*height)
    other, share, before, after = _first_met(poses(step), poses(step + 1), boxes, agent, heights)
    ours, theirs = (boxes[torch.arange(len(row), device=row.device), row] for row in (agent, other))
    ends = [(before.of(row), after.of(row)) for row in (agent, other)]
    one_hit, two_hit = (_at_contact(*end, share) for end in ends)
    kind = _classify(ends[0][0], ends[1][0], one_hit, two_hit, ours, theirs)
    if agent_type is not None:
        types = agent_type.expand(*lead, agent_type.shape[-1])[tuple(where)]
        hit_type = types.gather(-1, other[:, None])[:, 0]
        for number, named in _TYPES.items():
            kind = torch.where(hit_type == number, int(named), kind)
    playback = ~(other[:, None] == rows).any(-1)

    def filled(values: Int[Tensor, " M"]) -> Int[Tensor, "*_"]:
        return torch.full(hit.shape, -1, device=hit.device).masked_scatter(hit, values)[0]

    return CollisionKinds(filled(kind), filled(step), filled(other), filled(playback.long()) == 1)


def _placed(
    values: Shaped[Tensor, "M A *e"], driven: Shaped[Tensor, "M N *e"], rows: Int[Tensor, "M N"]
) -> Shaped[Tensor, "M A *e"]:
    """Values [M, A, ...] with those of the interactive agents [M, N, ...] in their rows."""
    count = values.shape[1]
    # Padding goes to a row more, which is dropped.
    values = torch.cat([values, torch.zeros_like(values[:, :1])], 1)
    index = torch.where(rows < 0, count, rows)
    index = index.reshape(index.shape + (1,) * (values.ndim - 2)).expand_as(driven)
    return values.scatter(1, index, driven)[:, :count]


def _first_met(
    before: _Poses,
    after: _Poses,
    boxes: Float[Tensor, "M A 2"],
    agent: Int[Tensor, " M"],
    height: list[Float[Tensor, "M A 2"]],
) -> tuple[Int[Tensor, " M"], Float[Tensor, " M"], _Poses, _Poses]:
    """Whom each agent [M] meets first in a step, after which share of it, and the poses of everyone: before the step,
    or after it of those that were not both there before. Heights are those before and after, or none.
    """
    me = torch.arange(len(agent), device=agent.device), agent
    seen = before.valid & before.valid[me][:, None]
    start = _chosen(seen, before, after)
    mine = _Poses(
        *(
            torch.where(_like(seen, b), b[me][:, None], a[me][:, None])
            for b, a in zip(before, after, strict=True)
        )
    )
    others = after.valid & (torch.arange(boxes.shape[1], device=agent.device) != agent[:, None])
    if height:
        apart, apart_after = (levels_apart(level, level[me][:, None]) for level in height)
        others &= ~(apart_after & (apart | ~seen))
    share = contact_share(
        torch.stack([mine.position, after.position[me][:, None].expand_as(mine.position)], -2),
        torch.stack([mine.heading, after.heading[me][:, None].expand_as(mine.heading)], -1),
        boxes[me][:, None],
        torch.stack([start.position, after.position], -2),
        torch.stack([start.heading, after.heading], -1),
        boxes,
    )
    gap = box_gap(
        after.position[me][:, None],
        after.heading[me][:, None],
        boxes[me][:, None],
        after.position,
        after.heading,
        boxes,
    )
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
    pair = torch.arange(len(agent), device=agent.device), other
    start = _chosen(seen[pair][:, None].expand_as(seen), before, after)
    return other, first.clamp(max=1.0), start, after


def _at_contact(before: _Poses, after: _Poses, share: Float[Tensor, " M"]) -> _Poses:
    centers, headings = (
        torch.stack([before.position, after.position], -2),
        torch.stack([before.heading, after.heading], -1),
    )
    position, heading = pose_at(centers, headings, share.to(centers.dtype))
    return _Poses(
        position,
        heading,
        torch.lerp(before.velocity, after.velocity, share[:, None].to(centers.dtype)),
        after.valid,
    )


def _like(mask: Bool[Tensor, "M ..."], value: Shaped[Tensor, "M ..."]) -> Bool[Tensor, "M ..."]:
    return mask.reshape(*mask.shape, *(1,) * (value.ndim - mask.ndim))


def _chosen(condition: Bool[Tensor, "M ..."], yes: _Poses, no: _Poses) -> _Poses:
    return _Poses(*(torch.where(_like(condition, a), a, b) for a, b in zip(yes, no, strict=True)))


def _classify(
    one: _Poses,
    two: _Poses,
    one_hit: _Poses,
    two_hit: _Poses,
    size_one: Float[Tensor, "M 2"],
    size_two: Float[Tensor, "M 2"],
) -> Int[Tensor, " M"]:
    """Kind [M] for poses before and at contact."""
    turn = wrap(two.heading - one.heading)
    away, along, across = _separations(one, two, size_one, size_two)
    _, along_hit, across_hit = _separations(one_hit, two_hit, size_one, size_two)
    ends = _closing(along, along_hit) >= _closing(across, across_hit)
    ahead = away > 0
    axis = one.heading + 0.5 * turn
    forward, forward_other = (rotate(pose.velocity, -axis)[..., 0] for pose in (one, two))
    back, front = torch.where(ahead, forward, forward_other), torch.where(ahead, forward_other, forward)
    backing = (front < -STANDING) & (back < STANDING)
    kind = torch.where(ahead, int(CollisionKind.INTO_LEADER), int(CollisionKind.REAR_ENDED))
    kind = torch.where(backing, int(CollisionKind.OTHER), kind)
    kind = torch.where(ends, kind, int(CollisionKind.SIDESWIPE))
    kind = torch.where(turn.abs() > SAME_WAY, int(CollisionKind.CROSSING), kind)
    return torch.where(turn.abs() >= OPPOSITE_WAY, int(CollisionKind.ONCOMING), kind)


def _separations(
    one: _Poses, two: _Poses, size_one: Float[Tensor, "M 2"], size_two: Float[Tensor, "M 2"]
) -> tuple[Float[Tensor, " M"], ...]:
    """How far two is ahead of one, and the gaps between their boxes along and across their mean heading."""
    half = 0.5 * wrap(two.heading - one.heading)
    # The mean heading, not that of either: so the two agents always agree on what they did.
    delta = rotate(two.position - one.position, -(one.heading + half))
    reach = 0.5 * (size_one + size_two)
    cos, sin = half.cos().abs(), half.sin().abs()
    along = delta[..., 0].abs() - (cos * reach[..., 0] + sin * reach[..., 1])
    across = delta[..., 1].abs() - (sin * reach[..., 0] + cos * reach[..., 1])
    return delta[..., 0], along, across


def _closing(gap: Float[Tensor, " M"], gap_hit: Float[Tensor, " M"]) -> Float[Tensor, " M"]:
    """Share of the step after which a gap is closed; where it was closed before, minus its depth."""
    return torch.where(gap > 0, gap / (gap - gap_hit).clamp(min=1e-6), gap)


def _lead(
    collided: Tensor,
    state: Tensor,
    exists: Tensor,
    subject: Tensor,
    log_state: Tensor,
    log_valid: Tensor,
    size: Tensor,
    agent_type: Tensor | None,
) -> torch.Size:
    (agents, steps), everyone = collided.shape[-2:], size.shape[-2]
    expected = {
        "state": (state, (agents, steps + 1, 4)),
        "exists": (exists, (agents, steps + 1)),
        "subject": (subject, (agents,)),
        "log_state": (log_state, (everyone, steps + 1, 5)),
        "log_valid": (log_valid, (everyone, steps + 1)),
        "size": (size, (everyone, 2)),
    }
    if agent_type is not None:
        expected["agent_type"] = agent_type, (everyone,)
    for name, (value, shape) in expected.items():
        if value.shape[-len(shape) :] != shape:
            raise ValueError(f"{name} is {list(value.shape)}, expected {list(shape)} at the end")
    shapes = [value.shape[: -len(shape)] for value, shape in expected.values()]
    return torch.broadcast_shapes(collided.shape[:-2], *shapes)
