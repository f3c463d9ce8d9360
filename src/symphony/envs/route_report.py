"""What the routes of a store are like: whether they can be driven, where they end, whether the log follows them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.data.segment import RunSegment
from symphony.data.selection import interactive_choice
from symphony.data.store import SegmentStore
from symphony.envs.routes import agent_routes, drivable
from symphony.errors import DataError
from symphony.roadgraph import LaneGraph, Route, ground_truth_routes, lane_of
from symphony.roadgraph.paths import own_sharpest
from symphony.roadgraph.routes import ends_inside

KINK = np.radians(30.0)
"""Radians by which a route may turn more within 3 m than its lanes do."""
NEAR = 2.0
"""Metres from the log, on average where it is on lanes, within which the route that was taken lies."""


def route_counts(
    store: SegmentStore, interactive: int = 2, advance: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Counts over the interactive agents of all segments of a store.

    Args:
        store: the run segments.
        interactive: agents of each segment, at most.
        advance: called after each segment with how many are done and how many there are.

    Returns:
        ``agents`` with routes, ``routes``, ``kinked`` (of which the direction changes over 3 m by 30 degrees more
        than that of their lanes), ``ends_inside`` (that end where the map goes on), ``without`` (agents on no lane),
        ``failed`` (agents whose routes cannot be built, with the first ``example``), and ``logged_within_2m``: the
        share of agents whose taken route is within 2 m of the log on average, where that is on lanes; None without.
    """
    found, near, example = Counter[str](), [], ""
    for number in range(len(store)):
        segment = store[number]
        graph, reach = LaneGraph(segment.road), drivable(segment)
        for agent in interactive_choice(segment, interactive, fewer=True).agents.tolist():
            try:
                first, kept, lines = agent_routes(segment, graph, agent, reach=reach)
            except DataError as error:
                found["failed"] += 1
                example = example or str(error)
                continue
            if not lines:
                found["without"] += 1
                continue
            found["agents"] += 1
            found["routes"] += len(lines)
            found["kinked"] += sum(kinked(graph, *pair) for pair in zip(kept, lines, strict=True))
            found["ends_inside"] += sum(
                not graph.successors[route.lanes[-1]] and ends_inside(graph, line)
                for route, line in zip(kept, lines, strict=True)
            )
            away = _away(segment, graph, agent, first, lines)
            if len(away):
                near.append(away.mean() < NEAR)
        if advance is not None:
            advance(number + 1, len(store))
    counts = {
        name: found[name] for name in ("agents", "routes", "kinked", "ends_inside", "without", "failed")
    }
    return {**counts, "example": example, "logged_within_2m": float(np.mean(near)) if near else None}


def kinked(graph: LaneGraph, route: Route, line: NDArray[np.float64]) -> bool:
    """Whether the line of a route turns more sharply within 3 m than its lanes do."""
    way = np.diff(line, axis=0)
    way = way[np.hypot(*way.T) > 1e-3]
    heading = np.arctan2(way[:, 1], way[:, 0])
    turn = np.abs((np.diff(heading) + np.pi) % (2 * np.pi) - np.pi).max(initial=0.0)
    if turn <= KINK:
        return False
    parts = [part for part in (route.lanes[: route.change], route.lanes[route.change :]) if part]
    return bool(turn > KINK + max(own_sharpest(graph, part) for part in parts))


def _away(
    segment: RunSegment, graph: LaneGraph, agent: int, first: int, lines: list[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Metres from the route that was taken to the log, where that is on lanes."""
    path, valid = segment.position[agent, first:, :2], segment.valid[agent, first:]
    taken = lines[int(ground_truth_routes(lines, path, valid).argmax())]
    on = lane_of(graph, path[valid], segment.heading[agent, first:][valid]) >= 0
    return np.asarray(
        shapely.distance(shapely.LineString(taken), shapely.points(path[valid][on].astype(float)))
    )
