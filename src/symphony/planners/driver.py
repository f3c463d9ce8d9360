"""Planners of the ego as a part of the policy, forked with the branches that they drive."""

from __future__ import annotations

import copy
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from symphony import keys
from symphony.data.segment import RunSegment
from symphony.envs.driving import DrivingEnv
from symphony.envs.dynamics import bicycle_step
from symphony.envs.observation import ObservationConfig
from symphony.envs.routes import ONWARD, SPACING
from symphony.errors import ConfigError
from symphony.planners.calls import SECONDS, answer, plans_of
from symphony.planners.included import IDMPlanner
from symphony.planners.interface import (
    HISTORY,
    Moments,
    Planner,
    Planners,
    Traffic,
    checked_plan,
    planner_maker,
    planner_name,
    scenario_of,
    traffic_of,
)
from symphony.streams import Stream, fold_in

POINTS = 20  # of a trajectory that are kept, at most


class PlannedEnv(DrivingEnv):
    """A driving environment with states besides actions: background agents go where ``BACKGROUND`` says, and the
    first P interactive agents, the ego and others with planners, where ``PLANNED`` says, else like the others.
    """

    def _moved(self, tensordict: TensorDictBase, state: Tensor, size: Tensor) -> Tensor:
        after = super()._moved(tensordict, state, size)
        ruled, planned = tensordict.get(keys.BACKGROUND, None), tensordict.get(keys.PLANNED, None)
        if ruled is not None:
            background = self.scenes.background[tensordict.get(keys.SCENE).squeeze(-1)]
            after = torch.where(background[..., None], ruled, after)
        return after if planned is None else torch.cat([planned, after[..., planned.shape[-2] :, :]], -2)


class Failure(NamedTuple):
    """The failure of a planner: from which step on the rollout doesn't count, and the reason in words."""

    step: int
    reason: str


class EgoPlanners(NamedTuple):
    """The planner of one agent in each scene of a batch: the ego, or another, which is the ego of its planner.

    Attributes:
        name: the name of the planner.
        make: a function that makes one planner.
        segments: behind the scenes, in their order.
        seconds: the time that a planner has for one answer.
    """

    name: str
    make: Callable[[], Planner]
    segments: Sequence[RunSegment]
    seconds: float = SECONDS


def ego_planners(
    planners: Planners, segments: Sequence[RunSegment], interactive: Int[Tensor, "B N"], seconds: float
) -> list[EgoPlanners]:
    """Return how the first interactive agents of scenes are planned, given the rows of all of them in their segments.

    Raises:
        ConfigError: in some segment another agent has the place of one with a planner.
    """
    found = []
    for place, (agent, planner) in enumerate(planners.items()):
        for segment, row in zip(segments, interactive[:, place].tolist(), strict=True):
            if row != segment.ego if agent is None else segment.agent_id[row] != agent:
                who = "the ego" if agent is None else f"agent {agent}"
                raise ConfigError(f"segment {segment.segment_id}: {who}, which has a planner, is not driven")
        found.append(EgoPlanners(planner_name(planner), planner_maker(planner), segments, seconds))
    return found


