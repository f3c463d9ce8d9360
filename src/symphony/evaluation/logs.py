"""The quality of the logged driving in a store: is it physical, varied, and within reach of the action space?"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from symphony.data.segment import RunSegment
from symphony.data.selection import interactive_agents
from symphony.data.store import SegmentStore
from symphony.envs.dynamics import Bicycle
from symphony.envs.scene import scene
from symphony.errors import DataError
from symphony.geometry.frames import with_speed
from symphony.roadgraph import LaneGraph, visited_regions
from symphony.rollouts.driving import playback

PERCENTILES = (1, 5, 50, 95, 99)
STRAIGHT = 0.5  # radians a branch may turn and still be called straight
MOST_FAULTS, LEAST_DIRECTION = 0.5, 15.0
"""Percent of collisions and of time off the road that a good set has at most, and of choices in each direction."""
_CHUNK = 64


def measure(
    store: SegmentStore, *, interactive: int = 2, progress: Callable[[int, int], None] = lambda *_: None
) -> dict[str, Any]:
    """Measure the logged driving of the interactive agents (see ``interactive_agents``) in every segment.

    As JSON can hold it: ``segments`` and ``skipped`` (with fewer agents); ``collision_rate`` (percent of segments in
    which one of them overlaps another agent) and ``offroad_time`` (percent of their steps), both without the first
    state; ``directions`` (percent of their ``choices`` at branching lanes); ``speed``, ``acceleration``, ``yaw_rate``
    and ``fit_error`` (metres between log and its fit to the action space, at the end) as percentiles etc., or NaN.

    Raises a :class:`DataError` where no segment has enough interactive agents.
    """
    sums = defaultdict[str, list[Any]](list)
    graph_of = lru_cache(maxsize=16)(lambda number: LaneGraph(store.road(number)))
    for begin in range(0, len(store), _CHUNK):
        # Agents of segments of equal length are fitted together: many small fits take far longer.
        alike = defaultdict[tuple[int, float], list[tuple[RunSegment, NDArray[np.int64]]]](list)
        for i in range(begin, min(begin + _CHUNK, len(store))):
            segment = store[i]
            try:
                rows = interactive_agents(segment, interactive)
            except DataError:
                continue
            alike[segment.num_steps, segment.dt].append((segment, rows))
            for name, values in _found(segment, rows, graph_of(int(store.map_index[i]))).items():
                sums[name].append(values)
        for group in alike.values():
            sums["fit_error"].append(_fit_error(group))
        progress(min(begin + _CHUNK, len(store)), len(store))
    if not (count := len(sums["collided"])):
        raise DataError(f"no segment has {interactive} interactive agents", file=store.path)
    found = {name: np.concatenate(values) for name, values in sums.items()}
    turn = found["branches"]
    directions = {"straight": np.abs(turn) <= STRAIGHT, "left": turn > STRAIGHT, "right": turn < -STRAIGHT}
    return {
        "interactive": interactive,
        "segments": count,
        "skipped": len(store) - count,
        "collision_rate": _percent(found["collided"]),
        "offroad_time": _percent(found["off"]),
        "directions": {name: _percent(share) for name, share in directions.items()},
        "choices": len(turn),
        **{name: _spread(found[name]) for name in ("speed", "acceleration", "yaw_rate", "fit_error")},
    }


def _found(segment: RunSegment, rows: NDArray[np.int64], graph: LaneGraph) -> dict[str, Any]:
    """Return everything but the fit of one segment."""
    valid, both = segment.valid[rows], segment.valid[rows, 1:] & segment.valid[rows, :-1]
    position = segment.position[rows, :, :2].astype(np.float64)
    heading, velocity = segment.heading[rows].astype(np.float64), segment.velocity[rows].astype(np.float64)
    # As the evaluator does, so that no figure here can differ from the playback row of a table.
    log = playback(scene(segment, rows.tolist()))
    speed = np.linalg.norm(velocity, axis=-1)
    turn = np.angle(np.exp(1j * np.diff(heading, axis=1)))
    lanes = graph.regions.lane[np.nonzero(visited_regions(graph, position, heading, valid))[1]]
    return {
        "collided": [bool(log.collision.any())],
        "off": log.offroad[log.counted].numpy(),
        "speed": speed[valid],
        "acceleration": np.diff(speed, axis=1)[both] / segment.dt,
        "yaw_rate": turn[both] / segment.dt,
        "branches": graph.curvature[lanes] * graph.length[lanes],
    }


def _fit_error(group: list[tuple[RunSegment, NDArray[np.int64]]]) -> NDArray[np.float64]:
    def all_of(name: str) -> torch.Tensor:
        return torch.from_numpy(np.concatenate([getattr(segment, name)[rows] for segment, rows in group]))

    state = (all_of("position")[..., :2], all_of("heading")[..., None], all_of("velocity"))
    log, valid = with_speed(torch.cat(state, -1)), all_of("valid")
    _, states = Bicycle().fit(log, valid, all_of("size")[:, :2], group[0][0].dt)
    which, last = torch.arange(len(valid)), valid.shape[1] - 1 - valid.flip(1).int().argmax(1)
    return (states[which, last, :2] - log[which, last, :2]).norm(dim=-1).double().numpy()


def _percent(flags: NDArray[np.bool_]) -> float:
    return round(100.0 * float(flags.mean()), 4) if len(flags) else math.nan


def _spread(values: NDArray[Any]) -> dict[str, float]:
    """Return mean, standard deviation, percentiles and largest; NaN if there are no values."""
    known = values if len(values) else np.array([math.nan])
    found = {f"p{q}": v for q, v in zip(PERCENTILES, np.percentile(known, PERCENTILES), strict=True)}
    whole = {"mean": known.mean(), "std": known.std(), **found, "max": known.max()}
    return {name: round(float(value), 4) for name, value in whole.items()}


def shortfalls(quality: dict[str, Any]) -> list[str]:
    """Return the targets that a set misses, in words; empty for a good one."""
    rates = ((name, quality[name]) for name in ("collision_rate", "offroad_time"))
    over = [f"{name} {rate:.2f} % is over {MOST_FAULTS} %" for name, rate in rates if rate > MOST_FAULTS]
    few = {name: share for name, share in quality["directions"].items() if share < LEAST_DIRECTION}
    return over + [f"only {n:.1f} % of the choices are {k}, below {LEAST_DIRECTION:.0f} %" for k, n in few.items()]
