"""Small scenarios for the WOSAC score, and slow, plain computations to compare with."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from helpers_sources import womd_scenario
from symphony.data.sources import womd_pb2 as pb
from symphony.wosac.rollouts import RolloutArrays
from symphony.wosac.scorer import SimulatedRollouts, WosacScenario

Reals = NDArray[np.floating[Any]]
ROAD = [(-200.0, -8.0, 0.0), (0.0, -8.0, 0.0), (200.0, -8.0, 0.0)]
"""Right edge of a road along +x; the drivable side is on its left."""


def made_scenario(agents: int = 4, seed: int = 0, **changes: Any) -> WosacScenario:
    """Agents that drive along +x, each in its lane, at speeds of its own; the first two are scored.

    Two lanes, ids 7 and 8; on the first a signal at x = 30 that is red from step 20 on.
    """
    rng = np.random.default_rng(seed)
    step = np.arange(91) * 0.1
    speed = 5 + rng.random((agents, 1)) * 5
    x = speed * step + rng.random((agents, 1)) * 10
    position = np.stack((x, np.broadcast_to(4.0 * np.arange(agents)[:, None], x.shape), np.zeros_like(x)), -1)
    arrays: dict[str, Any] = {
        "object_id": 10 + np.arange(agents),
        "object_type": np.ones(agents, int),
        "position": position,
        "heading": np.zeros((agents, 91), np.float32),
        "size": np.tile(np.array([4.5, 2.0, 1.5], np.float32), (agents, 1)),
        "valid": np.ones((agents, 91), bool),
        "evaluated": [10, 11],
        "road_edges": [ROAD],
        "lanes": [[(k, y, 0.0) for k in range(0, 100, 5)] for y in (0.0, 4.0)],
        "lane_id": [7, 8],
        "lane_type": [2, 2],
        "signal_step": np.arange(91),
        "signal_lane": np.full(91, 7),
        "signal_state": np.where(np.arange(91) >= 20, 4, 6),
        "signal_point": np.tile([30.0, 0.0], (91, 1)),
    }
    return WosacScenario.of("made", **{**arrays, **changes})


def made_rollouts(
    scenario: WosacScenario, count: int = 3, noise: float = 0.3, seed: int = 1
) -> SimulatedRollouts:
    """The log with noise, for every agent that is valid at step 10."""
    rng = np.random.default_rng(seed)
    rows = scenario.valid[:, 10].numpy()
    future = scenario.position.numpy()[rows, 11:]
    states = future[None] + rng.normal(0, noise, (count, *future.shape))
    heading = scenario.heading.numpy()[rows, 11:] + rng.normal(0, noise / 5, (count, *future.shape[:-1]))
    x, y, z = np.moveaxis(states.astype(np.float32), -1, 0)
    return SimulatedRollouts.of(scenario.object_id.numpy()[rows], x, y, z, heading.astype(np.float32))


def womd_record(name: str = "0123456789abcdef", tracks: int = 3) -> pb.Scenario:
    """A scenario record of the challenge's length."""
    scenario = womd_scenario(name, tracks=tracks, steps=91)
    scenario.current_time_index = 10
    return scenario


def record_rollouts(scenario: pb.Scenario, count: int = 32, seed: int = 0) -> RolloutArrays:
    """Log playback of a record with a little noise."""
    rng = np.random.default_rng(seed)
    logged = np.array(
        [[(s.center_x, s.center_y, s.center_z, s.heading) for s in t.states[11:]] for t in scenario.tracks]
    )
    states = logged + rng.normal(0, 0.1, (count, *logged.shape))
    ids = np.array([track.id for track in scenario.tracks])
    return RolloutArrays(ids, *np.moveaxis(states.astype(np.float32), -1, 0))


def box(center: Reals, heading: Reals | float, length: float, width: float) -> Reals:
    """Corners [*b, 4, 2] of centres [*b, 2]."""
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * [length / 2, width / 2]
    cos, sin = np.cos(heading), np.sin(heading)
    turn = np.moveaxis(np.array([[cos, sin], [-sin, cos]]), (0, 1), (-2, -1))
    return np.asarray(center)[..., None, :] + corners @ turn


def rounded_gap(a: tuple[Any, ...], b: tuple[Any, ...]) -> float:
    """Signed distance of two rounded boxes (centre, heading, length, width), by shapely."""
    radii = [0.7 * min(shape[2:]) / 2 for shape in (a, b)]
    cores = [
        box(shape[0], shape[1], shape[2] - 2 * r, shape[3] - 2 * r)
        for shape, r in zip((a, b), radii, strict=True)
    ]
    differences = shapely.MultiPoint((cores[0][:, None] - cores[1][None]).reshape(-1, 2)).convex_hull
    origin = shapely.Point(0, 0)
    inside = differences.contains(origin)
    return (-1 if inside else 1) * differences.exterior.distance(origin) - sum(radii)


def edge_distance(point: Reals, lines: list[Reals], stretch: float = 3.0) -> float:
    """Signed distance to the road edge by looking at every segment."""
    longest = max(map(len, lines))
    best: tuple[float, float] | None = None
    for line in lines:
        closed = np.square(line[0] - line[-1]).sum() < 1.0 and len(line) == longest
        segments = list(pairwise(line))
        for k, (start, end) in enumerate(segments):
            along, away = end - start, point - start
            squared = along[:2] @ along[:2]
            share = away[:2] @ along[:2] / squared if squared else 0.0
            offset = away - np.clip(share, 0, 1) * along
            far = np.hypot(np.hypot(*offset[:2]), stretch * offset[2])
            if best is not None and far >= best[0]:
                continue
            sign = _side(point, start, end)
            near = k + 1 if share > 1 else k - 1 if share < 0 else None
            if near is not None and (closed or 0 <= near < len(segments)):
                other = segments[near % len(segments)]
                first, second = (segments[k], other) if share > 1 else (other, segments[k])
                bend = np.outer((first[1] - first[0])[:2], (second[1] - second[0])[:2])
                turn = bend[0, 1] - bend[1, 0]
                sign = (max if turn > 0 else min)(sign, _side(point, *other))
            best = far, sign * np.hypot(*offset[:2])
    assert best is not None
    return best[1]


def _side(point: Reals, start: Reals, end: Reals) -> float:
    away, along = (point - start)[:2], (end - start)[:2]
    return float(np.sign(away[0] * along[1] - away[1] * along[0]))
