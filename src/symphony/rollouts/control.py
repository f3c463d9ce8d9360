"""Changes that a user makes to agents: goals of single ones, and the temperature of their draws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from symphony.data.segment import RunSegment
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError

REACH = 3.0
"""Metres from a route, on average, within which it goes to the end of a lane or past a point."""


def given_goals(
    goals: Sequence[str], segments: Sequence[RunSegment], scenes: SceneBatch, *, planned: int = 0
) -> Int[Tensor, "B N"]:
    """Return the numbers of the routes that agents are to follow, -1 where that is left open.

    A goal looks like ``7=lane:103``, for agent 7 a route over the lane of id 103, or ``7=12.5,-40``, one that passes
    a point in the frame of the segment; the nearest of the agent's feasible routes. Each must suit all segments
    behind the scenes. The first ``planned`` agents take none.

    Raises:
        ConfigError: a goal that can't be read, names an agent that is not driven or has one already, or a lane that
            is not there, or that no feasible route of the agent comes near.
    """
    found = torch.full(scenes.interactive.shape, -1, dtype=torch.int64)
    for goal in goals:
        agent, _, where = goal.partition("=")
        if not agent.removeprefix("-").isdecimal() or not where:
            raise ConfigError(f"a goal is AGENT=lane:ID or AGENT=X,Y, not '{goal}'")
        for b, segment in enumerate(segments):
            rows = np.flatnonzero(segment.agent_id == int(agent)).tolist()
            driven = scenes.interactive_valid[b] & ~scenes.background[b]
            place = [n for n in driven.nonzero()[:, 0].tolist() if int(scenes.interactive[b, n]) in rows]
            if not place:
                raise ConfigError(f"goal '{goal}': segment {segment.segment_id} has no driven agent {agent}")
            if place[0] < planned:
                raise ConfigError(f"goal '{goal}': a planner drives agent {agent}")
            if int(found[b, place[0]]) >= 0:
                raise ConfigError(f"goal '{goal}': agent {agent} already has another goal")
            away = _distances(scenes, b, place[0], shapely.points(_place(goal, where, segment)))
            if (nearest := min(away, default=np.inf)) > REACH:
                near = f", the nearest stays {nearest:.1f} m away" if away else ""
                who = f"agent {agent} in segment {segment.segment_id}"
                raise ConfigError(f"goal '{goal}': no feasible route of {who} leads there{near}")
            found[b, place[0]] = away.index(nearest)
    return found


def _place(goal: str, where: str, segment: RunSegment) -> NDArray[np.float64]:
    """Return points [P, 2] that a route must come near."""
    if where.startswith("lane:"):
        row = np.flatnonzero(segment.road.lane_id.astype(str) == where.removeprefix("lane:"))
        if not len(row):
            raise ConfigError(f"goal '{goal}': segment {segment.segment_id} has no {where.replace(':', ' ')}")
        lane = segment.road.lanes[int(row[-1])][:, :2].astype(np.float64)
        return lane[len(lane) // 2 :]  # the agent may be on it already, but not past its end
    try:
        point = np.array([float(number) for number in where.split(",")])
    except ValueError:
        point = np.zeros(0)
    if point.shape != (2,) or not np.isfinite(point).all():
        raise ConfigError(f"a goal is AGENT=lane:ID or AGENT=X,Y, not '{goal}'")
    return point[None]


def _distances(scenes: SceneBatch, b: int, n: int, target: NDArray[np.object_]) -> list[float]:
    """Return metres from points to each route of an agent, on average; infinite for one that is not a line."""
    found = []
    for route, count in enumerate(scenes.route_count[b, n].tolist()):
        line = shapely.LineString(scenes.whole_route(b, n, route).cpu().numpy()) if count > 1 else None
        found.append(float(shapely.distance(line, target).mean()) if count > 1 else np.inf)
    return found
