"""Beam search in a TorchRL environment that has nothing to do with driving: python examples/beam_search_torchrl.py

A pendulum is pushed at random. Every 5 steps the half of the branches with the higher cost makes room for copies
of the others: without learning anything, the search finds pushes that swing it up.
"""

from __future__ import annotations

import torch
from torchrl.envs import PendulumEnv

from symphony.collectors import KeepAll, KeepBest, KeyScore, Systematic, beam_search, branch, mean_then_sum

ROWS, STEPS, PRUNE_EVERY = 32, 100, 5


def main() -> None:
    """Print the mean cost per step of all leaves, and of the best leaf of each start."""
    env = PendulumEnv(seed=0)
    rows = env.reset(env.gen_params(batch_size=[ROWS]), set_state=False)
    rules = {
        "independent rollouts": KeepAll(),
        "keep the better half": KeepBest(0.5),
        "keep the best quarter": KeepBest(0.25),
        "systematic resampling": Systematic(temperature=1.0),
    }
    print(f"{'cost per step':<24}{'S = 4':>8}{'S = 16':>8}{'S = 64':>8}{'best of 64':>12}")
    for name, rule in rules.items():
        costs = []
        for branches in (4, 16, 64):
            generator = torch.Generator().manual_seed(0)
            found = beam_search(
                env,
                lambda td, rng=generator: td.set("action", 4 * torch.rand(*td.shape, 1, generator=rng) - 2),
                KeyScore("reward", negate=True),
                branch(rows, branches),
                steps=STEPS,
                prune_every=PRUNE_EVERY,
                rule=rule,
                aggregate=mean_then_sum,
                noise=torch.rand(ROWS, STEPS // PRUNE_EVERY, generator=generator),
                keep=["action"],
            )
            costs.append(found.scores.mean((-1, -2)))
        means = [float(cost.mean()) for cost in costs]
        print(
            f"{name:<24}{means[0]:>8.2f}{means[1]:>8.2f}{means[2]:>8.2f}{float(costs[-1].amin(-1).mean()):>12.2f}"
        )


if __name__ == "__main__":
    main()
