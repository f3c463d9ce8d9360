"""PPO and SAC, TorchRL's own, on logged driving: python benchmarks/reinforcement.py; some ten minutes of a core.

The ego of each built-in scene is driven along its logged route and paid for its metres, until it collides or leaves
the road. Each run leaves a file in ``out/reinforcement`` and is not repeated if that exists; together they become
``results/reinforcement.json``, the table of docs/reinforcement.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss, LossModule, SACLoss, SoftUpdate
from torchrl.objectives.value import GAE

from symphony import DrivingEnv, ObservationConfig, SegmentStore, builtin_store, keys, simulate
from symphony.collectors import with_rows
from symphony.envs import (
    OBJECT_FEATURES,
    ROUTE_FEATURES,
    SELF_FEATURES,
    Bicycle,
    ConstantVelocity,
    Displacement,
)
from symphony.envs.dynamics import RandomActions
from symphony.learning import SceneDataset
from symphony.modules import ElementGroup, SceneEncoder, SceneNetwork, SeededNoise, discrete_policy, mlp
from symphony.modules.encoder import scene_module
from symphony.render.style import AGENT_COLORS, new_figure, save
from symphony.rollouts import RouteGoals

ROOT = Path(__file__).resolve().parents[1]
RUNS, RECORD = ROOT / "out" / "reinforcement", ROOT / "results" / "reinforcement.json"
FIGURE = ROOT / "docs" / "reinforcement.png"
METHODS, SEEDS, BATCHES, SHOWN = ("ppo", "sac"), range(3), 200, (0, 90, 180)
"""Twenty batches from each of the last on are shown."""
ROWS, STEPS, OBJECTS = 32, 8, 6
SEES = ObservationConfig(num_objects=OBJECTS, num_points=0, route=True, along=True, clearance=True)
OWN = (keys.OWN, keys.ROUTE, keys.ROAD)
FEATURES = SELF_FEATURES + ROUTE_FEATURES + 5
OTHERS = [ElementGroup(keys.OBJECTS, keys.OBJECTS_MASK, OBJECT_FEATURES + 11, (keys.ALONG,))]
PEDALS = ("agents", "pedals")
ENDS = {name: ("agents", name) for name in ("done", "terminated")}


def progress(before: TensorDictBase, after: TensorDictBase) -> Tensor:
    """Return the reward [*b, N] of a step: 1 for every 50 metres, and -1 for a collision or for leaving the road."""
    moved = (after[keys.STATE] - before[keys.STATE])[..., :2].norm(dim=-1)
    return moved / 50 - (after[keys.COLLISION] | after[keys.OFFROAD]).squeeze(-1).float()


def environment(split: str, dynamics: Bicycle | Displacement) -> DrivingEnv:
    """Return all built-in scenes of a split, the ego of each interactive."""
    data = SceneDataset(SegmentStore(builtin_store(split)), 1, dynamics, routes=True)
    scenes = data.scenes(range(len(data)))
    return DrivingEnv(scenes, dynamics, SEES, reward=progress, ends_on=("collision", "offroad"), seed=0)


def per_agent(batch: TensorDictBase) -> TensorDictBase:
    """Return a batch with ends of episodes in the shape of the reward, as TorchRL's losses want them."""
    for name, key in ENDS.items():
        batch["next", *key] = batch["next", name].unsqueeze(-2)
    return batch


class Values(nn.Module):
    """Computes values [..., N, 1] of what agents observe and, where that is given, do."""

    def __init__(self, action: int) -> None:
        super().__init__()
        self.layers = mlp((FEATURES + OBJECTS * (OBJECT_FEATURES + 11) + action, 64, 64, 1))

    def forward(self, *seen: Tensor) -> Tensor:
        own, (objects, along), action = seen[:3], seen[3:5], seen[5:]
        return self.layers(torch.cat([*own, objects.flatten(-2), along.flatten(-2), *action], -1))


def critic(name: str, *action: keys.Key) -> TensorDictModule:
    """Return a network of values under ``("agents", name)``."""
    seen = [*OWN, keys.OBJECTS, keys.ALONG, *action]
    return TensorDictModule(Values(2 * len(action)), seen, [("agents", name)])


