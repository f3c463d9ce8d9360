"""Rollouts as the Waymo Open Sim Agents Challenge asks for them: 32 futures of all agents, 8 s (or less) at 10 Hz.

Nothing of the log after the current step is used: only agents that are valid then take part, and lights keep the
latest state seen up to then. The learned agent drives all vehicles, however few it was trained to drive, up to the
edge of the map, past which they keep their velocity. Those that stand stay, and people walk on; driven vehicles see
the latter at constant velocity.

Legend: A agents, n valid at the current step, N vehicles of them, R rollouts, F future steps (80), U decisions + 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from symphony.agents import Agent
from symphony.config import WosacSettings
from symphony.data.odd import mended
from symphony.data.resample import wrap
from symphony.data.segment import GREEN, RED, AgentType, RunSegment, SignalState, validate
from symphony.data.sources.womd import scenario_to_segment
from symphony.envs.routes import route_table
from symphony.envs.scene import MapEdge, beyond, map_edge, scene
from symphony.errors import ConfigError, DataError
from symphony.roadgraph import LaneGraph
from symphony.rollouts.driving import simulation
from symphony.rollouts.unroll import NotFiniteError, Rollouts
from symphony.rollouts.workers import shared
from symphony.streams import Stream, fold_in, stream_of, uniform
from symphony.wosac.records import check_times, parse_scenario, read_scenarios
from symphony.wosac.scorer import SimulatedRollouts
from symphony.wosac.scorer.config import CURRENT, DT, FUTURE, ROLLOUTS
from symphony.wosac.scorer.scenario import STATES

STILL = 0.2
"""The most metres that a standing vehicle has moved in the last second; at speeds up to twice that a second."""
AHEAD, ASIDE = 60.0, 3.0  # metres ahead and to a side within which a light is a vehicle's own
PACE, COURSE = 0.4, 0.17
"""How much people's speeds (a share) and courses (radians, 10 degrees) differ between rollouts, either way."""


def standing(segment: RunSegment) -> NDArray[np.bool_]:
    """Return [A] the vehicles that have stood for the last second and have no reason to go: no green light ahead. In
    logs, those under a green light go within 8 s, of the others one in eight or fewer.
    """
    now = segment.current_step
    past = slice(max(now - round(1 / segment.dt), 0), now + 1)
    away = np.linalg.norm(segment.position[:, past, :2] - segment.position[:, now, None, :2], axis=-1)
    still = np.where(segment.valid[:, past], away, 0.0).max(1) <= STILL
    still &= np.linalg.norm(segment.velocity[:, now], axis=-1) <= 2 * STILL
    still &= segment.valid[:, now] & (segment.agent_type == AgentType.VEHICLE)
    # Where each light is in the frame of each vehicle.
    shown = _latest(segment)
    delta = segment.signal_point[None, :, :2] - segment.position[:, now, None, :2]
    cos, sin = np.cos(segment.heading[:, now, None]), np.sin(segment.heading[:, now, None])
    along, aside = cos * delta[..., 0] + sin * delta[..., 1], cos * delta[..., 1] - sin * delta[..., 0]
    own = (along > 0) & (along < AHEAD) & (np.abs(aside) < ASIDE)
    green, red = ((own & np.isin(shown, states)).any(1) for states in (GREEN, RED))
    return np.asarray(still & ~(green & ~red))


def _latest(segment: RunSegment) -> NDArray[np.uint8]:
    """Return [Q] the latest known state of each light up to the current step."""
    seen = segment.signal_state[:, segment.current_step :: -1]
    return seen[np.arange(len(seen)), (seen != SignalState.UNKNOWN).argmax(1)]


