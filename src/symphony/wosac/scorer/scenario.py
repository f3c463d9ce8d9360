"""What is scored: a logged scenario and rollouts of it, as plain arrays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.errors import DataError
from symphony.wosac.scorer.config import CURRENT, FUTURE

VEHICLE = 1
"""Object type of vehicles."""
SURFACE_STREET = 2
"""Type of the lanes that count for traffic lights."""
_NAMED = 10
"""Agents named in an error."""


@dataclass(frozen=True)
class Lines:
    """Polylines of unequal length, one after the other.

    Attributes:
        points: [P, 3] metres.
        counts: [K] points of each line.
    """

    points: Float[Tensor, "P 3"]
    counts: Int[Tensor, " K"]

    @classmethod
    def of(cls, lines: Sequence[Any]) -> Lines:
        """From arrays [P_k, 3]."""
        arrays = [np.asarray(line, np.float64).reshape(-1, 3) for line in lines]
        points = np.concatenate([np.zeros((0, 3)), *arrays])
        return cls(torch.from_numpy(points), torch.tensor([len(array) for array in arrays], dtype=torch.long))

    def keep(self, kept: Bool[Tensor, " K"]) -> Lines:
        """Some of the lines."""
        return Lines(self.points[kept.repeat_interleave(self.counts)], self.counts[kept])

    def to(self, device: torch.device | str) -> Lines:
        """On another device."""
        return Lines(self.points.to(device), self.counts.to(device))


@dataclass(frozen=True)
class WosacScenario:
    """A logged scenario of 91 steps of 0.1 s; step 10 is the last that a simulator may know.

    World frame and headings as logged: part of the score depends on where the origin is and on headings that are not
    brought into one turn. States that are not valid hold whatever the log holds there.

    Attributes:
        scenario_id: its id.
        object_id: [A] of all tracks.
        object_type: [A] 1 vehicle, 2 pedestrian, 3 cyclist, 4 other.
        position: [A, 91, 3] box centres, metres.
        heading: [A, 91] radians.
        size: [A, 3] length, width and height at step 10, metres.
        valid: [A, 91].
        evaluated: [E] ids of the objects that are scored: the recording vehicle and those to predict.
        road_edges: boundaries of the drivable area, which is on their left.
        lanes: centre lines.
        lane_id: [K].
        lane_type: [K] 2 is a lane of a surface street.
        signal_step: [M] step of each observation of a traffic light.
        signal_lane: [M] id of the lane it is for.
        signal_state: [M] 1 and 4 are red (arrow stop, stop).
        signal_point: [M, 2] where to stop, metres.
        future: steps after step 10, all of which are simulated and scored; the challenge's 80, or fewer for logs that
            are shorter. "91" above and in what is made of a scenario is 11 more than this.
    """

    scenario_id: str
    object_id: Int[Tensor, " A"]
    object_type: Int[Tensor, " A"]
    position: Float[Tensor, "A 91 3"]
    heading: Float[Tensor, "A 91"]
    size: Float[Tensor, "A 3"]
    valid: Bool[Tensor, "A 91"]
    evaluated: Int[Tensor, " E"]
    road_edges: Lines
    lanes: Lines
    lane_id: Int[Tensor, " K"]
    lane_type: Int[Tensor, " K"]
    signal_step: Int[Tensor, " M"]
    signal_lane: Int[Tensor, " M"]
    signal_state: Int[Tensor, " M"]
    signal_point: Float[Tensor, "M 2"]
    future: int = FUTURE

    @classmethod
    def of(
        cls,
        scenario_id: str,
        *,
        road_edges: Sequence[Any],
        lanes: Sequence[Any],
        future: int = FUTURE,
        **arrays: Any,
    ) -> Self:
        """From anything numpy understands, checked.

        Args:
            scenario_id: its id.
            road_edges: arrays [P_k, 3].
            lanes: likewise.
            future: steps that are simulated and scored.
            arrays: the other attributes.

        Raises:
            DataError: naming scenario, field and agent.
        """
        tensors = {name: torch.as_tensor(np.asarray(array)) for name, array in arrays.items()}
        edges, centres = Lines.of(road_edges), Lines.of(lanes)
        scenario = cls(scenario_id, road_edges=edges, lanes=centres, future=future, **tensors)
        scenario.check()
        return scenario

    @property
    def sim_agents(self) -> Int[Tensor, " n"]:
        """Ids of the objects that a rollout must hold: all that are valid at step 10."""
        return self.object_id[self.valid[:, CURRENT]]

    @property
    def steps(self) -> int:
        """All there are: the history's and the future's."""
        return CURRENT + 1 + self.future

    def to(self, device: torch.device | str) -> Self:
        """On another device."""
        return replace(
            self,
            **{
                f.name: getattr(self, f.name).to(device)
                for f in fields(self)
                if f.name not in {"scenario_id", "future"}
            },
        )

    def check(self) -> None:
        """Raise a DataError where something can't be scored."""
        agents = len(self.object_id)
        signals = len(self.signal_step)
        expected = {
            "object_id": (agents,),
            "object_type": (agents,),
            "position": (agents, self.steps, 3),
            "heading": (agents, self.steps),
            "size": (agents, 3),
            "valid": (agents, self.steps),
            "lane_id": self.lanes.counts.shape,
            "lane_type": self.lanes.counts.shape,
            "signal_lane": (signals,),
            "signal_state": (signals,),
            "signal_point": (signals, 2),
        }
        for name, shape in expected.items():
            found = tuple(getattr(self, name).shape)
            if found != tuple(shape):
                raise self._error(f"has shape {found}, expected {tuple(shape)}", name)
        self._check_ids()
        self._check_numbers()

    def _check_ids(self) -> None:
        ids, count = self.object_id.unique(return_counts=True)
        if (count > 1).any():
            raise self._error(f"{_agents(ids[count > 1])} more than once", "object_id")
        if len(self.evaluated) == 0:
            raise self._error("no object to score", "evaluated")
        strange = self.evaluated[~torch.isin(self.evaluated, self.sim_agents)]
        if len(strange):
            raise self._error(
                f"{_agents(strange)} to be scored, but not valid at step {CURRENT}", "tracks_to_predict"
            )
        if not (self.road_edges.counts >= 2).any():
            raise self._error(
                "no road edge of two or more points, without which nothing is off-road", "road_edge"
            )
        steps = self.signal_step
        if ((steps < 0) | (steps >= self.steps)).any():
            raise self._error(f"outside the {self.steps} steps", "signal_step")

    def _check_numbers(self) -> None:
        agents = self.valid[:, CURRENT]
        numbers = {
            "position": (self.position, agents),
            "heading": (self.heading, agents),
            "size": (self.size, agents),
        }
        for name, (values, which) in numbers.items():
            bad = ~values.float().isfinite().flatten(1).all(1) & which
            if bad.any():
                raise self._error(f"{_agents(self.object_id[bad])} not finite", name)
        flat = (self.size[:, :2] <= 0).any(1) & agents
        if flat.any():
            raise self._error(f"{_agents(self.object_id[flat])} without length or width", "size")
        for name, points in (
            ("road_edge", self.road_edges.points),
            ("lane", self.lanes.points),
            ("signal_point", self.signal_point),
        ):
            if not points.float().isfinite().all():
                raise self._error("not finite", name)

    def _error(self, message: str, field: str) -> DataError:
        return DataError(message, segment=self.scenario_id, field=field)


