"""What is measured, in any version of the package: one round of work as a function, and how many agent-steps it is.

As a program it measures one workload in a process of its own and prints a line of JSON; ``side_by_side.py`` runs it
on two versions in turn.

    python benchmarks/workloads.py simulator --rounds 7
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from helpers_segments import straight_road
from symphony import keys
from symphony.collectors import KeepBest, KeyScore, beam_search
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, DrivingEnv, ObservationConfig, SceneBatch, collate, scene
from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES
from symphony.geometry import boxes_overlap
from symphony.modules import ElementGroup, discrete_policy, discriminator

Work = tuple[Callable[[], Any], int]
"""A round of work and its agent-steps."""

SCENES, AGENTS, POINTS = 64, 32, 2000


def ring(seed: int, agents: int = AGENTS, points: int = POINTS, steps: int = 11) -> SceneBatch:
    """A ring road of 2 x 1 000 short boundary segments, each also a map point, all agents interactive."""
    base, rng = scene(straight_road(3, steps=steps), [0, 1]), np.random.default_rng(seed)
    half, k = points // 2, np.arange(points // 2)
    angle = 2 * np.pi * k / half
    # Outer edge counter-clockwise, inner edge clockwise: the drivable side is on the left of both.
    lines = [
        radius * np.stack([np.cos(s * angle), np.sin(s * angle)], -1) for radius, s in ((100, 1), (70, -1))
    ]
    start = np.concatenate(lines)
    end = np.concatenate([np.roll(line, -1, 0) for line in lines])
    turn, radius = rng.uniform(0, 2 * np.pi, agents), rng.uniform(72, 98, agents)
    log = np.zeros((steps, agents, 5))
    log[..., 0], log[..., 1], log[..., 2] = radius * np.cos(turn), radius * np.sin(turn), turn + np.pi / 2
    log[..., 3], log[..., 4] = -8 * np.sin(turn), 8 * np.cos(turn)
    direction = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
    fields = {
        "log_state": log,
        "log_valid": np.ones((steps, agents)),
        "box_size": np.tile([4.5, 2.0], (agents, 1)),
        "agent_type": np.zeros(agents),
        "interactive": np.arange(agents),
        "interactive_valid": np.ones(agents),
        "last_step": steps - 1,
        "point": start,
        "point_direction": direction,
        "point_type": np.full(points, 2),
        "point_speed": np.zeros(points),
        "point_light": np.full(points, -1),
        "point_valid": np.ones(points),
        "light": np.zeros((steps, 0)),
        "edge_start": start,
        "edge_end": end,
        "edge_previous": np.concatenate([(k - 1) % half, half + (k - 1) % half]),
        "edge_following": np.concatenate([(k + 1) % half, half + (k + 1) % half]),
        "edge_valid": np.ones(points),
        "stream": seed,
        "route": np.zeros((agents, 0, *base.route.shape[3:])),
        "route_count": np.zeros((agents, 0)),
        "route_logged": np.full(agents, -1),
    }
    made = {
        name: torch.as_tensor(value)[None].to(getattr(base, name).dtype) for name, value in fields.items()
    }
    rest = {name: getattr(base, name) for name in SceneBatch.__annotations__ if name not in made}
    return SceneBatch(**made, **rest, batch_size=[1])


def step_of(scenes: SceneBatch, config: ObservationConfig, rows: Tensor) -> Work:
    """One step of the environment."""
    env = DrivingEnv(scenes, Bicycle(), config)
    start = env.start(rows)
    start.set(keys.ACTION, torch.full((*rows.shape, env.num_agents), env.dynamics.num_actions // 2))
    return lambda: env.step(start), rows.numel() * env.num_agents


def rings(objects: int, points: int) -> Work:
    """All agents of 64 ring roads."""
    scenes = collate([ring(seed) for seed in range(SCENES)])
    if objects or points:
        config = ObservationConfig(num_objects=objects, num_points=points)
    else:
        nothing = getattr(ObservationConfig, "nothing", None)
        # The least that could be asked for before.
        config = ObservationConfig(1, 1) if nothing is None else nothing()
    return step_of(scenes, config, torch.arange(SCENES))


def builtin(count: int, agents: int = 2) -> SceneBatch:
    """Scenes of the built-in segments."""
    store = SegmentStore(builtin_store("train"))
    return collate([scene(store[k], agents) for k in range(count)])


def search() -> Work:
    """A beam search on 16 built-in segments: 16 branches, 50 steps, 128 points, foresight."""
    config = ObservationConfig(16, 128, clearance=True, foresight=(0.5, 1.0, 2.0))
    groups = (
        ElementGroup(keys.OBJECTS, keys.OBJECTS_MASK, OBJECT_FEATURES),
        ElementGroup(keys.POINTS, keys.POINTS_MASK, POINT_FEATURES),
    )
    torch.manual_seed(0)
    policy = discrete_policy(SELF_FEATURES, groups)
    judge = discriminator(SELF_FEATURES, OBJECT_FEATURES, POINT_FEATURES, radius=1.0, features="foresight")
    env = DrivingEnv(builtin(16), Bicycle(), config)
    rows = torch.arange(16)[:, None].expand(-1, 16)
    start = env.start(rows, torch.arange(16).expand(rows.shape))
    score = KeyScore(keys.SCORE, judge, valid_key=keys.VALID)

    def once() -> Any:
        kept = [keys.STATE, keys.ACTION]
        return beam_search(env, policy, score, start, steps=50, prune_every=10, rule=KeepBest(0.5), keep=kept)

    return once, 16 * 16 * 2 * 50


def brute_force() -> Work:
    """The simulator's step as a plain program: bicycle, all pairs of boxes, the nearest of all points."""
    scenes, dynamics = collate([ring(seed) for seed in range(SCENES)]), Bicycle()
    state = torch.cat([scenes.log_state[:, 0, :, :3], torch.full((SCENES, AGENTS, 1), 8.0)], -1)
    action, size = torch.full((SCENES, AGENTS), 73), scenes.box_size
    normal = torch.stack([scenes.point_direction[..., 1], -scenes.point_direction[..., 0]], -1)
    squared = scenes.point.square().sum(-1)[:, None]

    def once() -> Any:
        after = dynamics.step(state, action, size, 0.2)
        place, heading = after[..., :2], after[..., 2]
        away = torch.baddbmm(squared, place, scenes.point.transpose(1, 2), alpha=-2)
        nearest = away.argmin(-1)[..., None].expand(-1, -1, 2)
        side = ((place - scenes.point.gather(1, nearest)) * normal.gather(1, nearest)).sum(-1)
        hit = boxes_overlap(
            place[:, :, None],
            heading[:, :, None],
            size[:, :, None],
            place[:, None],
            heading[:, None],
            size[:, None],
        )
        return hit.sum(-1) > 1, side > 0

    return once, SCENES * AGENTS


