"""What the logged driving in a store is like: is it physical, varied, and within reach of the action space?"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import shapely
import torch
from numpy.typing import NDArray

from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import MOVING, interactive_agents, travel
from symphony.data.store import SegmentStore
from symphony.envs.dynamics import Bicycle
from symphony.envs.scene import scene
from symphony.errors import DataError
from symphony.geometry.frames import with_speed
from symphony.roadgraph import LaneGraph, visited_regions
from symphony.roadgraph.lines import turn_between
from symphony.rollouts.driving import playback

PERCENTILES = (1, 5, 50, 95, 99)
STRAIGHT = 0.5
"""Radians a branch may turn and still be called straight; also what makes an agent one that turns."""
BEND = 0.005
"""1/m of curvature up to which a lane is straight enough to measure the distance from its centre."""
IN_LANE = 1.2
"""Metres from the centre line beyond which a vehicle is changing lanes."""
LIMITS = {"collision_rate": 0.5, "offroad_time": 0.5}
"""Percent that a good set stays within."""
LEAST_DIRECTION = 15.0
"""Percent of the choices that each direction has in a good set."""
_CHUNK = 64
_Sums = defaultdict[str, list[Any]]
"""Values of all agents measured so far."""


def measure(
    store: SegmentStore,
    *,
    interactive: int = 2,
    dynamics: Bicycle | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure the logged driving of the interactive agents (see ``interactive_agents``) in every segment.

    Args:
        store: the run segments.
        interactive: agents measured in each, the ego included (N_I).
        dynamics: the action space their logs are fitted to.
        progress: called with the segments measured and how many there are.

    Returns:
        As JSON can hold it: ``segments`` and ``skipped`` (with fewer agents); ``collision_rate`` (percent of segments
        in which one of them overlaps another agent) and ``offroad_time`` (percent of their steps with the
        centre off the road), both without the first state; ``directions`` (percent of their choices at branching
        lanes) out of ``choices``; ``turning`` (percent of agents whose heading spans more than half a radian);
        ``speed`` m/s, ``acceleration`` m/s², ``yaw_rate`` rad/s and ``lateral_offset`` (metres left of the centre of
        straight lanes) as percentiles and ``std``; ``fit_error`` (metres between log and greedy fit at the end);
        ``agents`` and ``moving`` per segment, the latter of vehicles at the first step; ``lights`` (percent of
        segments with some). NaN for what no segment has.

    Raises:
        DataError: no segment has so many interactive agents.
    """
    sums, skipped = _Sums(list), 0

    @lru_cache(maxsize=16)
    def graph_of(number: int) -> LaneGraph:
        return LaneGraph(store.road(number))

    for begin in range(0, len(store), _CHUNK):
        chosen = []
        for i in range(begin, min(begin + _CHUNK, len(store))):
            segment = store[i]
            try:
                rows = interactive_agents(segment, interactive)
            except DataError:
                skipped += 1
                continue
            chosen.append((segment, rows))
            _add(sums, segment, rows, graph_of(int(store.map_index[i])))
        _add_fits(sums, chosen, dynamics or Bicycle())
        if progress is not None:
            progress(min(begin + _CHUNK, len(store)), len(store))
    if not sums["collided"]:
        message = f"none of {len(store)} segments has {interactive} interactive agents"
        raise DataError(message, file=store.path)
    turn = np.concatenate(sums["branches"])
    directions = {"straight": np.abs(turn) <= STRAIGHT, "left": turn > STRAIGHT, "right": turn < -STRAIGHT}
    spreads = ("speed", "acceleration", "yaw_rate", "lateral_offset", "fit_error", "agents", "moving")
    return {
        "interactive": interactive,
        "segments": len(sums["collided"]),
        "skipped": skipped,
        "collision_rate": _percent(np.concatenate(sums["collided"])),
        "offroad_time": _percent(np.concatenate(sums["off"])),
        "directions": {name: _percent(share) for name, share in directions.items()},
        "choices": len(turn),
        "turning": _percent(np.concatenate(sums["turns"])),
        **{name: _spread(np.concatenate(sums[name])) for name in spreads},
        "lights": _percent(np.concatenate(sums["lights"])),
    }


