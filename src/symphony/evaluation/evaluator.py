"""The one evaluator: used by the trainer, the command line and the recipes."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from symphony.agents import Agent, load_agent
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.envs.objects import rollout_heights
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError, DataError
from symphony.imports import load_object
from symphony.learning.demonstrations import SceneDataset
from symphony.learning.experts import logged, logged_heights
from symphony.metrics import Choice, CollisionKinds, RolloutMetrics, choices, collision_kinds, route_turns
from symphony.roadgraph import visited_curvatures
from symphony.rollouts.crowd import crowd_dataset
from symphony.rollouts.driving import Simulation, simulate_batch
from symphony.rollouts.unroll import Rollouts, existing
from symphony.rollouts.workers import batches, naming, segments_together, shared
from symphony.saved.rollouts import SavedRollouts, saved_rollouts

BASELINES = ("playback", "constant_velocity")
"""Evaluated beside every agent, on the agents it drives and for as long."""
Metric = Callable[[SceneBatch, Rollouts], Float[Tensor, "B K"]]
"""A metric of a user's own: a number [B, K] per rollout, NaN where there is none."""
Observer = Callable[[int, SavedRollouts], None]
"""Called with the number of each run segment in its dataset and the very rollouts that the metrics are of."""


@dataclass
class Evaluation:
    """What the evaluator found.

    Attributes:
        agent: its name.
        metrics: accumulated over all run segments.
        config: how it was evaluated.
        interactive: agents per segment that acted, at most, or ``all``.
        search: how the rollouts came about: ``none``, ``tree``, ``backtrack``, ``best``; ``log`` for playback.
        own: mean of each metric of the user's own by run segment, by import path.
        seconds: CPU time of the simulation.
        steps: steps of single rollouts or branches that were simulated, those that a search dropped included.
        horizon: seconds that the longest rollout lasts.
        baselines: the evaluations of :data:`BASELINES`, where they were asked for.
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
    observe: Observer | None = None,
) -> Evaluation:
    """Evaluate an agent on every run segment of a store (paper, section V-B).

    Args:
        agent: an agent, or the name of one (see :func:`symphony.agents.load_agent`).
        data: a store, or its folder.
        config: how it is simulated.
        progress: called with the segments done and their total.
        items: only these run segments of the store, by their numbers.
        baselines: evaluate :data:`BASELINES` on the same segments, too.
        observe: called in this process with the rollouts of every run segment, to draw or keep them.

    Raises:
        ConfigError: if the agent learned another time step than the store has.
        DataError: if the store is empty, or a segment has no ego at its first step.
    """
    config = EvaluateConfig() if config is None else config
    agent = load_agent(agent, config.device) if isinstance(agent, str) else agent
    store = data if isinstance(data, SegmentStore) else SegmentStore(data)
    if len(store) == 0:
        raise DataError("the store holds no run segments", file=store.path)
    dataset = crowd_dataset(store, agent, config, items)
    return evaluate_dataset(agent, dataset, config, progress, baselines=baselines, observe=observe)


def evaluate_dataset(
    agent: Agent,
    dataset: SceneDataset,
    config: EvaluateConfig,
    progress: Callable[[int, int], None] | None = None,
    *,
    baselines: bool = False,
    observe: Observer | None = None,
) -> Evaluation:
    """Evaluate an agent on every run segment of a prepared dataset, as :func:`evaluate` does.

    The dataset is in the agent's action space, with routes if it follows goals; it decides how many agents act and
    for how long.

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
    evaluator, done = _BatchEvaluator(everyone, found, dataset, observe is not None), 0
    tasks = batches(range(len(dataset)), segments_together(agent, config, dataset.interactive), config)
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
            if progress is not None:
                progress(done, len(dataset))
    # The evaluated agent itself where it is one of the baselines.
    named = {evaluation.agent: evaluation for evaluation in found}
    return dataclasses.replace(found[0], baselines=tuple(named[other.name] for other in others))


