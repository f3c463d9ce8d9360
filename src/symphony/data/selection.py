"""The choice of the interactive agents of a segment, and of segments to leave out (paper, section V-A)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.data.levels import LEVEL, ground
from symphony.data.segment import AgentType, Bools, RunSegment, line_lengths, wrap
from symphony.errors import DataError

Reals = NDArray[np.floating[Any]]
Rows = NDArray[np.integer[Any]]

HALF_LANE, APART = 1.5, 2.5  # metres aside within which paths are one, and from which on lanes are different
SAME_WAY = np.deg2rad(30)  # turn below which two at one place go the same way; up to 150 degrees they cross
SHARED, LOOKBACK = 5.0, 50.0  # metres of path in common, and of those compared before two paths become one
TIME_GAP = 3.0  # seconds between two vehicles at the same place within which one follows the other
CONFLICT_GAP = 4.0
"""Seconds between two vehicles at the place where their paths cross or become one within which they interact.
Between two customary limits: 3 s on the difference in time to the conflict point (INTERACTION data set, Zhan et al.,
2019, arXiv:1910.03088) and 5 s on the post-encroachment time (SSAM, FHWA-HRT-08-051, 2008)."""
QUEUE_SPEED, KEPT = 5.0, 1.0  # m/s at which TIME_GAP is the distance of slower ones; seconds it must be kept
STEEP = 0.15  # metres of height for each metre between two cars of a queue that a street may have
TILE = 1_000_000  # pairs of steps that are compared at a time


class Context(StrEnum):
    """The reason for the choice of the ego's partner, best first; the later ones are its relations to the ego."""

    INTEREST = "interest"  # the source marks it as interacting (WOMD: objects of interest)
    PREDICT = "predict"  # the source marks it for prediction (WOMD: tracks to predict)
    MERGE = "merge"  # both come into one lane from different lanes, shortly after each other
    CROSSING = "crossing"  # the paths cross, and the two pass there shortly after each other
    LEADER = "leader"  # it drives ahead on the ego's path, a short time gap away
    FOLLOWER = "follower"  # it drives behind on the ego's path, a short time gap away
    NEAREST = "nearest"  # none of these: the nearest that moves


class Relations(NamedTuple):
    """The relations of K vehicles to the ego: seconds [K] between the two, infinite where there is no such relation.
    They are taken where paths merge, where they cross, and as the smallest time gap ahead and behind on one path.
    """

    merge: Reals
    crossing: Reals
    leader: Reals
    follower: Reals


def relations(segment: RunSegment, others: Rows) -> Relations:
    """Relate vehicles [K] to the ego, which is not one of them, by the paths that were logged."""
    merge, crossing = np.full(len(others), np.inf), np.full(len(others), np.inf)
    leader, follower = _queue_gap(segment, others, -1), _queue_gap(segment, others, 1)
    rows = np.flatnonzero(_boxes_meet(segment, others))
    if len(rows):
        meeting = _Meeting(segment, others[rows])
        together = meeting.shared @ meeting.spacing >= SHARED
        for on_path, field in ((meeting.before, leader), (meeting.after, follower)):
            field[rows] = np.minimum(np.where(together, on_path, np.inf), field[rows])
        # Two paths that become one, or stop being one, cross on the way: those relations have their own names.
        apart = ~meeting.shared.any(1)
        crossing[rows[apart]] = meeting.crossing[apart]
        for k in np.flatnonzero(together & (np.minimum(meeting.before, meeting.after) <= CONFLICT_GAP)):
            merge[rows[k]] = _merge_gap(segment, int(others[rows[k]]), *meeting.first[k].tolist())
    limits = ((merge, CONFLICT_GAP), (crossing, CONFLICT_GAP), (leader, TIME_GAP), (follower, TIME_GAP))
    return Relations(*(np.where(gaps <= limit + 1e-6, gaps, np.inf) for gaps, limit in limits))