@dataclass(frozen=True)
class SimulatedRollouts:
    """R simulated futures of a scenario: steps 11 to 90 of every agent that is valid at step 10, in any order.

    Attributes:
        object_id: [n].
        x, y, z: [R, n, 80] box centres in the scenario's frame, metres.
        heading: [R, n, 80] radians.
    """

    object_id: Int[Tensor, " n"]
    x: Float[Tensor, "R n 80"]
    y: Float[Tensor, "R n 80"]
    z: Float[Tensor, "R n 80"]
    heading: Float[Tensor, "R n 80"]

    @classmethod
    def of(cls, object_id: Any, x: Any, y: Any, z: Any, heading: Any) -> Self:
        """From anything numpy understands; :meth:`check` is for the scorer, which knows the scenario."""
        states = (torch.as_tensor(np.asarray(array)) for array in (x, y, z, heading))
        return cls(torch.as_tensor(np.asarray(object_id)), *states)

    def to(self, device: torch.device | str) -> Self:
        """On another device."""
        return replace(self, **{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def check(self, scenario: WosacScenario, count: int | None = None) -> None:
        """Compare with the scenario.

        Args:
            scenario: what was simulated.
            count: rollouts there must be, where that is prescribed.

        Raises:
            DataError: naming scenario, field and agent.
        """

        def error(message: str, field: str) -> DataError:
            return DataError(message, segment=scenario.scenario_id, field=field)

        if self.object_id.ndim != 1 or self.object_id.is_floating_point():
            raise error("must be a list of whole numbers", "object_id")
        ids, repeats = self.object_id.unique(return_counts=True)
        if (repeats > 1).any():
            raise error(f"{_agents(ids[repeats > 1])} more than once", "object_id")
        needed = scenario.sim_agents.to(ids.device)
        for who, what in (
            (needed[~torch.isin(needed, ids)], "missing from the rollouts"),
            (
                ids[~torch.isin(ids, needed)],
                f"in the rollouts, but not valid at step {CURRENT} of the scenario",
            ),
        ):
            if len(who):
                raise error(f"{_agents(who)} {what}", "object_id")
        rollouts = (len(self.x) if self.x.ndim else 0) if count is None else count
        if rollouts == 0:
            raise error("no rollouts", "x")
        shape = rollouts, len(ids), scenario.future
        for name in ("x", "y", "z", "heading"):
            values: Tensor = getattr(self, name)
            if tuple(values.shape) != shape:
                wanted = f"{shape} (rollouts, agents, steps)"
                raise error(f"has shape {tuple(values.shape)}, expected {wanted}", name)
            if not values.is_floating_point():
                raise error(f"must hold floating-point numbers, not {values.dtype}", name)
            bad = ~values.float().isfinite()
            if bad.any():
                rollout, agent, step = bad.nonzero()[0].tolist()
                where = f"rollout {rollout}, step {CURRENT + 1 + step}"
                raise error(f"agent {int(self.object_id[agent])}, {where}: not finite", name)


def _agents(ids: Iterable[Any]) -> str:
    names = [str(int(i)) for i in ids]
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return f"agent{'s' if len(names) > 1 else ''} {', '.join(names[:_NAMED])}{more}"
