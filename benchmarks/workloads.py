"""The workloads measured in any version of the package: one round of work as a function, and its agent-steps.

As a program it prepares one workload and answers each line of its input with a round's measurements as JSON;
``side_by_side.py`` asks two versions in turn.

    yes | head -7 | python benchmarks/workloads.py simulator
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.envs.utils import ExplorationType

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from helpers_segments import straight_road
from symphony import keys
from symphony.agents import load_agent
from symphony.collectors import KeepBest, KeyScore, beam_search
from symphony.config import AgentConfig, EvaluateConfig, TrainConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, DrivingEnv, ObservationConfig, SceneBatch, collate, scene
from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES
from symphony.evaluation import evaluate
from symphony.geometry import boxes_overlap
from symphony.learning import SceneDataset
from symphony.modules import ElementGroup, discrete_policy, discriminator
from symphony.recipes import recipe_of
from symphony.training import Processes

Work = tuple[Callable[[], Any], int]
"""A round of work, and how many agent-steps (updates, segments, operations) it is."""

SCENES, AGENTS, POINTS = 64, 32, 2000


def ring(seed: int, agents: int = AGENTS, points: int = POINTS, steps: int = 11) -> SceneBatch:
    """Return a ring road of 2 x 1 000 short boundary segments, each also a map point, all agents interactive."""
    base, rng = scene(straight_road(3, steps=steps), [0, 1]), np.random.default_rng(seed)
    half, k = points // 2, np.arange(points // 2)
    angle = 2 * np.pi * k / half
    # Outer edge counter-clockwise, inner edge clockwise: the drivable side is on the left of both.
    lines = [radius * np.stack([np.cos(s * angle), np.sin(s * angle)], -1) for radius, s in ((100, 1), (70, -1))]
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
        "enter": np.zeros(agents),
        "background": np.zeros(agents),
        "last_step": steps - 1,
        "point": start,
        "point_direction": direction,
        "point_type": np.full(points, 2),
        "point_speed": np.zeros(points),
        "point_light": np.full(points, -1),
        "point_valid": np.ones(points),
        "light": np.zeros((steps, 0)),
        "light_end": np.zeros((0, 2)),
        "edge_start": start,
        "edge_end": end,
        "edge_previous": np.concatenate([(k - 1) % half, half + (k - 1) % half]),
        "edge_following": np.concatenate([(k + 1) % half, half + (k + 1) % half]),
        "edge_valid": np.ones(points),
        "stream": seed,
        "route_point": np.zeros((0, 2)),
        **dict.fromkeys(("route_first", "route_count", "follow_first", "follow_count"), np.zeros((agents, 0))),
        "route_logged": np.full(agents, -1),
    }
    made = {name: torch.as_tensor(value)[None].to(getattr(base, name).dtype) for name, value in fields.items()}
    rest = {name: getattr(base, name) for name in SceneBatch.__annotations__ if name not in made}
    return SceneBatch(**made, **rest, batch_size=[1])


def step_of(scenes: SceneBatch, config: ObservationConfig, rows: Tensor, *, compiled: bool = False) -> Work:
    """Return one step of the environment."""
    env = DrivingEnv(scenes, Bicycle(), config)
    if compiled:
        env.compile()
    start = env.start(rows)
    straight = env.dynamics.num_actions // 2
    start.set(keys.ACTION, torch.full((*rows.shape, env.num_agents), straight, device=rows.device))
    # A step writes what comes next into what it is given; in a rollout that is new each time.
    return lambda: env.step(start.copy()), rows.numel() * env.num_agents


def rings(objects: int, points: int, *, count: int = SCENES, agents: int = AGENTS, device: str = "cpu") -> Work:
    """Return steps of all agents of some ring roads."""
    scenes = collate([ring(seed, agents) for seed in range(count)]).to(torch.device(device))
    if objects or points:
        config = ObservationConfig(num_objects=objects, num_points=points)
    else:
        nothing = getattr(ObservationConfig, "nothing", None)
        # The least that could be asked for before.
        config = ObservationConfig(1, 1) if nothing is None else nothing()
    return step_of(scenes, config, torch.arange(count, device=device))


def builtin(count: int, agents: int = 2) -> SceneBatch:
    """Return scenes of the built-in segments."""
    store = SegmentStore(builtin_store("train"))
    return collate([scene(store[k], agents) for k in range(count)])


def smallest_step(*, compiled: bool = False) -> Work:
    """Return one step of two agents of one scene."""
    return step_of(builtin(1), ObservationConfig(16, 128), torch.arange(1), compiled=compiled)


GROUPS = (
    ElementGroup(keys.OBJECTS, keys.OBJECTS_MASK, OBJECT_FEATURES),
    ElementGroup(keys.POINTS, keys.POINTS_MASK, POINT_FEATURES),
)


def actions_of_few() -> Work:
    """Return the actions of two agents by an untrained policy: with the smallest step, what a planner waits for."""
    start = DrivingEnv(builtin(1), Bicycle(), ObservationConfig(16, 128)).start(torch.arange(1))
    policy = discrete_policy(SELF_FEATURES, GROUPS)
    return lambda: policy(start.copy()), 2


def search(
    points: int = 128,
    features: Any = "foresight",
    *,
    branches: int = 16,
    steps: int = 50,
    segments: int = 16,
    noise: bool = False,
) -> Work:
    """Return a beam search on built-in segments with untrained networks.

    Args:
        points: nearest points that are observed.
        features: of the discriminator.
        branches: S.
        steps: T; the segments last 50.
        segments: how many.
        noise: let actions be decided by numbers of their own, so that another version draws the same.
    """
    ahead = (0.5, 1.0, 2.0) if features == "foresight" else ()
    config = ObservationConfig(16, points, clearance=features != "paper", foresight=ahead)
    torch.manual_seed(0)
    policy = discrete_policy(SELF_FEATURES, GROUPS)
    realism = discriminator(SELF_FEATURES, OBJECT_FEATURES, POINT_FEATURES, radius=1.0, features=features)
    env = DrivingEnv(builtin(segments), Bicycle(), config)
    rows = torch.arange(segments)[:, None].expand(-1, branches)
    start = env.start(rows, torch.arange(branches).expand(rows.shape))
    score = KeyScore(keys.SCORE, realism, valid_key=keys.VALID)

    def act(state: Any) -> Any:
        if noise:
            place = torch.arange(env.num_agents) + 1
            at = 12.9898 * state[keys.STREAM] % 1000 + 78.233 * state[keys.STEP] + 37.719 * place
            state.set(keys.NOISE, (at.double().sin() * 43758.5453 % 1).float().clamp(1e-6, 1 - 1e-6))
        return policy(state)

    def once() -> Any:
        kept = [keys.STATE, keys.ACTION, ("next", *keys.COLLISION), ("next", *keys.OFFROAD)]
        return beam_search(
            env,
            act if noise else policy,
            score,
            start,
            steps=steps,
            prune_every=10,
            rule=KeepBest(0.5),
            keep=kept,
            slot_keys=[keys.STREAM] if noise else [],
            exploration_type=ExplorationType.RANDOM,
        )

    return once, segments * branches * env.num_agents * steps


def update(method: str, *, states: int = 1024, points: int = 200, count: int = 1) -> Work:
    """Return ``count`` updates of a recipe on the built-in segments; one of every ten searches if it searches."""
    config = TrainConfig(
        method=method,
        data=builtin_store("train"),
        out=Path(tempfile.gettempdir()) / "not written",
        states=states,
        agent=AgentConfig(num_points=points),
        wandb="disabled",
    )
    trainer = recipe_of(method)(config, Processes(torch.device("cpu")))
    steps = itertools.count()

    def once() -> None:
        with torch.enable_grad():
            for step in itertools.islice(steps, count):
                trainer._update(step)

    return once, count


def preparation(segments: int = 64) -> Work:
    """Return the scenes, routes, lists and experts of built-in segments, from the store on; none is kept there."""
    store = SegmentStore(builtin_store("train"))

    def once() -> None:
        data, items = SceneDataset(store, 2, routes=True), list(range(segments))
        data.scenes(items)
        data.experts.many(items)

    return once, segments


def evaluation(segments: int = 64, rollouts: int = 16) -> Work:
    """Return an evaluation of an included agent on built-in segments, with its search."""
    agent, store = load_agent("pretrained:bc_ts_h"), SegmentStore(builtin_store("train"))
    config = EvaluateConfig(rollouts=rollouts)
    return lambda: evaluate(agent, store, config, items=range(segments)), segments


def brute_force() -> Work:
    """Return the simulator's step as a plain program: bicycle, all pairs of boxes, the nearest of all points."""
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
    """Return a product of 2 048 x 2 048 matrices; its "agent-steps" are floating-point operations."""
    a, b = torch.rand(2, 2048, 2048).unbind()
    return lambda: a @ b, 2 * 2048**3


