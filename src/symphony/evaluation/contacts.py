"""Collisions of single rollouts: with whom, when, how and at whose fault; and how long until the next one.

Contacts are found between the states; of each pair the first counts. Fault is judged at the time of contact, in the
sense of nuPlan's at-fault collisions (https://github.com/motional/nuplan-devkit): an agent answers for what it drives
into, not for being driven into. Further rules are red lights, lanes that an agent leaves, and lane changes in front
of others that are too close by RSS (Shalev-Shwartz et al., "On a formal model of safe and scalable self-driving
cars", 2017, definition 1). ``docs/metrics.md`` has them in a table.

Metres, radians, seconds. Legend: A agents, U states of a rollout, M evaluated agents, E contacts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
import torch
from torch import from_numpy

from symphony.data.segment import AgentType
from symphony.evaluation.driving import Bools, Heights, Indices, Lanes, Lights, Reals, half_across
from symphony.geometry import box_corners, boxes_overlap, levels_apart, meeting_time, pose_at
from symphony.geometry.boxes import covers, relation
from symphony.metrics import CollisionKind, meetings
from symphony.metrics.kinds import STANDING, kind_of_contact
from symphony.roadgraph.graph import turn_between
from symphony.saved.rollouts import World

STILL = 0.05  # speed in m/s up to which an agent that is hit has stopped, so that nothing is its fault (as in nuPlan)
HORIZON = 5.0  # seconds ahead within which a collision is sought
RED_SECONDS = 5.0  # for which an agent that ran a red light is at fault for meeting others across
CUT_IN_SECONDS = 4.0  # before a contact in which a lane change may have caused it
RESPONSE, SPEED_UP, BRAKE_LEAST, BRAKE_MOST = 1.0, 3.5, 4.0, 8.0
"""Parameters of RSS: seconds until the one behind brakes, its acceleration until then, its braking then, and the
braking of the one ahead, m/s^2 (defaults of Intel's ad-rss-lib)."""
CORNER = 0.5  # metres behind the front bumper that are its corner
ENTERING = 0.1  # speed in m/s towards the other from which on an agent is on its way into a lane
_TIE = 1e-3  # metres by which the normals of the other must part the boxes more than the own ones
_EDGE = 0.1  # metres an agent may reach over the edge of its lane and still count as within it
_AHEAD = 30.0  # metres that a path is thought to go on straight after a contact
_FRONT, _REAR, _SIDE = range(3)
_SLACK = 1e-3


class Contacts(NamedTuple):
    """The first contact of evaluated agents with each other agent, all [E], by time, then agent."""

    agent: Indices  # row of A
    other: Indices  # row of A
    step: Indices  # the state after it, from 1
    share: Reals  # of the step before that state after which they first overlap, from 0 to 1
    kind: Indices  # a CollisionKind, from the agent's point of view, but by motion alone: of people and cyclists, too
    at_state: Bools  # whether they overlap at any state, not only between two


def contacts(worlds: Sequence[World], evaluated: Indices) -> list[Contacts]:
    """Return the collisions of evaluated agents [M] in each of some rollouts of one segment. The first states do not
    count, and agents on different levels never meet.
    """

    def stacked(name: str) -> torch.Tensor:
        return from_numpy(np.stack([getattr(world, name) for world in worlds]))

    position, heading, size, valid = map(stacked, ("position", "heading", "size", "valid"))
    height = None if worlds[0].height is None else stacked("height")
    subject = from_numpy(evaluated).expand(len(worlds), -1)
    found = meetings(position, heading, size, valid, subject, height)
    parts = evaluated[found.subject.numpy()], found.other.numpy(), found.step.numpy() + 1, found.share.numpy()
    of = [found.row.numpy() == k for k in range(len(worlds))]
    return [_first(world, *(part[mine] for part in parts)) for world, mine in zip(worlds, of, strict=True)]


def _first(world: World, agent: Indices, other: Indices, step: Indices, share: Reals) -> Contacts:
    """Return of the contacts of each pair the first, in order of time; an agent that comes back meets anew."""
    boxes = [
        from_numpy(part)
        for row in (agent, other)
        for part in (world.position[row, step], world.heading[row, step], world.size[row])
    ]
    order = np.lexsort((other, agent, share, step))
    stay = (world.valid[:, 1:] & ~world.valid[:, :-1]).cumsum(1)[agent, step - 1]
    pair = ((agent * len(world.size) + other) * world.valid.shape[1] + stay)[order]
    _, first, number = np.unique(pair, return_index=True, return_inverse=True)
    at_state = np.bincount(number, boxes_overlap(*boxes).numpy()[order], len(first)) > 0
    turn = np.argsort(first)
    order = order[first[turn]]
    agent, other, step, share = agent[order], other[order], step[order], share[order]
    poses = pose_ends(world, agent, other, step), pose_ends(world, other, agent, step)
    sizes = (from_numpy(world.size[row]) for row in (agent, other))
    kind = kind_of_contact(*poses, from_numpy(share), *sizes)
    return Contacts(agent, other, step, share, kind.numpy(), at_state[turn])


def pose_ends(world: World, row: Indices, other: Indices, step: Indices) -> tuple[torch.Tensor, torch.Tensor]:
    """Return poses [E, 5] (x, y, heading, velocity x, velocity y) of agents before and after the step of a contact;
    both are those after it where one of the two was not there before.
    """
    seen = world.valid[row, step - 1] & world.valid[other, step - 1]
    poses = np.concatenate([world.position, world.heading[..., None], world.velocity], -1)
    return from_numpy(poses[row, np.where(seen, step - 1, step)]), from_numpy(poses[row, step])


def time_to_collision(world: World, evaluated: Indices) -> Reals:
    """Return the seconds [M, U] until an evaluated agent first overlaps one ahead of it, if both go on unchanged.

    All agents keep velocity and heading, and those on different levels never meet. Infinite if that is more than
    :data:`HORIZON` away, or the agent has stopped or is not there.
    """
    found = np.full((len(evaluated), world.valid.shape[1]), math.inf)
    radius = 0.5 * np.linalg.norm(world.size, axis=-1)
    for row, best in zip(evaluated.tolist(), found, strict=True):
        away, speed = world.position - world.position[row], world.velocity - world.velocity[row]
        heading = world.heading[row]
        near = (away * np.stack([np.cos(heading), np.sin(heading)], -1)).sum(-1) > 0
        near &= world.valid & world.valid[row] & (np.linalg.norm(world.velocity[row], axis=-1) > STILL)
        near[row] = False
        if world.height is not None:
            level = from_numpy(world.height)
            near &= ~levels_apart(level[row], level).numpy()
        # Boxes can only meet where the circles around them do, which are nearest to each other at this time.
        soonest = -(away * speed).sum(-1) / np.maximum(np.square(speed).sum(-1), 1e-12)
        nearest = away + np.clip(soonest, 0, HORIZON)[..., None] * speed
        near &= np.square(nearest).sum(-1) <= np.square(radius[row] + radius + _SLACK)[:, None]
        other, step = near.nonzero()
        me = heading[step], world.size[np.full(len(step), row)]
        parts = (away[near], speed[near], *me, world.heading[other, step], world.size[other])
        np.minimum.at(best, step, meeting_time(*map(from_numpy, parts)).numpy())
    return np.where(found <= HORIZON, found, math.inf)


class _Party(NamedTuple):
    """One of the two at each contact; height and level are None where the map has no levels."""

    row: Indices  # [E] of A
    position: Reals  # [E, 2]
    heading: Reals  # [E]
    velocity: Reals  # [E, 2]
    speed: Reals  # [E] along the heading
    size: Reals  # [E, 2] of the box
    height: Heights  # [E, 2]


def at_fault(world: World, found: Contacts, lanes: Lanes, offroad: Bools, lights: Lights) -> Bools:
    """Return whether the agent of each contact is at fault [E]. ``offroad`` says which agents are off the road [A,
    U]; ``lights`` are red ones that any agent of a contact ran.
    """
    if not len(found.agent):
        return np.zeros(0, bool)
    segment = lanes.segment
    me, it = _party(world, found.agent, found.other, found), _party(world, found.other, found.agent, found)
    kind, face = found.kind, _face(me, it)
    ends = np.isin(kind, [CollisionKind.INTO_LEADER, CollisionKind.REAR_ENDED])
    behind = kind == CollisionKind.INTO_LEADER
    rear, front = np.where(behind, me.row, it.row), np.where(behind, it.row, me.row)
    # Pedestrians change no lanes.
    driving = ends & (segment.agent_type[front] != AgentType.PEDESTRIAN)
    cut_in = np.zeros(len(kind), bool)
    cut_in[driving] = _cut_in(world, rear[driving], front[driving], found.step[driving], lanes)
    across = np.isin(kind, [CollisionKind.CROSSING, CollisionKind.ONCOMING])
    since = found.step[:, None] - lights.step
    recent = (since >= 0) & (since <= RED_SECONDS / segment.dt)
    red, their_red = (across & ((lights.agent == party.row[:, None]) & recent).any(-1) for party in (me, it))
    reaching = _reaching(me, it, lanes) | offroad[me.row, found.step]
    backing = (me.speed < -STILL) & (face == _REAR)
    beside = np.isin(kind, [CollisionKind.ONCOMING, CollisionKind.SIDESWIPE])
    on_foot = np.isin(segment.agent_type[it.row], [AgentType.PEDESTRIAN, AgentType.CYCLIST])  # in no lane
    # The first that holds decides.
    rules = (
        (red, True),
        (cut_in, ~behind),
        (np.abs(me.speed) <= STILL, False),
        (their_red, False),
        (backing, True),
        (ends & ~behind, False),
        (np.abs(it.speed) <= STANDING, True),
        (behind, True),
        (beside & reaching, True),
        (beside & _reaching(it, me, lanes) & ~on_foot, False),
        (face == _FRONT, True),
        (face == _SIDE, reaching),
    )
    holds, verdicts = zip(*rules, strict=True)
    return np.select(holds, [np.broadcast_to(verdict, kind.shape) for verdict in verdicts], False)


def _party(world: World, row: Indices, other: Indices, found: Contacts) -> _Party:
    ends = torch.stack(pose_ends(world, row, other, found.step), 1)
    share = from_numpy(found.share)
    position, heading = (part.numpy() for part in pose_at(ends[..., :2], ends[..., 2], share))
    velocity = (ends[:, 0, 3:] + share[:, None] * (ends[:, 1, 3:] - ends[:, 0, 3:])).numpy()
    # The box may have turned by half a turn; where its front is the state says.
    heading = heading + np.pi * (np.cos(heading - world.heading[row, found.step]) < 0)
    speed = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    height = None if world.height is None else world.height[row, found.step]
    return _Party(row, position, heading, velocity, speed, world.size[row], height)


def _face(me: _Party, it: _Party) -> Indices:
    """Return the side [E] with which each agent touches: the one whose normal separated the boxes last. A corner that
    hits the other's side counts as front or rear, and the last :data:`CORNER` metres of a flank count as front.
    """
    away = from_numpy(it.position - me.position)
    pair = relation(away[:, 0], away[:, 1], from_numpy(me.heading), from_numpy(it.heading))
    reach = covers(pair.turn, from_numpy(me.size), from_numpy(it.size))
    places = np.stack([part.numpy() for part in (*pair.in_a, *pair.in_b)])
    gaps = np.abs(places) - np.stack([part.numpy() for part in reach])
    gaps[:2] += _TIE
    which = gaps.argmax(0)
    # The normal from here to the other, along or across that one.
    turn = it.heading - me.heading
    towards = np.sign(places[2:]) * np.stack([np.cos(turn), -np.sin(turn)])
    corner = np.where(np.where(which == 2, towards[0], towards[1]) > 0, _FRONT, _REAR)
    end = np.where(places[0] > 0, _FRONT, _REAR)
    rearmost = places[0] - (reach[0].numpy() - 0.5 * me.size[:, 0])
    side = np.where(rearmost > 0.5 * me.size[:, 0] - CORNER, _FRONT, _SIDE)
    return np.where(which == 0, end, np.where(which == 1, side, corner))


def _reaching(me: _Party, it: _Party, lanes: Lanes) -> Bools:
    """Return whether agents [E] are in no lane, reach over its edge to the other, or over the far one, coming."""
    mine, theirs = (_place(party.position, party.heading, party.size, lanes, party.height) for party in (me, it))
    towards = ((it.position - me.position) * mine.left).sum(-1)
    # Two that meet on one line are on the sides on which their lanes are.
    lane = ((theirs.middle - mine.middle) * mine.left).sum(-1)
    side = np.sign(np.where(mine.inside & theirs.inside & (np.abs(lane) > _EDGE), lane, towards))
    off = side * mine.off
    coming = side * (me.velocity * mine.left).sum(-1) > ENTERING
    return ~mine.inside | (off > mine.reach) | (coming & (off < -mine.reach))


class _Place(NamedTuple):
    """Where agents [n] are in the lanes nearest to them; 0 for those in none."""

    inside: Bools  # whether there is one
    middle: Reals  # [n, 2] the nearest point of its centre line
    left: Reals  # [n, 2] to the left of it, a unit vector
    off: Reals  # metres that the agent is to the left of it
    reach: Reals  # metres that the agent may be off it for its box to be within it, by :data:`_EDGE`
    onward: Reals  # the direction of the lane, or of its first successor, :data:`_AHEAD` metres on


def _place(position: Reals, heading: Reals, size: Reals, lanes: Lanes, height: Heights) -> _Place:
    graph, lane = lanes.graph, lanes.lane_of(position, heading, height)
    found = _Place(lane >= 0, *np.zeros((2, len(lane), 2)), *np.zeros((3, len(lane))))
    inside = np.flatnonzero(found.inside)
    number, here = np.searchsorted(graph.usable_lanes, lane[inside]), position[inside]
    lines = graph.index.geometry[number]
    along = shapely.line_locate_point(lines, shapely.points(here))
    way = graph.index.heading(number, along)
    left = np.stack([-np.sin(way), np.cos(way)], -1)
    covered = half_across(heading[inside] - way, size[inside])
    found.middle[inside] = shapely.get_coordinates(shapely.line_interpolate_point(lines, along))
    found.left[inside], found.off[inside] = left, ((here - found.middle[inside]) * left).sum(-1)
    found.reach[inside] = 0.5 * lanes.width[lane[inside]] + _EDGE - covered
    after = np.array([next(iter(graph.successors[each]), each) for each in lane[inside].tolist()], np.int64)
    rest = along + _AHEAD - graph.length[lane[inside]]
    number = np.where(rest > 0, np.searchsorted(graph.usable_lanes, after), number)
    found.onward[inside] = graph.index.heading(number, np.where(rest > 0, rest, along + _AHEAD))
    return found


def _placed(world: World, row: Indices, step: Indices, lanes: Lanes) -> _Place:
    height = None if world.height is None else world.height[row, step]
    return _place(world.position[row, step], world.heading[row, step], world.size[row], lanes, height)


def _cut_in(world: World, rear: Indices, front: Indices, step: Indices, lanes: Lanes) -> Bools:
    """Return whether the one ahead came into the path of the one behind shortly before their contact, nearer than is
    safe [E]. The path is the one driven, and nobody cuts in who keeps to lanes and turns no more than the one behind:
    neither before one that changes lanes nor, on the straighter one, where two merge.
    """
    times = np.maximum(step[:, None] + np.arange(-math.ceil(CUT_IN_SECONDS / lanes.segment.dt) - 1, 0), 0)
    ours, theirs = world.position[rear[:, None], times], world.position[front[:, None], times]
    seen = world.valid[rear[:, None], times]
    heading, last = world.heading[rear[:, None], times], world.heading[rear, step]
    direction = np.stack([np.cos(heading), np.sin(heading)], -1)
    onward = world.position[rear, step] + _AHEAD * np.stack([np.cos(last), np.sin(last)], -1)
    # Before it was seen there is no path: it begins where it was first seen.
    start = np.take_along_axis(ours, seen.argmax(1)[:, None, None], 1)
    path = np.concatenate([np.where(seen[..., None], ours, start), onward[:, None]], 1)
    half, turned = 0.5 * world.size, world.heading[front[:, None], times]
    corners = box_corners(from_numpy(theirs), from_numpy(turned), from_numpy(world.size[front, None]))
    away = shapely.distance(shapely.linestrings(path)[:, None], shapely.polygons(corners.numpy()))
    both = seen & world.valid[front[:, None], times]
    outside = both & (away > half[rear, 1:])
    # The first state in which both are seen from which on it stays in the path, or the last one before.
    entered = outside.shape[1] - outside[:, ::-1].argmax(1)
    later = both & (np.arange(both.shape[1]) >= entered[:, None])
    at = np.arange(len(rear)), np.where(later.any(1), later.argmax(1), entered - 1)
    gap = ((theirs[at] - ours[at]) * direction[at]).sum(-1) - half[rear, 0] - half[front, 0]
    behind, ahead = (np.linalg.norm(world.velocity[row, times[at]], axis=-1) for row in (rear, front))
    # Beyond this many metres the one behind can stop (RSS).
    faster = behind + RESPONSE * SPEED_UP
    travel = behind * RESPONSE + 0.5 * SPEED_UP * RESPONSE**2 + faster**2 / (2 * BRAKE_LEAST)
    close = gap < np.maximum(travel - ahead**2 / (2 * BRAKE_MOST), 0.0)
    there = _placed(world, front, step, lanes)
    onward = np.where(there.inside, there.onward, world.heading[front, step])
    before = times[np.arange(len(rear)), np.maximum(entered - 1, 0)]
    turns, other_turns = (turn_between(world.heading[row, before], onward) for row in (front, rear))
    return outside.any(1) & close & ~(_kept(world, front, times, lanes) & (turns <= other_turns))


def _kept(world: World, row: Indices, times: Indices, lanes: Lanes) -> Bools:
    """Return whether agents [E] keep within lanes while they are there, at times [E, W], or there are no lanes."""
    seen = world.valid[row[:, None], times]
    place = _placed(world, np.broadcast_to(row[:, None], times.shape)[seen], times[seen], lanes)
    out = np.zeros(seen.shape, bool)
    out[seen] = ~place.inside | (np.abs(place.off) > place.reach)
    return np.asarray(~out.any(1) if len(lanes.graph.usable_lanes) else np.ones(len(row), bool))
