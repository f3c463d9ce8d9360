"""Where the time of a search goes: environment, policy, discriminator, and the search itself.

python benchmarks/search_parts.py [--scenes 16] [--branches 16] [--threads 1] [--prune-every 10]

Untrained networks of the default size on the built-in segments; process time, so that a busy machine counts less.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from typing import Any

import torch
from tensordict import TensorDictBase

from symphony.agents import build_agent
from symphony.collectors import KeepBest
from symphony.config import AgentConfig, AgentSpec, DiscriminatorConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, DrivingEnv
from symphony.learning.demonstrations import SceneDataset
from symphony.rollouts.search import search


def main() -> None:
    """Print the shares."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=16)
    parser.add_argument("--branches", type=int, default=16)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--points", type=int, default=128)
    parser.add_argument("--prune-every", type=int, default=10)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    spec = AgentSpec(
        action_space="bicycle",
        dt=0.2,
        goals=True,
        agent=AgentConfig(num_points=arguments.points),
        discriminator=DiscriminatorConfig(features="foresight"),
    )
    networks = build_agent("measured", spec)
    dataset = SceneDataset(SegmentStore(builtin_store("train")), 2, routes=True)
    env = DrivingEnv(dataset.scenes(range(arguments.scenes)), Bicycle(), networks.observation)
    scene = torch.arange(arguments.scenes)[:, None].expand(-1, arguments.branches)
    start = env.with_goals(env.start(scene, torch.arange(arguments.branches).expand(scene.shape)))
    spent: Counter[str] = Counter()

    def timed(name: str, function: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            began = time.process_time()
            result = function(*args, **kwargs)
            spent[name] += time.process_time() - began
            return result

        return call

    step, policy, discriminator = env._step, networks.policy.forward, networks.discriminator.forward
    env._step = timed("environment", step)
    networks.policy.forward = timed("policy", policy)
    networks.discriminator.forward = timed("discriminator", discriminator)

    def once() -> TensorDictBase:
        with torch.no_grad():
            return search(
                env,
                networks.policy,
                networks.discriminator,
                start,
                seed=0,
                rule=KeepBest(0.5),
                prune_every=arguments.prune_every,
            ).trajectories

    once()
    spent.clear()
    began, rounds = time.process_time(), 3
    for _ in range(rounds):
        once()
    total = time.process_time() - began
    spent["search and TorchRL"] = total - sum(spent.values())
    print(f"{arguments.scenes} scenes x {arguments.branches} branches, 50 steps: {total / rounds:.2f} s")
    for name, seconds in spent.most_common():
        print(f"  {name:<20}{seconds / rounds:7.3f} s {100 * seconds / total:5.1f} %")


if __name__ == "__main__":
    main()
