"""The one evaluator: used by the trainer, the command line and the recipes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictSequential
from torch import Tensor

from symphony.agents.agent import Agent, load_agent
from symphony.collectors import KeepAll, max_then_sum
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.envs.driving import DrivingEnv
from symphony.envs.scene import SceneBatch
from symphony.errors import ConfigError, DataError
from symphony.metrics import CollisionKinds, RolloutMetrics, collision_kinds, collisions, offroad
from symphony.modules import SeededNoise
from symphony.roadgraph import LaneGraph, visited_curvatures
from symphony.simulation.demonstrations import SceneDataset, logged
from symphony.simulation.rollouts import (
    Rollouts,
    plant,
    pruning_rule,
    rollouts_of,
    search,
    simulate,
)


@dataclass(frozen=True)
class Evaluation:
    """What the evaluator found.

    Attributes:
        agent: its name.
        metrics: accumulated over all run segments.
        config: how it was judged.
        interactive: agents per segment that acted.
        search: how the rollouts came about: ``none``, ``tree``, ``oracle``, ``best``; ``log`` for playback.
    """

    agent: str
    metrics: RolloutMetrics
    config: EvaluateConfig
    interactive: int
    search: str

    def numbers(self) -> dict[str, float | int | str]:
        """The table row: rates in percent, distances in metres, divergence in nats, standard errors beside them."""
        return {
            "agent": self.agent,
            **self.metrics.compute(),
            "interactive": self.interactive,
            "search": self.search,
            "trees": self.config.trees if self.search in ("tree", "oracle") else 0,
            "seed": self.config.seed,
        }


def evaluate(
    agent: Agent | str,
    data: SegmentStore | Path,
    config: EvaluateConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Judge an agent on every run segment of a store (paper, section V-B).

    Args:
        agent: an agent, or the name of one (see :func:`symphony.agents.load_agent`).
        data: a store, or its folder.
        config: how.
        progress: called with the segments done and their total.

    Raises:
        DataError: if the store is empty, or a segment has too few agents for so many interactive ones.
    """
    config = EvaluateConfig() if config is None else config
    agent = load_agent(agent, config.device) if isinstance(agent, str) else agent
    store = data if isinstance(data, SegmentStore) else SegmentStore(data)
    if len(store) == 0:
        raise DataError("the store holds no run segments", file=store.path)
    interactive = config.interactive or agent.interactive
    dataset = SceneDataset(
        store,
        interactive,
        agent.dynamics,
        routes=agent.goals is not None,
        duration=config.duration or agent.duration,
        keep=config.batch,
    )
    return judge(agent, dataset, config, progress)


