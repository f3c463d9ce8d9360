"""The ego of logged scenes as a Gymnasium environment, for planners that learn by themselves (extra ``gym``)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from symphony import keys
from symphony.data.store import SegmentStore
from symphony.envs.driving import DrivingEnv, Event
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import ObservationConfig
from symphony.envs.scene import SceneBatch, scene
from symphony.errors import ConfigError, DataError
from symphony.planners.driver import route_from
from symphony.planners.interface import HISTORY, Moment, Reals, Scenario, scenario_of, traffic_of
from symphony.planners.view import Lane, Observation, crosswalks_of, lanes_of, observation_of
from symphony.roadgraph import LaneGraph

BOUND = 1000.0  # what observations are clipped to; they are scaled to numbers near one
TOP_SPEED = 40.0  # m/s that the largest continuous action stands for

Observed = dict[str, NDArray[Any]]


class DrivingGym(gymnasium.Env[Observed, Any]):
    """One ego in a logged scene, with all others played back from the log; an episode is a run segment.

    Observations are what :class:`symphony.envs.driving.DrivingEnv` shows an agent, in its own frame: ``own``,
    ``objects`` and ``points`` with their masks, ``route`` where asked for (the one the log took). The rest is in
    ``info``: ``segment`` (its id), ``step``, ``state`` (x, y in metres, heading in radians, speed in m/s),
    ``collision``, ``offroad``, and ``driven``, metres since the step before. :meth:`seen` is what a planner is told.

    Args:
        data: a store of run segments, or its folder.
        action: ``discrete``: the kinematic bicycle's joint actions; ``continuous``: the displacement over a step,
            forward and to the left, where 1 stands for :data:`TOP_SPEED`.
        observation: what the ego observes.
        reward: of a step, by states before and after it, as for ``DrivingEnv``; default -1 in collision or off road.
        ends_on: what ends an episode early.
        duration: seconds of each segment that are driven, a step at least; 0 for all.

    ``reset(options={"segment": ID})`` starts a certain segment, by id or number; else one is drawn, of those whose
    ego is seen at the first step.

    Raises:
        DataError: the store is empty.
        ConfigError: an unknown kind of action, or a negative duration.
    """

    env: DrivingEnv
    _now: TensorDictBase
    _before: list[TensorDictBase]
    _scene: SceneBatch
    _told: tuple[Scenario, tuple[Lane, ...], tuple[Reals, ...]] | None
    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own

    def __init__(
        self,
        data: SegmentStore | str | Path,
        *,
        action: Literal["discrete", "continuous"] = "discrete",
        observation: ObservationConfig | None = None,
        reward: Callable[[TensorDictBase, TensorDictBase], Tensor] | None = None,
        ends_on: Sequence[Event] = ("collision", "offroad"),
        duration: float = 0.0,
    ) -> None:
        if action not in ("discrete", "continuous"):
            raise ConfigError(f"action is discrete or continuous, not {action!r}")
        if not 0 <= duration < math.inf:
            raise ConfigError(f"duration must not be negative, is {duration}")
        self.store = (data if isinstance(data, SegmentStore) else SegmentStore(data)).filled()
        self.dynamics: Bicycle | Displacement = Bicycle() if action == "discrete" else Displacement()
        self.observation = ObservationConfig() if observation is None else observation
        self.reward, self.ends_on, self.duration = reward, tuple(ends_on), duration
        number = next((i for i in range(len(self.store)) if self._usable(i)), None)
        if number is None:
            raise DataError("the ego is seen at the first step of no segment", file=self.store.path)
        self._open(number)
        seen = {name: _space(value) for name, value in self._observed().items()}
        self.observation_space: spaces.Space[Any] = spaces.Dict(seen)
        self.action_space: spaces.Space[Any] = spaces.Box(-1.0, 1.0, (2,), np.float32)
        if isinstance(self.dynamics, Bicycle):
            self.action_space = spaces.Discrete(self.dynamics.num_actions)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Start a segment.

        Raises a :class:`DataError` where the requested one does not exist, or its ego is not seen at its first step,
        a :class:`ConfigError` where the request is neither an id nor a number.
        """
        super().reset(seed=seed)
        wanted = (options or {}).get("segment")
        if wanted is None:
            number = int(self.np_random.integers(len(self.store)))
            while not self._usable(number):
                number = int(self.np_random.integers(len(self.store)))
        else:
            named = wanted if isinstance(wanted, str) else _whole(wanted)
            if named is None:
                raise ConfigError(f"a segment is an id or a number, not {wanted!r}")
            number = self.store.index_of(named)
            if not self._usable(number):
                name = self.store.ids[number]
                raise DataError("the ego is not seen at the first step", segment=name, field="valid")
        self._open(number)
        return self._observed(), self._info(0.0)

    def step(self, action: Any) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Drive one step.

        Raises a :class:`ConfigError` where the action is not in the space; continuous ones beyond it are clipped.
        """
        if isinstance(self.dynamics, Bicycle):
            number = _whole(action)
            if number is None or not 0 <= number < self.dynamics.num_actions:
                raise ConfigError(f"action {action} is not one of {self.dynamics.num_actions}")
            chosen = torch.tensor([number])
        else:
            numbers = np.asarray(action, np.float32)
            if numbers.shape != (2,) or not np.isfinite(numbers).all():
                raise ConfigError(f"an action is two finite numbers, not {action}")
            chosen = torch.as_tensor(numbers.clip(-1.0, 1.0) * (TOP_SPEED * self.env.dt))[None]
        before = self._now.get(keys.STATE)[0, :2]
        self._before = [*self._before, self._now][-round(HISTORY / self.env.dt) :]
        after = self.env.step(self._now.set(keys.ACTION, chosen)).get("next")
        reward, ended, cut = (after.get(key).item() for key in (keys.REWARD, "terminated", "truncated"))
        self._now = after.exclude(keys.REWARD)
        driven = float((self._now.get(keys.STATE)[0, :2] - before).norm())
        return self._observed(), reward, ended, cut, self._info(driven)

    def seen(self) -> Observation:
        """Return what a planner that is a function would observe now; its seed is 0."""
        ego, state = self.segment.ego, self._now.get(keys.STATE)[0].double().numpy()
        if self._told is None:
            which = int(self._scene.route_logged[0, 0])
            route = self._scene.whole_route(0, 0, which).numpy() if which >= 0 else np.zeros((0, 2), np.float32)
            first = self._before[0] if self._before else self._now
            told = scenario_of(self.segment, ego, route, first.get(keys.STATE)[0].numpy(), 0)
            self._told = told, lanes_of(told), crosswalks_of(told)
        told, lanes, crosswalks = self._told
        far = float(self._now.get(keys.PROGRESS)[0])
        now, past = self._moment(self._now), tuple(map(self._moment, self._before))
        at = self.segment, ego, int(self._now.get(keys.STEP)), state
        return observation_of(told, traffic_of(*at, now, past, route_from(told.route, far)), lanes, crosswalks)

    def _moment(self, now: TensorDictBase) -> Moment:
        row, step = now.get(keys.SCENE).flatten(), now.get(keys.STEP).flatten()
        everyone = self.env.objects(row, step, now.get(keys.STATE)[None], now.get(keys.VALID)[None])
        return everyone.state[0].double().numpy(), everyone.valid[0].numpy()

    def _usable(self, number: int) -> bool:
        segment = self.store[number]
        return bool(segment.valid[segment.ego, 0])

    def _open(self, number: int) -> None:
        """Start a segment of the store."""
        segment = self.store[number]
        if self.duration:
            steps = max(round(self.duration / segment.dt), 1) + 1
            segment = segment.during(slice(steps))
        self._scene = scene(segment, [segment.ego], LaneGraph(segment.road), number=number)
        self.segment, self.segment_id, ends = segment, segment.segment_id, self.ends_on
        self._before, self._told = [], None
        self.env = DrivingEnv(self._scene, self.dynamics, self.observation, reward=self.reward, ends_on=ends)
        self._now = self.env.start(torch.tensor(0), goal=self._scene.route_logged[0])

    def _observed(self) -> Observed:
        """Return the ego's observation as NumPy arrays."""
        seen: Observed = {}
        for name, value in self._now.get(("agents", "observation")).items():
            array = value[0].numpy()
            flags = array.dtype == np.bool_
            seen[name] = array.astype(np.int8) if flags else array.clip(-BOUND, BOUND).astype(np.float32)
        return seen

    def _info(self, driven: float) -> dict[str, Any]:
        return {
            "segment": self.segment_id,
            "step": int(self._now.get(keys.STEP)),
            "state": self._now.get(keys.STATE)[0].numpy().copy(),
            "collision": bool(self._now.get(keys.COLLISION)),
            "offroad": bool(self._now.get(keys.OFFROAD)),
            "driven": driven,
        }


def _whole(value: Any) -> int | None:
    """Return a single whole number, such as an int, a NumPy scalar or a tensor; None for anything else."""
    number = np.asarray(value)
    return int(number) if number.shape == () and number.dtype.kind in "iu" else None


def _space(value: NDArray[Any]) -> spaces.Space[Any]:
    if value.dtype == np.int8:
        # TorchRL reads the number, not a shape of one.
        return spaces.MultiBinary(value.shape[0] if value.ndim == 1 else value.shape)
    return spaces.Box(-BOUND, BOUND, value.shape, np.float32)
