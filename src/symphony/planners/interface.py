"""The interface of a user's planner of the ego: what it is told, what it observes and what it returns.

Plain Python and NumPy. World frame of the run segment, metres, seconds, m/s, radians counter-clockwise. Arrays are
read-only. Legend: A agents of the segment, Q lights, P points, T logged steps.
"""

from __future__ import annotations

import inspect
import math
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import Polylines, RoadMap, RunSegment
from symphony.errors import ConfigError
from symphony.imports import load_object

Reals = NDArray[np.float64]
Moment = tuple[Reals, NDArray[np.bool_]]
"""All agents at one step: x, y, heading and velocity [A, 5], and which are present [A]."""
Moments = tuple[Moment, ...]
Named = str | Callable[..., Any]
"""A planner by its name, or a function that makes it."""
Planners = Mapping[int | None, Named]
"""Planners by the ids of the agents that they drive, that of the ego, None, first."""

MAX_ACCELERATION, MAX_BRAKING = 5.0, 10.0
"""m/s^2 that a vehicle gains and loses at most, whatever it is asked for."""
MAX_STEERING = 0.6
"""Radians of its front wheels either way."""
MAX_SPEED = 80.0
"""m/s that a pose may ask for, and by which it may lie away from where the vehicle is."""
HISTORY = 2.0  # seconds before each step that planners are told
MAX_HEADING = 1e4
"""Radians either way that a pose may have."""
FARTHEST = 1e5  # metres from the origin that a trajectory may come to, as saved rollouts may


class Pose(NamedTuple):
    """The state of the ego at the next step: box centre, heading, speed along it (see :func:`checked_plan`)."""

    x: float
    y: float
    heading: float
    speed: float


class Control(NamedTuple):
    """The controls that move the ego to the next step, as :func:`symphony.envs.dynamics.bicycle_step` says.

    A vehicle does what it can: the acceleration ends at :data:`MAX_ACCELERATION` and -:data:`MAX_BRAKING`, the
    steering at :data:`MAX_STEERING` either way, the speed at 0.
    """

    acceleration: float
    steering: float


@dataclass(frozen=True)
class Traffic:
    """All agents at one step, the ego included.

    Attributes:
        step: since the start; 0 at the first call.
        time: seconds since the start.
        ego: row of the ego.
        state: [4] of the ego: x, y, heading, speed along it.
        position: [A, 2] box centres; 0 where not valid.
        heading: [A] headings.
        velocity: [A, 2] velocities.
        size: [A, 2] length, width.
        agent_type: [A] :class:`symphony.data.segment.AgentType`.
        valid: [A] which agents are present.
        lights: [Q] :class:`symphony.data.segment.SignalState` of each light of the scenario.
        route: [K, 2] points to follow from the ego's place on, 3 m apart: 200 m of the scenario's route, or what
            there is of it up to the end of the map.
        past: [H, A, 5] x, y, heading and velocity of all agents at the steps before, the oldest first: of the last
            :data:`HISTORY` seconds, or as many as there were since the start; 0 where not valid.
        past_valid: [H, A] which agents were present.
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
    route: Reals
    past: Reals
    past_valid: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Scenario:
    """The scene that a planner is told at the start. There is no history before it: simulations begin with the log.

    A copy is the scenario itself, so that planners that keep it are cheap to fork.

    Attributes:
        segment_id: the id of the run segment.
        dt: seconds per step.
        steps: how often the planner will be asked.
        ego: row of the ego in :class:`Traffic`.
        size: [2] its length and width.
        state: [4] its first x, y, heading and speed.
        route: [P, 2] points to follow, 3 m apart, from beside the ego on: the feasible route nearest to the log. It
            reaches 200 m beyond what can be driven in the segment, or to where the lanes end; empty where the ego is
            on no lane. Each :class:`Traffic` has the part ahead.
        goal: [2] where the ego is to come past, or its log ends.
        road: lanes with their successors and speed limits, boundary and marks.
        signal_lane: [Q] index of the lane each light controls.
        signal_point: [Q, 2] its stop point.
        agent_id: [A] the source's ids.
        log: [T, 4] what the ego did, for planners that play it back.
        log_valid: [T] where that is known.
        seed: seed of the planner's own random numbers, which should depend on nothing else; another for each rollout.
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
    agent_id: NDArray[np.int64]
    log: Reals
    log_valid: NDArray[np.bool_]
    seed: int = 0

    def __deepcopy__(self, memo: dict[int, Any]) -> Scenario:
        return self