WORKLOADS: dict[str, Callable[[], Work]] = {
    "simulator": lambda: rings(0, 0),
    "16 objects": lambda: rings(16, 1),
    "16 objects, 200 points": lambda: rings(16, 200),
    "16 objects, 1000 points": lambda: rings(16, 1000),
    "smallest step": smallest_step,
    "smallest step, compiled": lambda: smallest_step(compiled=True),
    "actions of two": actions_of_few,
    "search 16 x 16 x 50": search,
    "bc update": lambda: update("bc"),
    "bc update, paper size": lambda: update("bc", states=1600, points=1000),
    "bc_ts_h update": lambda: update("bc_ts_h", count=10),
    "segment prepared": preparation,
    "segment evaluated": evaluation,
    "brute force": brute_force,
    "matmul": matmul,
}
if not any(map(shutil.which, ("c++", "g++", "clang++"))):
    del WORKLOADS["smallest step, compiled"]


class Measured:
    """A workload, ready to run.

    Args:
        name: of the workload.
        warm: rounds before the first that counts.
    """

    def __init__(self, name: str, warm: int) -> None:
        torch.set_num_threads(1)
        self.work, self.steps = WORKLOADS[name]()
        self.prepared = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for _ in range(warm):
            self.work()

    def __call__(self) -> dict[str, float]:
        """Return CPU seconds and page faults of a round, and MiB by which the peak rose above the prepared work's."""
        faults, began = resource.getrusage(resource.RUSAGE_SELF).ru_minflt, time.process_time()
        self.work()
        seconds, after = time.process_time() - began, resource.getrusage(resource.RUSAGE_SELF)
        return {
            "seconds": seconds,
            "steps": self.steps,
            "faults": after.ru_minflt - faults,
            "mebibytes": (after.ru_maxrss - self.prepared) / 1024,
        }


@torch.no_grad()
def main() -> None:
    """Measure one workload once for each line that comes in."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workload", choices=WORKLOADS)
    parser.add_argument("--warm", type=int, default=40)
    parser.add_argument("--keep-memory", action="store_true", help="as the symphony command does")
    arguments = parser.parse_args()
    if arguments.keep_memory:
        from symphony import allocator  # noqa: PLC0415 - older versions have none

        allocator.tune()
    measured = Measured(arguments.workload, arguments.warm)
    print("ready", flush=True)
    for _ in sys.stdin:
        print(json.dumps(measured()), flush=True)


if __name__ == "__main__":
    main()
