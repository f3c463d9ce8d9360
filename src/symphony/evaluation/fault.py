"""Whose fault a collision is, judged at the time of contact.

The rules follow the sense of nuPlan's at-fault collisions (https://github.com/motional/nuplan-devkit): an agent
answers for what it drives into, not for being driven into. To these come red lights, lanes that an agent leaves, and
lane changes in front of others that are too close by RSS (Shalev-Shwartz et al., "On a formal model of safe and
scalable self-driving cars", 2017, definition 1). ``docs/metrics.md`` has them in a table.

Metres, radians, seconds. Legend: A agents, U states of a rollout, E contacts, W states of a window.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import shapely
import torch
from torch import from_numpy

from symphony.data.segment import AgentType
from symphony.evaluation.contacts import STILL, Bools, Contacts, Indices, Reals, pose_ends
from symphony.evaluation.driving import Lights
from symphony.evaluation.lanes import Heights, Lanes
from symphony.geometry import pose_at
from symphony.geometry.boxes import covers, relation
from symphony.metrics import CollisionKind
from symphony.metrics.kinds import STANDING
from symphony.saved.rollouts import World

RED_SECONDS = 5.0
"""Seconds for which an agent that ran a red light answers for whom it meets across."""
CUT_IN_SECONDS = 4.0
"""Seconds before a contact in which a lane change may have caused it."""
RESPONSE, SPEED_UP, BRAKE_LEAST, BRAKE_MOST = 1.0, 3.5, 4.0, 8.0
"""Of RSS: seconds until the one behind brakes, its acceleration until then, its braking then, and the braking of the
one ahead, m/s^2 (defaults of Intel's ad-rss-lib)."""
CORNER = 0.5
"""Metres behind the front bumper that are its corner."""
_TIE = 1e-3
"""Metres by which the normals of the other must part the boxes more than the own ones."""
_EDGE = 0.1
"""Metres an agent may reach over the edge of its lane and still count as within it."""
ENTERING = 0.1
"""Speed in m/s towards the other from which on an agent is on its way into a lane."""
_AHEAD = 30.0
"""Metres that a path is thought to go on straight after a contact."""
_FRONT, _REAR, _SIDE = range(3)


class _Party(NamedTuple):
    """One of the two at each contact.

    Attributes:
        row: [E] of A.
        position: [E, 2].
        heading: [E].
        velocity: [E, 2].
        speed: [E] along the heading.
        size: [E, 2] of the box.
        height: [E, 2] height and level; None where the map has no levels.
    """

    row: Indices
    position: Reals
    heading: Reals
    velocity: Reals
    speed: Reals
    size: Reals
    height: Heights


def at_fault(world: World, found: Contacts, lanes: Lanes, offroad: Bools, lights: Lights) -> Bools:
    """Whether the agent of each contact is at fault [E].

    Args:
        world: everyone.
        found: the contacts.
        lanes: of the segment that they are in.
        offroad: [A, U] whether an agent is off the road; read for the agents of contacts only.
        lights: red ones that any of the agents ran.
    """
    if not len(found.agent):
        return np.zeros(0, bool)
    segment = lanes.segment
    me, it = _party(world, found.agent, found), _party(world, found.other, found)
    kind, face = found.kind, _face(me, it)
    ends = np.isin(kind, [CollisionKind.INTO_LEADER, CollisionKind.REAR_ENDED])
    behind = kind == CollisionKind.INTO_LEADER
    rows, others = np.where(behind, me.row, it.row), np.where(behind, it.row, me.row)
    # Who is on foot changes no lanes.
    driving = ends & (segment.agent_type[others] != AgentType.PEDESTRIAN)
    cut_in = np.zeros(len(kind), bool)
    cut_in[driving] = _cut_in(world, rows[driving], others[driving], found.step[driving], segment.dt)
    across = np.isin(kind, [CollisionKind.CROSSING, CollisionKind.ONCOMING])
    red, their_red = (
        across & _ran_red(party.row, found.step, lights, RED_SECONDS / segment.dt) for party in (me, it)
    )
    reaching, their_reaching = (_reaching(one, two, lanes) for one, two in ((me, it), (it, me)))
    reaching = reaching | offroad[me.row, found.step]
    backing = (me.speed < -STILL) & (face == _REAR)
    beside = np.isin(kind, [CollisionKind.ONCOMING, CollisionKind.SIDESWIPE])
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
        (beside & their_reaching, False),
        (face == _FRONT, True),
        (face == _SIDE, reaching),
    )
    holds, verdicts = zip(*rules, strict=True)
    return np.select(holds, [np.broadcast_to(verdict, kind.shape) for verdict in verdicts], False)


