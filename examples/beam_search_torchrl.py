"""Beam search in a TorchRL environment that has nothing to do with driving: python examples/beam_search_torchrl.py

A pendulum is pushed at random. Every 5 steps the half of the branches with the higher cost is replaced by copies of
the others: without learning anything, the search finds pushes that swing it up.
"""

from __future__ import annotations

import torch
from torchrl.envs import PendulumEnv

from symphony.collectors import KeepAll, KeepBest, KeyScore, Systematic, beam_search, branch, mean_then_sum

PRUNE_EVERY = 5


def main(starts: int = 32, steps: int = 100, sizes: tuple[int, ...] = (4, 16, 64)) -> None:
    """Print the mean cost per step of all leaves, and of the best leaf of each start."""
    env = PendulumEnv(seed=0)
    rows = env.reset(env.gen_params(batch_size=[starts]), set_state=False)
    rules = {
        "independent rollouts": KeepAll(),
        "keep the better half": KeepBest(0.5),
        "keep the best quarter": KeepBest(0.25),
        "systematic resampling": Systematic(temperature=1.0),
    }
    head = "".join(f"{f'S = {size}':>8}" for size in sizes)
    print(f"{'cost per step':<24}{head}{f'best of {sizes[-1]}':>12}")
    for name, rule in rules.items():
        costs = []
        for branches in sizes:
            generator = torch.Generator().manual_seed(0)
            found = beam_search(
                env,
                lambda td, rng=generator: td.set("action", 4 * torch.rand(*td.shape, 1, generator=rng) - 2),
                KeyScore("reward", negate=True),
                branch(rows, branches),
                steps=steps,
                prune_every=PRUNE_EVERY,
                rule=rule,
                aggregate=mean_then_sum,
                noise=torch.rand(starts, steps // PRUNE_EVERY, generator=generator),
                keep=["action"],
            )
            costs.append(found.scores.mean((-1, -2)))
        means = "".join(f"{float(cost.mean()):>8.2f}" for cost in costs)
        print(f"{name:<24}{means}{float(costs[-1].amin(-1).mean()):>12.2f}")


if __name__ == "__main__":
    main()
