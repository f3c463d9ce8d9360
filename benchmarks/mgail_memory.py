"""Memory and time of one MGAIL gradient, by what is kept for the backward pass.

python benchmarks/mgail_memory.py [--rollouts 16] [--points 128] [--steps 50 100] [--cuda]

Each row is a process of its own: peak memory above that of the prepared scenes. Untrained networks of the default
size on the built-in segments, whose logs of 10 s end after 50 steps: later ones cost the same but count for nothing.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time

import torch

from symphony.agents import build_agent
from symphony.config import AgentConfig, AgentSpec, DiscriminatorConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Displacement, DrivingEnv
from symphony.objectives import MGAILLoss
from symphony.simulation.demonstrations import SceneDataset

VARIANTS = {
    "all kept": {},
    "truncated after 10": {"truncate": 10},
    "checkpoints of 10": {"checkpoint": 10},
    "checkpoints of 1": {"checkpoint": 1},
}


def measure(variant: str, steps: int, rollouts: int, points: int, device: str) -> None:
    """Print peak MiB and seconds of one gradient."""
    torch.set_num_threads(1)
    spec = AgentSpec(
        action_space="displacement",
        dt=0.2,
        agent=AgentConfig(num_points=points),
        discriminator=DiscriminatorConfig(features="foresight"),
    )
    networks = build_agent("measured", spec).to(torch.device(device))
    dataset = SceneDataset(SegmentStore(builtin_store("train")), 2, Displacement())
    env = DrivingEnv(dataset.scenes(range(rollouts)).to(device), Displacement(), networks.observation)
    loss = MGAILLoss(networks.policy, networks.discriminator, env, horizon=steps, **VARIANTS[variant])
    start = env.start(torch.arange(rollouts, device=device))
    loss.horizon = 1
    loss(start)["loss_mgail"].backward()
    loss.horizon = steps
    cuda = device != "cpu"
    before = _peak(cuda)
    began = time.perf_counter() if cuda else time.process_time()
    loss(start)["loss_mgail"].backward()
    if cuda:
        torch.cuda.synchronize()
    seconds = (time.perf_counter() if cuda else time.process_time()) - began
    print(f"{_peak(cuda) - before:.0f} {seconds:.2f}")


def _peak(cuda: bool) -> float:
    if cuda:
        return torch.cuda.max_memory_allocated() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rollouts", type=int, default=16)
    parser.add_argument("--points", type=int, default=128)
    parser.add_argument("--steps", type=int, nargs="+", default=[50, 100])
    parser.add_argument("--cuda", action="store_true")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    device = "cuda" if arguments.cuda else "cpu"
    if arguments.only:
        measure(arguments.only, arguments.steps[0], arguments.rollouts, arguments.points, device)
        return
    print(f"{arguments.rollouts} rollouts of 2 agents, {arguments.points} points, {device}")
    print(f"{'kept':<20}{'steps':>6}{'MiB':>8}{'s':>8}")
    for steps in arguments.steps:
        for variant in VARIANTS:
            command = [sys.executable, __file__, "--only", variant, "--steps", str(steps)]
            command += ["--rollouts", str(arguments.rollouts), "--points", str(arguments.points)]
            command += ["--cuda"] * arguments.cuda
            done = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603 - this file
            mebibytes, seconds = done.stdout.split()
            print(f"{variant:<20}{steps:>6}{mebibytes:>8}{seconds:>8}", flush=True)


if __name__ == "__main__":
    main()