def _add(sums: _Sums, segment: RunSegment, rows: NDArray[np.int64], graph: LaneGraph) -> None:
    """Add everything but the fit of one segment."""
    valid = segment.valid[rows]
    position = segment.position[rows, :, :2].astype(np.float64)
    heading, velocity = segment.heading[rows].astype(np.float64), segment.velocity[rows].astype(np.float64)
    # As the evaluator does, so that no figure here can differ from the playback row of a table.
    log = playback(scene(segment, rows.tolist()))
    speed = np.linalg.norm(velocity, axis=-1)
    both = valid[:, 1:] & valid[:, :-1]
    turn = np.angle(np.exp(1j * np.diff(heading, axis=1)))
    spans = np.ptp(np.pad(np.cumsum(np.where(both, turn, 0), axis=1), ((0, 0), (1, 0))), axis=1)
    lanes = graph.regions.lane[np.nonzero(visited_regions(graph, position, heading, valid))[1]]
    seen = segment.valid[:, 0] & (segment.agent_type == AgentType.VEHICLE)
    found = {
        "collided": [bool(log.collision.any())],
        "off": log.offroad[log.counted].numpy(),
        "speed": speed[valid],
        "acceleration": np.diff(speed, axis=1)[both] / segment.dt,
        "yaw_rate": turn[both] / segment.dt,
        "turns": spans > STRAIGHT,
        "branches": graph.curvature[lanes] * graph.length[lanes],
        "lateral_offset": _lateral(graph, position[valid], heading[valid]),
        "agents": [segment.num_agents],
        "moving": [int((seen & (travel(segment) > MOVING)).sum())],
        "lights": [len(segment.signal_lane) > 0],
    }
    for name, values in found.items():
        sums[name].append(values)


def _lateral(
    graph: LaneGraph, points: NDArray[np.float64], heading: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Metres to the left of the nearest straight lane's centre, of the points [K, 2] that are in one."""
    near = graph.index.near(points, IN_LANE)
    lane = graph.usable_lanes[near.line]
    turn = turn_between(near.heading, heading[near.point])
    near = near.only((np.abs(graph.curvature[lane]) < BEND) & (turn < 0.2))
    order = np.lexsort((near.distance, near.point))
    near = near.only(order[np.unique(near.point[order], return_index=True)[1]])
    centre = shapely.line_interpolate_point(graph.index.geometry[near.line], near.along)
    away = points[near.point] - shapely.get_coordinates(centre)
    left = np.cos(near.heading) * away[:, 1] - np.sin(near.heading) * away[:, 0]
    return np.copysign(near.distance, left)


def _add_fits(sums: _Sums, chosen: list[tuple[RunSegment, NDArray[np.int64]]], dynamics: Bicycle) -> None:
    """Fit the agents of segments of equal length together: many small fits take far longer."""
    groups: dict[tuple[int, float], list[tuple[RunSegment, NDArray[np.int64]]]] = {}
    for segment, rows in chosen:
        groups.setdefault((segment.num_steps, segment.dt), []).append((segment, rows))
    for (steps, dt), group in groups.items():
        position, heading, velocity, valid, size = (
            torch.from_numpy(np.concatenate([getattr(segment, name)[rows] for segment, rows in group]))
            for name in ("position", "heading", "velocity", "valid", "size")
        )
        log = with_speed(torch.cat([position[..., :2], heading[..., None], velocity], -1))
        _, states = dynamics.fit(log, valid, size[:, :2], dt)
        last = steps - 1 - valid.flip(1).int().argmax(1)
        which = torch.arange(len(last))
        away = states[which, last, :2] - log[which, last, :2]
        sums["fit_error"].append(away.norm(dim=-1).double().numpy())


def _percent(flags: NDArray[np.bool_]) -> float:
    return round(100.0 * float(flags.mean()), 4) if len(flags) else math.nan


def _spread(values: NDArray[Any]) -> dict[str, float]:
    """Mean, standard deviation, percentiles and largest."""
    if len(values) == 0:
        return dict.fromkeys(["mean", "std", *(f"p{q}" for q in PERCENTILES), "max"], math.nan)
    found = {f"p{q}": float(v) for q, v in zip(PERCENTILES, np.percentile(values, PERCENTILES), strict=True)}
    whole = {"mean": float(values.mean()), "std": float(values.std()), **found, "max": float(values.max())}
    return {name: round(value, 4) for name, value in whole.items()}


def shortfalls(quality: dict[str, Any]) -> list[str]:
    """The targets that a set misses, in words; empty for a good one."""
    missed = [
        f"{name} {quality[name]:.2f} % is over {limit} %"
        for name, limit in LIMITS.items()
        if quality[name] > limit
    ]
    return missed + [
        f"only {share:.1f} % of the choices are {name}, below {LEAST_DIRECTION:.0f} %"
        for name, share in quality["directions"].items()
        if share < LEAST_DIRECTION
    ]