_BatchResult = tuple[list[int], list[Evaluation], list[SavedRollouts]]
"""Items of a batch, what was found of each agent, and the rollouts of the first where they are asked for."""


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
            log, log_valid = logged(scenes)
            logged_curvature = self._curvatures(items, log, log_valid & ~scenes.background[:, None])
            parts: list[Evaluation] = []
            seen: list[SavedRollouts] = []
            for agent, blank in zip(self.agents, self.blank, strict=True):
                began = time.process_time()
                found = simulate_batch(agent, scenes, blank.config)
                seconds = time.process_time() - began
                part = dataclasses.replace(
                    blank, metrics=RolloutMetrics(), own={}, seconds=seconds, steps=found.steps
                )
                self._add(part, items, scenes, found, logged_curvature)
                parts.append(part)
                if self.seen and not seen:
                    driver, others = agent.name, blank.config.others
                    seen = [
                        saved_rollouts(
                            self.dataset.segment(item),
                            scenes,
                            found.rollouts,
                            row,
                            goal=found.goal,
                            driver=driver,
                            others=others,
                        )
                        for row, item in enumerate(items)
                    ]
            return items, parts, seen

    def _add(
        self,
        evaluation: Evaluation,
        items: list[int],
        scenes: SceneBatch,
        found: Simulation,
        logged_curvature: list[NDArray[np.float64]],
    ) -> None:
        """Add the rollouts of some run segments to what was found."""
        rollouts, (log, log_valid) = found.rollouts, logged(scenes)
        segments = [self.dataset.segment(i) for i in items]
        as_logged = evaluation.search == "log"
        evaluated = rollouts.counted & ~scenes.background[:, None, None]
        exists = log_valid[:, None] if as_logged else existing(scenes, rollouts)
        both = evaluated & log_valid[:, None, 1:]
        heights = _heights(scenes, rollouts, as_logged=as_logged)
        for path in evaluation.config.metric:
            values = load_object(path)(scenes, rollouts)
            if values.shape != rollouts.state.shape[:2]:
                shape = tuple(rollouts.state.shape[:2])
                raise ConfigError(f"metric '{path}' must give {shape} numbers, gives {tuple(values.shape)}")
            means = values.double().nanmean(-1).tolist()
            names = (segment.segment_id for segment in segments)
            evaluation.own.setdefault(path, {}).update(zip(names, means, strict=True))
        away = (rollouts.state[..., 1:, :, :2] - log[:, None, 1:, :, :2]).norm(dim=-1)
        evaluation.metrics.update(
            [segment.segment_id for segment in segments],
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
            kinds=_kinds(scenes, rollouts, evaluated, exists, heights),
            kinds_logged=_kinds(scenes, rollouts, both, exists, heights),
            curvature=self._curvatures(items, rollouts.state, exists & ~scenes.background[:, None, None]),
            curvature_log=logged_curvature,
            choices=_choices(scenes, found),
        )

    def _curvatures(
        self, items: list[int], state: Float[Tensor, "B *k U N 4"], there: Bool[Tensor, "B *k U N"]
    ) -> list[NDArray[np.float64]]:
        """Of every segment the average curvature of every branching region that each trajectory visits."""
        path, there = state.transpose(-2, -3).cpu().numpy(), there.transpose(-1, -2).cpu()
        return [
            visited_curvatures(self.dataset.graph(item), path[b, ..., :2], path[b, ..., 2], there[b].numpy())
            for b, item in enumerate(items)
        ]


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
    counted: Bool[Tensor, "B K T N"],
    exists: Bool[Tensor, "B K T+1 N"],
    heights: tuple[Tensor, Tensor] | None,
) -> CollisionKinds:
    """Who ran into whom, in the first counted collision of each agent."""
    steps = rollouts.state.shape[-3]
    return collision_kinds(
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
