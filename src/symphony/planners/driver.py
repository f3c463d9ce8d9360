"""The ego by a planner: planners as a part of the policy, forked with the branches that they drive."""

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
from symphony.planners.interface import Planner, Traffic, checked_plan, fixed, scenario_of
from symphony.streams import Stream, fold_in


class PlannedEnv(DrivingEnv):
    """Driving in which actions are not all: background agents go where ``BACKGROUND`` says, and the first interactive
    agent, the ego, where ``PLANNED`` does; where there is no such entry, they act like the others.
    """

    def _moved(self, tensordict: TensorDictBase, state: Tensor, size: Tensor) -> Tensor:
        after = super()._moved(tensordict, state, size)
        ruled, planned = tensordict.get(keys.BACKGROUND, None), tensordict.get(keys.PLANNED, None)
        if ruled is not None:
            background = self.scenes.background[tensordict.get(keys.SCENE).squeeze(-1)]
            after = torch.where(background[..., None], ruled, after)
        return after if planned is None else torch.cat([planned[..., None, :], after[..., 1:, :]], -2)


class Failure(NamedTuple):
    """Why a planner drives no more: from which step on the rollout doesn't count, and the reason in words."""

    step: int
    reason: str


class EgoPlanners(NamedTuple):
    """How the egos of a batch are planned.

    Attributes:
        name: of the planner.
        make: makes one.
        segments: behind the scenes, in their order; the first interactive agent of each is its ego.
        seconds: that a planner has for one answer.
    """

    name: str
    make: Callable[[], Planner]
    segments: Sequence[RunSegment]
    seconds: float = SECONDS