def reached(pedals: Tensor, state: Tensor) -> Tensor:
    """Return displacements [..., N, 2] from how much vehicles accelerate (up to 4 m/s²) and steer, from -1 to 1."""
    speed = state[..., 3]
    forward = (0.2 * speed + 0.16 * pedals[..., 0]).clamp_min(0.0)
    slope = 0.3 / (1.0 + (0.036 * speed.square()).square()).sqrt()  # 6 m/s² to the side
    return torch.stack([forward, forward * slope * pedals[..., 1]], -1)


def driven(policy: Callable[..., TensorDictBase], env: DrivingEnv) -> tuple[float, int]:
    """Return the metres that the egos of all scenes drive until they crash or the log ends, and how many crash."""
    start = env.with_goals(env.start(torch.arange(len(env.scenes))))
    found = simulate(env, policy, start)
    crashed = ((found.collision | found.offroad) & found.counted).squeeze(-1)
    going = (crashed.cumsum(-1) - crashed.long()) == 0
    moved = found.state[..., 0, :2].diff(dim=-2).norm(dim=-1)
    return float((moved * going).sum()), int(crashed.any(-1).sum())


def ppo(env: DrivingEnv) -> tuple[nn.Module, Callable[[TensorDictBase], None]]:
    """Return a policy over the bicycle's actions, and a function that learns from a batch."""
    actor = discrete_policy(FEATURES, OTHERS, hidden=32, head=(64,), own_keys=OWN, return_log_prob=True)
    values = critic("state_value")
    loss = ClipPPOLoss(actor, values, entropy_coeff=0.003, normalize_advantage=True)
    advantage = GAE(gamma=0.97, lmbda=0.9, value_network=values)
    for module in (loss, advantage):
        module.set_keys(value=("agents", "state_value"), reward=keys.REWARD, **ENDS)
    loss.set_keys(action=keys.ACTION, sample_log_prob=keys.LOG_PROB)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-3)

    def learn(batch: TensorDictBase) -> None:
        for _ in range(4):
            with torch.no_grad():
                advantage(batch)
            flat = batch.flatten()
            for picked in torch.randperm(len(flat)).split(128):
                step(loss, flat[picked], optimizer)

    return actor, learn


def sac(env: DrivingEnv) -> tuple[nn.Module, Callable[[TensorDictBase], None]]:
    """Return a policy over displacements that a vehicle can drive, and a function that learns from past batches."""
    network = SceneNetwork(SceneEncoder(FEATURES, [OTHERS[0].features], hidden=32), 4, head=(64,))
    seen = scene_module(network, OTHERS, ("agents", "head"), own_keys=OWN)
    where = [("agents", name) for name in ("loc", "scale")]
    normal = TensorDictModule(NormalParamExtractor(), [("agents", "head")], where)
    actor = ProbabilisticActor(TensorDictSequential(seen, normal), where, [PEDALS], distribution_class=TanhNormal)
    loss = SACLoss(actor, critic("action_value", PEDALS), alpha_init=0.02, target_entropy=-2.0)
    loss.set_keys(action=PEDALS, state_action_value=("agents", "action_value"), reward=keys.REWARD, **ENDS)
    loss.make_value_estimator(gamma=0.97)
    target, optimizer = SoftUpdate(loss, eps=0.99), torch.optim.Adam(loss.parameters(), 1e-3)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(50_000), batch_size=256)

    def learn(batch: TensorDictBase) -> None:
        buffer.extend(batch.flatten())
        for _ in range(20):
            step(loss, buffer.sample(), optimizer)
            target.step()

    return TensorDictSequential(actor, TensorDictModule(reached, [PEDALS, keys.STATE], [keys.ACTION])), learn


def step(loss: LossModule, batch: TensorDictBase, optimizer: torch.optim.Optimizer) -> None:
    """Make one update."""
    optimizer.zero_grad()
    sum(value for name, value in loss(batch).items() if name.startswith("loss")).backward()
    nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
    optimizer.step()