def matmul() -> Work:
    """A product of 2 048 x 2 048 matrices; its "agent-steps" are floating-point operations."""
    a, b = torch.rand(2, 2048, 2048).unbind()
    return lambda: a @ b, 2 * 2048**3


WORKLOADS: dict[str, Callable[[], Work]] = {
    "simulator": lambda: rings(0, 0),
    "16 objects": lambda: rings(16, 1),
    "16 objects, 200 points": lambda: rings(16, 200),
    "16 objects, 1000 points": lambda: rings(16, 1000),
    "smallest step": lambda: step_of(builtin(1), ObservationConfig(16, 128), torch.arange(1)),
    "search 16 x 16 x 50": search,
    "brute force": brute_force,
    "matmul": matmul,
}


@torch.no_grad()
def measure(name: str, rounds: int) -> dict[str, float]:
    """Median CPU seconds and page faults of a round, and MiB by which the peak rose above the prepared work."""
    torch.set_num_threads(1)
    work, steps = WORKLOADS[name]()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(1 if name.startswith("search") else 25):
        work()
    spent, faults = [], resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        began = time.process_time()
        work()
        spent.append(time.process_time() - began)
    after = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "seconds": statistics.median(spent),
        "steps": steps,
        "faults": (after.ru_minflt - faults) / rounds,
        "mebibytes": (after.ru_maxrss - before) / 1024,
    }


def main() -> None:
    """Measure one workload."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("workload", choices=WORKLOADS)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--keep-memory", action="store_true", help="as the symphony command does")
    arguments = parser.parse_args()
    if arguments.keep_memory:
        from symphony import allocator  # noqa: PLC0415 - older versions have none

        allocator.tune()
    print(json.dumps(measure(arguments.workload, arguments.rounds)))


if __name__ == "__main__":
    main()
