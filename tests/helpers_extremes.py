"""Scenes that the schema allows and hardly any log holds, by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from helpers_segments import crossing, make_road, make_segment, straight_road
from symphony.data.segment import (
    MAX_COORDINATE,
    MAX_DT,
    MAX_HEADING,
    MAX_HEIGHT,
    MAX_JUMP,
    MAX_SIZE,
    MAX_SPEED,
    MIN_DT,
    MIN_SIZE,
    AgentType,
    RunSegment,
    SignalState,
)

STEPS = 5


def road(**changes: Any) -> RunSegment:
    """Three cars on three lanes."""
    return straight_road(**{"num_agents": 3, "steps": STEPS, **changes})


def line(*points: Any) -> Any:
    return np.asarray(points, float)


def with_road(segment: RunSegment, **changes: Any) -> RunSegment:
    return segment.replace(road=dataclasses.replace(segment.road, **changes))


def only(segment: RunSegment, seen: Any) -> RunSegment:
    """With agents seen at some steps [A, T] only."""
    valid = np.broadcast_to(np.asarray(seen, bool), segment.valid.shape).copy()
    zero = {name: getattr(segment, name).copy() for name in ("position", "heading", "velocity")}
    for array in zero.values():
        array[~valid] = 0
    return segment.replace(valid=valid, **zero)


def moving(
    speed: float, *, dt: float = 0.2, agents: int = 2, steps: int = STEPS, heading: float = 0.0
) -> RunSegment:
    """Agents that keep a speed, 30 m beside each other, from behind the origin on."""
    reach = speed * dt * (steps - 1)
    x = np.linspace(-reach / 2, reach / 2, steps) + np.zeros((agents, 1))
    y = np.broadcast_to(30.0 * np.arange(agents)[:, None], x.shape)
    lanes = [line((-reach - 50, k), (0, k), (reach + 50, k)) for k in y[:, 0]]
    velocity = np.stack([np.full_like(x, speed), np.zeros_like(x)], -1)
    return make_segment(make_road(lanes), np.stack([x, y], -1), np.full_like(x, heading), velocity, dt)


def placed(position: Any, segment: RunSegment) -> RunSegment:
    """Agents of a segment at [A, 2] throughout, at rest."""
    where = segment.position.copy()
    where[..., :2] = np.asarray(position, np.float32)[:, None]
    return segment.replace(position=where, velocity=np.zeros_like(segment.velocity))


def crowd() -> RunSegment:
    big = road(num_agents=256, num_lanes=2)
    return placed(np.tile([[40.0, 0.0]], (256, 1)), big)


def signals(count: int, state: SignalState) -> dict[str, Any]:
    return {
        "signal_lane": np.zeros(count, np.int32),
        "signal_point": np.zeros((count, 3), np.float32),
        "signal_state": np.full((count, STEPS), state, np.uint8),
    }


def sizes(side: float) -> RunSegment:
    base = road()
    return base.replace(size=np.full_like(base.size, side))


def far_away() -> RunSegment:
    base = road()
    shift = np.array([MAX_COORDINATE - 400, -MAX_COORDINATE + 400, MAX_HEIGHT - 1], np.float32)
    moved = {
        name: dataclasses.replace(getattr(base.road, name), points=getattr(base.road, name).points + shift)
        for name in ("lanes", "boundary", "marks")
    }
    return with_road(base.replace(position=base.position + shift), **moved)


def jumping() -> RunSegment:
    base = moving(10.0)
    places = base.position.copy()
    places[:, 1::2, 0] += MAX_JUMP - 50
    return base.replace(position=places)


def without_lines() -> RunSegment:
    base = road()
    bare = make_road([line((0, 0), (200, 0))])
    return base.replace(road=bare)


def turned(angle: float) -> RunSegment:
    base = road()
    return base.replace(heading=base.heading + np.float32(angle))


def zigzag() -> RunSegment:
    """A lane that turns back at every point, and follows itself."""
    xs = np.arange(60) % 2 * 3.0
    lanes = [np.stack([xs, np.zeros(60)], -1), line((5, 5), (5, 5), (5, 5))]
    return road().replace(
        road=make_road(lanes, successors=[(0, 0), (0, 1), (1, 0)], left=[(0, 0)], right=[(0, 1)])
    )


def types(kind: AgentType) -> RunSegment:
    base = road()
    return base.replace(agent_type=np.full(3, kind, np.uint8))


def logged_twice() -> RunSegment:
    """Two agents that are one and the same in all but their id."""
    base = road(num_agents=2)
    same = {name: getattr(base, name)[[0, 0]] for name in ("position", "heading", "velocity", "size")}
    return base.replace(**same)


def tangle() -> RunSegment:
    """Every lane leads to every other one."""
    pairs = [(a, b) for a in range(6) for b in range(6)]
    lanes = [line((0, k), (30, k), (60, k)) for k in range(6)]
    return road().replace(road=make_road(lanes, successors=pairs, left=pairs, right=pairs))


SCENES: dict[str, Callable[[], RunSegment]] = {
    "one agent": lambda: road(num_agents=1),
    "256 in one spot": crowd,
    "10 km apart": lambda: placed([(0, 0), (7000, 7000), (-7000, -7000)], road()),
    "a map of two points": lambda: road().replace(road=make_road([line((0, 0), (1, 0))])),
    "a lane of one point": lambda: road().replace(road=make_road([line((30, 0))])),
    "a lane of one place": lambda: road().replace(road=make_road([line(*[(30, 0)] * 5)])),
    "no boundary and no marks": without_lines,
    "a lane of 30 km": lambda: road().replace(road=make_road([line((-15_000, 0), (15_000, 0))])),
    "a lane that turns back and follows itself": zigzag,
    "a tangle of lanes": tangle,
    "one lane": lambda: road(num_lanes=1),
    "seen at the first two steps only": lambda: only(road(), np.arange(STEPS) < 2),
    "seen now and then": lambda: only(road(), (np.arange(STEPS) + np.arange(3)[:, None]) % 3 < 2),
    "all but two vanish": lambda: only(
        road(num_agents=6), (np.arange(6)[:, None] < 2) | (np.arange(STEPS) < 1)
    ),
    "the shortest log": lambda: road(steps=2),
    "all standing": lambda: placed([(20, 0), (40, 0), (60, 3.5)], road()),
    "all in reverse": lambda: moving(-10.0),
    "logged twice": logged_twice,
    "the highest speed": lambda: moving(MAX_SPEED - 1, dt=0.05),
    "the largest jumps": jumping,
    "the shortest time step": lambda: moving(10.0, dt=MIN_DT),
    "the longest time step": lambda: moving(10.0, dt=MAX_DT),
    "the smallest boxes": lambda: sizes(MIN_SIZE),
    "the largest boxes": lambda: sizes(MAX_SIZE - 0.5),
    "headings turned often": lambda: turned(MAX_HEADING - 10),
    "at the edge of the world": far_away,
    "pedestrians only": lambda: types(AgentType.PEDESTRIAN),
    "unknown kinds of agents": lambda: types(AgentType.UNSET),
    "widths and limits unknown": lambda: with_road(
        road(), lane_width=np.full(3, np.nan, "f4"), speed_limit=np.full(3, np.nan, "f4")
    ),
    "200 lights in one place": lambda: road().replace(**signals(200, SignalState.STOP)),
    "lights of unknown state": lambda: road().replace(**signals(2, SignalState.UNKNOWN)),
    "lights, and all leave": lambda: crossing(4, steps=STEPS, seed=3),
}
