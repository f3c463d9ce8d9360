"""The input of the score: a logged scenario and rollouts of it, as plain arrays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.errors import DataError
from symphony.wosac.scorer.config import CURRENT, FUTURE

VEHICLE = 1  # object type of vehicles
SURFACE_STREET = 2  # type of the lanes that count for traffic lights
STATES = ("x", "y", "z", "heading")
_NAMED = 10  # agents named in an error

Ints = NDArray[np.integer[Any]]
Reals = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class WosacScenario:
    """A logged scenario of 91 steps of 0.1 s; step 10 is the last that a simulator may know.

    World frame and headings as logged: part of the score depends on where the origin is and on headings that are not
    brought into one turn. States that are not valid hold whatever the log holds there.

    Raises a :class:`DataError` where it can't be scored; names scenario, field and agent.
    """

    scenario_id: str  # its id
    object_id: Ints  # [A] of all tracks
    object_type: Ints  # [A] 1 vehicle, 2 pedestrian, 3 cyclist, 4 other
    position: Reals  # [A, 91, 3] box centres, metres
    heading: Reals  # [A, 91] radians
    size: Reals  # [A, 3] length, width and height at step 10, metres
    valid: NDArray[np.bool_]  # [A, 91]
    evaluated: Ints  # [E] ids of the objects that are scored: the recording vehicle and those to predict
    #: arrays [P, 3], metres: boundaries of the drivable area, which is on their left
    road_edges: Sequence[Reals]
    lanes: Sequence[Reals]  # arrays [P, 3], metres: centre lines of K lanes
    lane_id: Ints  # [K]
    lane_type: Ints  # [K] 2 is a lane of a surface street
    signal_step: Ints  # [M] step of each observation of a traffic light
    signal_lane: Ints  # [M] id of the lane it is for
    signal_state: Ints  # [M] 1 and 4 are red (arrow stop, stop)
    signal_point: Reals  # [M, 2] where to stop, metres
    #: steps after step 10, all of which are simulated and scored; the challenge's 80, or fewer for logs that
    #: are shorter. "91" above and in what is made of a scenario is 11 more than this.
    future: int = FUTURE

    def __post_init__(self) -> None:
        def demand(good: Any, field: str, message: str) -> None:
            if not np.all(good):
                raise DataError(message, segment=self.scenario_id, field=field)

        ids, count = np.unique(self.object_id, return_counts=True)
        demand(count == 1, "object_id", f"{_agents(ids[count > 1])} more than once")
        demand(len(self.evaluated), "evaluated", "no object to score")
        strange = np.setdiff1d(self.evaluated, self.sim_agents)
        message = f"{_agents(strange)} to be scored, but not valid at step {CURRENT}"
        demand(len(strange) == 0, "tracks_to_predict", message)
        edges = any(len(edge) >= 2 for edge in self.road_edges)
        demand(edges, "road_edge", "no road edge of two or more points, without which nothing is off-road")
        now = self.valid[:, CURRENT]
        for name in ("position", "heading", "size"):
            bad = now & ~_finite(getattr(self, name)).reshape(len(now), -1).all(1)
            demand(~bad, name, f"{_agents(self.object_id[bad])} not finite")
        flat = now & (self.size[:, :2] <= 0).any(1)
        demand(~flat, "size", f"{_agents(self.object_id[flat])} without length or width")
        for name, lines in (("road_edge", self.road_edges), ("lane", self.lanes)):
            demand([_finite(line).all() for line in lines], name, "not finite")
        demand(_finite(self.signal_point), "signal_point", "not finite")

    @property
    def sim_agents(self) -> Ints:
        """The ids [n] of the objects that a rollout must hold: all that are valid at step 10."""
        return self.object_id[self.valid[:, CURRENT]]


@dataclass(frozen=True)
class SimulatedRollouts:
    """R simulated futures of a scenario: steps 11 to 90 of every agent that is valid at step 10, in any order."""

    object_id: Ints  # [n]
    x: Reals  # [R, n, 80] box centres in the world frame of the log, metres
    y: Reals  # [R, n, 80] box centres in the world frame of the log, metres
    z: Reals  # [R, n, 80] box centres in the world frame of the log, metres
    heading: Reals  # [R, n, 80] radians

    def check(self, agents: Ints | None = None, future: int = FUTURE, count: int | None = None) -> None:
        """Check that all is present and finite, with the right number of agents, steps and rollouts.

        Raises a :class:`DataError` that names field and agent.
        """
        if self.object_id.ndim != 1:
            raise DataError(f"has shape {self.object_id.shape}, expected (agents,)", field="object_id")
        check_agents(self.object_id, self.object_id if agents is None else agents)
        rollouts = (len(self.x) if self.x.ndim else 0) if count is None else count
        if rollouts == 0:
            raise DataError("no rollouts", field="x")
        shape = rollouts, len(self.object_id), future
        for name in STATES:
            values: Reals = getattr(self, name)
            if values.shape != shape:
                message = f"has shape {values.shape}, expected {shape} (rollouts, agents, steps)"
                raise DataError(message, field=name)
            if not (good := _finite(values)).all():
                rollout, agent, step = np.argwhere(~good)[0]
                where = f"rollout {rollout}, step {CURRENT + 1 + step}"
                raise DataError(f"agent {self.object_id[agent]}, {where}: not finite", field=name)


def check_agents(found: Ints, wanted: Ints) -> None:
    """Check that rollouts hold exactly the wanted agents.

    Raises a :class:`DataError` where an agent is missing, present more than once, or not one of those to simulate.
    """
    ids, counts = np.unique(found, return_counts=True)
    for who, problem in (
        (ids[counts > 1], "more than once"),
        (np.setdiff1d(wanted, ids), "missing from the rollouts"),
        (np.setdiff1d(ids, wanted), f"in the rollouts, but not valid at step {CURRENT} of the scenario"),
    ):
        if len(who):
            raise DataError(f"{_agents(who)} {problem}", field="object_id")


def _finite(values: Any) -> NDArray[np.bool_]:
    """Return whether numbers are finite in float32, in which all is scored."""
    return np.asarray(np.abs(values) <= np.finfo(np.float32).max)


def _agents(ids: Iterable[Any]) -> str:
    names = [str(int(i)) for i in ids]
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"agent{'s' if len(names) > 1 else ''} {', '.join(names[:_NAMED])}{more}"
