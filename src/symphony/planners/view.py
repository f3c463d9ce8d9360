"""Everything a planner sees in one record: for planners that are plain functions, and for those in other processes.

World frame of the run segment, metres, seconds, m/s, radians counter-clockwise. Legend: M others that are there,
K points, Q lights.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import AgentType, SignalState
from symphony.planners.interface import Reals, Scenario, Traffic, fixed

TYPES = np.array([kind.name.lower() for kind in AgentType])
STATES = np.array([state.name.lower() for state in SignalState])


class Ego(NamedTuple):
    """The ego: box centre, heading, speed along it, and its box."""

    x: float
    y: float
    heading: float
    speed: float
    length: float
    width: float


class Agents(NamedTuple):
    """Everyone else who is there, arrays [M]: box centres, headings, velocities, boxes, words for the types
    (``vehicle``, ``pedestrian``, ``cyclist``, ``other``, ``unset``), and ids that stay the same.
    """

    x: Reals
    y: Reals
    heading: Reals
    vx: Reals
    vy: Reals
    length: Reals
    width: Reals
    type: NDArray[np.str_]
    id: NDArray[np.int64]


class Lane(NamedTuple):
    """A lane: centre line [K, 2] in the direction of travel, limit (NaN where unknown), ids of those that follow."""

    id: int
    points: Reals
    speed_limit: float
    successors: tuple[int, ...]


class Lights(NamedTuple):
    """Traffic lights, arrays [Q]: stop points, ids of the lanes they control, words for the states: ``stop``,
    ``caution``, ``go``, the same with ``arrow_`` or ``flashing_`` before them, ``unknown``.
    """

    x: Reals
    y: Reals
    lane: NDArray[np.int64]
    state: NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class Observation:
    """The record that a planner sees at one step: seconds and steps since the start, seconds per step, the ego and
    everyone else, points [K, 2] to follow from where the ego is (see :class:`~symphony.planners.interface.Traffic`;
    may be empty), lanes and lights of the map, the run segment's id and the seed of the rollout.
    """

    time: float
    dt: float
    step: int
    ego: Ego
    agents: Agents
    route: Reals
    lanes: tuple[Lane, ...]
    lights: Lights
    segment_id: str
    seed: int


def lanes_of(scenario: Scenario) -> tuple[Lane, ...]:
    """The lanes of a scenario."""
    road = scenario.road
    after: dict[int, list[int]] = {}
    for one, other in road.successors.tolist():
        after.setdefault(one, []).append(int(road.lane_id[other]))
    lines = [fixed(road.lanes[k][:, :2].astype(np.float64)) for k in range(len(road.lanes))]
    parts = zip(road.lane_id.tolist(), lines, road.speed_limit.tolist(), strict=True)
    return tuple(Lane(*part, tuple(after.get(k, ()))) for k, part in enumerate(parts))


def observation_of(scenario: Scenario, traffic: Traffic, lanes: tuple[Lane, ...]) -> Observation:
    """One record of what a planner is told at the start and what it observes now."""
    there = traffic.valid.copy()
    there[traffic.ego] = False
    (x, y), (vx, vy) = traffic.position[there].T, traffic.velocity[there].T
    (length, width), at = traffic.size[there].T, scenario.signal_point
    kinds, controlled = TYPES[traffic.agent_type[there]], scenario.road.lane_id[scenario.signal_lane]
    return Observation(
        time=traffic.time,
        dt=scenario.dt,
        step=traffic.step,
        ego=Ego(*traffic.state.tolist(), *scenario.size.tolist()),
        agents=Agents(x, y, traffic.heading[there], vx, vy, length, width, kinds, scenario.agent_id[there]),
        route=traffic.route,
        lanes=lanes,
        lights=Lights(at[:, 0], at[:, 1], controlled.astype(np.int64), STATES[traffic.lights]),
        segment_id=scenario.segment_id,
        seed=scenario.seed,
    )


class FunctionPlanner:
    """A planner that is a function of the observation alone; it remembers nothing, so copies are itself.

    Args:
        function: from an :class:`Observation` to a plan.
    """

    def __init__(self, function: Callable[[Observation], Any]) -> None:
        self.function = function

    def reset(self, scenario: Scenario) -> None:
        """Remember the map."""
        self.scenario, self.lanes = scenario, lanes_of(scenario)

    def plan(self, traffic: Traffic) -> Any:
        """The plan that the function gives."""
        return self.function(observation_of(self.scenario, traffic, self.lanes))

    def __deepcopy__(self, memo: dict[int, Any]) -> FunctionPlanner:
        return self