def walks(segment: RunSegment, rows: NDArray[np.int64], rollouts: int, steps: int, seed: int) -> NDArray[np.float64]:
    """Return [R, n, F, 3] x, y, heading of pedestrians and all others that are not driven.

    They keep their velocity, each rollout with a pace and a course of its own, and their headings change as they did
    at some step of the last second, drawn for each step.
    """
    now = segment.current_step
    stream = fold_in(torch.tensor(stream_of(segment.segment_id)), Stream.WALKS)
    agents = torch.from_numpy(segment.agent_id[rows].astype(np.int64))
    line = fold_in(fold_in(stream, torch.arange(rollouts)[:, None]), agents)[..., None]
    drawn = uniform(seed, line, torch.arange(steps + 2)).double().numpy()
    pace, course = 1 + PACE * (2 * drawn[..., 0] - 1), COURSE * (2 * drawn[..., 1] - 1)
    velocity = segment.velocity[rows, now].astype(np.float64)
    cos, sin = pace * np.cos(course), pace * np.sin(course)
    x, y = cos * velocity[:, 0] - sin * velocity[:, 1], sin * velocity[:, 0] + cos * velocity[:, 1]
    time = np.arange(1, steps + 1) * segment.dt
    path = segment.position[rows, now, None, :2] + np.stack([x, y], -1)[:, :, None] * time[:, None]
    past = slice(max(now - round(1 / segment.dt), 0), now + 1)
    heading, valid = segment.heading[rows, past].astype(np.float64), segment.valid[rows, past]
    turns = np.where(valid[:, 1:] & valid[:, :-1], wrap(np.diff(heading)), 0.0)
    turns -= turns.mean(1, keepdims=True)
    which = (drawn[..., 2:] * turns.shape[1]).astype(np.int64)
    turned = np.take_along_axis(np.broadcast_to(turns, (rollouts, *turns.shape)), which, -1).cumsum(-1)
    found = wrap(heading[:, -1, None] + course[..., None] + turned)
    return np.concatenate([path, found[..., None]], -1)


Doubles = NDArray[np.float64]
_TIMED = ("position", "heading", "velocity", "valid")

AT_ONCE = 1600  # observations made at a time in a search, 0.1 MB each


def wosac_rollouts(agent: Agent, segment: RunSegment, settings: WosacSettings) -> SimulatedRollouts:
    """Return 32 rollouts of all agents that are valid at the segment's current step.

    Between the agent's decisions positions are interpolated linearly and headings along the shorter arc; z is held.

    They are in the world frame of the log, headings in [-π, π). Of the segment, with steps of 0.1 s, nothing after
    the current step, 10, is read, but for the routes where they are the log's.

    Raises a :class:`ConfigError` where the agent is log playback, or can't search as asked for, a :class:`DataError`
    for other steps, or where no agent is valid at the current one, and a :class:`NotFiniteError` that names the
    segment where a network of the agent returns a number that is not finite.
    """
    if agent.policy is None:
        raise ConfigError("log playback knows the future and can't be simulated")
    if agent.name == "constant_velocity" and agent.plan(settings.config(1, 0)).kind == "none":  # people, too
        return constant_velocity(segment, settings.future)
    rows, held = _present(segment), standing(segment)
    segment = segment.replace(velocity=np.where(held[:, None, None], np.float32(0), segment.velocity))
    dt = DT if agent.spec is None else agent.spec.dt
    settings = settings if agent.spec else replace(settings, pace=0.0)  # baselines are as they are
    start = history_only(segment, dt, settings.future)
    is_vehicle = start.agent_type == AgentType.VEHICLE
    graph = LaneGraph(start.road)
    edge = map_edge(graph)
    driven = is_vehicle & ~held[rows] & ~beyond(start.position[:, 0, :2], edge)
    vehicles, people = np.flatnonzero(driven), np.flatnonzero(~is_vehicle)
    states = _extrapolated(segment, rows, settings.future)
    states[:, people] = walks(segment, rows[people], ROLLOUTS, settings.future, settings.seed)
    if len(vehicles):
        try:
            log = future_log(segment) if settings.logged_goals else None
            found = _driven(agent, start, vehicles, settings, graph, edge, log)
            states[:, vehicles] = between_decisions(found, dt, settings.future)
        except NotFiniteError as error:
            raise error.named(segment.segment_id) from error
    return _rollouts(segment, rows, states)


def constant_velocity(segment: RunSegment, future: int = FUTURE) -> SimulatedRollouts:
    """Return 32 equal rollouts of all agents at the velocity and heading of the current step.

    Raises a :class:`DataError` as :func:`wosac_rollouts` does.
    """
    rows = _present(segment)
    return _rollouts(segment, rows, _extrapolated(segment, rows, future))


def simulated_scenarios(
    agent: Agent, data: Path, settings: WosacSettings, progress: Callable[[int], None] = lambda done: None
) -> Iterator[tuple[str, SimulatedRollouts]]:
    """Yield id and rollouts of every WOMD scenario of a file, folder or pattern, of all agents, odd ones included.

    Raises a :class:`DataError` where a record can't be used; names file, scenario and field.
    """
    work = partial(_simulated, agent, settings)
    with closing(shared(work, read_scenarios(data), settings.config(1, 0))) as results:
        for done, found in enumerate(results, 1):
            yield found
            progress(done)


