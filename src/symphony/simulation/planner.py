"""A planner of one's own as the ego: what it is told, what it observes and what it gives back.

Plain Python and NumPy. World frame of the run segment, metres, seconds, m/s, radians counter-clockwise. Arrays are
read-only. Legend: A agents of the segment, Q lights, P points, T logged steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import Polylines, RoadMap, RunSegment
from symphony.errors import ConfigError
from symphony.imports import build_object, load_object

Reals = NDArray[np.float64]

MAX_ACCELERATION = 5.0
"""m/s^2 that a vehicle gains at most, whatever it is asked for."""
MAX_BRAKING = 10.0
"""m/s^2 that it loses at most."""
MAX_STEERING = 0.6
"""Radians of its front wheels either way."""
MAX_SPEED = 80.0
"""m/s that a target may ask for, and by which it may lie away from where the vehicle is."""


class Target(NamedTuple):
    """The state of the ego at the next step: box centre, heading, speed along it."""

    x: float
    y: float
    heading: float
    speed: float


class Control(NamedTuple):
    """What moves the ego to the next step, as :func:`symphony.envs.dynamics.bicycle_step` says.

    A vehicle does what it can: the acceleration ends at :data:`MAX_ACCELERATION` and -:data:`MAX_BRAKING`, the
    steering at :data:`MAX_STEERING` either way, the speed at 0.
    """

    acceleration: float
    steering: float


@dataclass(frozen=True)
class Traffic:
    """Everyone at one step, the ego included.

    Attributes:
        step: since the start; 0 at the first call.
        time: seconds since the start.
        ego: row of the ego.
        state: [4] of the ego: x, y, heading, speed along it.
        position: [A, 2] box centres; 0 where not valid.
        heading: [A].
        velocity: [A, 2].
        size: [A, 2] length, width.
        agent_type: [A] :class:`symphony.data.segment.AgentType`.
        valid: [A] who is there.
        lights: [Q] :class:`symphony.data.segment.SignalState` of each light of the scenario.
    """

    step: int
    time: float
    ego: int
    state: Reals
    position: Reals
    heading: Reals
    velocity: Reals
    size: Reals
    agent_type: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    lights: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Scenario:
    """What a planner is told at the start. There is no history before it: simulations begin with the log.

    A copy is the scenario itself, so that planners that keep it are cheap to fork.

    Attributes:
        segment_id: of the run segment.
        dt: seconds per step.
        steps: how often the planner will be asked.
        ego: row of the ego in :class:`Traffic`.
        size: [2] its length and width.
        state: [4] its first x, y, heading and speed.
        route: [P, 2] points to follow, from beside the ego on: the feasible route nearest to the log, up to 189 m or
            where the lanes end; empty where the ego is on no lane.
        goal: [2] where the ego's log ends.
        road: lanes with their successors and speed limits, boundary and marks.
        signal_lane: [Q] index of the lane each light controls.
        signal_point: [Q, 2] its stop point.
        log: [T, 4] what the ego did, for planners that play it back.
        log_valid: [T].
        seed: for random numbers of the planner's own, which should come from nothing else; another for each rollout.
    """

    segment_id: str
    dt: float
    steps: int
    ego: int
    size: Reals
    state: Reals
    route: Reals
    goal: Reals
    road: RoadMap
    signal_lane: NDArray[np.int32]
    signal_point: Reals
    log: Reals
    log_valid: NDArray[np.bool_]
    seed: int = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> Scenario:
        return self


class Planner(Protocol):
    """Drives the ego of one rollout. It is made without arguments.

    A search forks planners by ``copy.deepcopy``; one that can't be copied drives with ``--search none``. A copy
    draws the same random numbers as the one it was made of, if it draws them as :attr:`Scenario.seed` says. One that
    raises an exception, or gives back what is not finite, of another length or a target farther away than
    :data:`MAX_SPEED` allows, makes its run a failed one; the run's later steps don't count.
    """

    def reset(self, scenario: Scenario) -> None:
        """Begin a rollout; called once, before the first plan."""
        ...

    def plan(self, traffic: Traffic) -> Target | Control | Sequence[float] | NDArray[Any]:
        """What the ego does until the next step: 4 numbers are a :class:`Target`, 2 a :class:`Control`."""
        ...


NAMES = {"idm": "symphony.simulation.planners:IDMPlanner", "log": "symphony.simulation.planners:LogPlanner"}
"""Planners with names of their own."""


def planner_maker(name: str) -> Callable[[], Planner]:
    """What makes planners, one for each rollout.

    Args:
        name: ``idm``, ``log``, or the import path of a class or function, such as ``my.planner:Planner``.

    Raises:
        ConfigError: there is no such planner, or it has no ``reset`` and ``plan``.
    """
    path = NAMES.get(name, name)
    if ":" not in path:
        names = ", ".join(NAMES)
        raise ConfigError(
            f"planner is one of {names} or an import path such as my.planner:Planner, not '{name}'"
        )
    try:
        made = build_object(path)
    except ConfigError:
        raise
    except Exception as error:  # whatever a user's planner raises
        raise ConfigError(f"planner '{name}' can't be made: {type(error).__name__}: {error}") from error
    missing = [part for part in ("reset", "plan") if not callable(getattr(made, part, None))]
    if missing:
        raise ConfigError(f"planner '{name}' has no {' and no '.join(missing)}")
    return load_object(path)


def scenario_of(segment: RunSegment, route: NDArray[Any], state: NDArray[Any], seed: int) -> Scenario:
    """What planners of a run segment are told.

    Args:
        segment: the segment.
        route: [P, 2].
        state: [4] first state of the ego.
        seed: of the rollout.
    """
    ego, valid = segment.ego, segment.valid[segment.ego]
    heading, velocity = segment.heading[ego].astype(np.float64), segment.velocity[ego].astype(np.float64)
    speed = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    position = segment.position[ego, :, :2].astype(np.float64)
    last = segment.num_steps - 1 - int(valid[::-1].argmax())
    return Scenario(
        segment_id=segment.segment_id,
        dt=float(segment.dt),
        steps=segment.num_steps - 1,
        ego=int(ego),
        size=fixed(segment.size[ego, :2].astype(np.float64)),
        state=fixed(state.astype(np.float64)),
        route=fixed(route.astype(np.float64)),
        goal=fixed(position[last]),
        road=_fixed_road(segment.road),
        signal_lane=fixed(segment.signal_lane),
        signal_point=fixed(segment.signal_point[:, :2].astype(np.float64)),
        log=fixed(np.concatenate([position, heading[:, None], speed[:, None]], -1)),
        log_valid=fixed(valid),
        seed=seed,
    )


def fixed(array: NDArray[Any]) -> NDArray[Any]:
    """A view that can't be written to."""
    view = array.view()
    view.flags.writeable = False
    return view