class Planner(Protocol):
    """Drives the ego of one rollout. It is made without arguments.

    A class may also have a class method ``plan_batch(planners, traffics)``: it takes all its planners of a batch of
    rollouts and what each of them sees, lists of one length, and returns as many plans. Then ``plan`` is not called.

    A search forks planners by ``copy.deepcopy``; a planner that can't be copied needs ``--search none``. A copy draws
    the same random numbers as its original, if these come from :attr:`Scenario.seed`. The run fails, and its later
    steps don't count, if the planner raises an exception or returns numbers that are not finite, a plan of another
    length, or a target farther away than :data:`MAX_SPEED` allows.
    """

    def reset(self, scenario: Scenario) -> None:
        """Begin a rollout; called once, before the first plan."""
        ...

    def plan(self, traffic: Traffic) -> Pose | Control | Sequence[float] | Sequence[Pose] | NDArray[Any]:
        """Return the plan of the ego until the next step: 4 numbers are a :class:`Pose`, 2 a :class:`Control`. Of a
        trajectory (several poses, one step apart) the ego goes to the first; then the planner is asked again.
        """
        ...


NAMES = {"idm": "symphony.planners.included:IDMPlanner", "log": "symphony.planners.included:LogPlanner"}
"""Planners with names of their own."""
PIPE = "pipe:"
"""The prefix before the command of a planner in another process."""


def planner_maker(planner: str | Callable[..., Any]) -> Callable[[], Planner]:
    """Return a function that makes planners, one for each rollout.

    Args:
        planner: a class with ``reset`` and ``plan``, a function that makes such objects, or a function from an
            :class:`~symphony.planners.view.Observation` to a plan; what makes an
            :class:`~symphony.planners.included.IDMPlanner`; or the name of one: ``idm``, ``log``, an
            import path such as ``my.planner:Planner``, a file such as ``my.py:plan``, or ``pipe:COMMAND`` (see
            :mod:`symphony.planners.process`).

    Raises:
        ConfigError: there is no such planner, or it has no ``reset`` and ``plan``.
    """
    from symphony.planners.included import IDMPlanner  # noqa: PLC0415 - these build on this module
    from symphony.planners.process import ProcessPlanner  # noqa: PLC0415
    from symphony.planners.view import FunctionPlanner  # noqa: PLC0415

    name, given = planner_name(planner), planner
    if isinstance(given, str):
        if given.startswith(PIPE):
            try:
                words = shlex.split(given.removeprefix(PIPE))
            except ValueError as error:
                raise ConfigError(f"planner '{given}': {error}") from error
            if not words or shutil.which(words[0]) is None:
                raise ConfigError(f"planner '{given}': there is no command '{words[0] if words else ''}'")
            return partial(ProcessPlanner, given.removeprefix(PIPE))
        path = NAMES.get(given, given)
        if ":" not in path:
            raise ConfigError(
                f"planner is one of {', '.join(NAMES)}, an import path such as my.planner:Planner, a file such as "
                f"my.py:plan, or {PIPE}COMMAND, not '{name}'"
            )
        given = load_object(path)
    if not inspect.isclass(given) and len(_needed(given)) == 1:
        return partial(FunctionPlanner, given)
    try:
        made = given()
    except (Exception, SystemExit) as error:  # whatever a user's planner raises
        raise ConfigError(f"planner '{name}' can't be made: {type(error).__name__}: {error}") from error
    missing = [part for part in ("reset", "plan") if not callable(getattr(made, part, None))]
    if missing and not (isinstance(made, IDMPlanner) and len(missing) == 2):
        raise ConfigError(f"planner '{name}' has no {' and no '.join(missing)}, and isn't a function of one argument")
    return given


def named_planners(words: Sequence[str]) -> tuple[str, dict[int, str]]:
    """Return the planner of the ego, empty for none, and of others by their ids, from words such as ``3=my.py:plan``.

    Raises:
        ConfigError: two of one agent, or others' without one of the ego.
    """
    egos, others = list[str](), dict[int, str]()
    for word in words:
        agent, _, name = word.partition("=")
        if not agent.removeprefix("-").isdecimal():
            egos.append(word)
        elif others.setdefault(int(agent), name) != name or not name:
            wrong = f"agent {agent} already has another one" if name else "names no planner, as in 3=idm"
            raise ConfigError(f"planner '{word}': {wrong}")
    if len(egos) > 1 or (others and not egos):
        told = f"{len(egos)} are named: {', '.join(egos)}" if egos else "there is none (`log` plays back its log)"
        raise ConfigError(f"the ego has one planner, {told}; name another agent's by its id, as in 3=idm")
    return "".join(egos), others


def planner_name(planner: str | Callable[..., Any]) -> str:
    """Return the name of a planner in records."""
    if isinstance(planner, str):
        return planner
    if isinstance(planner, partial):
        return planner_name(planner.func)
    return f"{getattr(planner, '__module__', '')}:{getattr(planner, '__qualname__', type(planner).__name__)}"


def _needed(function: Callable[..., Any]) -> list[str]:
    by_place = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    try:
        found = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # not everything says
        return []
    return [one.name for one in found if one.kind in by_place and one.default is one.empty]