def _simulated(
    agent: Agent, settings: WosacSettings, packed: tuple[Path, int, bytes]
) -> tuple[str, SimulatedRollouts]:
    file, record, payload = packed
    scenario = parse_scenario(payload, file, record)
    try:
        check_times(scenario, CURRENT + 1)
        # What comes later decides nothing, such as which part of a track that jumps is odd.
        for timed in (scenario.dynamic_map_states, *(track.states for track in scenario.tracks)):
            del timed[CURRENT + 1 :]
        # As in the score, a step is 0.1 s however recordings jitter: no other step, no states in between.
        scenario.timestamps_seconds[:] = DT * np.arange(CURRENT + 1)
        whole = scenario_to_segment(scenario, file=file.name)
        found = wosac_rollouts(agent, validate(mended(whole)), settings)
        return scenario.scenario_id, with_the_rest(found, whole)
    except DataError as error:
        raise error.at(file=file, segment=scenario.scenario_id) from None


def with_the_rest(found: SimulatedRollouts, segment: RunSegment) -> SimulatedRollouts:
    """Return rollouts of all agents in a segment, as a submission must hold them: agents that were left out as odd go
    on at their velocity. Raises a :class:`DataError` where a state of theirs at the current step is not finite.
    """
    now = segment.current_step
    rest = np.asarray(segment.valid[:, now] & ~np.isin(segment.agent_id, found.object_id))
    if not rest.any():
        return found
    logged = [getattr(segment, name)[rest, now] for name in ("position", "heading", "velocity")]
    if not all(np.isfinite(values).all() for values in logged):
        raise DataError("not finite at the current step", segment=segment.segment_id, field="tracks.states")
    more = constant_velocity(segment.replace(valid=segment.valid & rest[:, None]), found.x.shape[-1])
    joined = {name: np.concatenate([getattr(found, name), getattr(more, name)], 1) for name in STATES}
    return SimulatedRollouts(np.concatenate([found.object_id, more.object_id]), **joined)


def history_only(segment: RunSegment, dt: float, future: int = FUTURE) -> RunSegment:
    """Return what a simulator may know, as a segment to drive in, with steps of ``dt`` seconds: it begins with the
    current step, all agents that are valid then go on at constant velocity, and lights keep their latest state;
    those without one, which the log may show later, are not there.
    """
    rows, now, shown = _present(segment), segment.current_step, _latest(segment)
    lights = shown != SignalState.UNKNOWN
    steps = math.ceil(future * DT / dt - 1e-6) + 1
    path = np.repeat(segment.position[rows, now, None].astype(np.float64), steps, 1)
    path[..., :2] += segment.velocity[rows, now, None] * (np.arange(steps) * dt)[:, None]
    return _from_now_on(
        segment,
        rows,
        dt=dt,
        position=path.astype(np.float32),
        heading=np.repeat(segment.heading[rows, now, None], steps, 1),
        velocity=np.repeat(segment.velocity[rows, now, None], steps, 1),
        valid=np.ones((len(rows), steps), bool),
        signal_lane=segment.signal_lane[lights],
        signal_point=segment.signal_point[lights],
        signal_state=np.repeat(shown[lights, None], steps, 1),
    )


def future_log(segment: RunSegment) -> RunSegment:
    """Return the log from the current step on of agents valid then, in the rows of :func:`history_only`."""
    rows, now = _present(segment), segment.current_step
    states = {name: getattr(segment, name)[rows, now:] for name in _TIMED}
    return _from_now_on(segment, rows, signal_state=segment.signal_state[:, now:], **states)


def _from_now_on(segment: RunSegment, rows: NDArray[np.int64], **changes: Any) -> RunSegment:
    """Return some agents of a segment; its ego, not always one of them, and its marks decide nothing here."""
    kept = {name: getattr(segment, name)[rows] for name in ("agent_id", "agent_type", "size")}
    none = np.zeros(0, np.int32)
    return segment.replace(ego=0, current_step=0, interest=none, predict=none, **kept, **changes)


