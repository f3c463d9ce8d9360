"""The one evaluator: used by the trainer, the command line and the recipes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from symphony import keys
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.envs.driving import DrivingEnv
from symphony.envs.scene import SceneBatch
from symphony.errors import DataError
from symphony.metrics import RolloutMetrics, collisions, offroad
from symphony.roadgraph import LaneGraph, visited_curvatures
from symphony.streams import fold_in, uniform
from symphony.trainers.agents import Agent, load_agent
from symphony.trainers.dataset import SceneDataset
from symphony.trainers.simulate import Rollouts, simulate


@dataclass(frozen=True)
class Evaluation:
    """What the evaluator found.

    Attributes:
        agent: its name.
        metrics: accumulated over all run segments.
        config: how it was judged.
        interactive: agents per segment that acted.
    """

    agent: str
    metrics: RolloutMetrics
    config: EvaluateConfig
    interactive: int

    def numbers(self) -> dict[str, float | int | str]:
        """The table row: rates in percent, distances in metres, divergence in nats, standard errors beside them."""
        return {
            "agent": self.agent,
            **self.metrics.compute(),
            "interactive": self.interactive,
            "seed": self.config.seed,
        }


class SeededNoise(TensorDictModuleBase):
    """Gives every agent the random number its next action is decided by.

    It depends on the seed, the rollout's identity, the step and the agent's place alone (never on the batch).

    Args:
        seed: of the evaluation.
    """

    in_keys = [keys.STREAM, keys.STEP, keys.VALID]  # noqa: RUF012 - the type TensorDictModuleBase declares
    out_keys = [keys.NOISE]  # noqa: RUF012

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.seed = seed

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write numbers [..., N] in (0, 1)."""
        agents = tensordict.get(keys.VALID).shape[-1]
        place = torch.arange(agents, device=tensordict.device)
        stream = fold_in(tensordict.get(keys.STREAM), place)
        return tensordict.set(keys.NOISE, uniform(self.seed, stream, tensordict.get(keys.STEP)))


def evaluate(
    agent: Agent | str,
    data: SegmentStore | Path,
    config: EvaluateConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Evaluation:
    """Judge an agent on every run segment of a store (paper, section V-B).

    Args:
        agent: an agent, or the name of one (see :func:`symphony.trainers.load_agent`).
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
    dataset = SceneDataset(store, interactive, agent.dynamics)
    metrics = RolloutMetrics()
    for first in range(0, len(dataset), config.batch):
        items = list(range(first, min(first + config.batch, len(dataset))))
        _evaluate_batch(agent, dataset, items, config, metrics)
        if progress is not None:
            progress(items[-1] + 1, len(dataset))
    return Evaluation(agent.name, metrics, config, interactive)


def _evaluate_batch(
    agent: Agent, dataset: SceneDataset, items: list[int], config: EvaluateConfig, metrics: RolloutMetrics
) -> None:
    scenes = dataset.scenes(items).to(torch.device(config.device))
    log, log_valid = logged(scenes)
    playing = agent.policy is None
    rollouts = playback(scenes) if playing else simulated(agent, scenes, config.rollouts, config.seed)
    segments = [dataset.segment(i) for i in items]
    away = (rollouts.state[..., 1:, :, :2] - log[:, None, 1:, :, :2]).norm(dim=-1)
    driven, judged, log, log_valid = (t.cpu() for t in (rollouts.state, rollouts.counted, log, log_valid))
    regions, regions_log = [], []
    for b, segment in enumerate(segments):
        graph = LaneGraph(segment.road)
        regions.append(_curvatures(graph, driven[b], judged[b]))
        regions_log.append(_curvatures(graph, log[b], log_valid[b, 1:]))
    metrics.update(
        [segment.segment_id for segment in segments],
        collided=rollouts.collision.transpose(2, 3).cpu(),
        offroad=rollouts.offroad.transpose(2, 3).cpu(),
        displacement=away.transpose(2, 3).cpu(),
        simulated=judged.transpose(2, 3),
        logged=log_valid[:, 1:].transpose(1, 2),
        curvature=regions,
        curvature_log=regions_log,
    )


def simulated(agent: Agent, scenes: SceneBatch, rollouts: int, seed: int) -> Rollouts:
    """K rollouts of every scene [B, K, ...]; they depend on the seed and the segment, not on the batch."""
    if agent.policy is None:
        raise ValueError("log playback has nothing to simulate")
    env = DrivingEnv(scenes, agent.dynamics, agent.observation)
    shape = (len(scenes), rollouts)
    scene = torch.arange(len(scenes), device=scenes.device)[:, None].expand(shape)
    number = torch.arange(rollouts, device=scenes.device).expand(shape)
    policy = TensorDictSequential(SeededNoise(seed), agent.policy)
    return simulate(env, policy, env.start(scene, number))


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


def logged(scenes: SceneBatch) -> tuple[Tensor, Tensor]:
    """What the interactive agents did in the log: states [B, T, N, 4] and validity [B, T, N]."""
    steps = scenes.log_valid.shape[1]
    index = scenes.interactive[:, None].expand(-1, steps, -1)
    log = scenes.log_state.gather(2, index[..., None].expand(*index.shape, 5))
    heading, velocity = log[..., 2], log[..., 3:]
    speed = velocity[..., 0] * heading.cos() + velocity[..., 1] * heading.sin()
    valid = scenes.log_valid.gather(2, index) & scenes.interactive_valid[:, None]
    return torch.cat([log[..., :3], speed[..., None]], -1), valid


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
