"""Who is driven in a run segment beyond the pair of the paper: many or all of its vehicles.

Legend: A agents of a segment, N driven ones.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.agents import Agent
from symphony.config import EvaluateConfig
from symphony.config.evaluation import MOST, TOGETHER
from symphony.data.segment import AgentType, RunSegment
from symphony.data.selection import MOVING, interactive_choice, travel
from symphony.data.store import SegmentStore
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.edge import beyond, map_edge
from symphony.envs.routes import route_table
from symphony.envs.scene import SceneBatch, scene
from symphony.errors import DataError, DataWarning
from symphony.learning.demonstrations import SceneDataset
from symphony.learning.experts import IN_LANE
from symphony.roadgraph import LaneGraph, lane_of

Indices = NDArray[np.int64]
PAIR = 2
"""Agents that are driven wherever they are: the ego and its partner."""


@dataclass(frozen=True)
class Crowd:
    """Which agents of a segment are driven.

    Attributes:
        count: by the agent, at most.
        everyone: not only those that move: also vehicles that stand in a lane.
        radius: metres from the ego within which those beyond :data:`PAIR` must come in the log; 0 for no limit.
        open_traffic: whether they enter and leave.
        background: whether the other vehicles are driven, too, by a rule; up to :data:`MOST` with the others.
        along_routes: whether that rule needs a route; vehicles that are on no lane then play back the log.
    """

    count: int
    everyone: bool = False
    radius: float = 0.0
    open_traffic: bool = False
    background: bool = False
    along_routes: bool = False

    @classmethod
    def of(cls, config: EvaluateConfig, default: int) -> Crowd:
        """As an evaluation asks for it, ``default`` agents if it leaves that to the agent."""
        everyone, rule = config.interactive == "all", config.others != "log"
        return cls(
            count=MOST if config.interactive == "all" else config.interactive or default,
            everyone=everyone,
            radius=config.radius,
            open_traffic=config.open_traffic or everyone or rule,
            background=rule,
            along_routes=config.others == "idm",
        )

    def choose(self, segment: RunSegment, graph: LaneGraph) -> tuple[Indices, Indices]:
        """Rows of A: those that the agent drives, the ego first, and background agents.

        Those there at the first step come in the order of :func:`symphony.data.selection.interactive_choice`, then
        those that stand in a lane, by their distance; in open traffic then those that come later, by their time and
        then by their distance.

        Raises:
            DataError: the ego is not seen at the first step, or in open traffic never within the map.
        """
        there = segment.valid
        if self.open_traffic:
            there = there & ~beyond(segment.position[..., :2], map_edge(graph))
        early = interactive_choice(segment, segment.num_agents, fewer=True).agents
        if not there[segment.ego].any():
            raise DataError("the ego is never within the map", segment=segment.segment_id, field="ego")
        early = early[there[early].any(1)]
        order = [*early[:PAIR], *early[PAIR:][self._near(segment, early[PAIR:])]]
        if len(order) >= self.count and not self.background:
            return np.array(order[: self.count], np.int64), np.zeros(0, np.int64)
        moves = (segment.agent_type == AgentType.VEHICLE) & there.any(1) & (travel(segment) > MOVING)
        stands = (segment.agent_type == AgentType.VEHICLE) & there.any(1) & ~moves & _in_lane(segment, graph)
        first = there.argmax(1)
        away = _distance_at(segment, first)
        rest = np.setdiff1d(np.flatnonzero(moves | stands), early)
        rest = rest[np.lexsort((away[rest], stands[rest], first[rest]))]
        if not self.open_traffic:
            rest = rest[(first[rest] == 0) & stands[rest]]
        rest = rest[self._near(segment, rest)]
        wanted = rest if self.everyone else rest[moves[rest]]
        driven = np.array([*order, *wanted], np.int64)[: self.count]
        if not self.background:
            return driven, np.zeros(0, np.int64)
        others = np.array([a for a in (*order, *rest) if a not in driven], np.int64)
        if self.along_routes:
            on_route = [route_table(segment, graph, int(a), int(first[a])).logged >= 0 for a in others]
            others = others[np.array(on_route, bool)]
        return driven, others[: MOST - len(driven)]

    def _near(self, segment: RunSegment, rows: Indices) -> NDArray[np.bool_]:
        """[K] whether agents come near the ego's log at some step that has both."""
        if not self.radius:
            return np.ones(len(rows), bool)
        delta = segment.position[rows, :, :2] - segment.position[segment.ego, :, :2]
        both = segment.valid[rows] & segment.valid[segment.ego]
        return (both & (np.linalg.norm(delta, axis=-1) <= self.radius)).any(1)


class CrowdDataset(SceneDataset):
    """Scenes in which a :class:`Crowd` is driven, whatever number that is in each.

    Args:
        store: the run segments.
        crowd: which of their agents.
        dynamics: as of :class:`SceneDataset`, like the others.
        indices: see there.
        routes: see there.
        duration: see there.
        keep: see there.
    """

    def __init__(
        self,
        store: SegmentStore,
        crowd: Crowd,
        dynamics: Bicycle | Displacement | None = None,
        indices: Sequence[int] | None = None,
        *,
        routes: bool = False,
        duration: float = 0,
        keep: int | None = None,
    ) -> None:
        routes = routes or crowd.along_routes
        super().__init__(store, crowd.count, dynamics, indices, routes=routes, duration=duration, keep=keep)
        self.crowd = crowd

    @property
    def open_traffic(self) -> bool:
        """Whether agents enter and leave."""
        return self.crowd.open_traffic

    def __reduce__(self) -> tuple[Any, ...]:
        build = partial(CrowdDataset, routes=self.routes, duration=self.duration, keep=self.keep)
        return build, (self.store, self.crowd, self.dynamics, self.indices)

    def _scene(self, i: int) -> SceneBatch:
        segment, graph = self.segment(i), self.graph(i)
        driven, background = self.crowd.choose(segment, graph)
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
) -> CrowdDataset:
    """The scenes that a configuration asks for.

    Args:
        store: the run segments.
        agent: that drives.
        config: how many, how long.
        indices: rows of the store; all by default.
        default: interactive agents where the configuration leaves that open; by default as many as it was trained
            with.
        routes: whether scenes come with routes even if the agent follows none.

    Warns:
        DataWarning: if the store's generation is not finished.
    """
    if store.unfinished is not None:
        warnings.warn(f"{store.path} {store.unfinished}", DataWarning, stacklevel=2)
    return CrowdDataset(
        store,
        Crowd.of(config, agent.interactive if default is None else default),
        agent.dynamics,
        indices,
        routes=agent.routed or routes,
        duration=config.duration or agent.duration,
        keep=config.batch or TOGETHER,
    )


def _in_lane(segment: RunSegment, graph: LaneGraph) -> NDArray[np.bool_]:
    """[A] whether an agent is first seen in a lane: there it waits, elsewhere it is parked."""
    everyone, first = np.arange(segment.num_agents), segment.valid.argmax(1)
    position, heading = segment.position[everyone, first, :2], segment.heading[everyone, first]
    return lane_of(graph, position, heading, tolerance=IN_LANE) >= 0


def _distance_at(segment: RunSegment, step: Indices) -> NDArray[np.floating[Any]]:
    """[A] metres from the ego at a step of each; from where it was last, if it is not seen then."""
    last = np.maximum.accumulate(np.where(segment.valid[segment.ego], np.arange(segment.num_steps), 0))[step]
    everyone = np.arange(segment.num_agents)
    return np.linalg.norm(
        segment.position[everyone, step, :2] - segment.position[segment.ego, last, :2], axis=-1
    )