def between_decisions(states: Doubles, dt: float, future: int = FUTURE) -> Doubles:
    """Return [R, N, F, 3] x, y, heading at 10 Hz from states [R, U, N, 3] every ``dt`` s, the first at present."""
    where = np.arange(1, future + 1) * DT / dt
    before = np.floor(where + 1e-6).astype(np.int64)
    share = np.where(where - before < 1e-6, 0.0, where - before)[:, None]
    after = np.where(share[:, 0] > 0, before + 1, before)
    first, second = states[:, before], states[:, after]
    place = first[..., :2] + share[..., None] * (second[..., :2] - first[..., :2])
    heading = wrap(first[..., 2] + share * wrap(second[..., 2] - first[..., 2]))
    return np.concatenate([place, heading[..., None]], -1).swapaxes(1, 2)


def _present(segment: RunSegment) -> NDArray[np.int64]:
    """Return [n] rows of the agents that are valid at the current step."""
    rows = np.flatnonzero(segment.valid[:, segment.current_step])
    for wrong, message, field in (
        (abs(segment.dt - DT) > 1e-6, f"has steps of {segment.dt:g} s, needs {DT:g}", "dt"),
        (segment.current_step != CURRENT, f"is {segment.current_step}, needs {CURRENT}", "current_step"),
        (len(rows) == 0, f"no agent at step {CURRENT}", "valid"),
    ):
        if wrong:
            raise DataError(message, file=segment.file or None, segment=segment.segment_id, field=field)
    return rows


def _extrapolated(segment: RunSegment, rows: NDArray[np.int64], future: int) -> Doubles:
    """Return [R, n, F, 3] x, y, heading at constant velocity."""
    now = segment.current_step
    place = segment.position[rows, now, None, :2].astype(np.float64)
    path = place + segment.velocity[rows, now, None] * (np.arange(1, future + 1) * DT)[:, None]
    heading = np.repeat(wrap(segment.heading[rows, now, None].astype(np.float64)), future, 1)
    return np.repeat(np.concatenate([path, heading[..., None]], -1)[None], ROLLOUTS, 0)


def _driven(
    agent: Agent,
    start: RunSegment,
    vehicles: NDArray[np.int64],
    settings: WosacSettings,
    graph: LaneGraph,
    edge: MapEdge,
    log: RunSegment | None,
) -> Doubles:
    """Return [R, U, N, 3] x, y, heading of the vehicles; on the routes of the log, where there is one."""
    scenes = scene(start, vehicles.tolist(), graph if agent.routed else None, edge=edge)
    if agent.routed and log is not None:
        # The first state is the same, so the routes are; which of them was taken is for the log to say.
        taken = [route_table(log, graph, int(row)).logged for row in vehicles]
        scenes.route_logged = torch.tensor([taken])
    scenes = scenes.to(torch.device(settings.device))
    one = agent.plan(settings.config(1, 0))
    if one.kind == "none":
        # What a rule drives is alike in all of them.
        plans = [settings.config(1 if agent.rule else ROLLOUTS, settings.seed)]
    else:
        # All branches of all trees together would take gigabytes.
        trees = max(AT_ONCE // (one.branches * len(vehicles)), 1)
        plans = [
            settings.config(min(trees, ROLLOUTS - first), settings.seed * ROLLOUTS + first)
            for first in range(0, ROLLOUTS, trees)
        ]
    found = [_gone_on(simulation(agent, scenes, plan).rollouts.cpu(), start.dt) for plan in plans]
    states = torch.cat(found).double().numpy()
    return np.repeat(states, ROLLOUTS // len(states), 0)


def _gone_on(found: Rollouts, dt: float) -> Tensor:
    """Return states [R, U, N, 3] of the one scene of rollouts: those that left the map keep their velocity."""
    state, steps = found.state[0], torch.arange(found.state.shape[2])[:, None]
    last = found.counted[0].sum(1, keepdim=True)  # [R, 1, N] the last decision at which each is present
    x, y, heading, speed = state.take_along_dim(last.minimum(steps)[..., None], 1).unbind(-1)
    away = speed * dt * (steps - last).clamp_min(0)
    return torch.stack([x + away * heading.cos(), y + away * heading.sin(), heading], -1)


def _rollouts(segment: RunSegment, rows: NDArray[np.int64], states: Doubles) -> SimulatedRollouts:
    """Return states [32, n, F, 3] of the segment's frame in that of the log."""
    z = segment.position[rows, segment.current_step, 2].astype(np.float64) + segment.origin[2]
    return SimulatedRollouts(
        object_id=segment.agent_id[rows],
        x=states[..., 0] + segment.origin[0],
        y=states[..., 1] + segment.origin[1],
        z=np.broadcast_to(z[:, None], states.shape[:-1]).copy(),
        heading=states[..., 2],
    )
