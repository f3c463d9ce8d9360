"""Who is interactive in a segment, and which segments are left out (paper, section V-A)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.data.context import Context, relations
from symphony.data.segment import AgentType, RunSegment, line_lengths
from symphony.errors import DataError

MAX_PLAYBACK_AGENTS = 256
MAX_ROAD_POINTS = 10_000
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
    """[A] the farthest each agent gets from where it is first seen, in metres.

    A distance, not a path length: the jitter of a parked car's track does not add up.
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
    (:mod:`symphony.data.context`; the one with the smallest time gap, then the nearest), else the nearest that
    moves. Then the nearest that move. All are vehicles seen at the first step; "nearest" is to the ego at that
    step, and agents seen at every step (which can be compared with the log throughout) go before the others, whatever
    their context.

    Raises a :class:`DataError` if there is no ego, or there are not as many (N_I, 2 or 8 in the paper); ``fewer``
    takes those that there are.
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
        has = len(chosen) if has_ego else "no ego"
        message = f"needs {count} interactive agents at its first step, has {has}"
        raise DataError(message, file=segment.file or None, segment=segment.segment_id, field="agents")
    return InteractiveChoice(np.asarray(chosen[:count], np.int64), context)


def interactive_agents(segment: RunSegment, count: int) -> NDArray[np.int64]:
    """[count] the agents of :func:`interactive_choice`, the ego first."""
    return interactive_choice(segment, count).agents


def choices(segments: Iterable[RunSegment], count: int) -> dict[str, Any]:
    """The choices in many segments, as JSON can hold them.

    Returns:
        ``count``; ``contexts``: how many segments have a partner of each :class:`Context`; ``too_few``: how many
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


def _partner(
    segment: RunSegment, others: NDArray[np.int64], moves: NDArray[np.int64]
) -> tuple[int | None, Context | None]:
    """The ego's partner among others and those of them that move, both in the order of preference."""
    for group, marks, context in (
        (others, segment.interest, Context.INTEREST),
        (moves, segment.predict, Context.PREDICT),
    ):
        marked = group[np.isin(group, marks)]
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
    """Points of lanes, boundary and markings once each line has one at least every 2 m.

    Raw logs differ in density (WOMD: 0.5 m), so the paper's limit is applied to this number.
    """
    lines = (segment.road.lanes, segment.road.boundary, segment.road.marks)
    return sum(int((np.ceil(line_lengths(each) / POINT_SPACING) + 1).sum()) for each in lines)


def exclusion(segment: RunSegment, count: int) -> tuple[str, DataError] | None:
    """The first of the paper's :data:`EXCLUSIONS` that applies to a segment and an error that says why; None if none.

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


def usable(segment: RunSegment, count: int) -> None:
    """Raise the :class:`DataError` of :func:`exclusion`, if there is one."""
    found = exclusion(segment, count)
    if found is not None:
        raise found[1]