def _party(world: World, row: Indices, found: Contacts) -> _Party:
    other = np.where(row == found.agent, found.other, found.agent)
    ends = torch.stack(pose_ends(world, row, other, found.step), 1)
    share = torch.from_numpy(found.share)
    position, heading = (part.numpy() for part in pose_at(ends[..., :2], ends[..., 2], share))
    velocity = (ends[:, 0, 3:] + share[:, None] * (ends[:, 1, 3:] - ends[:, 0, 3:])).numpy()
    # The box may have turned by half a turn; where its front is the state says.
    front = world.heading[row, found.step]
    heading = heading + np.pi * (np.cos(heading - front) < 0)
    speed = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    height = None if world.height is None else world.height[row, found.step]
    return _Party(row, position, heading, velocity, speed, world.size[row], height)


def _face(me: _Party, it: _Party) -> Indices:
    """With which side each agent touches [E]: that whose normal parts the boxes last, or of a corner that meets the
    other's side, the end it is at. Who is only beside the last :data:`CORNER` before the front touches that.
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


def _ran_red(row: Indices, step: Indices, lights: Lights, steps: float) -> Bools:
    since = step[:, None] - lights.step
    return ((lights.agent == row[:, None]) & (since >= 0) & (since <= steps)).any(-1)


def _reaching(me: _Party, it: _Party, lanes: Lanes) -> Bools:
    """Whether an agent is in no lane, reaches over that edge of its lane which is towards the other, or over the far
    one on its way in [E].
    """
    graph, lane = lanes.graph, lanes.lane_of(me.position, me.heading, me.height)
    found = np.ones(len(lane), bool)
    inside = lane >= 0
    number = np.searchsorted(graph.usable_lanes, lane[inside])
    lines, here = graph.index.geometry[number], me.position[inside]
    along = shapely.line_locate_point(lines, shapely.points(here))
    way = graph.index.heading(number, along)
    nearest = shapely.get_coordinates(shapely.line_interpolate_point(lines, along))
    left = np.stack([-np.sin(way), np.cos(way)], -1)
    turn = me.heading[inside] - way
    covered = 0.5 * (np.abs(np.stack([np.sin(turn), np.cos(turn)], -1)) * me.size[inside]).sum(-1)
    side = np.sign(((it.position[inside] - here) * left).sum(-1))
    off = side * ((here - nearest) * left).sum(-1)
    coming = side * (me.velocity[inside] * left).sum(-1) > ENTERING
    reach = 0.5 * lanes.width[lane[inside]] + _EDGE - covered
    found[inside] = (off > reach) | (coming & (off < -reach))
    return found


def _cut_in(world: World, rear: Indices, front: Indices, step: Indices, dt: float) -> Bools:
    """Whether the one ahead came into the path of the one behind shortly before their contact, nearer than is safe
    [E]. The path is the one driven, so that a bend or a lane change of the one behind makes nobody cut in.
    """
    count = math.ceil(CUT_IN_SECONDS / dt)
    times = np.maximum(step[:, None] + np.arange(-count - 1, 0), 0)
    ours, theirs = world.position[rear[:, None], times], world.position[front[:, None], times]
    known = world.valid[rear[:, None], times] & world.valid[front[:, None], times]
    heading = world.heading[rear[:, None], times]
    direction = np.stack([np.cos(heading), np.sin(heading)], -1)
    last = world.heading[rear, step]
    onward = world.position[rear, step] + _AHEAD * np.stack([np.cos(last), np.sin(last)], -1)
    seen = world.valid[rear[:, None], times]
    # Before it was seen there is no path: it begins where it was first seen.
    start = np.take_along_axis(ours, seen.argmax(1)[:, None, None], 1)
    path = np.concatenate([np.where(seen[..., None], ours, start), onward[:, None]], 1)
    half = 0.5 * world.size
    away = shapely.distance(shapely.linestrings(path)[:, None], shapely.points(theirs))
    beside = away - (half[rear, 1] + half[front, 1])[:, None]
    outside = known & (beside > 0)
    # The first state from which on it stays in the path.
    entered = outside.shape[1] - outside[:, ::-1].argmax(1)
    at = np.arange(len(rear)), np.minimum(entered, outside.shape[1] - 1)
    gap = ((theirs[at] - ours[at]) * direction[at]).sum(-1) - half[rear, 0] - half[front, 0]
    speeds = (np.linalg.norm(world.velocity[row, times[at]], axis=-1) for row in (rear, front))
    return outside.any(1) & (gap < safe_distance(*speeds))


def safe_distance(behind: Reals, ahead: Reals) -> Reals:
    """Metres between two that follow each other at speeds in m/s, beyond which the one behind can stop (RSS)."""
    faster = behind + RESPONSE * SPEED_UP
    travel = behind * RESPONSE + 0.5 * SPEED_UP * RESPONSE**2 + faster**2 / (2 * BRAKE_LEAST)
    return np.maximum(travel - ahead**2 / (2 * BRAKE_MOST), 0.0)
