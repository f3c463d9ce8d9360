"""Driving more of a run segment than the pair of the paper: many or all of its vehicles.

Legend: A agents of a segment, N driven ones.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.agents import Agent
from symphony.config import EvaluateConfig
from symphony.config.evaluation import MOST, TOGETHER, SimulateConfig
from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import MOVING, interactive_choice, named_vehicles, travel
from symphony.data.store import SegmentStore
from symphony.envs.routes import route_table
from symphony.envs.scene import SceneBatch, beyond, map_edge, scene
from symphony.errors import ConfigError, DataError, DataWarning
from symphony.learning.demonstrations import SceneDataset
from symphony.learning.experts import IN_LANE
from symphony.roadgraph import LaneGraph, lane_of
from symphony.rollouts.onward import Onward

Indices = NDArray[np.int64]
PAIR = 2
"""Agents that are driven wherever they are: the ego and its partner."""


@dataclass(frozen=True)
class Crowd:
    """Which agents of a segment are driven: at most ``count`` that move or, with ``everyone``, also stand in a lane.
    Those beyond the first two must come within ``radius`` metres of the ego in the log (0 for no limit). In open
    traffic they enter and leave. With a ``background``, a rule drives the other vehicles, up to :data:`MOST` agents
    in all; with ``along_routes``, vehicles that are on no lane play back the log instead. Ids in ``also`` are driven
    in addition, right after the ego. ``onward`` says how traffic goes on if the log is too short: vehicles enter only
    if the agent drives everyone, these included, or a background's rule drives them.
    """

    count: int
    everyone: bool = False
    radius: float = 0.0
    open_traffic: bool = False
    background: bool = False
    along_routes: bool = False
    also: tuple[int, ...] = ()
    onward: Onward | None = None

    def choose(self, segment: RunSegment, graph: LaneGraph) -> tuple[Indices, Indices]:
        """Return rows of A: those that the agent drives, the ego first, and background agents.

        Those present at the first step come in the order of :func:`symphony.data.selection.interactive_choice`, then
        those that stand in a lane, by their distance; in open traffic then later ones, by time, then distance.

        Raises:
            DataError: the ego or one of those is absent at first, or in open traffic the ego never on the map.
        """
        there = segment.valid
        if self.open_traffic:
            there = there & ~beyond(segment.position[..., :2], map_edge(graph))
        early = interactive_choice(segment, segment.num_agents, fewer=True).agents
        if not there[segment.ego].any():
            raise DataError("the ego is never within the map", segment=segment.segment_id, field="ego")
        early = early[there[early].any(1)]
        order = [*early[:PAIR], *early[PAIR:][self._near(segment, early[PAIR:])]]
        order = list(dict.fromkeys([*order[:1], *named_vehicles(segment, self.also), *order]))
        count = self.count + len(self.also)
        if len(order) >= count and not self.background:
            return np.array(order[:count], np.int64), np.zeros(0, np.int64)
        vehicle, moves = (segment.agent_type == AgentType.VEHICLE) & there.any(1), travel(segment) > MOVING
        stands = vehicle & ~moves & _in_lane(segment, graph)
        first = there.argmax(1)
        rest = np.setdiff1d(np.flatnonzero((vehicle & moves) | stands), [*early, *order])
        rest = rest[np.lexsort((_distance_at(segment, first)[rest], stands[rest], first[rest]))]
        if not self.open_traffic:
            rest = rest[(first[rest] == 0) & stands[rest]]
        rest = rest[self._near(segment, rest)]
        driven = np.array([*order, *(rest if self.everyone else rest[moves[rest]])], np.int64)[:count]
        if not self.background:
            return driven, np.zeros(0, np.int64)
        others = [agent for agent in (*order, *rest) if agent not in driven]
        if self.along_routes:
            has = (route_table(segment, graph, int(agent), int(first[agent])).logged >= 0 for agent in others)
            others = list(itertools.compress(others, has))
        return driven, np.array(others[: MOST - len(driven)], np.int64)

    def _near(self, segment: RunSegment, rows: Indices) -> NDArray[np.bool_]:
        """Return [K] whether agents come near the ego's log at some step that has both."""
        if not self.radius:
            return np.ones(len(rows), bool)
        delta = segment.position[rows, :, :2] - segment.position[segment.ego, :, :2]
        both = segment.valid[rows] & segment.valid[segment.ego]
        return (both & (np.linalg.norm(delta, axis=-1) <= self.radius)).any(1)


