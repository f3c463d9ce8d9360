"""Run segments that go on past the end of their log: vehicles enter at the edges of the map, lights change.

Legend: A agents, T logged steps, U steps in all, L entrance lanes, V vehicles that enter. Metres, seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from symphony.data.segment import MAX_STATES, MAX_STEPS, STATES, AgentType, RunSegment
from symphony.data.selection import MOVING, travel
from symphony.envs.scene import beyond, map_edge
from symphony.errors import DataError
from symphony.metrics.kinds import STANDING
from symphony.roadgraph import LaneGraph, lane_of
from symphony.roadgraph.graph import turn_between
from symphony.rollouts.lights import continued
from symphony.streams import Stream, fold_in, stream_of, uniform

Reals = NDArray[np.float64]
Indices = NDArray[np.int64]

NEAR, TURN = 50.0, math.pi / 3
"""Metres from where an entrance lane begins, and largest angle to it, within which a vehicle came in by it."""
PRIOR = 10.0  # seconds of the log for which the mean rate of all entrances of a map counts at each of them
USUAL = 8.0  # speed in m/s of those that enter where none drives in the log, if the lane has no lower limit
MOST_ENTER = 512  # vehicles that enter a run segment past its log, at most


@dataclass(frozen=True)
class Onward:
    """Traffic past the end of the log: vehicles per second that want to enter on each entrance lane, None for the
    rates of :func:`entry_rates`; seconds of green, amber and all red of each phase of the lights, none to go on as
    :func:`symphony.rollouts.lights.continued` does; the seed of what is drawn.
    """

    inflow: float | None = None
    lights: tuple[float, ...] = ()
    seed: int = 0

    def extended(self, segment: RunSegment, graph: LaneGraph, steps: int, *, enter: bool = True) -> RunSegment:
        """Return a segment of U ``steps``, the first T of which are those of the log (``logged``).

        After the log, only agents that stood in one place throughout are seen, at that place; all others leave or are
        driven. With ``enter``, new vehicles become rows after those of the log. Each is valid at a single step: where
        and when it may first enter, by a Bernoulli draw for every step and lane. Its size is that of a logged
        vehicle, its speed that of one that came in by the same lane, or drives on the map. All is drawn from seed and
        segment, so that planners that are compared meet the same demand. So do rollouts: they share the rows of their
        scene, as all rows are compared with each other, and demand of their own would multiply them.

        Raises:
            DataError: more than :data:`MOST_ENTER` vehicles would enter, or there would be more than can be kept.
        """
        if steps > (most := min(MAX_STEPS, MAX_STATES // segment.num_agents)):
            why = f"would have {steps} steps, at most {most} can be kept: simulate a shorter time"
            raise DataError(why, segment=segment.segment_id, field="valid")
        more, last = steps - segment.num_steps, segment.num_steps - 1
        stays = segment.valid[:, last] & (travel(segment) <= MOVING)
        stays &= np.linalg.norm(segment.velocity[:, last], axis=-1) <= STANDING
        fields: dict[str, Any] = {"signal_state": continued(segment, graph, steps, self.lights)}
        for name in STATES:
            part = getattr(segment, name)
            held = (stays & (name != "velocity")).reshape(-1, *(1,) * (part.ndim - 2))
            kept = np.where(held, part[:, last], 0).astype(part.dtype)
            fields[name] = np.concatenate([part, np.repeat(kept[:, None], more, 1)], 1)
        longer = segment.replace(**fields, logged=segment.num_steps)
        return self._entered(segment, longer, graph) if enter and self.inflow != 0 else longer

    def _entered(self, log: RunSegment, longer: RunSegment, graph: LaneGraph) -> RunSegment:
        lanes, first = entrances(graph), log.num_steps
        came, by = _came_in(log, graph, lanes)
        rates = entry_rates(log, graph) if self.inflow is None else np.full(len(lanes), self.inflow)
        stream = fold_in(torch.tensor(stream_of(log.segment_id)), Stream.ENTRIES)
        # A lane keeps its numbers whatever the others are, and a step its own however long the segment becomes.
        stream = fold_in(stream, torch.from_numpy(lanes))[:, None]
        numbers = [fold_in(stream, use) for use in range(3)]
        step = torch.arange(first, longer.num_steps)
        arrives, which, pace = (uniform(self.seed, each, step).numpy() for each in numbers)
        at, lane = np.nonzero((arrives < rates[:, None] * log.dt).T)
        if len(at) > (most := min(MOST_ENTER, MAX_STATES // longer.num_steps - log.num_agents)):
            why = f"{len(at)} vehicles would enter past its log, at most {most} can: simulate a shorter time"
            raise DataError(why, segment=log.segment_id, field="agents")
        if not len(at):
            return longer
        which, pace = which[lane, at], pace[lane, at]
        vehicles = np.flatnonzero(log.agent_type == AgentType.VEHICLE)
        size = log.size[vehicles if len(vehicles) else [log.ego]]
        size = size[(which * len(size)).astype(np.int64)]
        place, heading = _beginnings(log, graph, lanes[lane], size)
        speed = np.array([_pace(log, graph, lanes[k], came[by == k], u) for k, u in zip(lane, pace, strict=True)])
        count, base = len(at), log.num_agents
        fields: dict[str, Any] = {"agent_id": log.agent_id.max() + 1 + np.arange(count), "size": size}
        fields["agent_type"] = np.full(count, AgentType.VEHICLE)
        found: dict[str, Any] = {
            name: np.concatenate([getattr(log, name), value.astype(getattr(log, name).dtype)])
            for name, value in fields.items()
        }
        way = np.stack([np.cos(heading), np.sin(heading)], -1)
        values = {"position": place, "heading": heading, "velocity": speed[:, None] * way, "valid": True}
        for name, value in values.items():
            old = getattr(longer, name)
            found[name] = np.concatenate([old, np.zeros((count, *old.shape[1:]), old.dtype)])
            found[name][base + np.arange(count), first + at] = value
        return longer.replace(**found)


def entrances(graph: LaneGraph) -> Indices:
    """Return the [L] lanes by which vehicles come onto the map.

    Neither such a lane nor a lane beside it has a predecessor: one that begins beside others, as a turn pocket does,
    is reached by a lane change. Of several that begin at one place it is the first.
    """
    found: dict[tuple[float, ...], int] = {}
    for lane in graph.usable_lanes.tolist():
        together = (lane, *graph.left[lane], *graph.right[lane])
        if not any(graph.predecessors[other] for other in together):
            found.setdefault(tuple(np.rint(graph.lines[lane][0]).tolist()), lane)
    return np.array(list(found.values()), np.int64)


def entry_rates(segment: RunSegment, graph: LaneGraph) -> Reals:
    """Return vehicles [L] per second that came in by each of the :func:`entrances` of a log.

    Counted are vehicles first seen after the first step, within :data:`NEAR` metres of where a lane begins. Where
    none came in at all, as in logs of vehicles that are present throughout, the flow on the entrance lanes takes
    their place: metres driven on a lane in terms of its length (Edie, 1963). The mean over lanes has half a vehicle
    more (Jeffreys' prior), and counts for :data:`PRIOR` seconds at each lane.
    """
    lanes, seconds = entrances(graph), (segment.num_steps - 1) * segment.dt
    count = np.bincount(_came_in(segment, graph, lanes)[1], minlength=len(lanes)).astype(np.float64)
    if not count.any():
        who, step = np.nonzero(segment.valid[:, :-1] & (segment.agent_type == AgentType.VEHICLE)[:, None])
        lane = lane_of(graph, segment.position[who, step, :2], segment.heading[who, step])
        driven = np.linalg.norm(segment.velocity[who, step].astype(np.float64), axis=-1) * segment.dt
        whole = np.bincount(lane[lane >= 0], driven[lane >= 0], len(graph))
        count = whole[lanes] / graph.length[lanes]
    mean = (count.sum() + 0.5) / (max(len(lanes), 1) * seconds)
    return (count + PRIOR * mean) / (seconds + PRIOR)


def _came_in(segment: RunSegment, graph: LaneGraph, lanes: Indices) -> tuple[Indices, Indices]:
    """Return the vehicles that came in by some of L lanes, and by which."""
    there = segment.valid & ~beyond(segment.position[..., :2], map_edge(graph))
    who = np.flatnonzero((segment.agent_type == AgentType.VEHICLE) & there.any(1) & ~there[:, 0])
    if not len(who) or not len(lanes):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    first = there[who].argmax(1)
    begin = np.array([graph.lines[lane][0] for lane in lanes])
    away = np.linalg.norm(segment.position[who, first, None, :2] - begin, axis=-1)
    turn = turn_between(segment.heading[who, first, None].astype(np.float64), graph.start_heading[lanes])
    away = np.where(turn <= TURN, away, np.inf)
    near = away.min(1) <= NEAR
    return who[near], away.argmin(1)[near]


def _pace(log: RunSegment, graph: LaneGraph, lane: int, came: Indices, number: float) -> float:
    """Return a speed for a vehicle that enters: of one of those that came in by its lane, or of one that drives."""
    seen, first = np.linalg.norm(log.velocity, axis=-1), log.valid.argmax(1)
    speeds = seen[came, first[came]]
    if not (speeds := speeds[speeds > STANDING]).size:
        speeds = seen[log.valid & (log.agent_type == AgentType.VEHICLE)[:, None] & (seen > STANDING)]
    limit = log.road.speed_limit[lane]
    speed = float(speeds[int(number * len(speeds))]) if speeds.size else USUAL
    return speed if np.isnan(limit) else min(speed, float(limit))


def _beginnings(log: RunSegment, graph: LaneGraph, lanes: Indices, size: Any) -> tuple[Reals, Reals]:
    """Return centres [V, 3] and headings [V] of boxes whose rears are where their lanes begin, or a little ahead."""
    place, heading = np.zeros((len(lanes), 3)), np.zeros(len(lanes))
    for k, lane in enumerate(lanes.tolist()):
        line, arc = log.road.lanes[lane].astype(np.float64), graph.arc[lane]
        at = min(0.5 * float(size[k, 0]), float(graph.length[lane]))
        piece = min(int(np.searchsorted(arc, at, side="right")), len(arc) - 1)
        ahead = np.diff(graph.lines[lane][piece - 1 : piece + 1], axis=0)[0]
        step = np.append(0.0, np.hypot(*np.diff(line[:, :2], axis=0).T).cumsum())
        place[k] = [np.interp(at, step, part) for part in line.T]
        place[k, 2] += 0.5 * size[k, 2]
        heading[k] = math.atan2(ahead[1], ahead[0])
    return place, heading