class EgoPolicy(TensorDictModuleBase):
    """Asks planners, one for each of the first interactive agents, and writes the resulting states as ``PLANNED``.

    Rollouts name their planners by number (``PLANNER``). Copies of a branch share a number until they go on; then
    each gets a planner of its own, copied before any of them plans.

    Args:
        env: the environment.
        egos: how the first interactive agents are planned.
        start: [...] states at which planners begin, the agents on the routes of the log; each gets its numbers.
        seed: the seed of all rollouts.
        rule: made with an environment and the parameters of an IDM that has no ``plan`` of its own, it drives.
        forked: a search will copy planners with its branches.

    Raises:
        ConfigError: ``forked``, and they can't be copied: reported now, as it may be long until one has to be.
    """

    in_keys = [keys.SCENE, keys.STEP, keys.STATE, keys.VALID, keys.PROGRESS, keys.PLANNER]  # noqa: RUF012
    out_keys = [keys.PLANNED, keys.PLANNER]  # noqa: RUF012

    def __init__(
        self,
        env: DrivingEnv,
        egos: Sequence[EgoPlanners],
        start: TensorDictBase,
        seed: int,
        rule: Callable[[PlannedEnv, IDMPlanner], TensorDictModuleBase],
        *,
        forked: bool = False,
    ) -> None:
        super().__init__()
        self.drivers: list[_Ruled | _Asked] = []
        for place, one in enumerate(egos):
            first = answer(one.make, seconds=one.seconds)
            if isinstance(first, IDMPlanner) and not callable(getattr(first, "plan", None)):
                self.drivers.append(_Ruled(env, one, place, rule, first))
            else:
                self.drivers.append(_Asked(env, one, place, start, seed, first, forked=forked))
        start.set(keys.PLANNER, torch.cat([one.begin(start) for one in self.drivers], -1))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write planned states [..., P, 4] and numbers of planners [..., P]."""
        numbers = tensordict.get(keys.PLANNER).unbind(-1)
        moved = [one.moved(tensordict, number) for one, number in zip(self.drivers, numbers, strict=True)]
        states, numbers = zip(*moved, strict=True)
        tensordict.set(keys.PLANNED, torch.stack(states, -2))
        return tensordict.set(keys.PLANNER, torch.stack(numbers, -1))

    def failures(self, number: Int[Tensor, "*b P"]) -> list[Failure | None]:
        """Return the first failure of the planners with these numbers, flattened; None where all of them drive on."""
        each = (one.failures(part) for one, part in zip(self.drivers, number.unbind(-1), strict=True))
        return [min(filter(None, found), default=None) for found in zip(*each, strict=True)]

    def meant(self, number: Int[Tensor, "K P"], steps: int) -> NDArray[np.float32] | None:
        """Return the trajectories [K, P, T, H, 2] that planners returned, NaN for none; None if there are none."""
        asked = [(k, one) for k, one in enumerate(self.drivers) if isinstance(one, _Asked)]
        given = {k: plan for k, one in asked if (plan := one.meant(number[:, k], steps)) is not None}
        most = max((plan.shape[2] for plan in given.values()), default=0)
        found = np.full((*number.shape, steps, most, 2), np.nan, np.float32)
        for k, plan in given.items():
            found[:, k, :, : plan.shape[2]] = plan
        return found if given else None


class _Driver:
    """The agent at one place among the interactive ones of each scene: its row, and a prefix for its failures."""

    def __init__(self, env: DrivingEnv, egos: EgoPlanners, place: int) -> None:
        self.env, self.egos, self.place = env, egos, place
        self.rows = env.scenes.interactive[:, place].tolist()
        named = zip(egos.segments, self.rows, strict=True)
        self.who = [f"agent {one.agent_id[row]}, " if place else "" for one, row in named]


class _Ruled(_Driver):
    """Agents that go where a rule for background agents leads them; the number of a planner is its scene's."""

    def __init__(
        self,
        env: DrivingEnv,
        egos: EgoPlanners,
        place: int,
        rule: Callable[[PlannedEnv, IDMPlanner], TensorDictModuleBase],
        driver: IDMPlanner,
    ) -> None:
        super().__init__(env, egos, place)
        scenes = env.scenes.clone(recurse=False)
        background = torch.zeros_like(scenes.background)
        scenes.background = background.index_fill(1, scenes.interactive.new_tensor([place]), 1)
        self.rule = rule(PlannedEnv(scenes, env.dynamics, ObservationConfig.nothing()), driver)
        self.lost = scenes.route_logged[:, place] < 0

    def begin(self, start: TensorDictBase) -> Tensor:
        """Return the numbers [..., 1] of the planners."""
        return start.get(keys.SCENE).clone()

    def moved(self, tensordict: TensorDictBase, number: Tensor) -> tuple[Tensor, Tensor]:
        """Return planned states [..., 4] and numbers of planners [...]."""
        moved = self.rule(tensordict.select(*self.rule.in_keys)).get(keys.BACKGROUND)
        return moved[..., self.place, :], number

    def failures(self, number: Int[Tensor, "*b"]) -> list[Failure | None]:
        """Return the failures of agents in these scenes, flattened: those on no lane fail from the first step on."""
        rows, why = number.flatten().tolist(), "reset: the ego is on no lane that it could follow"
        lost = self.lost.tolist()
        return [Failure(0, f"{self.who[row]}{why}") if lost[row] else None for row in rows]


