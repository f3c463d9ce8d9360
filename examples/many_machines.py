"""Searches on many machines: python examples/many_machines.py

TorchRL's Ray collector runs ours, here in one and then in two workers of this machine; with RAY_ADDRESS set, in those
of a cluster. Every worker searches a share of the store of its own, with an agent that comes with the package.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase

from symphony import keys
from symphony.agents import load_agent
from symphony.collectors import BeamSearchCollector, KeepBest, with_rows
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv
from symphony.learning import SceneDataset
from symphony.modules import SeededNoise
from symphony.rollouts.search import branched_streams, realism_score

AGENT = "pretrained:bc_ts_h"


def make_env(share: int, shares: int, rows: int) -> EnvBase:
    """Build as many scenes at a time as there are rows, drawn from every ``shares``-th segment of the store."""
    agent, store = load_agent(AGENT), SegmentStore(builtin_store("train"))
    data = SceneDataset(store, agent.interactive, agent.dynamics, range(share, len(store), shares), routes=True)
    rng = torch.Generator().manual_seed(share)
    return with_rows(DrivingEnv(data, agent.dynamics, agent.observation, generator=rng), [rows])


class Searches(BeamSearchCollector):
    """A collector that builds what it needs where it runs: environment, score, and the routes of its first states."""

    def __init__(self, create_env_fn: Any, policy: Any, **settings: Any) -> None:
        env = create_env_fn()
        driving, discriminator = env.base_env, load_agent(AGENT).discriminator
        super().__init__(
            env,
            policy,
            score=realism_score(driving, discriminator),
            prepare=lambda start: driving.with_goals(branched_streams(start)),
            rule=KeepBest(0.5),
            slot_keys=[keys.STREAM],
            keep=[keys.STATE, keys.ACTION, keys.SCENE],
            **settings,
        )


def collected(workers: int, batches: int, rows: int, branches: int, steps: int) -> Iterator[TensorDictBase]:
    """Yield batches of the best rollouts of searches, each of them from all workers."""
    agent, frames = load_agent(AGENT), workers * rows * steps
    policy = TensorDictSequential(SeededNoise(0, agent.dynamics.numbers), agent.policy)
    collector = RayCollector(
        [partial(make_env, share, workers, rows) for share in range(workers)],
        policy,
        collector_class=Searches.bind(branches=branches, prune_every=10),
        frames_per_batch=frames,
        total_frames=batches * frames,
        remote_configs={"num_cpus": 1, "num_gpus": 0},
        sync=True,
    )
    try:
        collector.update_policy_weights_(TensorDict.from_module(policy))  # while learning: after every update
        yield from collector
    finally:
        collector.shutdown()


def main(most: int = 2, batches: int = 4, rows: int = 8, branches: int = 16, steps: int = 50) -> dict[int, float]:
    """Print and return searches a second by number of workers."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # of every worker
    found = {}
    for workers in range(1, most + 1):
        batch = collected(workers, batches + 1, rows, branches, steps)
        next(batch)  # workers start, maps get their grids
        began = time.perf_counter()
        searches = sum(one.numel() // steps for one in batch)
        found[workers] = searches / (time.perf_counter() - began)
        share = found[workers] / workers / found[1]
        print(f"{workers} workers: {found[workers]:.2f} searches/s, {100 * share:.0f} % of the first each")
    return found


if __name__ == "__main__":
    main()