def _fixed_road(road: RoadMap) -> RoadMap:
    def of(value: Any) -> Any:
        return (
            Polylines(fixed(value.points), fixed(value.offsets))
            if isinstance(value, Polylines)
            else fixed(value)
        )

    return replace(road, **{item.name: of(getattr(road, item.name)) for item in fields(road)})


def checked_plan(plan: Any, state: NDArray[Any], dt: float) -> Reals:
    """What a planner gave back as 2 or 4 finite numbers.

    Args:
        plan: as it came.
        state: [4] of the ego.
        dt: seconds.

    Raises:
        ValueError: it is something else, or a target out of reach.
    """
    numbers = np.asarray(plan, np.float64)
    if numbers.shape not in ((2,), (4,)):
        shape = "x".join(map(str, numbers.shape)) or "single"
        raise ValueError(f"a plan is 4 numbers (a state) or 2 (acceleration, steering), not a {shape} one")
    if not np.isfinite(numbers).all():
        raise ValueError(f"a plan that is not finite: {numbers.tolist()}")
    if len(numbers) == 4:
        away = math.dist(numbers[:2], state[:2])
        if max(away / dt, abs(numbers[3])) > MAX_SPEED:
            raise ValueError(
                f"a target {away:.1f} m away at {numbers[3]:.1f} m/s, at most {MAX_SPEED:g} m/s are possible"
            )
        return numbers
    return np.clip(numbers, [-MAX_BRAKING, -MAX_STEERING], [MAX_ACCELERATION, MAX_STEERING])