class _Asked(_Driver):
    """Agents whose planners are asked, one for each rollout."""

    def __init__(
        self,
        env: DrivingEnv,
        egos: EgoPlanners,
        place: int,
        start: TensorDictBase,
        seed: int,
        first: Any,
        *,
        forked: bool,
    ) -> None:
        super().__init__(env, egos, place)
        self._last = env.scenes.last_step.cpu().numpy()
        self._held: dict[int, Planner | Failure] = {}
        self._meant: dict[int, dict[int, NDArray[np.float32]]] = {}
        self._past: dict[int, tuple[int, Moments]] = {}  # and the step after which the last of them was seen
        scene = start.get(keys.SCENE).flatten().tolist()
        state = start.get(keys.STATE)[..., place, :].reshape(-1, 4).cpu().numpy()
        own = fold_in(fold_in(start.get(keys.STREAM), Stream.PLANNERS), seed)
        # Planners of one rollout draw independently; the ego's as if it were the only one.
        own = fold_in(own, env.scenes.interactive[start.get(keys.SCENE), place]) if place else own
        stream = own.flatten().tolist()
        self._routes = [self._route(row) for row in range(len(egos.segments))]
        for number, row in enumerate(scene):
            begin, drawn = state[number], stream[number] & (2**63 - 1)
            made = scenario_of(egos.segments[row], self.rows[row], self._routes[row], begin, drawn)
            planner: Any = answer(egos.make, seconds=egos.seconds) if number else first
            error = planner if isinstance(planner, Exception) else None
            error = error or answer(planner.reset, made, seconds=egos.seconds)
            failed = isinstance(error, Exception)
            self._held[number] = self._failure(row, 0, "reset", error) if failed else planner
            self._meant[number], self._past[number] = {}, (-1, ())
        self._next = len(scene)
        drives = next((held for held in self._held.values() if not isinstance(held, Failure)), None)
        if forked and drives is not None:
            self._copy(drives)

    def _failure(self, row: int, step: int, when: str, error: Exception) -> Failure:
        return Failure(step, f"{self.who[row]}{when}: {_words(error)}")

    def begin(self, start: TensorDictBase) -> Tensor:
        return torch.arange(start.numel(), device=start.device).reshape(*start.shape, 1)

    def _route(self, row: int) -> NDArray[np.float32]:
        """Return points [P, 2] of the route that the agent of a scene takes; none if it is on no lane."""
        which = int(self.env.scenes.route_logged[row, self.place])
        if which < 0:
            return np.zeros((0, 2), np.float32)
        return self.env.scenes.whole_route(row, self.place, which).cpu().numpy()

    def moved(self, tensordict: TensorDictBase, number: Tensor) -> tuple[Tensor, Tensor]:
        scene, at, place = *(tensordict.get(key).flatten() for key in (keys.SCENE, keys.STEP)), self.place
        state, valid, progress = (
            tensordict.get(key).flatten(0, tensordict.ndim - 1) for key in (keys.STATE, keys.VALID, keys.PROGRESS)
        )
        everyone = self.env.objects(scene, at, state, valid)
        rows, steps, come = scene.tolist(), at.tolist(), progress[:, place].tolist()
        # One that has left the map is over, too.
        last, there = self._last[rows].tolist(), valid[:, place].tolist()
        going = [step < end and here for step, end, here in zip(steps, last, there, strict=True)]
        numbers = self._own(number.flatten().tolist(), going)
        own = state[:, place].cpu().double()
        moves, present = everyone.state.cpu().double().numpy(), everyone.valid.cpu().numpy()
        asked: list[tuple[int, Planner, Traffic]] = []
        for m, row in enumerate(rows):
            planner = self._held[numbers[m]]
            if going[m] and not isinstance(planner, Failure):
                ahead = route_from(self._routes[row], come[m])
                seen_at, past = self._past[numbers[m]]
                past = past if seen_at == steps[m] - 1 else ()  # one that was gone begins again
                now = moves[m], present[m]
                at = self.egos.segments[row], self.rows[row], steps[m], own[m].numpy()
                seen = traffic_of(*at, now, past, ahead)
                self._past[numbers[m]] = steps[m], (*past, now)[-round(HISTORY / self.env.dt) :]
                asked.append((m, planner, seen))
        plans = plans_of([one[1] for one in asked], [one[2] for one in asked], self.egos.seconds)
        # One that is over, or has failed, keeps its speed.
        control, target = np.zeros((len(rows), 2)), np.full((len(rows), 4), np.nan)
        for (m, _, seen), given in zip(asked, plans, strict=True):
            found: Any = given
            if not isinstance(given, Exception):
                found = answer(checked_plan, given, seen.state, self.env.dt)
            if isinstance(found, Exception):
                self._held[numbers[m]] = self._failure(rows[m], steps[m], f"step {steps[m]}", found)
            else:
                (control if len(found) == 2 else target)[m] = found
                if np.ndim(given) == 2:
                    points = np.asarray(given, np.float32)[:, :2]
                    shown = np.linspace(0, len(points) - 1, min(len(points), POINTS)).round().astype(int)
                    self._meant[numbers[m]][steps[m]] = points[shown]  # the last one is among them
        length = [float(self.egos.segments[row].size[self.rows[row], 0]) for row in rows]
        pulled, turned = torch.from_numpy(control).unbind(-1)
        after = bicycle_step(own, pulled, turned, torch.tensor(length, dtype=torch.float64), self.env.dt)
        wanted = torch.from_numpy(target)
        after = torch.where(wanted.isnan(), after, wanted).to(state)
        return after.reshape(*tensordict.shape, 4), number.new_tensor(numbers).reshape(tensordict.shape)

    def failures(self, number: Int[Tensor, "*b"]) -> list[Failure | None]:
        """Return the failures of the planners with these numbers, flattened; None for those that drive on."""
        found = (self._held[n] for n in number.flatten().tolist())
        return [planner if isinstance(planner, Failure) else None for planner in found]

    def meant(self, number: Int[Tensor, "*b"], steps: int) -> NDArray[np.float32] | None:
        given = [self._meant[n] for n in number.flatten().tolist()]
        most = max((len(plan) for plans in given for plan in plans.values()), default=0)
        found = np.full((len(given), steps, most, 2), np.nan, np.float32)
        for row, plans in zip(found, given, strict=True):
            for step in plans.keys() & {*range(steps)}:
                row[step, : len(plans[step])] = plans[step]
        return found if most else None

    def _own(self, numbers: list[int], going: list[bool]) -> list[int]:
        """Return numbers of planners that may be changed, one for each rollout that goes on."""
        self._held = {n: self._held[n] for n in set(numbers)}
        self._meant = {n: self._meant[n] for n in set(numbers)}
        self._past = {n: self._past[n] for n in set(numbers)}
        taken: set[int] = set()
        out = []
        for number, goes in zip(numbers, going, strict=True):
            planner, chosen = self._held[number], number
            if goes and not isinstance(planner, Failure):
                if number in taken:
                    chosen, self._next = self._next, self._next + 1
                    self._held[chosen], self._meant[chosen] = self._copy(planner), {**self._meant[number]}
                    self._past[chosen] = self._past[number]
                taken.add(chosen)
            out.append(chosen)
        return out

    def _copy(self, planner: Planner) -> Planner:
        try:
            return copy.deepcopy(planner)
        except Exception as error:  # whatever a user's planner raises
            raise ConfigError(
                f"planner '{self.egos.name}' can't be copied ({_words(error)}), but a search forks it with its "
                "branches: simulate with --search none"
            ) from error


def route_from(route: NDArray[Any], progress: float) -> NDArray[np.float64]:
    """Return points [K, 2] of a route from ``progress`` metres on, at least 200 m of it or all there is."""
    if not len(route):
        return route.astype(np.float64)
    piece = min(int(progress // SPACING), len(route) - 2)
    later = route[piece + 1 : piece + 3 + round(ONWARD / SPACING)].astype(np.float64)
    way = route[piece + 1] - route[piece]
    # The last piece may be shorter than the others.
    share = min((progress - SPACING * piece) / max(float(np.hypot(*way)), 1e-6), 1.0)
    return np.concatenate([(route[piece] + share * way)[None], later])


def _words(error: Exception) -> str:
    """Return an exception on one line, with the place that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    said = str(traceback.TracebackException.from_exception(error))  # also of one that can't say what it is
    return f"{type(error).__name__}: {' '.join(said.split())[:200]}{place}"
