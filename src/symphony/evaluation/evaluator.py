"""The one evaluator: used by the trainer, the command line and the recipes."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from symphony.agents import Agent, load_agent
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.envs.driving import NO_ROUTES
from symphony.envs.objects import rollout_heights
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError
from symphony.imports import build_object, load_object
from symphony.learning.demonstrations import SceneDataset
from symphony.learning.experts import logged, logged_heights
from symphony.metrics import RolloutMetrics, collision_kinds
from symphony.roadgraph import visited_curvatures
from symphony.rollouts.crowd import crowd_dataset
from symphony.rollouts.driving import Simulation, simulate_batch
from symphony.rollouts.unroll import Rollouts, existing
from symphony.rollouts.workers import batches, naming, segments_together, settled, shared
from symphony.saved.rollouts import SavedRollouts, saved_rollouts

BASELINES = ("playback", "constant_velocity")
"""Baselines evaluated beside every agent, on the agents that it drives and for as long."""
Observer = Callable[[int, SavedRollouts], None]
"""Called with the number of each run segment in its dataset and the rollouts that the metrics come from."""


@dataclass
class Evaluation:
    """The result of evaluating an agent."""

    agent: str
    metrics: RolloutMetrics
    config: EvaluateConfig
    interactive: int | Literal["all"]  # agents per segment that acted, at most
    search: str  # how the rollouts came about: `none`, `tree`, `backtrack`; `log` for playback
    own: dict[str, dict[str, float]] = field(default_factory=dict)  # by import path, means by run segment
    seconds: float = 0.0  # CPU time of the simulation
    steps: int = 0  # of rollouts or branches that were simulated, those that a search dropped included
    horizon: float = 0.0  # seconds that the longest rollout lasts
    baselines: tuple[Evaluation, ...] = ()  # the evaluations of BASELINES, where they were asked for

    def numbers(self) -> dict[str, float | int | str]:
        """Return the table row: rates in percent, distances in metres, divergence in nats, each with its error."""
        own: dict[str, float] = {}
        for path, values in self.own.items():
            own[path], own[f"{path}_se"] = self.metrics.mean(values)
        trees = self.config.trees if self.search == "tree" else 0
        how = {"interactive": self.interactive, "search": self.search, "seed": self.config.seed, "trees": trees}
        return {"agent": self.agent, **self.metrics.compute(), **own, **how}


def evaluate(
    agent: Agent | str,
    data: SegmentStore | SceneDataset | Path,
    config: EvaluateConfig | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
    *,
    items: Sequence[int] | None = None,
    baselines: bool = False,
    observe: Observer | None = None,
) -> Evaluation:
    """Evaluate an agent on every run segment of a store (paper, section V-B).

    Args:
        agent: an agent, or the name of one (see :func:`symphony.agents.load_agent`).
        data: a store, or its folder; or scenes in the agent's action space, with routes if it follows goals, which
            decide how many agents act and for how long.
        config: how it is simulated.
        progress: called with the segments done and their total.
        items: only these run segments of the store, by their numbers.
        baselines: evaluate :data:`BASELINES` on the same segments, too.
        observe: called in this process with the rollouts of every run segment, to draw or keep them.

    Raises:
        ConfigError: if the agent learned another time step than the segments have, or scenes lack its routes.
        DataError: if the store is empty, a segment has no ego at its first step, or too few agents.
        NotFiniteError: if a network of the agent puts out a number that is not finite.
    """
    config = EvaluateConfig() if config is None else config
    agent = load_agent(agent, config.device) if isinstance(agent, str) else agent
    if isinstance(data, SceneDataset):
        if items is not None:
            raise ConfigError("items are those of a store; these scenes are chosen already")
        if agent.routed and not data.routes:
            raise ConfigError(NO_ROUTES)
        dataset = data
    else:
        store = (data if isinstance(data, SegmentStore) else SegmentStore(data)).filled()
        dataset = crowd_dataset(store, agent, config, items)
    agent.check_step(dataset.dt)
    others = [load_agent(name, config.device) for name in BASELINES] if baselines else []
    everyone = [agent, *(other for other in others if other.name != agent.name)]
    size = segments_together(agent, config, dataset.interactive)
    config = settled(config, dataset, -(-len(dataset) // size))
    # Baselines always do the same, and have no discriminator to search by.
    alone: Any = {"rollouts": 1, "trees": 1, "search": "none", "pace": 0.0, "compile": "no"}
    once = dataclasses.replace(config, **alone)
    acting: int | Literal["all"] = "all" if config.interactive == "all" else dataset.interactive
    found = []
    for number, one in enumerate(everyone):
        how = once if number else config
        evaluation = Evaluation(one.name, RolloutMetrics(), how, acting, one.plan(how).kind)
        found.append(dataclasses.replace(evaluation, horizon=dataset.decisions * dataset.dt))
    for path in config.metric:
        load_object(path)  # fail before anything is simulated
    evaluator, done = _BatchEvaluator(everyone, found, dataset, observe is not None), 0
    tasks = batches(range(len(dataset)), size, config)
    with closing(shared(evaluator, tasks, config, dataset)) as results:
        for numbers, parts, seen in results:
            for whole, part in zip(found, parts, strict=True):
                whole.metrics.merge(part.metrics)
                for path, values in part.own.items():
                    whole.own.setdefault(path, {}).update(values)
                whole.seconds += part.seconds
                whole.steps += part.steps
            if observe is not None:
                for item, saved in zip(numbers, seen, strict=True):
                    observe(item, saved)
            done += len(numbers)
            progress(done, len(dataset))
    # The evaluated agent itself where it is one of the baselines.
    named = {evaluation.agent: evaluation for evaluation in found}
    return dataclasses.replace(found[0], baselines=tuple(named[other.name] for other in others))


@dataclass(frozen=True)
class _BatchEvaluator:
    """Simulates agents on a batch of run segments and compares them with the log."""

    agents: list[Agent]  # the first is the one evaluated, the others are baselines
    blank: list[Evaluation]  # for each, an evaluation without any segments
    dataset: SceneDataset
    seen: bool  # whether rollouts are asked for, too

    def __call__(self, items: list[int]) -> tuple[list[int], list[Evaluation], list[SavedRollouts]]:
        """Return the items, the evaluation of each agent, and the rollouts of the first if they are asked for."""
        with naming(self.dataset, items):
            scenes = self.dataset.scenes(items).to(torch.device(self.blank[0].config.device))
            if bool((scenes.last_step > scenes.log_end).any()):
                raise ConfigError("what is past a log can't be compared with it: simulate and report it")
            log, log_valid = logged(scenes)
            logged_curvature = self._curvatures(items, log, log_valid & ~scenes.background[:, None])
            parts: list[Evaluation] = []
            seen: list[SavedRollouts] = []
            for agent, blank in zip(self.agents, self.blank, strict=True):
                began = time.process_time()
                found = simulate_batch(agent, scenes, blank.config)
                part = dataclasses.replace(blank, metrics=RolloutMetrics(), own={}, steps=found.steps)
                part.seconds = time.process_time() - began
                self._add(part, items, scenes, found, logged_curvature)
                parts.append(part)
                if self.seen and not seen:
                    driver = partial(saved_rollouts, driver=agent.name, others=blank.config.others)
                    for row, item in enumerate(items):
                        segment = self.dataset.segment(item)
                        seen.append(driver(segment, scenes, found.rollouts, row, goal=found.goal))
            return items, parts, seen

    def _add(
        self,
        evaluation: Evaluation,
        items: list[int],
        scenes: SceneBatch,
        found: Simulation,
        logged_curvature: list[NDArray[np.float64]],
    ) -> None:
        rollouts, (log, log_valid) = found.rollouts, logged(scenes)
        segments = [self.dataset.segment(i) for i in items]
        names = [segment.segment_id for segment in segments]
        as_logged = evaluation.search == "log"
        evaluated = rollouts.counted & ~scenes.background[:, None, None]
        exists = log_valid[:, None] if as_logged else existing(scenes, rollouts)
        for path in evaluation.config.metric:
            values = build_object(path, scenes, rollouts)
            if values.shape != rollouts.state.shape[:2]:
                shape = tuple(rollouts.state.shape[:2])
                raise ConfigError(f"metric '{path}' must give {shape} numbers, gives {tuple(values.shape)}")
            means = values.double().nanmean(-1).tolist()
            evaluation.own.setdefault(path, {}).update(zip(names, means, strict=True))
        away = (rollouts.state[..., 1:, :, :2] - log[:, None, 1:, :, :2]).norm(dim=-1)
        heights, steps = _heights(scenes, rollouts, as_logged=as_logged), rollouts.state.shape[-3]
        # Who ran into whom, in the first counted collision of each agent: always, and while its log exists.
        kinds, kinds_logged = (
            collision_kinds(
                (rollouts.collision & counted).transpose(2, 3),
                rollouts.state.transpose(2, 3),
                exists.transpose(2, 3),
                torch.where(scenes.interactive_valid, scenes.interactive, -1)[:, None],
                scenes.log_state[:, None, :steps].transpose(2, 3),
                scenes.log_valid[:, None, :steps].transpose(2, 3),
                scenes.box_size[:, None],
                scenes.agent_type[:, None],
                heights,
            )
            for counted in (evaluated, evaluated & log_valid[:, None, 1:])
        )
        evaluation.metrics.update(
            names,
            # Segments of one recording share its traffic, so errors are over recordings.
            [segment.group or segment.segment_id for segment in segments],
            simulated=evaluated.transpose(2, 3),
            logged=log_valid[:, 1:].transpose(1, 2),
            at_states=found.at_states.transpose(2, 3),
            offroad=rollouts.offroad.transpose(2, 3),
            bounded=scenes.edge_valid.any(1),
            displacement=away.transpose(2, 3),
            speed=rollouts.state[..., 1:, :, 3].transpose(2, 3),
            speed_log=log[:, 1:, :, 3].transpose(1, 2),
            last=scenes.last_step - 1,
            kinds=kinds,
            kinds_logged=kinds_logged,
            curvature=self._curvatures(items, rollouts.state, exists & ~scenes.background[:, None, None]),
            curvature_log=logged_curvature,
        )

    def _curvatures(
        self, items: list[int], state: Float[Tensor, "B *k U N 4"], there: Bool[Tensor, "B *k U N"]
    ) -> list[NDArray[np.float64]]:
        """Return for each segment the average curvature of every branching region that each trajectory visits."""
        path, there = state.transpose(-2, -3).cpu().numpy(), there.transpose(-1, -2).cpu()
        return [
            visited_curvatures(self.dataset.graph(item), path[b, ..., :2], path[b, ..., 2], there[b].numpy())
            for b, item in enumerate(items)
        ]


def _heights(scenes: SceneBatch, rollouts: Rollouts, *, as_logged: bool) -> tuple[Tensor, Tensor] | None:
    """Return height and level of interactive agents [B, K, N, T+1, 2] and of all as logged [B, 1, A, T+1, 2]."""
    own, driven = logged_heights(scenes), rollout_heights(scenes, rollouts.state)
    if own is None or driven is None:
        return None
    log = scenes.agent_height[:, None, : rollouts.state.shape[2]]
    return (own[:, None] if as_logged else driven).transpose(2, 3), log.transpose(2, 3)
