"""The one evaluator: used by the trainer, the command line and the recipes."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from symphony.agents import Agent, load_agent
from symphony.config import EvaluateConfig
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.envs.objects import rollout_heights
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError, DataError
from symphony.imports import load_object
from symphony.learning.demonstrations import SceneDataset
from symphony.learning.logged import logged, logged_heights
from symphony.metrics import (
    AgentSteps,
    Choice,
    CollisionKinds,
    RolloutMetrics,
    Standing,
    choices,
    collision_kinds,
    route_turns,
    standing_at_end,
)
from symphony.roadgraph import LaneGraph, visited_curvatures
from symphony.rollouts.crowd import crowd_dataset
from symphony.rollouts.driving import Simulation, simulate_batch
from symphony.rollouts.finite import NotFiniteError
from symphony.rollouts.unroll import Rollouts, existing
from symphony.rollouts.workers import batches, naming, segments_together, shared

BASELINES = ("playback", "constant_velocity")
"""Evaluated beside every agent, on the agents it drives and for as long."""
Metric = Callable[[SceneBatch, Rollouts], Float[Tensor, "B K"]]
"""A metric of a user's own: a number [B, K] per rollout, NaN where there is none."""


class EvaluatedBatch(NamedTuple):
    """Scenes and the very rollouts that the metrics are of.

    Attributes:
        items: numbers of the run segments in their dataset.
        segments: the run segments.
        scenes: B scenes, on the CPU.
        rollouts: [B, K, ...], on the CPU.
        goal: [B, K, N] number of the route that each agent followed, -1 for none.
    """

    items: list[int]
    segments: list[RunSegment]
    scenes: SceneBatch
    rollouts: Rollouts
    goal: Int[Tensor, "B K N"]


@dataclass(frozen=True)
class Evaluation:
    """What the evaluator found.

    Attributes:
        agent: its name.
        metrics: accumulated over all run segments.
        config: how it was evaluated.
        interactive: agents per segment that acted, at most, or ``all``.
        search: how the rollouts came about: ``none``, ``tree``, ``backtrack``, ``best``; ``log`` for playback.
        own: mean of each metric of the user's own by run segment, by import path.
        seconds: CPU time of the simulation, what it costs.
        steps: that were simulated, each of a rollout or branch, those that a search dropped included.
        horizon: seconds that the longest rollout lasts.
        baselines: the same of :data:`BASELINES`, where they were asked for.
    """

    agent: str
    metrics: RolloutMetrics
    config: EvaluateConfig
    interactive: int | Literal["all"]
    search: str
    own: dict[str, dict[str, float]] = field(default_factory=dict)
    seconds: float = 0.0
    steps: int = 0
    horizon: float = 0.0
    baselines: tuple[Evaluation, ...] = ()

    def numbers(self) -> dict[str, float | int | str]:
        """The table row: rates in percent, distances in metres, divergence in nats, standard errors beside them."""
        own: dict[str, float] = {}
        for path, values in self.own.items():
            own[path], own[f"{path}_se"] = self.metrics.mean(values)
        return {
            "agent": self.agent,
            **self.metrics.compute(),
            **own,
            "interactive": self.interactive,
            "search": self.search,
            "trees": self.config.trees if self.search == "tree" else 0,
            "seed": self.config.seed,
        }


def evaluate(
    agent: Agent | str,
    data: SegmentStore | Path,
    config: EvaluateConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    items: Sequence[int] | None = None,
    baselines: bool = False,
    observe: Callable[[EvaluatedBatch], None] | None = None,
) -> Evaluation:
    """Evaluate an agent on every run segment of a store (paper, section V-B).

    Args:
        agent: an agent, or the name of one (see :func:`symphony.agents.load_agent`).
        data: a store, or its folder.
        config: how.
        progress: called with the segments done and their total.
        items: only these run segments of the store, by their numbers.
        baselines: evaluate :data:`BASELINES` on the same segments, too.
        observe: called with every batch of rollouts in this process, to draw or keep them.

    Raises:
        ConfigError: if the agent learned another time step than the store has.
        DataError: if the store is empty, or a segment has no ego at its first step.
    """
    config = EvaluateConfig() if config is None else config
    agent = load_agent(agent, config.device) if isinstance(agent, str) else agent
    store = data if isinstance(data, SegmentStore) else SegmentStore(data)
    if len(store) == 0:
        raise DataError("the store holds no run segments", file=store.path)
    return evaluate_dataset(
        agent,
        crowd_dataset(store, agent, config, items),
        config,
        progress,
        baselines=baselines,
        observe=observe,
    )