class CrowdDataset(SceneDataset):
    """Scenes in which a :class:`Crowd` is driven, of any size; other arguments are those of :class:`SceneDataset`."""

    def __init__(self, store: SegmentStore, crowd: Crowd, *given: Any, routes: bool = False, **named: Any) -> None:
        super().__init__(store, crowd.count, *given, routes=routes or crowd.along_routes, **named)
        self.crowd = crowd

    @property
    def open_traffic(self) -> bool:
        """Whether agents enter and leave."""
        return self.crowd.open_traffic

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(CrowdDataset, **self._how), (self.store, self.crowd, self.dynamics, self.indices)

    def segment(self, i: int) -> RunSegment:
        """Return the run segment behind item ``i``, up to the duration, if need be past its log."""
        segment, crowd = self.store[self.indices[i]], self.crowd
        steps = round(self.duration / segment.dt) + 1
        if crowd.onward is None or segment.num_steps >= steps:
            return super().segment(i)
        enter = crowd.everyone or crowd.background
        return crowd.onward.extended(segment, self.graph(i), steps, enter=enter)

    def _scene(self, i: int) -> SceneBatch:
        segment, graph = self.segment(i), self.graph(i)
        log = self.store[self.indices[i]] if segment.logged else segment
        driven, background = self.crowd.choose(log, graph)
        later = np.arange(log.num_agents, segment.num_agents)
        driven = np.append(driven, later[: len(later) * self.crowd.everyone])
        background = np.append(background, later[len(later) * self.crowd.everyone :])
        return scene(
            segment,
            np.concatenate([driven, background]).tolist(),
            graph if self.routes else None,
            number=i,
            edge=map_edge(graph) if self.crowd.open_traffic else None,
            background=np.arange(len(driven) + len(background)) >= len(driven),
        )


def crowd_dataset(
    store: SegmentStore,
    agent: Agent,
    config: EvaluateConfig,
    indices: Sequence[int] | None = None,
    *,
    default: int | None = None,
    routes: bool = False,
    also: Sequence[int] = (),
) -> CrowdDataset:
    """Return the scenes that a configuration asks for, of all or some rows of a store; a :class:`DataWarning` says if
    the store is unfinished. The number of interactive agents, if the configuration leaves it open, is ``default`` or
    that of training. ``routes`` asks for routes even if the agent follows none; ``also`` is as for :class:`Crowd`.
    """
    if store.unfinished is not None:
        warnings.warn(f"{store.path} {store.unfinished}", DataWarning, stacklevel=2)
    everyone, rule = config.interactive == "all", config.others != "log"
    count = MOST if config.interactive == "all" else config.interactive or default or agent.interactive
    in_open, onward = config.open_traffic or everyone or rule, None
    if isinstance(config, SimulateConfig):
        in_open = in_open or config.after_collision in ("remove", "respawn")
        if config.inflow and not (everyone or rule):
            raise ConfigError("--inflow needs --interactive all or --others: nobody drives those who enter")
        # Vehicles without a driver don't enter.
        inflow = config.inflow if rule or agent.policy is not None else 0.0
        onward = Onward(inflow, config.lights, config.seed) if config.duration and in_open else None
        if onward is None and (config.inflow or config.lights):
            raise ConfigError("--inflow and --lights are for open traffic beyond the log: see --duration")
    crowd = Crowd(count, everyone, config.radius, in_open, rule, config.others == "idm", tuple(also), onward)
    seconds, keep = config.duration or agent.duration, config.batch or TOGETHER
    routes = agent.routed or routes
    return CrowdDataset(store, crowd, agent.dynamics, indices, routes=routes, duration=seconds, keep=keep)


def _in_lane(segment: RunSegment, graph: LaneGraph) -> NDArray[np.bool_]:
    """Return [A] whether an agent is first seen in a lane: there it waits, elsewhere it is parked."""
    everyone, first = np.arange(segment.num_agents), segment.valid.argmax(1)
    position, heading = segment.position[everyone, first, :2], segment.heading[everyone, first]
    return lane_of(graph, position, heading, tolerance=IN_LANE) >= 0


def _distance_at(segment: RunSegment, step: Indices) -> NDArray[np.floating[Any]]:
    """Return [A] metres from the ego at a step of each; from where it was last, if it is not seen then."""
    last = np.maximum.accumulate(np.where(segment.valid[segment.ego], np.arange(segment.num_steps), 0))[step]
    own = segment.position[np.arange(segment.num_agents), step, :2]
    return np.linalg.norm(own - segment.position[segment.ego, last, :2], axis=-1)
