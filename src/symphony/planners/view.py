"""The view of a planner in one record: for planners that are plain functions, and for those in other processes.

World frame of the segment, metres, seconds, m/s, radians counter-clockwise. M others present, K points, Q lights.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import AgentType, MarkType, SignalState
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
    """All other agents that are present, arrays [M]: box centres, headings, velocities, boxes, words for the types
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
    """A lane: centre line [K, 2] in the direction of travel, limit, ids of the lanes that follow, that lead here, and
    that a lane change may reach; its width and bounds [K, 2]. Unknown values are NaN.
    """

    id: int
    points: Reals
    speed_limit: float
    successors: tuple[int, ...]
    predecessors: tuple[int, ...]
    left_neighbors: tuple[int, ...]
    right_neighbors: tuple[int, ...]
    width: float
    left: Reals
    right: Reals


class Lights(NamedTuple):
    """Traffic lights, arrays [Q]: stop points, ids of the lanes they control, words for the states: ``stop``,
    ``caution``, ``go``, the same with ``arrow_`` or ``flashing_`` before them, ``unknown``.
    """

    x: Reals
    y: Reals
    lane: NDArray[np.int64]
    state: NDArray[np.str_]


class Before(NamedTuple):
    """The ego and all others at an earlier step, at this many seconds since the start."""

    time: float
    ego: Ego
    agents: Agents


@dataclass(frozen=True, eq=False)
class Observation:
    """The record that a planner sees at one step: seconds and steps since the start, seconds per step, the ego and
    all others, points [K, 2] to follow from where the ego is (see :class:`~symphony.planners.interface.Traffic`; may
    be empty), lanes, crosswalks (closed outlines [K, 2]) and lights of the map, the last seconds, the oldest step
    first, the run segment's id and the seed of the rollout.
    """

    time: float
    dt: float
    step: int
    ego: Ego
    agents: Agents
    route: Reals
    lanes: tuple[Lane, ...]
    crosswalks: tuple[Reals, ...]
    lights: Lights
    history: tuple[Before, ...]
    segment_id: str
    seed: int


def lanes_of(scenario: Scenario) -> tuple[Lane, ...]:
    """Return the lanes of a scenario."""
    road, ids = scenario.road, scenario.road.lane_id.tolist()
    ways = (road.successors, road.successors[:, ::-1], road.left_neighbors, road.right_neighbors)
    linked = [{k: list[int]() for k in range(len(ids))} for _ in ways]
    for found, pairs in zip(linked, ways, strict=True):
        for one, other in pairs.tolist():
            found[one].append(ids[other])
    lanes = []
    for k, width in enumerate(road.lane_width.tolist()):
        line = road.lanes[k][:, :2].astype(np.float64)
        aside = 0.5 * width * normals(line)
        after, before, left, right = (tuple(found[k]) for found in linked)
        about = ids[k], fixed(line), float(road.speed_limit[k]), after, before, left, right
        lanes.append(Lane(*about, width, fixed(line + aside), fixed(line - aside)))
    return tuple(lanes)


def crosswalks_of(scenario: Scenario) -> tuple[Reals, ...]:
    """Return the outlines [K, 2] of crosswalks."""
    marks, kinds = scenario.road.marks, scenario.road.mark_type.tolist()
    walks = [marks[k][:, :2].astype(np.float64) for k, kind in enumerate(kinds) if kind == MarkType.CROSSWALK]
    return tuple(map(fixed, walks))


def normals(line: Reals) -> Reals:
    """Return [P, 2] vectors to the left at each point, long enough to keep bounds at their distance at corners (at
    most 1.5); NaN for a line of one place.
    """
    new = np.concatenate([[True], (np.diff(line, axis=0) != 0).any(1)])
    if new.sum() < 2:
        return np.full_like(line, np.nan)
    along = np.diff(line[new], axis=0)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    left = np.stack([-along[:, 1], along[:, 0]], -1)
    before, after = np.concatenate([left[:1], left]), np.concatenate([left, left[-1:]])
    middle = before + after
    length = np.linalg.norm(middle, axis=-1, keepdims=True)
    middle = np.where(length > 1e-6, middle / np.maximum(length, 1e-6), before)
    return (middle * np.minimum(2 / np.maximum(length, 1e-6), 1.5))[np.cumsum(new) - 1]


def observation_of(
    scenario: Scenario, traffic: Traffic, lanes: tuple[Lane, ...] = (), crosswalks: tuple[Reals, ...] = ()
) -> Observation:
    """Return one record of what a planner is told at the start and what it observes now."""
    me, size, at = traffic.ego, scenario.size.tolist(), scenario.signal_point

    def others(moves: Reals, valid: NDArray[np.bool_]) -> Agents:
        there = valid & (np.arange(len(valid)) != me)
        kinds, (length, width) = TYPES[traffic.agent_type[there]], traffic.size[there].T
        x, y, heading, vx, vy = moves[there].T
        return Agents(x, y, heading, vx, vy, length, width, kinds, scenario.agent_id[there])

    def before(step: int, moves: Reals, valid: NDArray[np.bool_]) -> Before:
        x, y, heading, vx, vy = moves[me].tolist()
        ego = Ego(x, y, heading, vx * np.cos(heading) + vy * np.sin(heading), *size)
        return Before(step * scenario.dt, ego, others(moves, valid))

    steps = range(traffic.step - len(traffic.past), traffic.step)
    now = np.column_stack([traffic.position, traffic.heading, traffic.velocity])
    controlled = scenario.road.lane_id[scenario.signal_lane]
    return Observation(
        time=traffic.time,
        dt=scenario.dt,
        step=traffic.step,
        ego=Ego(*traffic.state.tolist(), *size),
        agents=others(now, traffic.valid),
        route=traffic.route,
        lanes=lanes,
        crosswalks=crosswalks,
        lights=Lights(at[:, 0], at[:, 1], controlled.astype(np.int64), STATES[traffic.lights]),
        history=tuple(map(before, steps, traffic.past, traffic.past_valid)),
        segment_id=scenario.segment_id,
        seed=scenario.seed,
    )


class FunctionPlanner:
    """A planner that is a function of the observation alone; it remembers nothing, so it is its own copy.

    Args:
        function: a function from an :class:`Observation` to a plan.
    """

    def __init__(self, function: Callable[[Observation], Any]) -> None:
        self.function = function

    def reset(self, scenario: Scenario) -> None:
        """Remember the map."""
        self.scenario, self.road = scenario, (lanes_of(scenario), crosswalks_of(scenario))

    def plan(self, traffic: Traffic) -> Any:
        """Return the plan that the function gives."""
        return self.function(observation_of(self.scenario, traffic, *self.road))

    def __deepcopy__(self, memo: dict[int, Any]) -> FunctionPlanner:
        return self