class RuledEgo(TensorDictModuleBase):
    """Writes the states that a rule for background agents leads the egos to as ``PLANNED``.

    Args:
        env: the environment.
        rule: made with an environment and the parameters, it writes ``BACKGROUND``.
        driver: the parameters, of all egos.
        start: [...] states at which rollouts begin; each names its scene as its planner.
    """

    in_keys = [keys.SCENE, keys.STEP, keys.STATE, keys.VALID]  # noqa: RUF012 - the type declared
    out_keys = [keys.PLANNED]  # noqa: RUF012

    def __init__(
        self,
        env: DrivingEnv,
        rule: Callable[[PlannedEnv, IDMPlanner], TensorDictModuleBase],
        driver: IDMPlanner,
        start: TensorDictBase,
    ) -> None:
        super().__init__()
        scenes = env.scenes.clone(recurse=False)
        scenes.background = torch.zeros_like(scenes.background).index_fill(
            1, scenes.interactive.new_zeros(1), 1
        )
        self.rule = rule(PlannedEnv(scenes, env.dynamics, ObservationConfig.nothing()), driver)
        self.lost = scenes.route_logged[:, 0] < 0
        start.set(keys.PLANNER, start.get(keys.SCENE).clone())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write planned states [..., 4]."""
        moved = self.rule(tensordict.select(*self.in_keys)).get(keys.BACKGROUND)
        return tensordict.set(keys.PLANNED, moved[..., 0, :])

    def failures(self, number: Int[Tensor, "*b"]) -> list[Failure | None]:
        """The failures of egos in these scenes, flattened: those on no lane fail from the first step on."""
        failure = Failure(0, "reset: the ego is on no lane that it could follow")
        return [failure if lost else None for lost in self.lost[number.flatten()].tolist()]


class EgoPolicy(TensorDictModuleBase):
    """Asks the planners and writes the states they lead to as ``PLANNED``.

    Rollouts name their planner by number (``PLANNER``). Copies of a branch share a number until they are driven on;
    then each gets a planner of its own, copied before any of them plans.

    Args:
        env: the environment.
        egos: how egos are planned.
        start: [...] states at which planners begin, the egos on the routes of the log; each gets its number.
        seed: of all rollouts.
        first: the planner of the first rollout, or the exception that making it ended with.
        forked: a search will copy planners with its branches.

    Raises:
        ConfigError: ``forked``, and they can't be copied: said now, as it may take long until one has to be.
    """

    in_keys = [keys.SCENE, keys.STEP, keys.STATE, keys.VALID, keys.PROGRESS, keys.PLANNER]  # noqa: RUF012
    out_keys = [keys.PLANNED, keys.PLANNER]  # noqa: RUF012

    def __init__(
        self,
        env: DrivingEnv,
        egos: EgoPlanners,
        start: TensorDictBase,
        seed: int,
        first: Planner | Exception,
        *,
        forked: bool = False,
    ) -> None:
        super().__init__()
        self.env, self.egos = env, egos
        numbers = torch.arange(start.numel(), device=start.device)
        start.set(keys.PLANNER, numbers.reshape(*start.shape, 1))
        self._last = env.scenes.last_step.cpu().numpy()
        self._held: dict[int, Planner | Failure] = {}
        scene = start.get(keys.SCENE).flatten().tolist()
        state = start.get(keys.STATE)[..., 0, :].reshape(-1, 4).cpu().numpy()
        stream = fold_in(fold_in(start.get(keys.STREAM), Stream.PLANNERS), seed).flatten().tolist()
        self._routes = [self._route(row) for row in range(len(egos.segments))]
        for number, row in enumerate(scene):
            made = scenario_of(
                egos.segments[row], self._routes[row], state[number], stream[number] & (2**63 - 1)
            )
            planner: Any = answer(egos.make, seconds=egos.seconds) if number else first
            error = planner if isinstance(planner, Exception) else None
            error = error or answer(planner.reset, made, seconds=egos.seconds)
            failed = isinstance(error, Exception)
            self._held[number] = Failure(0, f"reset: {_words(error)}") if failed else planner
        self._next = len(scene)
        drives = next((held for held in self._held.values() if not isinstance(held, Failure)), None)
        if forked and drives is not None:
            self._copy(drives)

    def _route(self, row: int) -> NDArray[np.float32]:
        """Points [P, 2] of the route that the ego of a scene takes; none if it is on no lane."""
        which = int(self.env.scenes.route_logged[row, 0])
        if which < 0:
            return np.zeros((0, 2), np.float32)
        return self.env.scenes.whole_route(row, 0, which).cpu().numpy()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write planned states [..., 4] and numbers of planners [..., 1]."""
        scene, at, number = (tensordict.get(key).flatten() for key in (keys.SCENE, keys.STEP, keys.PLANNER))
        state, valid, progress = (
            tensordict.get(key).flatten(0, tensordict.ndim - 1)
            for key in (keys.STATE, keys.VALID, keys.PROGRESS)
        )
        everyone = self.env.objects(scene, at, state, valid)
        rows, steps, come = scene.tolist(), at.tolist(), progress[:, 0].tolist()
        # An ego that has left the map is over, too.
        last, there = self._last[rows].tolist(), valid[:, 0].tolist()
        going = [step < end and here for step, end, here in zip(steps, last, there, strict=True)]
        numbers = self._own(number.tolist(), going)
        own = state[:, 0].cpu().double()
        moves, present = everyone.state.cpu().double().numpy(), everyone.valid.cpu().numpy()
        asked: list[tuple[int, Planner, Traffic]] = []
        for m, row in enumerate(rows):
            planner = self._held[numbers[m]]
            if going[m] and not isinstance(planner, Failure):
                ahead = route_from(self._routes[row], come[m])
                asked.append(
                    (m, planner, self._traffic(row, steps[m], own[m].numpy(), moves[m], present[m], ahead))
                )
        plans = plans_of([one[1] for one in asked], [one[2] for one in asked], self.egos.seconds)
        # One that is over, or has failed, keeps its speed.
        control, target = np.zeros((len(rows), 2)), np.full((len(rows), 4), np.nan)
        for (m, _, seen), given in zip(asked, plans, strict=True):
            found: Any = given
            if not isinstance(given, Exception):
                found = answer(checked_plan, given, seen.state, self.env.dt)
            if isinstance(found, Exception):
                self._held[numbers[m]] = Failure(steps[m], f"step {steps[m]}: {_words(found)}")
            else:
                (control if len(found) == 2 else target)[m] = found
        length = [float(self.egos.segments[row].size[self.egos.segments[row].ego, 0]) for row in rows]
        pulled, turned = torch.from_numpy(control).unbind(-1)
        after = bicycle_step(own, pulled, turned, torch.tensor(length, dtype=torch.float64), self.env.dt)
        wanted = torch.from_numpy(target)
        after = torch.where(wanted.isnan(), after, wanted).to(state)
        tensordict.set(keys.PLANNED, after.reshape(*tensordict.shape, 4))
        return tensordict.set(keys.PLANNER, number.new_tensor(numbers).reshape(*tensordict.shape, 1))

    def failures(self, number: Int[Tensor, "*b"]) -> list[Failure | None]:
        """The failures of the planners with these numbers, flattened; None for those that drive on."""
        found = (self._held[n] for n in number.flatten().tolist())
        return [planner if isinstance(planner, Failure) else None for planner in found]

    def _own(self, numbers: list[int], going: list[bool]) -> list[int]:
        """Numbers of planners that may be changed, one for each rollout that goes on."""
        self._held = {n: self._held[n] for n in set(numbers)}
        taken: set[int] = set()
        out = []
        for number, goes in zip(numbers, going, strict=True):
            planner, chosen = self._held[number], number
            if goes and not isinstance(planner, Failure):
                if number in taken:
                    chosen, self._next = self._next, self._next + 1
                    self._held[chosen] = self._copy(planner)
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

    def _traffic(
        self,
        row: int,
        step: int,
        own: NDArray[Any],
        moves: NDArray[Any],
        there: NDArray[Any],
        route: NDArray[Any],
    ) -> Traffic:
        segment = self.egos.segments[row]
        there = there[: segment.num_agents]
        moves = np.where(there[:, None], moves[: segment.num_agents], 0.0)
        return Traffic(
            step=step,
            time=step * self.env.dt,
            ego=segment.ego,
            state=fixed(own),
            position=fixed(moves[:, :2]),
            heading=fixed(moves[:, 2]),
            velocity=fixed(moves[:, 3:]),
            size=fixed(segment.size[:, :2].astype(np.float64)),
            agent_type=fixed(segment.agent_type),
            valid=fixed(there),
            lights=fixed(segment.signal_state[:, step]),
            route=fixed(route),
        )


