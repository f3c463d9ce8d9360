"""Small scenarios for the WOSAC score."""

from __future__ import annotations

from typing import Any

import numpy as np

from helpers_sources import womd_scenario
from symphony.data.sources import womd_pb2 as pb
from symphony.wosac.meta import SubmissionMeta
from symphony.wosac.scorer import SimulatedRollouts, WosacScenario

ROAD = np.array([(-200.0, -8.0, 0.0), (0.0, -8.0, 0.0), (200.0, -8.0, 0.0)])
"""Right edge of a road along +x; the drivable side is on its left."""
MADE = ("somebody@example.org", "made", False, False, False, "200K", True)
META = SubmissionMeta(*MADE, authors=("A", "B"), affiliation="Nowhere")


def made_scenario(agents: int = 4, seed: int = 0, **changes: Any) -> WosacScenario:
    """Agents that drive along +x in lanes 7 and 8, the first two scored; a signal at x = 30, red from step 20."""
    rng = np.random.default_rng(seed)
    step = np.arange(91) * 0.1
    speed = 5 + rng.random((agents, 1)) * 5
    x = speed * step + rng.random((agents, 1)) * 10
    position = np.stack((x, np.broadcast_to(4.0 * np.arange(agents)[:, None], x.shape), np.zeros_like(x)), -1)
    arrays = {
        "object_id": 10 + np.arange(agents), "object_type": np.ones(agents, int), "position": position,
        "heading": np.zeros((agents, 91), np.float32),
        "size": np.tile(np.array([4.5, 2.0, 1.5], np.float32), (agents, 1)),
        "valid": np.ones((agents, 91), bool), "evaluated": np.array([10, 11]), "road_edges": [ROAD],
        "lanes": [np.array([(k, y, 0.0) for k in range(0, 100, 5)]) for y in (0.0, 4.0)],
        "lane_id": np.array([7, 8]), "lane_type": np.array([2, 2]), "signal_step": np.arange(91),
        "signal_lane": np.full(91, 7), "signal_state": np.where(np.arange(91) >= 20, 4, 6),
        "signal_point": np.tile([30.0, 0.0], (91, 1)),
    }  # fmt: skip
    return WosacScenario("made", **{**arrays, **changes})


def made_rollouts(scenario: WosacScenario, count: int = 3, noise: float = 0.3) -> SimulatedRollouts:
    """The log with noise, for every agent that is valid at step 10."""
    rng, rows = np.random.default_rng(1), scenario.valid[:, 10]
    future = scenario.position[rows, 11:]
    states = future[None] + rng.normal(0, noise, (count, *future.shape))
    heading = scenario.heading[rows, 11:] + rng.normal(0, noise / 5, (count, *future.shape[:-1]))
    x, y, z = np.moveaxis(states.astype(np.float32), -1, 0)
    return SimulatedRollouts(scenario.object_id[rows], x, y, z, heading.astype(np.float32))


def womd_record(name: str = "0123456789abcdef", tracks: int = 3) -> pb.Scenario:
    """A scenario record of the challenge's length."""
    scenario = womd_scenario(name, tracks=tracks, steps=91)
    scenario.current_time_index = 10
    return scenario


def record_rollouts(scenario: pb.Scenario, count: int = 32, seed: int = 0) -> SimulatedRollouts:
    """Log playback of a record with a little noise."""
    rng, names = np.random.default_rng(seed), ("center_x", "center_y", "center_z", "heading")
    logged = [[[getattr(s, name) for name in names] for s in track.states[11:]] for track in scenario.tracks]
    states = np.array(logged) + rng.normal(0, 0.1, (count, *np.shape(logged)))
    ids = np.array([track.id for track in scenario.tracks])
    return SimulatedRollouts(ids, *np.moveaxis(states.astype(np.float32), -1, 0))