def scenario_of(segment: RunSegment, ego: int, route: NDArray[Any], state: NDArray[Any], seed: int) -> Scenario:
    """Return the scenario of an agent of a run segment, for a route [P, 2], its first state [4] and a seed."""
    valid = segment.valid[ego]
    heading, velocity = segment.heading[ego].astype(np.float64), segment.velocity[ego].astype(np.float64)
    speed = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    position = segment.position[ego, :, :2].astype(np.float64)
    return Scenario(
        segment_id=segment.segment_id,
        dt=float(segment.dt),
        steps=segment.num_steps - 1,
        ego=int(ego),
        size=fixed(segment.size[ego, :2].astype(np.float64)),
        state=fixed(state.astype(np.float64)),
        route=fixed(route.astype(np.float64)),
        goal=fixed(np.array((ego == segment.ego and segment.goal) or position[np.flatnonzero(valid)[-1]])),
        road=_fixed_road(segment.road),
        signal_lane=fixed(segment.signal_lane),
        signal_point=fixed(segment.signal_point[:, :2].astype(np.float64)),
        agent_id=fixed(segment.agent_id.astype(np.int64)),
        log=fixed(np.concatenate([position, heading[:, None], speed[:, None]], -1)),
        log_valid=fixed(valid),
        seed=seed,
    )


def traffic_of(
    segment: RunSegment, ego: int, step: int, state: Reals, now: Moment, past: Moments, route: Reals
) -> Traffic:
    """Return the traffic that an agent sees: its state [4], all agents now and before, and the route ahead [K, 2]."""
    agents, (moves, there) = segment.num_agents, now
    before = [np.where(here[:, None], each, 0.0)[:agents] for each, here in past]
    moves, there = np.where(there[:, None], moves, 0.0)[:agents], there[:agents]
    return Traffic(
        step=step,
        time=step * float(segment.dt),
        ego=ego,
        state=fixed(state),
        position=fixed(moves[:, :2]),
        heading=fixed(moves[:, 2]),
        velocity=fixed(moves[:, 3:]),
        size=fixed(segment.size[:, :2].astype(np.float64)),
        agent_type=fixed(segment.agent_type),
        valid=fixed(there),
        lights=fixed(segment.signal_state[:, step]),
        route=fixed(route),
        past=fixed(np.array(before).reshape(-1, agents, 5)),
        past_valid=fixed(np.array([here[:agents] for _, here in past], bool).reshape(-1, agents)),
    )


def fixed(array: NDArray[Any]) -> NDArray[Any]:
    """Return a view that can't be written to."""
    view = array.view()
    view.flags.writeable = False
    return view


def _fixed_road(road: RoadMap) -> RoadMap:
    parts: dict[str, Any] = {item.name: getattr(road, item.name) for item in fields(road)}
    for name, value in parts.items():
        lines = isinstance(value, Polylines)
        parts[name] = Polylines(fixed(value.points), fixed(value.offsets)) if lines else fixed(value)
    return replace(road, **parts)


def checked_plan(plan: Any, state: NDArray[Any], dt: float) -> Reals:
    """Return the plan of a planner as 2 or 4 finite numbers: of a trajectory, its first state. It gets the speed of
    its way if it names one that :data:`MAX_BRAKING` within the step does not explain.

    Args:
        plan: as the planner returned it.
        state: [4] of the ego.
        dt: seconds.

    Raises:
        ValueError: it is something else, or a target out of reach.
    """
    numbers = np.asarray(plan, np.float64)
    trajectory = numbers.ndim == 2 and numbers.shape[1] == 4 and len(numbers) > 0
    if numbers.shape not in ((2,), (4,)) and not trajectory:
        raise ValueError(
            "a plan is 4 numbers (a state), several such states, or 2 numbers (acceleration, steering), "
            f"not a {'x'.join(map(str, numbers.shape)) or 'single'} one"
        )
    if not np.isfinite(numbers).all():
        raise ValueError(f"a plan that is not finite: {numbers.tolist()}")
    if numbers.shape == (2,):
        return np.clip(numbers, [-MAX_BRAKING, -MAX_STEERING], [MAX_ACCELERATION, MAX_STEERING])
    target: Reals = numbers[0] if trajectory else numbers
    away = math.dist(target[:2], state[:2])
    if max(away / dt, abs(target[3])) > MAX_SPEED:
        why = f"a target {away:.1f} m away at {target[3]:.1f} m/s"
        raise ValueError(f"{why}, at most {MAX_SPEED:g} m/s are possible")
    if trajectory and np.abs(numbers[:, :2]).max() > FARTHEST:
        raise ValueError(f"a trajectory past {FARTHEST:g} m from the origin")
    if abs(target[2]) > MAX_HEADING:
        raise ValueError(f"a heading of {target[2]:g} rad, at most {MAX_HEADING:g} are possible")
    way = target[:2] - state[:2]
    speed = math.copysign(away / dt, way @ (math.cos(target[2]), math.sin(target[2])))
    return target if abs(target[3] - speed) <= MAX_BRAKING * dt + 0.1 else np.array([*target[:3], speed])
