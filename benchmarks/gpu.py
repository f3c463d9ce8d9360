"""Measure a graphics card: the paper's update, its search, and rollouts of very many branches.

    python benchmarks/gpu.py [--branches 10000] [--device cuda] [--compiled]

Prints seconds, agent-steps a second and the peak of the card's memory; with ``--device cpu`` that of the process
since it began. With ``--compiled`` again with a compiled environment, which takes minutes to make.
Networks are untrained, run segments those that come with the package.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from typing import Any

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from symphony.agents import build_agent
from symphony.collectors import KeepBest
from symphony.config import AgentConfig, AgentSpec, DiscriminatorConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv
from symphony.learning import SceneDataset
from symphony.objectives import BCLoss
from symphony.rollouts.search import search

PAPER = 16  # branches of a search when it is evaluated (paper, section III-A)


def seconds(work: Callable[[], Any], device: torch.device, rounds: int) -> tuple[float, float]:
    """Return the quickest of some rounds after one that doesn't count, and the peak of memory in MiB."""

    def waited() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    work()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    found = []
    for _ in range(rounds):
        began = waited()
        work()
        found.append(waited() - began)
    if device.type == "cuda":
        return min(found), torch.cuda.max_memory_allocated(device) / 2**20
    return min(found), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print a line for each measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--branches", type=int, default=10_000, help="the most, over all scenes")
    parser.add_argument("--scenes", type=int, default=16)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--states", type=int, default=1600, help="of an update")
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--compiled", action="store_true", help="also after compiling")
    options = parser.parse_args()
    device = torch.device(options.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise SystemExit("this PyTorch sees no CUDA device")
    spec = AgentSpec(
        action_space="bicycle",
        dt=0.2,
        agent=AgentConfig(num_points=options.points),
        discriminator=DiscriminatorConfig(features="paper"),
    )
    agent = build_agent("measured", spec).to(device)
    data = SceneDataset(SegmentStore(builtin_store("train")), 2, agent.dynamics)
    if not 1 <= options.scenes <= len(data):
        raise SystemExit(f"--scenes is 1 to {len(data)}, is {options.scenes}")
    items, rng = list(range(options.scenes)), torch.Generator().manual_seed(0)

    def show(name: str, work: Callable[[], Any], count: int, unit: str) -> None:
        took, peak = seconds(work, device, options.rounds)
        print(f"{name}: {took:.3f} s, {count / took:,.0f} {unit}/s, peak {peak:,.0f} MiB", flush=True)

    loss = BCLoss(agent.policy)
    optimizer = torch.optim.Adam(loss.parameters())

    def update() -> None:
        batch = data.sample_states(items, options.states, agent.observation, rng, device)
        optimizer.zero_grad(set_to_none=True)
        loss(batch)["loss_bc"].backward()
        optimizer.step()

    show(f"update of {options.states:,} states, {options.points:,} points", update, options.states, "states")
    env = DrivingEnv(data.scenes(items).to(device), agent.dynamics, agent.observation, device=device)

    @torch.no_grad()
    def simulations(branches: int, compiled: str = "") -> None:
        rows = torch.arange(options.scenes, device=device)[:, None].expand(-1, branches)
        start = env.start(rows, torch.arange(branches, device=device).expand(rows.shape))
        steps, name = rows.numel() * env.num_agents, f"{options.scenes} x {branches:,} branches{compiled}"

        def rollout(number: int) -> None:
            state = start.copy()
            with set_exploration_type(ExplorationType.RANDOM):
                for _ in range(number):
                    state = env.step_mdp(env.step(agent.policy(state)))

        def searched() -> None:
            search(env, agent.policy, agent.discriminator, start, seed=0, rule=KeepBest(0.5), prune_every=10)

        show(f"one step of {name}", lambda: rollout(1), steps, "agent-steps")
        show(
            f"{options.steps} steps of {name}",
            lambda: rollout(options.steps),
            steps * options.steps,
            "agent-steps",
        )
        show(f"search of {name}", searched, steps * data.decisions, "agent-steps")

    wide = max(2, options.branches // options.scenes)
    simulations(PAPER)
    simulations(wide)
    if options.compiled:
        env.compile()
        simulations(PAPER, ", compiled")
        simulations(wide, ", compiled")


if __name__ == "__main__":
    main()