def evaluate_dataset(
    agent: Agent,
    dataset: SceneDataset,
    config: EvaluateConfig,
    progress: Callable[[int, int], None] | None = None,
    *,
    baselines: bool = False,
    observe: Callable[[EvaluatedBatch], None] | None = None,
) -> Evaluation:
    """Evaluate an agent on every run segment of a prepared dataset, as :func:`evaluate` does.

    Args:
        agent: the agent, on ``config.device``.
        dataset: in the agent's action space, with routes if it follows goals; it decides how many agents act and
            for how long.
        config: how else.
        progress: called with the segments done and their total.
        baselines: evaluate :data:`BASELINES` too.
        observe: called with every batch of rollouts.

    Raises:
        ConfigError: if the agent learned another time step than the dataset has.
        DataError: if a segment has too few agents for so many interactive ones.
        NotFiniteError: if a network of the agent puts out a number that is not finite.
    """
    agent.check_step(dataset.dt)
    others = [load_agent(name, config.device) for name in BASELINES] if baselines else []
    everyone = [agent, *(other for other in others if other.name != agent.name)]
    # Baselines always do the same, and have no discriminator to search by.
    once = dataclasses.replace(config, rollouts=1, trees=1, search="none", action_temperature=1.0, persona="")
    acting: int | Literal["all"] = "all" if config.interactive == "all" else dataset.interactive
    hows = [config] + [once] * (len(everyone) - 1)
    horizon = dataset.decisions * dataset.dt
    found = [
        Evaluation(one.name, RolloutMetrics(), how, acting, one.plan(how).kind, horizon=horizon)
        for one, how in zip(everyone, hows, strict=True)
    ]
    for path in config.metric:
        load_object(path)  # or complain before anything is simulated
    seconds, steps = [0.0] * len(everyone), [0] * len(everyone)
    evaluator, done = _BatchEvaluator(everyone, found, dataset, observe is not None), 0
    tasks = batches(range(len(dataset)), segments_together(agent, config, dataset.interactive), config)
    with closing(shared(evaluator, tasks, config, dataset)) as results:
        for batch in results:
            for k, part in enumerate(batch.parts):
                found[k].metrics.merge(part.metrics)
                for path, values in part.own.items():
                    found[k].own.setdefault(path, {}).update(values)
                seconds[k] += part.seconds
                steps[k] += part.steps
            if observe is not None and batch.seen is not None:
                scenes, rollouts, goal = batch.seen
                segments = [dataset.segment(i) for i in batch.items]
                observe(EvaluatedBatch(batch.items, segments, scenes, rollouts, goal))
            done += len(batch.items)
            if progress is not None:
                progress(done, len(dataset))
    costs = zip(found, seconds, steps, strict=True)
    found = [dataclasses.replace(one, seconds=spent, steps=made) for one, spent, made in costs]
    # The evaluated agent itself where it is one of the baselines.
    named = {evaluation.agent: evaluation for evaluation in found}
    return dataclasses.replace(found[0], baselines=tuple(named[other.name] for other in others))


class _BatchResult(NamedTuple):
    """Of a batch: what was found of each agent, and the scenes, rollouts and goals of the first, on the CPU."""

    items: list[int]
    parts: list[Evaluation]
    seen: tuple[SceneBatch, Rollouts, Tensor] | None


