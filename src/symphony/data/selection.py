"""Who is interactive in a segment, and which segments are left out (paper, section V-A)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import AgentType, Polylines, RunSegment
from symphony.errors import DataError

MAX_PLAYBACK_AGENTS = 256
MAX_ROAD_POINTS = 10_000
POINT_SPACING = 2.0
"""Metres between the roadgraph points that are counted."""
MOVING = 2.0
"""Metres of logged travel past which an agent counts as moving."""


def travel(segment: RunSegment) -> NDArray[np.float32]:
    """[A] the farthest each agent gets from where it is first seen, in metres.

    A distance, not a path length: the jitter of a parked car's track does not add up.
    """
    agents = np.arange(segment.num_agents)
    start = segment.position[agents, segment.valid.argmax(1), :2]
    away = np.linalg.norm(segment.position[..., :2] - start[:, None], axis=-1)
    return np.where(segment.valid, away, 0).max(1)


def interactive_agents(segment: RunSegment, count: int, *, moving: float = MOVING) -> NDArray[np.int64]:
    """Pick the agents that are simulated.

    First the ego. Then one partner: the nearest of the agents the source marks as interacting, else of those
    it marks for prediction that move, else of all that move. Then the nearest that move. All are vehicles
    seen at the first step; "nearest" is to the ego at that step, and agents seen until the last step (which
    the log can judge throughout) go before the others.

    Args:
        segment: the segment.
        count: how many, N_I (2 or 8 in the paper).
        moving: metres of :func:`travel` past which an agent moves.

    Returns:
        [count] agent indices, the ego first.

    Raises:
        DataError: there are not as many.
    """
    if count < 1:
        raise ValueError(f"count must be positive, is {count}")
    seen = segment.valid[:, 0] & (segment.agent_type == AgentType.VEHICLE)
    others = seen & (np.arange(segment.num_agents) != segment.ego)
    moves = others & (travel(segment) > moving)
    order = _nearest_first(segment)

    def marked(indices: NDArray[np.integer]) -> NDArray[np.bool_]:
        return np.isin(np.arange(segment.num_agents), indices)

    partners = (others & marked(segment.interest), moves & marked(segment.predict), moves)
    chosen = [segment.ego] if segment.valid[segment.ego, 0] else []
    for group in partners:
        if chosen and group.any():
            chosen.append(int(order[group[order]][0]))
            break
    rest = moves & ~marked(np.asarray(chosen))
    chosen += order[rest[order]].tolist()
    if len(chosen) < count or not segment.valid[segment.ego, 0]:
        has = len(chosen) if segment.valid[segment.ego, 0] else "no ego"
        message = f"needs {count} interactive agents at its first step, has {has}"
        raise DataError(message, file=segment.file or None, segment=segment.segment_id, field="agents")
    return np.asarray(chosen[:count], np.int64)


def _nearest_first(segment: RunSegment) -> NDArray[np.int64]:
    """[A] agents by distance from the ego at the first step, those seen throughout before the others."""
    first = segment.position[:, 0, :2]
    distance = np.linalg.norm(first - first[segment.ego], axis=-1)
    return np.lexsort((distance, ~segment.valid.all(1)))


def road_points(segment: RunSegment) -> int:
    """Points of lanes, boundary and markings once each line has one at least every 2 m.

    Raw logs differ in density (WOMD: 0.5 m), so the paper's limit is applied to this number.
    """
    road = segment.road
    return sum(_resampled_points(lines) for lines in (road.lanes, road.boundary, road.marks))


def _resampled_points(lines: Polylines) -> int:
    if len(lines.points) == 0:
        return 0
    sides = np.linalg.norm(np.diff(lines.points[:, :2].astype(np.float64), axis=0), axis=-1)
    index = lines.line_index
    within = index[1:] == index[:-1]
    length = np.bincount(index[1:][within], sides[within], minlength=len(lines))
    return int((np.ceil(length / POINT_SPACING) + 1).sum())


def usable(segment: RunSegment, count: int) -> None:
    """Apply the paper's exclusions.

    Args:
        segment: the segment.
        count: interactive agents it must have at its first step.

    Raises:
        DataError: more than 256 playback agents (those seen at some step), more than 10 000 roadgraph points
            (see :func:`road_points`), or too few interactive agents.
    """
    where = {"file": segment.file or None, "segment": segment.segment_id}
    playback = int(segment.valid.any(1).sum()) - count
    if playback > MAX_PLAYBACK_AGENTS:
        raise DataError(
            f"{playback} playback agents, at most {MAX_PLAYBACK_AGENTS} allowed", **where, field="agents"
        )
    points = road_points(segment)
    if points > MAX_ROAD_POINTS:
        raise DataError(
            f"{points} roadgraph points, at most {MAX_ROAD_POINTS} allowed", **where, field="road"
        )
    interactive_agents(segment, count)
