"""Cost of simulation on the built-in segments: a step of the environment, of the policy, and a training batch.

python -m pytest benchmarks/test_env_benchmark.py --benchmark-group-by=func
"""

from __future__ import annotations

from typing import Any

import pytest
import torch

from symphony.config import AgentConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, DrivingEnv
from symphony.objectives import BCLoss
from symphony.trainers.agents import build_policy, observation_config
from symphony.trainers.dataset import SceneDataset

POINTS = pytest.mark.parametrize("points", [200, 1000])


def parts(points: int) -> tuple[SceneDataset, DrivingEnv, Any, AgentConfig]:
    torch.set_num_threads(1)
    agent = AgentConfig(num_points=points)
    dataset = SceneDataset(SegmentStore(builtin_store("train")))
    env = DrivingEnv(dataset.scenes(range(16)), Bicycle(), observation_config(agent))
    return dataset, env, build_policy(agent, Bicycle()), agent


@POINTS
@torch.no_grad()
def test_env_step(benchmark: Any, points: int) -> None:
    _, env, _, _ = parts(points)
    state = env.rand_action(env.start(torch.arange(16)[:, None].expand(16, 16)))
    benchmark(env.step, state)


@POINTS
@torch.no_grad()
def test_policy(benchmark: Any, points: int) -> None:
    _, env, policy, _ = parts(points)
    state = env.start(torch.arange(16)[:, None].expand(16, 16))
    benchmark(policy, state)


def test_sampling_of_a_training_batch(benchmark: Any) -> None:
    dataset, _, _, agent = parts(200)
    rng = torch.Generator().manual_seed(0)
    benchmark(dataset.sample_states, 16, 1024, observation_config(agent), rng)


def test_update(benchmark: Any) -> None:
    dataset, _, policy, agent = parts(200)
    batch = dataset.sample_states(16, 1024, observation_config(agent), torch.Generator().manual_seed(0))
    loss = BCLoss(policy)

    def update() -> None:
        policy.zero_grad()
        loss(batch)["loss_bc"].backward()

    benchmark(update)
