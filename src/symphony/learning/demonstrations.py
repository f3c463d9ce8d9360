"""Scenes and expert states of a store, prepared once per segment and kept in memory."""

from __future__ import annotations

import math
import os
import warnings
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from operator import attrgetter
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from tensordict import TensorDict
from torch import Tensor

from symphony import keys
from symphony.config import PerturbConfig
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import ObservationConfig
from symphony.envs.routes import FollowedRoutes, RouteWindow, packed, route_choices
from symphony.envs.scene import SceneBatch, collate, scene
from symphony.errors import ConfigError, DataError, DataWarning
from symphony.geometry.frames import with_speed
from symphony.learning.experts import Experts, KeptExperts, expert_batch, fit_experts, logged, logged_routes
from symphony.roadgraph import LaneGraph

T = TypeVar("T")

SHARE = 0.125
"""Part of the machine's memory that one cache may take; a data set has two."""
GRAPHS = 64
"""Lane graphs held in memory."""
GOALS, PASSES = 128, 10
"""Agents per update of the goal policy, and how often it learns from each before it stops."""
DISPLACED = 2.0
"""Metres that a state to learn from may lie from the log, within which its place along the route is sought."""


def evenly_spaced(total: int, count: int) -> list[int]:
    """Return ``count`` numbers below ``total``, evenly spaced from 0 on, or all if there are fewer."""
    count = min(count, total)
    return [k * total // count for k in range(count)]


def room() -> int:
    """Return the bytes that a cache may hold; processes of one training share the machine."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return int(SHARE * total) // max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


class ItemCache(Generic[T]):
    """A cache of values made from items when first asked for, several at a time; those used longest ago go first.

    Warns once when items asked for have to go although fewer than ``keep`` are held.

    Args:
        make: function that returns the values of some items, in their order.
        size: function that returns the bytes of a value.
        keep: items held at most; None for no bound.
        limit: bytes held at most, beyond the last request; :func:`room` by default.
        name: name of the values, for the warning.

    Attributes:
        kept: what is held, with its bytes, by item.
    """

    def __init__(
        self,
        make: Callable[[Sequence[int]], list[T]],
        size: Callable[[T], int],
        *,
        keep: int | None = None,
        limit: int | None = None,
        name: str = "items",
    ) -> None:
        self.make, self.size, self.keep, self.name = make, size, keep, name
        self.limit = room() if limit is None else limit
        self.kept: OrderedDict[int, tuple[T, int]] = OrderedDict()
        self._held, self._warned = 0, False

    def __call__(self, item: int) -> T:
        """Return the value of one item."""
        return self.many([item])[0]

    def many(self, items: Sequence[int]) -> list[T]:
        """Return the values of several items, in their order."""
        missing = [item for item in dict.fromkeys(items) if item not in self.kept]
        for item, value in zip(missing, self.make(missing) if missing else [], strict=True):
            self.kept[item] = value, self.size(value)
            self._held += self.kept[item][1]
        found = [self.kept[item][0] for item in items]
        for item in items:
            self.kept.move_to_end(item)
        while self.keep is not None and len(self.kept) > self.keep:
            self._held -= self.kept.popitem(last=False)[1][1]
        while self._held > self.limit and len(self.kept) > 1:
            if not self._warned:
                self._warned = True
                much = f"{self.limit / 2**30:.2g} GiB of memory: {len(self.kept)} are kept"
                why = f"{self.name} take more than {much}, others are prepared again each time they are drawn"
                warnings.warn(why, DataWarning, stacklevel=2)
            self._held -= self.kept.popitem(last=False)[1][1]
        return found


class SceneDataset:
    """Random access to the scenes and experts of a store. It pickles without what it keeps in memory.

    Args:
        store: the run segments.
        interactive: agents per segment that act.
        dynamics: action space the experts are fitted to.
        indices: rows of the store to use; all by default.
        routes: whether scenes and experts come with their routes.
        duration: seconds of each segment that are used; 0 for all.
        keep: segments held in memory once they are prepared; None for as many as there is room for (a quarter of the
            machine's memory; 170 kB each in the built-in data, with routes).
        few_shapes: pad batches to a few shapes (see :func:`symphony.envs.scene.collate`), for compiled programs.

    Raises:
        DataError: on access, for a segment shorter than the duration.
    """

    def __init__(
        self,
        store: SegmentStore,
        interactive: int = 2,
        dynamics: Bicycle | Displacement | None = None,
        indices: Sequence[int] | None = None,
        *,
        routes: bool = False,
        duration: float = 0,
        keep: int | None = None,
        few_shapes: bool = False,
    ) -> None:
        self.store = store
        self.interactive = interactive
        self.dynamics = Bicycle() if dynamics is None else dynamics
        self.indices = list(range(len(store))) if indices is None else list(indices)
        self.routes, self.duration, self.keep, self.few_shapes = routes, duration, keep, few_shapes
        self.scene = ItemCache(
            lambda items: [self._scene(i) for i in items], SceneBatch.bytes, keep=keep, name="prepared run segments"
        )
        self.experts = ItemCache(self.fit, attrgetter("nbytes"), keep=keep, name="demonstrations")
        self.kept = KeptExperts(store.path, f"{self.dynamics} {duration} {routes}")
        self._graph = lru_cache(GRAPHS)(lambda number: LaneGraph(store.road(number)))
        # An update asks for the same ones twice, for states and for goals; what a batch derives stays with it.
        shapes: dict[str, list[int]] = {}
        self._batch = lru_cache(1)(
            lambda items: collate(self.scene.many(items), shapes=shapes if self.few_shapes else None)
        )
        self._placed = lru_cache(1)(lambda items, device: self.scenes(items).to(device))

    @property
    def _how(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("routes", "duration", "keep", "few_shapes")}

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(SceneDataset, **self._how), (self.store, self.interactive, self.dynamics, self.indices)

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def dt(self) -> float:
        """Seconds per step.

        Raises:
            DataError: if there is no segment, or segments differ in it; names one that does.
        """
        if not self.indices:
            raise DataError("the store holds no run segments", file=self.store.path)
        steps = self.store.time_steps[self.indices]
        other = np.flatnonzero(steps != steps[0])
        if len(other):
            why = f"has steps of {steps[other[0]]:g} s, others of {steps[0]:g} s"
            name = self.store.ids[self.indices[other[0]]]
            raise DataError(why, file=self.store.path, segment=name, field="dt")
        return float(steps[0])

    @property
    def open_traffic(self) -> bool:
        """Whether agents enter and leave: here they never do, as the same agents are present at every step."""
        return False

    @property
    def decisions(self) -> int:
        """The number of actions until the last logged step of the longest segment, or up to the duration."""
        longest = int(self.store.num_steps[self.indices].max()) - 1
        return min(longest, round(self.duration / self.dt)) if self.duration else longest

    def checksum(self) -> str:
        """Return the checksum of the store."""
        return self.store.checksum()

    def segment(self, i: int) -> RunSegment:
        """Return the run segment behind item ``i``, up to the duration."""
        segment = self.store[self.indices[i]]
        if not self.duration:
            return segment
        steps = round(self.duration / segment.dt) + 1
        if segment.num_steps < steps:
            why = f"has {(segment.num_steps - 1) * segment.dt:g} s, {self.duration:g} are asked for"
            why += "; only open traffic that is simulated, not evaluated or learned from, goes on past the log"
            raise DataError(why, file=self.store.path, segment=segment.segment_id)
        return segment.during(slice(steps))

    def graph(self, i: int) -> LaneGraph:
        """Return the lane graph of item ``i``; segments on one map share it."""
        return self._graph(int(self.store.map_index[self.indices[i]]))

    def _scene(self, i: int) -> SceneBatch:
        graph, segment = self.graph(i) if self.routes else None, self.segment(i)
        return scene(segment, self.interactive, graph, number=i)

    def scenes(self, items: Sequence[int]) -> SceneBatch:
        """Return several items as one padded batch."""
        return self._batch(tuple(items))

    def fit(self, items: Sequence[int]) -> list[Experts]:
        """Return the demonstrations of several items: those in the store, the others fitted together and kept."""
        contents = [self.store.content(self.indices[i]) for i in items]
        known = [self.kept.load(content) for content in contents]
        missing = [k for k, experts in enumerate(known) if experts is None]
        segments, graphs = [self.segment(items[k]) for k in missing], [self.graph(items[k]) for k in missing]
        made = fit_experts(segments, self.dynamics, graphs, routes=self.routes) if missing else []
        for k, experts in zip(missing, made, strict=True):
            self.kept.save(contents[k], experts)
            known[k] = experts
        return [experts for experts in known if experts is not None]

    def pick(self, states: int, count: int, items: Sequence[int], rng: torch.Generator) -> Int[Tensor, " K"]:
        """Return some of the states in the logs of items at random; a :class:`DataError` if they have none."""
        if not states:
            why = f"is the first of {len(items)} run segments drawn, none of which shows how a vehicle drives on"
            name = self.store.ids[self.indices[items[0]]]
            raise DataError(why, file=self.store.path, segment=name, field="valid")
        return torch.randint(states, (count,), generator=rng)

    def draw(self, count: int, rng: torch.Generator) -> list[int]:
        """Return different items at random (all, if there are fewer)."""
        return torch.randperm(len(self), generator=rng)[:count].tolist()

    def sample_states(
        self,
        items: Sequence[int],
        states: int,
        observation: ObservationConfig,
        rng: torch.Generator,
        device: torch.device | str = "cpu",
        perturb: PerturbConfig | None = None,
    ) -> TensorDict:
        """Return a training batch: expert states drawn from some segments, some of them displaced.

        Returns:
            TensorDict [states], one agent per row: observation, ``valid`` and the expert's ``action``.
        """
        found = self.experts.many(items)
        places = [expert.valid.nonzero(as_tuple=True) for expert in found]
        sizes = torch.tensor([len(which) for which, _ in places])
        scenes = self.scenes(items)
        pick = self.pick(int(sizes.sum()), states, items, rng)
        item = torch.repeat_interleave(torch.arange(len(items)), sizes)[pick]
        which, when = (torch.cat(parts)[pick] for parts in zip(*places, strict=True))
        ends = torch.tensor([len(expert.agent) for expert in found]).cumsum(0)
        row = which + torch.cat([ends.new_zeros(1), ends[:-1]])[item]
        # Segments may differ in length, so rows of states are looked up by their place in one flat list.
        lengths = torch.cat([torch.full((len(e.agent),), e.states.shape[1]) for e in found])
        begin = lengths.cumsum(0) - lengths
        state = torch.cat([e.states.flatten(0, 1) for e in found])[begin[row] + when]
        action = torch.cat([e.actions.flatten(0, 1) for e in found])[begin[row] - row + when]
        action = action.long() if self.dynamics.discrete else action
        agent = torch.cat([e.agent for e in found])[row]
        if perturb is not None:
            from symphony.learning import perturbation  # noqa: PLC0415 - few learn from displaced states

            now, later = (with_speed(scenes.log_state[item, when + k, agent]) for k in (0, 1))
            size = scenes.box_size[item, agent]
            how = self.dynamics, self.dt, perturb.share, rng
            state, action = perturbation.perturbed(state, action, now, later, size, *how)
        seen = None
        if observation.route:
            progress = torch.cat([e.progress.flatten() for e in found])[begin[row] + when]
            # An agent that is displaced along the route by some metres has come as far as where it is now.
            near = torch.full_like(progress, DISPLACED)[:, None]
            taken = logged_routes([one for e in found for one in e.routes], row)
            seen = taken.window(taken.progress(state[:, None, :2], progress[:, None], near))
        where = item.to(device), when.to(device), agent.to(device), state.to(device)
        routes = None if seen is None else RouteWindow(*(part.to(device) for part in seen))
        action = action.to(device)
        return expert_batch(self._placed(tuple(items), device), *where, observation, action=action, routes=routes)

    def goal_updates(self, most: int, processes: int = 1) -> int:
        """Return after how many updates the goal policy has learned from each expert ``PASSES`` times, at most
        ``most``. Soon after, it would know few choices by heart. Some segments tell how many agents are experts.
        """
        agents, some = self.store.num_agents[self.indices], evenly_spaced(len(self.indices), 32)
        share = sum(len(expert.agent) for expert in self.experts.many(some)) / max(int(agents[some].sum()), 1)
        return min(most, max(math.ceil(PASSES * share * int(agents.sum()) / (GOALS * processes)), 1))

    def sample_goals(
        self,
        items: Sequence[int],
        count: int | None,
        observation: ObservationConfig,
        rng: torch.Generator,
        device: torch.device | str = "cpu",
    ) -> TensorDict:
        """Return a training batch for the goal policy: experts at their first state, and their routes.

        Returns:
            TensorDict [count], one agent per row (all, without a count): observation, ``valid``, ``ROUTES``,
            ``ROUTES_MASK``, ``GOAL`` (-1 for vehicles on no lane) and ``GOAL_SET``, all that are equally right.
        """
        each = self.experts.many(items)
        found = [(i, k, t) for i, fit in enumerate(each) for k, t in enumerate(fit.valid.int().argmax(1).tolist())]
        # Routes begin where the log does, which a fit may reach later.
        found = [(i, k, t) for i, k, t in found if each[i].progress[k, t] <= 2 * DISPLACED]
        pick = None if count is None else self.pick(len(found), count, items, rng).tolist()
        chosen = found if pick is None else [found[k] for k in pick]
        item, _, when = torch.tensor(chosen).unbind(1)
        tables = [each[i].routes[k] for i, k, _ in chosen]
        points, first, length, *_, change = (torch.from_numpy(part).to(device) for part in packed(tables, 1))
        right = np.zeros(length.shape, np.bool_)
        for row, table in enumerate(tables):
            right[row, : len(table.right)] = table.right
        state = torch.stack([each[i].states[k, t] for i, k, t in chosen]).to(device)
        agent = torch.stack([each[i].agent[k] for i, k, _ in chosen])
        where = item.to(device), when.to(device), agent.to(device), state
        batch = expert_batch(self._placed(tuple(items), device), *where, observation)
        routes = FollowedRoutes(points, first[:, None], length[:, None])
        features, mask = route_choices(state[:, None], routes, change[:, None], observation.distance_scale)
        batch.set(keys.ROUTES, features)
        batch.set(keys.ROUTES_MASK, mask)
        batch.set(keys.GOAL, torch.tensor([[table.logged] for table in tables], device=device))
        # A route of one point is no choice (see `route_choices`).
        batch.set(keys.GOAL_SET, torch.from_numpy(right)[:, None].to(device) & mask)
        return batch

    def fitted(self, items: Sequence[int], scenes: SceneBatch) -> Fitted:
        """Return the motion of the interactive agents of some segments, as fitted to the action space."""
        state, valid = logged(scenes)
        state, progress, known = (state.clone(), torch.zeros_like(state[..., 0]), torch.zeros_like(valid[:, 1:]))
        action = torch.zeros_like(state[:, 1:, ..., :2])
        action = action[..., 0].long() if self.dynamics.discrete else action
        for b, expert in enumerate(self.experts.many(items)):
            steps = expert.states.shape[1]
            hit = expert.agent[:, None].to(scenes.device) == scenes.interactive[b]
            which, place = hit.nonzero(as_tuple=True)
            state[b, :steps, place] = expert.states.to(scenes.device)[which].transpose(0, 1)
            done = expert.actions.to(action)[which].transpose(0, 1)
            action[b, : steps - 1, place] = done
            known[b, : steps - 1, place] = expert.valid.to(scenes.device)[which].T
            if self.routes:
                progress[b, :steps, place] = expert.progress.to(scenes.device)[which].T
        return Fitted(state, valid, progress, action, known & scenes.interactive_valid[:, None])


class Fitted(NamedTuple):
    """The motion of interactive agents; those that are not experts move as logged, without actions."""

    state: Float[Tensor, "B T N 4"]
    valid: Bool[Tensor, "B T N"]  # where the log is
    progress: Float[Tensor, "B T N"]  # metres along the routes that were taken, 0 without routes
    action: Shaped[Tensor, "B Tm1 N ..."]
    known: Bool[Tensor, "B Tm1 N"]  # where the log is valid before and after an action


def transitions(
    data: SceneDataset, items: Sequence[int] | None = None, observation: ObservationConfig | None = None, **how: Any
) -> TensorDict:
    """Return the driving of the interactive agents in logs as steps of a :class:`DrivingEnv`: for replay buffers.

    Args:
        data: the segments; agents follow the routes that they took, where it has routes.
        items: some of them; all by default.
        observation: what the agents observe.
        how: ``reward`` and ``ends_on`` of the environment.

    Returns:
        TensorDict [M] of steps (s, a, r, s') with all entries of the environment's, the state after a step under
        ``"next"``, segment by segment in the order of time. ``VALID`` are agents whose action the log shows; steps
        without any are left out. The last step of a segment is ``truncated``.
    """
    from symphony.envs.driving import NO_ROUTES, DrivingEnv  # noqa: PLC0415 - cloning needs no environment

    items = range(len(data)) if items is None else items
    scenes = data.scenes(items)
    env, fit = DrivingEnv(scenes, data.dynamics, observation, **how), data.fitted(items, scenes)
    if env._follows and not data.routes:
        raise ConfigError(NO_ROUTES)
    row = torch.arange(len(scenes))[:, None].expand(fit.known.shape[:2])
    step = torch.arange(row.shape[1]).expand(row.shape)
    route = scenes.route_logged if data.routes else torch.full_like(scenes.interactive, -1)
    rows = {keys.SCENE: row, keys.STEP: step, keys.STREAM: scenes.stream[row]}
    each = {keys.GOAL: route[row], keys.STATE: fit.state[:, :-1], keys.VALID: fit.valid[:, :-1]}
    each |= {key: value[..., None] for key, value in rows.items()} | {keys.PROGRESS: fit.progress[:, :-1]}
    env._followed = data.routes  # even where none of the agents is on a lane
    found = env.step(env.at(TensorDict(each, batch_size=row.shape)).set(keys.ACTION, fit.action))
    for part in (found, found.get("next")):
        part.set(keys.VALID, fit.known)
    return found[fit.known.any(-1)]