def judge(
    agent: Agent,
    dataset: SceneDataset,
    config: EvaluateConfig,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Judge an agent on every run segment of a prepared dataset, as :func:`evaluate` does.

    Args:
        agent: the agent, on ``config.device``.
        dataset: in the agent's action space, with routes if it follows goals; it decides how many agents act and
            for how long.
        config: how else.
        progress: called with the segments done and their total.

    Raises:
        DataError: if a segment has too few agents for so many interactive ones.
    """
    metrics = RolloutMetrics()
    for first in range(0, len(dataset), config.batch):
        items = list(range(first, min(first + config.batch, len(dataset))))
        _evaluate_batch(agent, dataset, items, config, metrics)
        if progress is not None:
            progress(items[-1] + 1, len(dataset))
    kind = "log" if agent.policy is None else _kind(agent, config)
    return Evaluation(agent.name, metrics, config, dataset.interactive, kind)


def _evaluate_batch(
    agent: Agent, dataset: SceneDataset, items: list[int], config: EvaluateConfig, metrics: RolloutMetrics
) -> None:
    scenes = dataset.scenes(items).to(torch.device(config.device))
    log, log_valid = logged(scenes)
    playing = agent.policy is None
    rollouts = driven_by(agent, scenes, config)
    segments = [dataset.segment(i).segment_id for i in items]
    kinds = _kinds(scenes, rollouts, log_valid if playing else None)
    away = (rollouts.state[..., 1:, :, :2] - log[:, None, 1:, :, :2]).norm(dim=-1)
    driven, judged, log, log_valid = (t.cpu() for t in (rollouts.state, rollouts.counted, log, log_valid))
    regions, regions_log = [], []
    for b, item in enumerate(items):
        graph = dataset.graph(item)
        regions.append(_curvatures(graph, driven[b], judged[b]))
        regions_log.append(_curvatures(graph, log[b], log_valid[b, 1:]))
    metrics.update(
        segments,
        collided=rollouts.collision.transpose(2, 3).cpu(),
        offroad=rollouts.offroad.transpose(2, 3).cpu(),
        displacement=away.transpose(2, 3).cpu(),
        simulated=judged.transpose(2, 3),
        logged=log_valid[:, 1:].transpose(1, 2),
        curvature=regions,
        curvature_log=regions_log,
        kinds=kinds,
    )


def _kinds(scenes: SceneBatch, rollouts: Rollouts, log_valid: Tensor | None) -> CollisionKinds:
    """Who ran into whom, in the first collision of each agent."""
    steps = rollouts.state.shape[-3]
    if log_valid is None:
        exists = scenes.interactive_valid[:, None, :, None].expand(-1, rollouts.state.shape[1], -1, steps)
    else:
        exists = log_valid.transpose(1, 2)[:, None]
    subject = torch.where(scenes.interactive_valid, scenes.interactive, -1)[:, None]
    return collision_kinds(
        (rollouts.collision & rollouts.counted).transpose(2, 3),
        rollouts.state.transpose(2, 3),
        exists,
        subject,
        scenes.log_state[:, None, :steps].transpose(2, 3),
        scenes.log_valid[:, None, :steps].transpose(2, 3),
        scenes.box_size[:, None],
    )


def simulated(agent: Agent, scenes: SceneBatch, config: EvaluateConfig) -> Rollouts:
    """K rollouts of every scene [B, K, ...]; they depend on the seed and the segment, not on the batch.

    Raises:
        ConfigError: if the search needs a discriminator and the agent has none.
    """
    if agent.policy is None:
        raise ValueError("log playback has nothing to simulate")
    env = DrivingEnv(scenes, agent.dynamics, agent.observation)
    trees, branches, taken = _plan(agent, config)
    start = plant(
        env,
        agent.goals,
        trees=trees,
        branches=branches,
        seed=config.seed,
        logged_goals=config.logged_goals,
    )
    if _kind(agent, config) == "none":
        policy = TensorDictSequential(SeededNoise(config.seed, env.dynamics.numbers), agent.policy)
        found = simulate(env, policy, start)
    else:
        best = config.search == "best"
        settings = config.pruning(agent.search)
        with torch.no_grad():
            result = search(
                env,
                agent.policy,
                None if config.search == "oracle" else agent.discriminator,
                start,
                seed=config.seed,
                rule=KeepAll() if best else pruning_rule(settings),
                prune_every=settings.prune_every,
                leaves=None if best else taken,
                retries=0 if best else config.retries,
                retry_above=config.retry_above,
            )
        found = rollouts_of(env, start, result.trajectories)
        if best:
            order = max_then_sum(result.scores).argsort(dim=-1, stable=True)[..., :1]
            found = Rollouts(*(_branches(part, order) for part in found))
    return Rollouts(*(part[:, :, :taken].flatten(1, 2) for part in found))


def _kind(agent: Agent, config: EvaluateConfig) -> str:
    if config.search == "agent":
        return "tree" if agent.searches and agent.discriminator is not None else "none"
    if config.search in ("tree", "best") and agent.discriminator is None:
        raise ConfigError(
            f"search '{config.search}' needs an agent with a discriminator, {agent.name} has none"
        )
    return config.search


def _plan(agent: Agent, config: EvaluateConfig) -> tuple[int, int, int]:
    """Trees per segment, branches per tree, and rollouts taken from each tree."""
    kind = _kind(agent, config)
    if kind == "none":
        return config.rollouts, 1, 1
    branches = config.branches or agent.search.test_branches
    if kind == "best":
        return config.rollouts, branches, 1
    taken = config.rollouts // config.trees
    if taken > branches:
        raise ConfigError(
            f"{config.trees} trees of {branches} branches give less than {config.rollouts} rollouts"
        )
    return config.trees, branches, taken


def _branches(part: Tensor, order: Tensor) -> Tensor:
    """part [B, trees, S, ...] at the branches order [B, trees, K]."""
    index = order.reshape(*order.shape, *(1,) * (part.ndim - 3)).expand(*order.shape, *part.shape[3:])
    return part.gather(2, index)


def driven_by(agent: Agent, scenes: SceneBatch, config: EvaluateConfig) -> Rollouts:
    """What an agent does [B, K, ...]: :func:`playback` of the log, or :func:`simulated`."""
    return playback(scenes) if agent.policy is None else simulated(agent, scenes, config)


def playback(scenes: SceneBatch) -> Rollouts:
    """The log itself as one rollout per scene [B, 1, ...], counted where it is valid."""
    log, valid = logged(scenes)
    position, heading = scenes.log_state[..., :2].transpose(1, 2), scenes.log_state[..., 2].transpose(1, 2)
    everyone = scenes.log_valid.transpose(1, 2)
    hit = collisions(position, heading, scenes.box_size, everyone, scenes.interactive).transpose(1, 2) & valid
    edges = (
        scenes.edge_start,
        scenes.edge_end,
        scenes.edge_valid,
        scenes.edge_previous,
        scenes.edge_following,
    )
    off = offroad(log[..., :2], *edges) & valid
    return Rollouts(log[:, None], hit[:, None, 1:], off[:, None, 1:], valid[:, None, 1:])


def _curvatures(graph: LaneGraph, state: Tensor, counted: Tensor) -> NDArray[np.float64]:
    """Average curvature of every branching region that each trajectory visits.

    Args:
        graph: lanes.
        state: [..., T + 1, N, 4].
        counted: [..., T, N]; the first state counts wherever the second does.
    """
    valid = torch.cat([counted[..., :1, :], counted], -2)
    path = state.transpose(-2, -3).numpy()
    return visited_curvatures(graph, path[..., :2], path[..., 2], valid.transpose(-1, -2).numpy())