@dataclass(frozen=True)
class _BatchEvaluator:
    """Simulates agents on a batch of run segments and compares them with the log.

    Attributes:
        agents: the first is the one evaluated, the others are baselines.
        blank: for each, an evaluation without any segments.
        dataset: the run segments.
        seen: whether rollouts are asked for, too.
    """

    agents: list[Agent]
    blank: list[Evaluation]
    dataset: SceneDataset
    seen: bool

    def __call__(self, items: list[int]) -> _BatchResult:
        """Evaluate some items."""
        with naming(self.dataset, items):
            scenes = self.dataset.scenes(items).to(torch.device(self.blank[0].config.device))
            regions, parts, seen = _logged_curvatures(self.dataset, items, scenes), [], None
            for agent, blank in zip(self.agents, self.blank, strict=True):
                began = time.process_time()
                try:
                    found = simulate_batch(agent, scenes, blank.config)
                except NotFiniteError as error:
                    raise error.named(self.dataset.segment(items[error.row]).segment_id) from error
                seconds = time.process_time() - began
                part = dataclasses.replace(
                    blank, metrics=RolloutMetrics(), own={}, seconds=seconds, steps=found.steps
                )
                own = {path: load_object(path) for path in blank.config.metric}
                _add(part, self.dataset, items, scenes, found, own, regions)
                parts.append(part)
                if self.seen and seen is None:
                    seen = scenes.cpu(), found.rollouts.cpu(), found.goal.cpu()
            return _BatchResult(items, parts, seen)


def _add(
    evaluation: Evaluation,
    dataset: SceneDataset,
    items: list[int],
    scenes: SceneBatch,
    found: Simulation,
    own: dict[str, Metric],
    regions_log: list[NDArray[np.float64]],
) -> None:
    """Add the rollouts of some run segments to what was found."""
    rollouts, (log, log_valid) = found.rollouts, logged(scenes)
    evaluated = rollouts._replace(counted=rollouts.counted & ~scenes.background[:, None, None])
    exists = (log_valid[:, None] if evaluation.search == "log" else existing(scenes, rollouts)).transpose(
        2, 3
    )
    both = evaluated._replace(counted=evaluated.counted & log_valid[:, None, 1:])
    standing = standing_at_end(rollouts.state, log, log_valid, scenes.last_step, evaluated.counted)
    away = (rollouts.state[..., 1:, :, :2] - log[:, None, 1:, :, :2]).norm(dim=-1)
    for path, metric in own.items():
        values = metric(scenes, rollouts)
        if values.shape != rollouts.state.shape[:2]:
            shape = tuple(rollouts.state.shape[:2])
            raise ConfigError(f"metric '{path}' must give {shape} numbers, gives {tuple(values.shape)}")
        names = (dataset.segment(i).segment_id for i in items)
        means = values.double().nanmean(-1).tolist()
        evaluation.own.setdefault(path, {}).update(zip(names, means, strict=True))
    heights = _heights(scenes, rollouts, as_logged=evaluation.search == "log")
    kinds = _kinds(scenes, evaluated, exists, heights)
    bounded = scenes.edge_valid.any(1)
    single = AgentSteps(
        evaluated.counted.transpose(2, 3),
        log_valid[:, 1:].transpose(1, 2),
        rollouts.offroad.transpose(2, 3),
        _kinds(scenes, both, exists, heights),
        rollouts.state[..., 1:, :, 3].transpose(2, 3),
        log[:, 1:, :, 3].transpose(1, 2),
        bounded,
    )
    there = exists.transpose(2, 3) & ~scenes.background[:, None, None]
    driven, counted, there, log_valid = (
        t.cpu() for t in (rollouts.state, evaluated.counted, there, log_valid)
    )
    regions = [
        _curvatures(dataset.graph(i), *states) for i, *states in zip(items, driven, there, strict=True)
    ]
    segments = [dataset.segment(i) for i in items]
    evaluation.metrics.update(
        [segment.segment_id for segment in segments],
        collided=rollouts.collision.transpose(2, 3).cpu(),
        at_states=found.at_states.transpose(2, 3).cpu(),
        offroad=rollouts.offroad.transpose(2, 3).cpu(),
        bounded=bounded,
        displacement=away.transpose(2, 3).cpu(),
        simulated=counted.transpose(2, 3),
        logged=log_valid[:, 1:].transpose(1, 2),
        curvature=regions,
        curvature_log=regions_log,
        kinds=kinds,
        # Segments of one recording share its traffic, so errors are over recordings.
        groups=[segment.group or segment.segment_id for segment in segments],
        single=single,
        standing=Standing(*(part.cpu() for part in standing)),
        choices=_choices(scenes, found),
    )


