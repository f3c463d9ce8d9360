"""Scenes and expert states of a store, prepared once per segment and kept in memory."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cached_property, lru_cache, partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from symphony import keys
from symphony.config import PerturbConfig, SamplingConfig
from symphony.data.segment import RunSegment
from symphony.data.selection import interactive_choice
from symphony.data.store import SegmentStore
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import ObservationConfig
from symphony.envs.routes import RouteWindow, route_choices
from symphony.envs.scene import SceneBatch, collate, scene
from symphony.errors import DataError
from symphony.geometry.frames import with_speed
from symphony.roadgraph import LaneGraph
from symphony.simulation.experts import Experts, fit_experts
from symphony.simulation.kept import KeptExperts, KeptLists
from symphony.simulation.logged import expert_batch, logged, logged_routes
from symphony.simulation.memory import ItemCache
from symphony.simulation.weights import segment_weights, some_of, state_weights
from symphony.streams import stream_of, uniform

if TYPE_CHECKING:
    from symphony.simulation.personas import PersonaScale

GRAPHS = 64
"""Lane graphs held in memory."""
DISPLACED = 2.0
"""Metres that a state to learn from may lie from the log, for which its place along the route is looked for."""
_COUNT = (1 << 40) + 3
"""Number, in a segment's stream, of the draw of how many agents act: far above those of rollouts and steps."""