def run(method: str, seed: int, batches: int = BATCHES) -> dict[str, Any]:
    """Learn; return metres driven and crashes in each batch, and in the scenes that were not learned from."""
    torch.manual_seed(seed)
    env = environment("train", Bicycle() if method == "ppo" else Displacement())
    env.set_seed(seed)
    actor, learn = (ppo if method == "ppo" else sac)(env)
    rows, frames = with_rows(TransformedEnv(env, RouteGoals()), [ROWS]), ROWS * STEPS
    sizes = {"frames_per_batch": frames, "total_frames": batches * frames}
    found = []
    for number, batch in enumerate(Collector(rows, actor, auto_register_policy_transforms=False, **sizes), 1):
        moved = (batch["next", *keys.STATE] - batch[keys.STATE])[..., :2].norm(dim=-1)
        found.append((float(moved.sum()), int(batch["next", "terminated"].sum())))
        learn(per_agent(batch))
        print(f"{method} {seed}, batch {number}: {found[-1][0]:.0f} m, {found[-1][1]} crashes", flush=True)
    return {"batches": found, "unseen": driven(actor, environment("test", env.dynamics))}


def per_crash(metres: float, crashes: int) -> float:
    """Return metres per crash; where none crashed, all of them."""
    return metres / max(1, crashes)


def record(runs: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Return the record of ``benchmarks/results_page.py``: means and their standard errors over seeds."""

    def over_seeds(values: Sequence[float]) -> list[float]:
        spread = torch.tensor(values, dtype=torch.float64)
        return [float(spread.mean()), float(spread.std()) / len(values) ** 0.5]

    def sums(batches: list[tuple[float, int]]) -> tuple[float, int]:
        metres, crashes = zip(*batches, strict=True)
        return sum(metres), sum(crashes)

    heads = [f"batches {first + 1} to {first + 20}" for first in SHOWN]
    scenes = {split: environment(split, Bicycle()) for split in ("train", "test")}
    rows: list[list[Any]] = []
    noise = TensorDictSequential(SeededNoise(0), RandomActions(Bicycle()))
    for name, policy in (("random actions", noise), ("constant velocity", ConstantVelocity(Bicycle()))):
        known, new = (per_crash(*driven(policy, scenes[split])) for split in ("train", "test"))
        rows.append([name, *"–" * (len(SHOWN) - 1), known, new])
    for name, found in runs.items():
        parts = [[sums(one["batches"][first : first + 20]) for one in found] for first in SHOWN]
        parts.append([one["unseen"] for one in found])
        rows.append([name.upper(), *(over_seeds([per_crash(*one) for one in part]) for part in parts)])
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.check_output(git, cwd=ROOT, text=True).strip()  # noqa: S603
    return {
        "of": f"metres driven per crash in the scenes learned from, and in others; {len(SEEDS)} seeds",
        "made": {"commit": commit, "command": "python benchmarks/reinforcement.py"},
        "columns": [[""], *([head, 0] for head in heads), ["unseen scenes", 0]],
        "rows": rows,
    }


def curves(runs: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Draw metres per crash over the ten batches up to each, a line for each seed."""
    axes = (figure := new_figure(7, 3)).subplots()
    for color, (name, found) in zip(AGENT_COLORS, runs.items(), strict=False):
        for k, one in enumerate(found):
            metres, crashes = torch.tensor(one["batches"]).unfold(0, 10, 1).sum(-1).unbind(-1)
            label = name.upper() if k == 0 else None
            axes.plot(range(10, len(metres) + 10), metres / crashes.clamp_min(1), color=color, label=label)
    axes.set(xlabel="batches of 256 steps", ylabel="metres per crash, of ten batches")
    axes.legend()
    save(figure, path)


def main() -> None:
    """Do the missing runs, write the record, and draw the curves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs=2, metavar=("METHOD", "SEED"), help="one run, without the record")
    only = parser.parse_args().only
    RUNS.mkdir(parents=True, exist_ok=True)
    for method, seed in [(only[0], int(only[1]))] if only else [(m, s) for m in METHODS for s in SEEDS]:
        if not (kept := RUNS / f"{method}-{seed}.json").exists():
            kept.write_text(json.dumps(run(method, seed)))
    if not only:
        runs = {m: [json.loads((RUNS / f"{m}-{s}.json").read_text()) for s in SEEDS] for m in METHODS}
        RECORD.write_text(json.dumps(record(runs), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        curves(runs, FIGURE)


if __name__ == "__main__":
    main()