def ego_policy(
    env: DrivingEnv,
    egos: EgoPlanners,
    start: TensorDictBase,
    seed: int,
    rule: Callable[[PlannedEnv, IDMPlanner], TensorDictModuleBase],
    *,
    forked: bool = False,
) -> EgoPolicy | RuledEgo:
    """What moves the egos: a rule with the parameters of an IDM that has no ``plan`` of its own, or planners."""
    first = answer(egos.make, seconds=egos.seconds)
    if isinstance(first, IDMPlanner) and not callable(getattr(first, "plan", None)):
        return RuledEgo(env, rule, first, start)
    return EgoPolicy(env, egos, start, seed, first, forked=forked)


def route_from(route: NDArray[np.float32], progress: float) -> NDArray[np.float64]:
    """Points [K, 2] of a route from so many metres along on, at least 200 m of it or all there is."""
    if not len(route):
        return route.astype(np.float64)
    piece = min(int(progress // SPACING), len(route) - 2)
    later = route[piece + 1 : piece + 3 + round(ONWARD / SPACING)].astype(np.float64)
    way = route[piece + 1] - route[piece]
    # The last piece may be shorter than the others.
    share = min((progress - SPACING * piece) / max(float(np.hypot(*way)), 1e-6), 1.0)
    return np.concatenate([(route[piece] + share * way)[None], later])


def _words(error: Exception) -> str:
    """An exception on one line, with the place that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}{place}"