def _choices(scenes: SceneBatch, found: Simulation) -> list[Choice] | None:
    """What a search made of the goals; None without search or without goals."""
    if found.search is None or found.drawn is None or not scenes.route_point.shape[1]:
        return None
    # The rollouts of a tree are the first of its leaves.
    each = found.goal.shape[1] // found.drawn.shape[1]
    first = found.search.slots[..., 0, :each].sort(-1).values
    founders = 1 + (first.diff(dim=-1) != 0).sum(-1)
    turn = route_turns(*scenes.routes.beginnings())
    # Goals of the background are nobody's choice.
    drawn, goal = (
        torch.where(scenes.background[:, None], -1, each) for each in (found.drawn.flatten(1, 2), found.goal)
    )
    return choices(drawn.cpu(), goal.cpu(), turn.cpu(), founders.float().mean(-1).cpu())


def _heights(scenes: SceneBatch, rollouts: Rollouts, *, as_logged: bool) -> tuple[Tensor, Tensor] | None:
    """Height and level of the interactive agents [B, K, N, T+1, 2] and of all as logged [B, 1, A, T+1, 2]."""
    logged_ones = logged_heights(scenes)
    driven = rollout_heights(scenes, rollouts.state)
    if logged_ones is None or driven is None:
        return None
    driven = logged_ones[:, None] if as_logged else driven
    log = scenes.agent_height[:, None, : rollouts.state.shape[2]]
    return driven.transpose(2, 3), log.transpose(2, 3)


def _kinds(
    scenes: SceneBatch,
    rollouts: Rollouts,
    exists: Bool[Tensor, "B K N T+1"],
    heights: tuple[Tensor, Tensor] | None,
) -> CollisionKinds:
    """Who ran into whom, in the first collision of each agent."""
    steps = rollouts.state.shape[-3]
    subject = torch.where(scenes.interactive_valid, scenes.interactive, -1)[:, None]
    return collision_kinds(
        (rollouts.collision & rollouts.counted).transpose(2, 3),
        rollouts.state.transpose(2, 3),
        exists,
        subject,
        scenes.log_state[:, None, :steps].transpose(2, 3),
        scenes.log_valid[:, None, :steps].transpose(2, 3),
        scenes.box_size[:, None],
        scenes.agent_type[:, None],
        heights,
    )


def _logged_curvatures(
    dataset: SceneDataset, items: list[int], scenes: SceneBatch
) -> list[NDArray[np.float64]]:
    """Of every segment those that the evaluated agents visit in its log."""
    log, valid = logged(scenes)
    states = zip(items, log.cpu(), (valid & ~scenes.background[:, None]).cpu(), strict=True)
    return [_curvatures(dataset.graph(item), *one) for item, *one in states]


def _curvatures(
    graph: LaneGraph, state: Float[Tensor, "*b U N 4"], there: Bool[Tensor, "*b U N"]
) -> NDArray[np.float64]:
    """Average curvature of every branching region that each trajectory visits.

    Args:
        graph: lanes.
        state: [..., T + 1, N, 4].
        there: [..., T + 1, N] which states count.
    """
    path = state.transpose(-2, -3).numpy()
    return visited_curvatures(graph, path[..., :2], path[..., 2], there.transpose(-1, -2).numpy())