class _Meeting:
    """K vehicles and the ego, each of T steps with each: found a tile at a time, as T squared may be large.

    Attributes:
        spacing: [T] metres the ego drives in a step, half before and half after it.
        shared: [K, T] whether the other, at some step, is where the ego is at this one, going the same way.
        first: [K, 2] the ego's first such step, and the other's step nearest along it; 0 where there is none.
        before, after: [K] smallest time in seconds by which the other is there before or after the ego.
        crossing: [K] smallest time in seconds between the two at a place where they pass at an angle.
    """

    def __init__(self, segment: RunSegment, others: Rows) -> None:
        agents, steps = len(others), segment.num_steps
        self.spacing = _spacing(segment.position[segment.ego, :, :2], segment.valid[segment.ego])
        self.shared, self.first = np.zeros((agents, steps), bool), np.zeros((agents, 2), np.int64)
        self.before, self.after, self.crossing = (np.full(agents, np.inf) for _ in range(3))
        rows = max(TILE // steps, 1)
        group = max(rows // steps, 1)
        for a in range(0, agents, group):
            for t in range(0, steps, rows):
                self._add(segment, others, slice(a, a + group), slice(t, t + rows))

    def _add(self, segment: RunSegment, others: Rows, group: slice, steps: slice) -> None:
        """Look at some of the others [k] and some of the ego's steps [t]."""
        along, shared, crossing = _places(segment, others[group], steps, self.spacing[steps])
        time = np.arange(segment.num_steps) * segment.dt
        # From the ego's step to the other's; negative where that is there first.
        gap = time - time[steps, None]
        for field, where, value in (
            (self.before, shared & (gap < 0), -gap),
            (self.after, shared & (gap > 0), gap),
            (self.crossing, crossing, np.abs(gap)),
        ):
            field[group] = np.minimum(field[group], np.where(where, value, np.inf).min((1, 2)))
        there = np.asarray(shared.any(axis=2))
        new = np.flatnonzero(there.any(axis=1) & ~self.shared[group].any(axis=1))
        mine = there[new].argmax(1)
        theirs = np.where(shared[new, mine], along[new, mine], np.inf).argmin(1)
        self.first[group][new] = np.stack([steps.start + mine, theirs], -1)
        self.shared[group, steps] = there


def _places(segment: RunSegment, others: Rows, steps: slice, spacing: Reals) -> tuple[Reals, Bools, Bools]:
    """Compare each of the ego's steps [t] with each of the others' [k, t, T]. Returns metres the ego is ahead,
    whether both are in one place the same way, and whether at an angle.
    """
    ego, position = segment.ego, segment.position[..., :2]
    delta = position[ego, None, steps, None] - position[others][:, None]
    heading = segment.heading[others]
    along, aside = map(np.abs, _turned(delta, heading[:, None]))
    turn = np.abs(wrap(segment.heading[ego, None, steps, None] - heading[:, None]))
    theirs = _spacing(position[others], segment.valid[others])[:, None]
    both = segment.valid[ego, None, steps, None] & segment.valid[others][:, None]
    # A place lies between two logged steps as a rule: half the way to the next one is added.
    both &= along <= theirs / 2 + 0.5
    low = ground(segment)[..., 2]
    both &= np.abs(low[ego, None, steps, None] - low[others][:, None]) < LEVEL
    shared = both & (turn < SAME_WAY) & (aside <= HALF_LANE)
    crosses = (turn >= SAME_WAY) & (turn <= np.pi - SAME_WAY)
    return along, shared, both & crosses & (aside <= spacing[:, None] / 2 + 0.5)


def _turned(delta: Reals, heading: Reals) -> tuple[Reals, Reals]:
    """Return the parts of vectors [..., 2] along headings and to their left."""
    cos, sin = np.cos(heading), np.sin(heading)
    return cos * delta[..., 0] + sin * delta[..., 1], cos * delta[..., 1] - sin * delta[..., 0]


def _spacing(position: Reals, valid: Bools) -> Reals:
    """Return [..., T] half the way from the step before plus half the way to the next, in metres."""
    sides = np.linalg.norm(np.diff(position, axis=-2), axis=-1)
    sides = np.where(valid[..., 1:] & valid[..., :-1], sides, 0)
    padded = np.concatenate([sides[..., :1], sides, sides[..., -1:]], -1)
    return (padded[..., 1:] + padded[..., :-1]) / 2


def _boxes_meet(segment: RunSegment, others: Rows) -> Bools:
    """Return [K] whether the boxes around the two paths come close: cheap, and leaves few."""
    position, valid = segment.position[..., :2], segment.valid[..., None]
    rows = np.append(others, segment.ego)
    low = np.where(valid[rows], position[rows], np.inf).min(1) - HALF_LANE
    high = np.where(valid[rows], position[rows], -np.inf).max(1) + HALF_LANE
    return ((low[:-1] <= high[-1]) & (low[-1] <= high[:-1])).all(1)


def _queue_gap(segment: RunSegment, others: Rows, sign: int) -> Reals:
    """Return [K] the smallest time gap that two in one lane keep for a while; infinite if they never are in one.

    In a queue, paths in common are too short to tell and time gaps grow without limit: there the distance counts,
    as if the one behind drove ``QUEUE_SPEED``. The sign is -1 for those ahead of the ego, 1 for those behind it.
    """
    ego, heading = segment.ego, segment.heading[others]
    delta = sign * (segment.position[ego, :, :2] - segment.position[others, :, :2])
    along, aside = _turned(delta, heading)
    speed = np.linalg.norm(segment.velocity[[ego] if sign < 0 else others], axis=-1)
    gap = along / np.maximum(speed, QUEUE_SPEED)
    turn = np.abs(wrap(segment.heading[ego] - heading))
    kept = segment.valid[ego] & segment.valid[others] & (along > 0) & (gap <= TIME_GAP)
    low = ground(segment)[..., 2]
    apart = np.abs(low[ego] - low[others]) >= LEVEL + STEEP * along
    kept &= (np.abs(aside) <= HALF_LANE) & (turn < SAME_WAY) & ~apart
    long_enough = kept.sum(1) * segment.dt >= KEPT
    return np.where(long_enough, np.where(kept, gap, np.inf).min(1), np.inf)


def _merge_gap(segment: RunSegment, other: int, mine: int, theirs: int) -> float:
    """Return the seconds between the ego and another where their paths become one; infinite if they always were one.
    Both paths are followed backwards from that place by the same distances: they must have been apart or at an angle.
    """
    ahead, beside = _way_back(segment, segment.ego, mine), _way_back(segment, other, theirs)
    back = np.arange(1.0, min(ahead[0][-1], beside[0][-1], LOOKBACK) + 1e-6)
    ego, partner = (np.stack([np.interp(back, way[0], row) for row in way[1:]]) for way in (ahead, beside))
    apart = np.hypot(*(ego[:2] - partner[:2])) >= APART
    if not (apart | (np.abs(wrap(ego[2] - partner[2])) >= 1.5 * SAME_WAY)).any():
        return np.inf
    return abs(theirs - mine) * segment.dt


def _way_back(segment: RunSegment, agent: int, step: int) -> Reals:
    """Return [4, n] distance driven since, x, y and heading at the logged steps from one back to the first."""
    steps = np.flatnonzero(segment.valid[agent, : step + 1])[::-1]
    position = segment.position[agent, steps, :2].astype(np.float64)
    heading = np.unwrap(segment.heading[agent, steps].astype(np.float64))
    driven = np.append(0, np.cumsum(np.hypot(*np.diff(position, axis=0).T)))
    return np.stack([driven, *position.T, heading])


MAX_PLAYBACK_AGENTS, MAX_ROAD_POINTS = 256, 10_000
EXCLUSIONS = {
    "playback_agents": f"more than {MAX_PLAYBACK_AGENTS} playback agents",
    "roadgraph_points": f"more than {MAX_ROAD_POINTS} roadgraph points (convert --radius keeps fewer)",
    "interactive_agents": "too few interactive agents",
    "overlaps": "boxes that overlap in the log",
}
"""The paper's exclusions, and last the one a conversion may add, in words."""
POINT_SPACING = 2.0  # metres between the roadgraph points that are counted
MOVING = 2.0  # metres of logged travel past which an agent counts as moving


def travel(segment: RunSegment) -> NDArray[np.float32]:
    """Return [A] the farthest each agent gets from where it is first seen, in metres. A distance, not a path length:
    the jitter of a parked car's track does not add up.
    """
    agents = np.arange(segment.num_agents)
    start = segment.position[agents, segment.valid.argmax(1), :2]
    away = np.linalg.norm(segment.position[..., :2] - start[:, None], axis=-1)
    return np.where(segment.valid, away, 0).max(1)


class InteractiveChoice(NamedTuple):
    """The agents [count] that are simulated (the ego, its partner, the rest), and why the partner was chosen."""

    agents: NDArray[np.int64]
    context: Context | None


def interactive_choice(segment: RunSegment, count: int, *, fewer: bool = False) -> InteractiveChoice:
    """Pick the agents that are simulated.

    First the ego. Then one partner, chosen by context: the nearest of the agents the source marks as interacting,
    else of those it marks for prediction that move, else the one the ego merges with, crosses, follows or leads
    (:mod:`symphony.data.selection`; the one with the smallest time gap, then the nearest), else the nearest that
    moves. Then the nearest that move. All are vehicles seen at the first step; "nearest" is to the ego at that step,
    and agents seen at every step (comparable with the log throughout) go before the others, whatever their context.

    Raises a :class:`DataError` if there is no ego, or there are fewer than ``count`` (N_I, 2 or 8 in the paper); with
    ``fewer`` those are taken.
    """
    seen = segment.valid[:, 0] & (segment.agent_type == AgentType.VEHICLE)
    others = seen & (np.arange(segment.num_agents) != segment.ego)
    first = segment.position[:, 0, :2]
    distance = np.linalg.norm(first - first[segment.ego], axis=-1)
    order = np.lexsort((distance, ~segment.valid.all(1)))
    others, moves = order[others[order]], order[(others & (travel(segment) > MOVING))[order]]
    has_ego = bool(segment.valid[segment.ego, 0])
    partner, context = _partner(segment, others, moves) if has_ego and count > 1 else (None, None)
    chosen = [segment.ego] if partner is None else [segment.ego, partner]
    chosen += [agent for agent in moves.tolist() if agent != partner]
    if (len(chosen) < count and not fewer) or not has_ego:
        few = f"needs {count} interactive agents at its first step, has {len(chosen)}"
        message = few if has_ego else "its ego is not seen at its first step"
        raise DataError(message, file=segment.file or None, segment=segment.segment_id, field="agents")
    return InteractiveChoice(np.asarray(chosen[:count], np.int64), context)


def named_vehicles(segment: RunSegment, ids: Sequence[int]) -> list[int]:
    """Return the rows of vehicles besides the ego by their ids; a DataError if one is not seen at the first step."""
    found = [int(row) for agent in ids for row in np.flatnonzero(segment.agent_id == agent)]
    free = (segment.agent_type[found] == AgentType.VEHICLE) & segment.valid[found, 0]
    if len(found) < len(ids) or segment.ego in found or not free.all():
        who = ", ".join(map(str, ids))
        text = f"{who}: not all are ids of vehicles beside the ego that are seen at the first step"
        raise DataError(text, segment=segment.segment_id, field="agent_id")
    return found


def interactive_agents(segment: RunSegment, count: int) -> NDArray[np.int64]:
    """Return [count] the agents of :func:`interactive_choice`, the ego first."""
    return interactive_choice(segment, count).agents


def choices(segments: Iterable[RunSegment], count: int) -> dict[str, Any]:
    """Return the choices in many segments, in types that JSON can hold.

    That is ``count``; ``contexts``: how many segments have a partner of each :class:`Context`; ``too_few``: how many
    have fewer vehicles; ``segments``: by segment id the ``context`` and the ``agents`` (the source's ids).
    """
    found: dict[str, dict[str, Any]] = {}
    too_few = 0
    for segment in segments:
        try:
            agents, context = interactive_choice(segment, count)
            found[segment.segment_id] = {"context": context, "agents": segment.agent_id[agents].tolist()}
        except DataError:
            too_few += 1
    counts = Counter(each["context"] for each in found.values())
    contexts = {str(context): counts[context] for context in Context if counts[context]}
    return {"count": count, "contexts": contexts, "too_few": too_few, "segments": found}


def _partner(segment: RunSegment, others: Rows, moves: Rows) -> tuple[int | None, Context | None]:
    """Return the ego's partner and why; others, and those of them that move, are given in order of preference."""
    marks = ((others, segment.interest, Context.INTEREST), (moves, segment.predict, Context.PREDICT))
    for group, wanted, context in marks:
        marked = group[np.isin(group, wanted)]
        if len(marked):
            return int(marked[0]), context
    if len(moves) == 0:
        return None, None
    throughout = segment.valid[moves].all(1)
    pool = moves[throughout] if throughout.any() else moves
    found = relations(segment, pool)
    following = np.minimum(found.leader, found.follower)
    queue = Context.LEADER if found.leader[following.argmin()] <= following.min() else Context.FOLLOWER
    gaps = {Context.MERGE: found.merge, Context.CROSSING: found.crossing, queue: following}
    for context, gap in gaps.items():
        if np.isfinite(gap.min()):
            return int(pool[gap.argmin()]), context  # the first of the smallest gaps, so the nearest of them
    return int(pool[0]), Context.NEAREST


def road_points(segment: RunSegment) -> int:
    """Return the number of points of lanes, boundary and markings once each line has one at least every 2 m. Raw logs
    differ in density (WOMD: 0.5 m), so the paper's limit is applied to this number.
    """
    lines = (segment.road.lanes, segment.road.boundary, segment.road.marks)
    return sum(int((np.ceil(line_lengths(each) / POINT_SPACING) + 1).sum()) for each in lines)


def exclusion(segment: RunSegment, count: int) -> tuple[str, DataError] | None:
    """Return the first of the paper's :data:`EXCLUSIONS` that applies, and an error that says why; None if none does.

    Playback agents are those seen at some step but for the ``count`` interactive ones that a segment must have at its
    first step; for roadgraph points see :func:`road_points`.
    """
    playback, points = int(segment.valid.any(1).sum()) - count, road_points(segment)
    for kind, field, number, most in (
        ("playback_agents", "agents", playback, MAX_PLAYBACK_AGENTS),
        ("roadgraph_points", "road", points, MAX_ROAD_POINTS),
    ):
        if number > most:
            message = f"{number} {kind.replace('_', ' ')}, at most {most} allowed"
            file = segment.file or None
            return kind, DataError(message, file=file, segment=segment.segment_id, field=field)
    try:
        interactive_agents(segment, count)
    except DataError as error:
        return "interactive_agents", error
    return None
