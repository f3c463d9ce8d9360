"""The driving environment: interactive agents act, all others are played back from the log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import torch
from jaxtyping import Bool, Float, Int, Shaped
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from symphony import keys
from symphony.envs.dynamics import BOUNDS, Bicycle, Displacement
from symphony.envs.flags import collision_flags, offroad_flags
from symphony.envs.objects import Objects, entering, everyone_at, rows_of
from symphony.envs.observation import ObservationConfig, observation_spec, observe_states
from symphony.envs.routes import route_choices
from symphony.envs.scene import SceneBatch, SceneSource, Tables, leaving, with_few_steps
from symphony.errors import ConfigError
from symphony.geometry.frames import with_speed
from symphony.geometry.nearest import has_values, on_host
from symphony.streams import fold_in

Event = Literal["collision", "offroad"]
AfterCollision = Literal["go-on", "stop", "remove", "respawn"]
EVENTS = {"collision": keys.COLLISION, "offroad": keys.OFFROAD}  # what can end an episode
NO_ROUTES = "agents observe or draw routes, but their scenes come without: SceneDataset(..., routes=True)"
NO_GOALS = "agents observe routes and follow none: TransformedEnv(env, RouteGoals()), or start(..., goal)"


def penalty(before: TensorDictBase, after: TensorDictBase) -> Float[Tensor, "*b N"]:
    """Return the reward: -1 for an agent that collides or is off the road or nowhere, else 0."""
    bad = after.get(keys.COLLISION) | after.get(keys.OFFROAD)
    state = after.get(keys.STATE)
    return -(bad.squeeze(-1) | _nowhere(state, after.get(keys.VALID))).to(state.dtype)


def _nowhere(state: Float[Tensor, "*b N 4"], valid: Bool[Tensor, "*b N"]) -> Bool[Tensor, "*b N"]:
    return valid & ~state.isfinite().all(-1)


class State(NamedTuple):
    """The complete simulation state; leading dimensions [*b] are those of the batch."""

    scene: Tensor  # [*b] rows of the scene batch
    step: Tensor  # [*b] simulated steps since the first state
    stream: Tensor  # [*b] identity of the rollout
    state: Tensor  # [*b, N, 4] x, y, heading, speed
    valid: Tensor  # [*b, N] which agents are present
    goal: Tensor  # [*b, N] routes that agents follow, -1 for none
    progress: Tensor  # [*b, N] metres that they have come along them
    waiting: Tensor | None = None  # [*b, N] which have not entered yet; None where traffic is not open


class DrivingEnv(EnvBase):
    """A batch of logged scenes in which N agents are driven by actions (paper, section II-A).

    All simulation state is in the TensorDict: which scene (``scene``), the step, the rollout's identity (``stream``),
    the state of the interactive agents and the routes they follow. The environment holds only constants, so forking a
    branch is an index and one instance serves every batch shape. Where the scenes say where their maps end, traffic
    is open: agents enter where the log brings them in, once there is room for them (they wait beside the road), and
    leave at the edge of the map; absent agents are not ``valid``. An episode ends at the last step of its scene
    (``truncated``), or at what ``ends_on`` names (``terminated``). An action that is not finite leaves its agent
    nowhere, which also ends the episode (``terminated``), so that no step waits for a device. Simulations with an
    agent's networks raise an error at their end that names agent and step (:class:`NotFiniteError`).

    Args:
        scenes: static data of B segments, all with the same number of interactive agents; or a source, from which
            every reset of a whole batch draws as many as the batch has rows.
        dynamics: :class:`Bicycle` (joint discrete actions) or :class:`Displacement` (metres).
        observation: what the agents observe.
        reward: reward ``[*b, N]`` of a step, from the state before it (with its action) and the state after it; by
            default -1 for an agent that collides or is off the road.
        ends_on: what ends the episode of a scene, after a step, for any of its interactive agents.
        after_collision: what becomes of interactive agents whose boxes overlap another: they ``go-on``, ``stop`` for
            as long as they overlap, are gone from the next step on (``remove``), or until there is room where they
            began (``respawn``); the last two in open traffic only.
        seed: the seed of the scenes that :meth:`reset` draws; by default another in every instance and process.
        generator: the generator that draws them instead.
        device: the device of scenes from a source; others stay where they are.

    ``reset(rows, set_state=False)`` starts the scenes named in their ``scene`` entry, or draws them at random; rows
    reset alone start other scenes of those at hand. ``reset(state, set_state=True)`` starts from the given simulation
    state. Raises a :class:`ConfigError` for an unknown name in ``ends_on`` or ``after_collision``, both seed and
    generator, routes observed and not there, or agents that leave where traffic is not open.
    """

    batch_locked = False
    branchable = True
    _supports_set_state = True
    _scenes: SceneBatch | None = None
    open_traffic: bool = False
    dt: float = 0.0
    _followed: bool = False  # whether routes were ever given

    def __init__(
        self,
        scenes: SceneBatch | SceneSource,
        dynamics: Bicycle | Displacement | None = None,
        observation: ObservationConfig | None = None,
        *,
        reward: Callable[[TensorDictBase, TensorDictBase], Tensor] | None = None,
        ends_on: Sequence[Event] = (),
        after_collision: AfterCollision = "go-on",
        seed: int | None = None,
        generator: torch.Generator | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        fixed = scenes if isinstance(scenes, SceneBatch) else None
        super().__init__(device=device if fixed is None else fixed.log_state.device, batch_size=[])
        if set(ends_on) - EVENTS.keys():
            raise ConfigError(f"ends_on names {', '.join(EVENTS)}, not {', '.join(map(str, ends_on))}")
        if after_collision not in get_args(AfterCollision):
            known = ", ".join(get_args(AfterCollision))
            raise ConfigError(f"after_collision is one of {known}, not {after_collision}")
        if after_collision in ("remove", "respawn") and not scenes.open_traffic:
            raise ConfigError(f"after_collision '{after_collision}' needs open traffic")
        if seed is not None and generator is not None:
            raise ConfigError("give a seed or a generator, not both")
        self.source: SceneSource | None = None if isinstance(scenes, SceneBatch) else scenes
        self.dynamics = Bicycle() if dynamics is None else dynamics
        self.observation = ObservationConfig() if observation is None else observation
        self._follows = self.observation.route or self.observation.along
        if self._follows and not getattr(scenes, "routes", True):
            raise ConfigError(NO_ROUTES)
        self.reward = penalty if reward is None else reward
        self.ends_on, self.after_collision = tuple(EVENTS[name] for name in ends_on), after_collision
        self._rng = torch.Generator() if generator is None else generator
        if generator is None:
            self._set_seed(seed)
        if fixed is not None:
            self.scenes = fixed
        elif self.source is not None:
            self.open_traffic = self.source.open_traffic
            self.dt = 0.0 if self.dynamics.discrete else float(self.source.dt)
        self._make_specs()

    @property
    def num_agents(self) -> int:
        """N, interactive agents per scene."""
        return self.scenes.interactive.shape[1] if self.source is None else self.source.interactive

    @property
    def scenes(self) -> SceneBatch:
        """The current scenes.

        Raises a :class:`ConfigError` before the first reset of an environment that draws from a source.
        """
        if self._scenes is None:
            raise ConfigError("no scenes yet: reset draws them from the source")
        return self._scenes

    @scenes.setter
    def scenes(self, scenes: SceneBatch) -> None:
        self._scenes, before = scenes, (self.open_traffic, self.dt)
        # Read here, once: a step or a search must not wait for the device to tell.
        self.dt = float(scenes.dt[0])  # seconds per step, that of the scenes
        self.decisions = int(scenes.last_step.max())  # actions until the longest scene's last step
        self.past_log = bool((scenes.last_step > scenes.log_end).any())  # whether some scene is longer
        drawn_open = self.source is not None and self.source.open_traffic
        self.open_traffic = drawn_open or scenes.open_traffic  # whether agents enter and leave
        if (self.open_traffic, self.dt if isinstance(self.dynamics, Displacement) else before[1]) != before:
            self._make_specs()

    def _make_specs(self) -> None:
        self._tables: Tables | None = None
        n, device = self.num_agents, self.device

        def flags(*shape: int) -> Binary:
            return Binary(shape=shape, dtype=torch.bool, device=device)

        def numbers(*shape: int, dtype: torch.dtype = torch.float32) -> Unbounded:
            return Unbounded(shape=shape, dtype=dtype, device=device)

        def rows(*names: str, **agents: Any) -> Composite:
            own = {name: numbers(1, dtype=torch.int64) for name in names}
            return Composite(**own, agents=Composite(agents, shape=(n,)))

        state: dict[str, Any] = {"valid": flags(n), "state": numbers(n, 4), "progress": numbers(n)}
        state["goal"] = numbers(n, dtype=torch.int64)
        if self.open_traffic:
            state["waiting"] = flags(n)
        seen = observation_spec(self.observation, n, device)
        observed = {} if seen.is_empty() else {"observation": seen}
        outcome = {"collision": flags(n, 1), "offroad": flags(n, 1)}
        self.state_spec = rows("scene", "step", "stream", **state)
        self.observation_spec = rows("scene", "step", "stream", "segment", **state, **observed, **outcome)
        if isinstance(self.dynamics, Bicycle):
            action: Any = Categorical(self.dynamics.num_actions, shape=(n,), dtype=torch.int64, device=device)
        else:
            bounds = self.dt * torch.tensor(BOUNDS, dtype=torch.float32)[:, None].expand(2, n, 2)
            action = Bounded(*bounds, device=device, dtype=torch.float32)
        self.action_spec, self.reward_spec = rows(action=action), rows(reward=numbers(n, 1))
        self.done_spec = Composite(done=flags(1), terminated=flags(1), truncated=flags(1))

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            self._rng.seed()
        else:
            self._rng.manual_seed(seed)

    def to(self, device: torch.device | str | int) -> DrivingEnv:
        """Move the environment and its scenes to a device."""
        moved = super().to(device)
        if moved._scenes is not None and moved._scenes.log_state.device != moved.device:
            moved.scenes = moved.scenes.to(moved.device)
        return moved

    def compile(self, *args: Any, **kwargs: Any) -> None:
        """Compile the step in place, as :meth:`torch.nn.Module.compile` compiles a forward pass.

        This saves the calls of small operators, of which a step of few agents consists; with many it is slower.
        Copies of the environment are not compiled. The default backend of :func:`torch.compile` needs a C++ compiler.
        """
        step = torch.compile(type(self)._step.__get__(self), *args, **kwargs)
        self._step = step  # type: ignore[method-assign]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in super().__getstate__().items() if name != "_step"}

    def start(
        self, scene: Int[Tensor, "*b"], rollout: Int[Tensor, "*b"] | int = 0, goal: Int[Tensor, "*b N"] | None = None
    ) -> TensorDict:
        """Return the state at the first logged step, as :meth:`reset` returns it.

        The shape of ``scene``, rows of the scene batch, is the batch size. The number of a ``rollout`` (branch,
        repetition) in its scene lets each draw its own in any batch. Goals are routes to follow; by default none.
        """
        rollout = torch.as_tensor(rollout, device=scene.device).expand(scene.shape)
        stream = fold_in(self.scenes.stream[scene], rollout)
        real, early = self.scenes.interactive_valid[scene], self.scenes.enter[scene] == 0
        waiting, first = real & ~early if self.open_traffic else None, self._first(scene)
        begin, progress = torch.zeros_like(scene), torch.zeros_like(first[..., 0])
        none = torch.full_like(real, -1, dtype=torch.int64)
        start = State(scene, begin, stream, first, real & early, none, progress, waiting)
        return self._from_state(start if goal is None else self._following(start, goal))

    def _first(self, scene: Int[Tensor, "*b"]) -> Float[Tensor, "*b N 4"]:
        """Return the states in which agents begin; those that enter later begin where the log has them then."""
        row, index, enter = scene[..., None], self.scenes.interactive[scene], self.scenes.enter[scene]
        first = with_speed(self.scenes.log_state[row, enter, index])
        return torch.cat([first[..., :3], first[..., 3:].clamp_min(0.0)], -1)

    def at(self, state: TensorDictBase) -> TensorDict:
        """Return observation and flags of simulation states (of ``state_spec``), ended ones included."""
        return self._from_state(self._read(state))

    def choices(self, state: TensorDictBase) -> TensorDictBase:
        """Add the feasible routes of a start state, as the goal policy observes them. Writes ``ROUTES`` [..., N, G,
        F] and ``ROUTES_MASK`` [..., N, G] into a copy.
        """
        row, state = state.get(keys.SCENE).squeeze(-1), state.copy()
        (moved,), routes = _flat(row.ndim, state.get(keys.STATE)), self.scenes.routes.among(row.flatten())
        change = self.scenes.route_change[row.flatten()]
        features, mask = route_choices(moved, routes, change, self.observation.distance_scale)
        state.set(keys.ROUTES, features.reshape(*row.shape, *features.shape[1:]))
        return state.set(keys.ROUTES_MASK, mask.reshape(*row.shape, *mask.shape[1:]))

    def with_goals(self, state: TensorDictBase, goal: Int[Tensor, "*b N"] | None = None) -> TensorDict:
        """Return a start state whose agents follow the given routes (by default those nearest to the log)."""
        start = self._read(state)
        goal = self.scenes.route_logged[start.scene] if goal is None else goal
        return self._from_state(self._following(start, goal))

    def _following(self, start: State, goal: Int[Tensor, "*b N"]) -> State:
        self._followed = True
        start = start._replace(goal=goal, progress=torch.zeros_like(start.progress))
        return start._replace(progress=self._progress(start, start.state))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        if tensordict is None:
            tensordict = TensorDict({}, batch_size=[], device=self.device)
        partial = tensordict.get("_reset", None)
        # Unless told otherwise, TorchRL takes whatever names a scene, or is reset in part, for a state to begin from.
        whole = partial is None and tensordict.get(keys.STATE, None) is not None
        if kwargs.get("set_state") and whole:
            return self._from_state(self._read(tensordict))
        named = tensordict.get(keys.SCENE, None)
        if named is not None and partial is None:
            scene = named.squeeze(-1)
        else:
            renew = partial is None or (self.source is not None and bool(partial.all()))
            scene = self._draw(tensordict.batch_size, renew=renew).to(self.device)
        rollout = torch.randint(1 << 31, tuple(scene.shape), generator=self._rng).to(self.device)
        fresh = self.start(scene, rollout)
        if partial is None:
            return fresh
        kept = fresh.copy().update(tensordict.select(*fresh.keys(True, True), strict=False))
        return torch.where(partial.squeeze(-1), fresh, kept)

    def _draw(self, shape: torch.Size, *, renew: bool) -> Int[Tensor, "*b"]:
        """Return the rows of the scenes that a batch starts, current ones or new ones of a source."""
        if self.source is None or (not renew and self._scenes is not None):
            return torch.randint(len(self.scenes), tuple(shape), generator=self._rng)
        items = self.source.draw(shape.numel(), self._rng)
        scenes = self.source.scenes(items)
        few = getattr(self.source, "few_shapes", False)
        self.scenes = (with_few_steps(scenes) if few else scenes).to(self.device)
        # A source with fewer segments than the batch has rows gives some of them more than once.
        return (torch.arange(shape.numel()) % len(items)).reshape(shape)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        now = self._read(tensordict)
        if self._follows and not self._followed and has_values():
            if bool((now.goal < 0).all()):
                raise ConfigError(NO_GOALS)
            self._followed = now.goal.device.type != "cpu"  # where looking waits, once is enough
        index = _of(self.scenes.interactive, now.scene)
        size = self.scenes.box_size[now.scene[..., None], index]
        after = self._moved(tensordict, now.state, size)
        after = torch.where(now.valid[..., None], after, now.state)
        valid, waiting, hit = now.valid, now.waiting, None
        if self.after_collision != "go-on":
            hit = valid & tensordict.get(keys.COLLISION).squeeze(-1)
            still = torch.cat([now.state[..., :3], torch.zeros_like(now.state[..., 3:])], -1)
            after = torch.where(hit[..., None], still, after)
            valid = valid if self.after_collision == "stop" else valid & ~hit
        if waiting is not None:
            valid, waiting = self._flow(now.scene, now.step + 1, now.state, after, valid, waiting)
        progress = self._progress(now, after)
        if hit is not None and waiting is not None and self.after_collision == "respawn":
            waiting, progress = waiting | hit, progress.masked_fill(hit, 0.0)
            after = torch.where(hit[..., None], self._first(now.scene), after)
        later = now._replace(step=now.step + 1, state=after, valid=valid, progress=progress, waiting=waiting)
        out = self._from_state(later)
        earned = self.reward(tensordict, out)
        return out.set(keys.REWARD, earned.reshape(*valid.shape, 1))

    @torch.no_grad()
    def _progress(self, before: State, after: Float[Tensor, "*b N 4"]) -> Float[Tensor, "*b N"]:
        """Return metres [..., N] that agents have come along their routes, from where they were before."""
        if self.scenes.route_point.shape[1] == 0:
            return before.progress
        old, new, goal, about = _flat(before.scene.ndim, before.state, after, before.goal, before.progress)
        moved = (new[..., :2] - old[..., :2]).square().sum(-1).sqrt()
        routes = self.scenes.routes.of(before.scene.flatten(), goal)
        return routes.progress(new[..., :2], about, moved).reshape(before.progress.shape)

    def _moved(self, tensordict: TensorDictBase, state: Tensor, size: Tensor) -> Float[Tensor, "*b N 4"]:
        """Return the agents [..., N, 4] a step later, boxes [..., N, 2]."""
        return self.dynamics.step(state, tensordict.get(keys.ACTION), size, self.dt)

    def _flow(
        self, scene: Tensor, step: Tensor, before: Tensor, after: Tensor, valid: Tensor, waiting: Tensor
    ) -> tuple[Bool[Tensor, "*b N"], Bool[Tensor, "*b N"]]:
        """Return which agents [..., N] are present after a step, and which wait; those that have left do neither."""
        row, at = scene.flatten(), step.flatten()
        old, new, there, waits = _flat(scene.ndim, before, after, valid, waiting)
        gone = leaving(old[..., :2], new[..., :2], self.scenes.exits[row], self.scenes.hull[row])
        there = there & ~gone
        ready = waits & (at[:, None] >= self.scenes.enter[row])
        # In most steps no agent can enter; only a device would have to wait to know.
        if not on_host(ready) or bool(ready.any()):
            index = self.scenes.interactive[row]
            late = self.scenes.enter[row] > self.scenes.log_end[row, None] if self.past_log else None
            enters = entering(self.objects(row, at, new, there | ready), index, ready, late)
            there, waits = there | enters, waits & ~enters
        return there.reshape(valid.shape), waits.reshape(valid.shape)

    def objects(self, row: Tensor, step: Tensor, state: Tensor, valid: Tensor) -> Objects:
        """Return all objects at logged steps of scenes ``row``: ``valid`` agents in their states, others logged."""
        return everyone_at(self.scenes, row, step, state, valid)

    def _read(self, tensordict: TensorDictBase) -> State:
        scene, step, stream = (tensordict.get(k).squeeze(-1) for k in (keys.SCENE, keys.STEP, keys.STREAM))
        state, valid, goal, progress = (tensordict.get(k) for k in (keys.STATE, keys.VALID, keys.GOAL, keys.PROGRESS))
        waiting = tensordict.get(keys.WAITING) if self.open_traffic else None
        return State(scene, step, stream, state, valid, goal, progress, waiting)

    def _from_state(self, now: State) -> TensorDict:
        """Return observation, flags and end of the episode, all functions of the simulation state."""
        scenes, shape = self.scenes, now.scene.shape
        row, at = now.scene.flatten(), now.step.flatten()
        moved, real, goal, progress = _flat(len(shape), now.state, now.valid, now.goal, now.progress)
        along: dict[str, Tensor] = {"goal": goal, "progress": progress} if self._follows else {}
        seen, objects = observe_states(scenes, row, at, moved, real, self.observation, tables=self._kept(), **along)
        index = scenes.interactive.index_select(0, row)
        with torch.no_grad():
            collision = collision_flags(objects, index) & real
            if "road" in seen:
                offroad = (seen["road"][..., 0] > 0) & real
            else:
                place = rows_of(objects.state, index)[..., :2]
                height = None if objects.height is None else rows_of(objects.height, index)
                offroad = offroad_flags(scenes, row, place, self._kept(), height) & real
        truncated = at >= scenes.last_step[row]
        flags = {keys.COLLISION: collision, keys.OFFROAD: offroad}
        terminated = _nowhere(moved, real).any(-1)
        for key in self.ends_on:
            terminated = terminated | flags[key].any(-1) & (at > 0)  # a reset must not end it

        def back(value: Shaped[Tensor, "M ..."]) -> Shaped[Tensor, "*_"]:
            return value.reshape((*shape, *value.shape[1:]))

        def nested(parts: dict[str, Any]) -> TensorDict:
            # One without a device would be taken for a transfer, and waited for.
            return TensorDict(parts, batch_size=[*shape, self.num_agents], device=self.device)

        agents: dict[str, Any] = {name: getattr(now, name) for name in ("valid", "state", "goal", "progress")}
        agents |= {"collision": back(collision)[..., None], "offroad": back(offroad)[..., None]}
        if now.waiting is not None:
            agents["waiting"] = now.waiting
        if seen:
            agents["observation"] = nested({name: back(value) for name, value in seen.items()})
        rows = {"scene": now.scene, "step": now.step, "stream": now.stream}
        rows |= {"segment": _of(scenes.segment, now.scene), "done": back(truncated | terminated)}
        rows |= {"truncated": back(truncated), "terminated": back(terminated)}
        whole = {name: value[..., None] for name, value in rows.items()} | {"agents": nested(agents)}
        return TensorDict(whole, batch_size=shape, device=self.device)

    def _kept(self) -> Tables:
        """Return the tables of the current scenes that each step looks up."""
        if self._tables is None or self._tables.scenes is not self.scenes:
            self._tables = Tables(self.scenes, self.observation)
        return self._tables


def _flat(ndim: int, *values: Tensor) -> list[Tensor]:
    """Return the values with their first ``ndim`` dimensions flattened into one."""
    return [value.reshape(-1, *value.shape[ndim:]) for value in values]


def _of(table: Shaped[Tensor, "B ..."], scene: Int[Tensor, "*b"]) -> Shaped[Tensor, "*_"]:
    """Return table[scene], which would not compile for a single scene as a number without dimensions."""
    return table.index_select(0, scene.flatten()).reshape((*scene.shape, *table.shape[1:]))
