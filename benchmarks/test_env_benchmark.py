"""Cost of simulation on the built-in segments: a step of the environment, of the policy, and a training batch.

python -m pytest benchmarks/test_env_benchmark.py --benchmark-group-by=func
"""

from __future__ import annotations

from typing import Any

import pytest
import torch

from symphony.agents import build_agent
from symphony.config import AgentConfig, AgentSpec
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, DrivingEnv, ObservationConfig
from symphony.objectives import BCLoss
from symphony.simulation.demonstrations import SceneDataset

POINTS = pytest.mark.parametrize("points", [200, 1000])


def parts(points: int) -> tuple[SceneDataset, DrivingEnv, Any, ObservationConfig]:
    torch.set_num_threads(1)
    spec = AgentSpec(action_space="bicycle", dt=0.2, agent=AgentConfig(num_points=points))
    agent = build_agent("measured", spec)
    dataset = SceneDataset(SegmentStore(builtin_store("train")))
    env = DrivingEnv(dataset.scenes(range(16)), Bicycle(), agent.observation)
    return dataset, env, agent.policy, agent.observation


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
    dataset, _, _, config = parts(200)
    rng = torch.Generator().manual_seed(0)
    benchmark(dataset.sample_states, range(16), 1024, config, rng)


def test_update(benchmark: Any) -> None:
    dataset, _, policy, config = parts(200)
    batch = dataset.sample_states(range(16), 1024, config, torch.Generator().manual_seed(0))
    loss = BCLoss(policy)

    def update() -> None:
        policy.zero_grad()
        loss(batch)["loss_bc"].backward()

    benchmark(update)