def evenly_spaced(total: int, count: int) -> list[int]:
    """Numbers below ``total``, evenly spaced from 0 on: ``count`` of them, or all if there are fewer."""
    count = min(count, total)
    return [k * total // count for k in range(count)]


class SceneDataset:
    """Random access to the scenes and experts of a store. Pickles without what it keeps in memory.

    Args:
        store: the run segments.
        interactive: agents per segment that act.
        dynamics: action space the experts are fitted to.
        indices: rows of the store to use; all by default.
        routes: whether scenes and experts come with their routes.
        duration: seconds of each segment that are used; 0 for all.
        keep: segments held in memory once they are prepared; None for as many as there is room for (a quarter of the
            machine's memory; 170 kB each in the built-in data, with routes, 220 with lists).
        sampling: what is drawn more often than the rest; nothing by default.
        most: where it is more than ``interactive``, the number that act is drawn for every segment, once and for all,
            between the two; a segment with fewer has those that there are.
        persona: whether the driving style of all agents is measured.
        num_points: how many of the nearest map points agents will see: lists of what these can be are made for each
            map and kept with the store. 0: what is near is found when it is asked for; the same, in more time.

    Raises:
        ConfigError, DataError: if its record is of another store or can't be read.
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
        sampling: SamplingConfig | None = None,
        most: int = 0,
        persona: bool = False,
        num_points: int = 0,
    ) -> None:
        self.store = store
        self.least, self.interactive = interactive, max(interactive, most)
        self.dynamics = Bicycle() if dynamics is None else dynamics
        self.indices = list(range(len(store))) if indices is None else list(indices)
        self.routes, self.duration, self.keep, self.persona = routes, duration, keep, persona
        self.num_points = num_points
        self.sampling = SamplingConfig() if sampling is None else sampling
        self._weights = segment_weights(self.sampling, store, self.indices)
        self.scene = ItemCache(self._prepared, _nbytes, keep=keep, name="prepared run segments")
        self.experts = ItemCache(self._experts, attrgetter("nbytes"), keep=keep, name="demonstrations")
        self.kept = KeptExperts(store.path, f"{self.dynamics} {duration} {routes}")
        self.lists = KeptLists(store.path, num_points) if num_points else None
        self._graph = lru_cache(GRAPHS)(lambda number: LaneGraph(store.road(number)))
        # An update asks for the same ones twice, for states and for goals; what a batch derives stays with it.
        # Of a drawn number of agents the rest is padding, so that N stays what it is.
        agents = 0 if self.least == self.interactive else self.interactive
        self._batch = lru_cache(1)(lambda items: collate(self.scene.many(items), agents))

    def __reduce__(self) -> tuple[Any, ...]:
        build = partial(
            SceneDataset,
            routes=self.routes,
            duration=self.duration,
            keep=self.keep,
            sampling=self.sampling,
            most=self.interactive,
            persona=self.persona,
            num_points=self.num_points,
        )
        return build, (self.store, self.least, self.dynamics, self.indices)

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
            raise DataError(
                f"has steps of {steps[other[0]]:g} s, others of {steps[0]:g} s",
                file=self.store.path,
                segment=self.store.ids[self.indices[other[0]]],
                field="dt",
            )
        return float(steps[0])

    @property
    def open_traffic(self) -> bool:
        """Whether agents enter and leave: here the same ones are there from the first step to the last."""
        return False

    @property
    def decisions(self) -> int:
        """Actions until the last logged step of the longest segment, or up to the duration."""
        longest = int(self.store.num_steps[self.indices].max()) - 1
        return min(longest, round(self.duration / self.dt)) if self.duration else longest

    def checksum(self) -> str:
        """Of the store, and of the record that says which segments are hard, if there is one."""
        if self._weights is None or self.sampling.hard is None:
            return self.store.checksum()
        return hashlib.sha256(self.store.checksum().encode() + self._weights.numpy().tobytes()).hexdigest()

    def segment(self, i: int) -> RunSegment:
        """The run segment behind item ``i``, up to the duration."""
        segment = self.store[self.indices[i]]
        if not self.duration:
            return segment
        steps = round(self.duration / segment.dt) + 1
        if segment.num_steps < steps:
            has = (segment.num_steps - 1) * segment.dt
            raise DataError(
                f"has {has:g} s, {self.duration:g} are asked for",
                file=self.store.path,
                segment=segment.segment_id,
            )
        timed = ("position", "heading", "velocity", "valid", "signal_state")
        return segment.replace(**{name: getattr(segment, name)[:, :steps] for name in timed})

    def graph(self, i: int) -> LaneGraph:
        """The lane graph of item ``i``; segments on one map share it."""
        return self._graph(int(self.store.map_index[self.indices[i]]))

    def _scene(self, i: int) -> SceneBatch:
        """Item ``i`` as a batch of one scene."""
        graph, segment = self.graph(i) if self.routes else None, self.segment(i)
        persona = self.personas.personas(self._styles(i)) if self.persona else None
        return scene(segment, self._interactive(segment), graph, number=i, persona=persona)

    @cached_property
    def personas(self) -> PersonaScale:
        """The driving styles of all items, measured when first asked for."""
        from symphony.simulation.personas import PersonaScale  # noqa: PLC0415 - few learn with them

        return PersonaScale.of(map(self._styles, range(len(self))))

    def _styles(self, i: int) -> NDArray[np.float64]:
        from symphony.simulation.personas import styles  # noqa: PLC0415

        return styles(self.segment(i), self.graph(i))

    def _interactive(self, segment: RunSegment) -> int | list[int]:
        """How many agents of a segment act, or which."""
        if self.least == self.interactive:
            return self.interactive
        # Of the segment's own stream, so that neither its place in the store nor an interruption matters.
        share = float(uniform(0, torch.tensor(stream_of(segment.segment_id)), _COUNT))
        count = self.least + int(share * (self.interactive - self.least + 1))
        chosen = interactive_choice(segment, count, fewer=True).agents.tolist()
        return chosen if len(chosen) >= self.least else self.least

    def _prepared(self, items: Sequence[int]) -> list[SceneBatch]:
        prepared = [self._scene(i) for i in items]
        if self.lists is None:
            return prepared
        return [self.lists.of(one).beside(one) for one in prepared]

    def scenes(self, items: Sequence[int]) -> SceneBatch:
        """Several items as one padded batch."""
        found: SceneBatch = self._batch(tuple(items))
        return found

    def _experts(self, items: Sequence[int]) -> list[Experts]:
        """The demonstrations of several items: those kept with the store, the others fitted together and kept."""
        contents = [self.store.content(self.indices[i]) for i in items]
        known = [self.kept.load(content) for content in contents]
        missing = [k for k, experts in enumerate(known) if experts is None]
        segments, graphs = [self.segment(items[k]) for k in missing], [self.graph(items[k]) for k in missing]
        made = fit_experts(segments, self.dynamics, graphs, routes=self.routes) if missing else []
        for k, experts in zip(missing, made, strict=True):
            self.kept.save(contents[k], experts)
            known[k] = experts
        return [experts for experts in known if experts is not None]

    def draw(self, count: int, rng: torch.Generator) -> list[int]:
        """Different items at random (all, if there are fewer)."""
        if self._weights is not None:
            return some_of(self._weights, count, self.sampling.share, rng)
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
        """A training batch: expert states drawn from some segments (see ``sampling``), some of them displaced.

        Returns:
            TensorDict [states], one agent per row: observation, ``valid`` and the expert's ``action``.
        """
        found = self.experts.many(items)
        places = [expert.valid.nonzero(as_tuple=True) for expert in found]
        sizes = torch.tensor([len(which) for which, _ in places])
        scenes = self.scenes(items)
        pick = self._pick(found, places, scenes, states, rng)
        item = torch.repeat_interleave(torch.arange(len(items)), sizes)[pick]
        which, when = (torch.cat(parts)[pick] for parts in zip(*places, strict=True))
        ends = torch.tensor([len(expert.agent) for expert in found]).cumsum(0)
        row = which + torch.cat([ends.new_zeros(1), ends[:-1]])[item]
        # Segments may differ in length, so rows of states are looked up by their place in one flat list.
        lengths = torch.cat([torch.full((len(e.agent),), e.states.shape[1]) for e in found])
        begin = lengths.cumsum(0) - lengths
        state = torch.cat([e.states.flatten(0, 1) for e in found])[begin[row] + when]
        ordinal = torch.arange(len(lengths))
        action = torch.cat([e.actions.flatten(0, 1) for e in found])[begin[row] - ordinal[row] + when]
        action = action.long() if self.dynamics.discrete else action
        agent = torch.cat([e.agent for e in found])[row]
        if perturb is not None:
            from symphony.simulation.perturbation import perturbed  # noqa: PLC0415 - likewise

            now, later = (with_speed(scenes.log_state[item, when + k, agent]) for k in (0, 1))
            size = scenes.box_size[item, agent]
            state, action = perturbed(state, action, now, later, size, self.dynamics, self.dt, perturb, rng)
        seen = None
        if observation.route:
            progress = torch.cat([e.progress.flatten() for e in found])[begin[row] + when]
            seen = _seen_routes(found, row, progress, state)
        return expert_batch(
            scenes.to(device),
            item.to(device),
            when.to(device),
            agent.to(device),
            state.to(device),
            observation,
            action=action.to(device),
            routes=None if seen is None else RouteWindow(*(part.to(device) for part in seen)),
        )

    def _pick(
        self,
        experts: Sequence[Experts],
        places: Sequence[tuple[Tensor, ...]],
        scenes: SceneBatch,
        count: int,
        rng: torch.Generator,
    ) -> Int[Tensor, " count"]:
        """Numbers of some of all valid expert states."""
        if self.sampling.even:
            return torch.randint(sum(len(which) for which, _ in places), (count,), generator=rng)
        acts = [
            torch.isin(expert.agent[which], chosen[real])
            for expert, (which, _), chosen, real in zip(
                experts, places, scenes.interactive, scenes.interactive_valid, strict=True
            )
        ]
        speed = [expert.states[place][:, 3] for expert, place in zip(experts, places, strict=True)]
        weights = state_weights(torch.cat(acts), torch.cat(speed), self.sampling)
        if not (weights > 0).any():
            raise DataError(
                "none of the states drawn for an update counts; give a larger batch or weights above 0",
                file=self.store.path,
                field="sampling",
            )
        return torch.multinomial(weights, count, replacement=True, generator=rng)

    def sample_goals(
        self,
        items: Sequence[int],
        count: int,
        observation: ObservationConfig,
        rng: torch.Generator,
        device: torch.device | str = "cpu",
    ) -> TensorDict:
        """A training batch for the goal policy: experts at their first state, their routes and the one they took.

        Returns:
            TensorDict [count], one agent per row: observation, ``valid``, ``ROUTES``, ``ROUTES_MASK``, ``GOAL``
            (-1 for vehicles on no lane) and ``GOAL_SET``, all that are equally right.
        """
        each = self.experts.many(items)
        found = [(i, expert, k) for i, expert in enumerate(each) for k in range(len(expert.agent))]
        pick = torch.randint(len(found), (count,), generator=rng).tolist()
        chosen = [found[k] for k in pick]
        when = torch.stack([e.valid[k].int().argmax() for _, e, k in chosen])
        tables = [e.routes[k] for _, e, k in chosen]
        most = max(1, *(len(table.count) for table in tables))
        firsts, counts = np.zeros((2, count, most), np.int64)
        right, begin = np.zeros((count, most), np.bool_), 0
        for row, table in enumerate(tables):
            counts[row, : len(table.count)] = table.count
            firsts[row, : len(table.count)] = begin + np.cumsum(table.count) - table.count
            right[row, : len(table.count)] = table.right
            begin += len(table.points)
        points = np.concatenate([table.points for table in tables])
        state = torch.stack([e.states[k, int(t)] for (_, e, k), t in zip(chosen, when, strict=True)]).to(
            device
        )
        batch = expert_batch(
            self.scenes(items).to(device),
            torch.tensor([i for i, _, _ in chosen], device=device),
            when.to(device),
            torch.stack([e.agent[k] for _, e, k in chosen]).to(device),
            state,
            observation,
        )
        features, mask = route_choices(
            state[:, None],
            torch.from_numpy(points).to(device),
            torch.from_numpy(firsts)[:, None].to(device),
            torch.from_numpy(counts)[:, None].to(device),
            observation.distance_scale,
            turns=observation.turns,
        )
        batch.set(keys.ROUTES, features)
        batch.set(keys.ROUTES_MASK, mask)
        batch.set(keys.GOAL, torch.tensor([[table.logged] for table in tables], device=device))
        # A route of one point is no choice (see `route_choices`).
        batch.set(keys.GOAL_SET, torch.from_numpy(right)[:, None].to(device) & mask)
        return batch

    def fitted(self, items: Sequence[int], scenes: SceneBatch) -> tuple[Tensor, Tensor, Tensor]:
        """What the interactive agents of some segments did, as the fit to the action space has it.

        Args:
            items: the segments.
            scenes: their scenes.

        Returns:
            States [B, T, N, 4], where the log is valid [B, T, N], and metres along the routes that were taken
            [B, T, N], 0 without routes; agents that are no experts as logged.
        """
        state, valid = logged(scenes)
        state, valid, progress = state.clone(), valid.clone(), torch.zeros_like(state[..., 0])
        for b, expert in enumerate(self.experts.many(items)):
            steps = expert.states.shape[1]
            hit = expert.agent[:, None].to(scenes.device) == scenes.interactive[b]
            which, place = hit.nonzero(as_tuple=True)
            state[b, :steps, place] = expert.states.to(scenes.device)[which].transpose(0, 1)
            if self.routes:
                progress[b, :steps, place] = expert.progress.to(scenes.device)[which].T
        return state, valid, progress


def _seen_routes(
    experts: Sequence[Experts],
    row: Int[Tensor, " M"],
    progress: Float[Tensor, " M"],
    state: Float[Tensor, "M 4"],
) -> RouteWindow:
    """What experts see of the routes they took from states that may lie beside where they were."""
    taken = logged_routes([table for expert in experts for table in expert.routes], row)
    # Whoever is displaced along the route by up to some metres has come as far as where it is now.
    near = torch.full_like(progress, DISPLACED)[:, None]
    return taken.window(taken.progress(state[:, None, :2], progress[:, None], near))


def _nbytes(scene: SceneBatch) -> int:
    return sum(getattr(scene, name).nbytes for name in SceneBatch.__annotations__)
