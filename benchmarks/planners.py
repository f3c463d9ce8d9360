"""TorchRL's planners and the beam search at equal simulated steps: python benchmarks/planners.py; some minutes.

Writes the mean return (and its standard error over seeds) of 8 rows to ``results/planners.json``, the table of
docs/torchrl.md.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, PendulumEnv
from torchrl.modules import CEMPlanner, MPPIPlanner
from torchrl.objectives.value import TDLambdaEstimator

from symphony.collectors import BeamSearchPlanner, with_rows

ROOT = Path(__file__).resolve().parents[1]
RECORD = ROOT / "results" / "planners.json"

ROWS, SEEDS, STEPS = 8, 3, {"pendulum": 60, "point": 40, "pole": 60}
HORIZON, ROUNDS, CANDIDATES = 12, 4, 64
"""An action takes 4 x 64 x 12 simulated steps, in the beam search one round of 256 branches."""


class Plane(EnvBase):
    """A state whose step is a function; the episode ends where it leaves its bounds."""

    batch_locked = False

    def __init__(self, size: int, actions: int, seed: int) -> None:
        super().__init__(batch_size=[])
        self.observation_spec = Composite(observation=Unbounded((size,)))
        self.state_spec = self.observation_spec.clone()
        self.action_spec, self.reward_spec = Bounded(-1, 1, (actions,)), Unbounded((1,))
        self.size, self.rng = size, torch.Generator().manual_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        self.rng.manual_seed(0 if seed is None else seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        shape = () if tensordict is None else tensordict.shape
        drawn = torch.rand(*shape, self.size, generator=self.rng)
        return TensorDict({"observation": self.begin(drawn)}, shape)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, reward, over = self.move(tensordict["observation"], tensordict["action"].clamp(-1, 1))
        done = {"done": over[..., None], "terminated": over[..., None].clone()}
        return TensorDict({"observation": state, "reward": reward[..., None], **done}, tensordict.shape)


class Point(Plane):
    """A point in the plane is pushed to the origin: the cost is its squared distance."""

    def begin(self, drawn: torch.Tensor) -> torch.Tensor:
        return torch.cat([2 * drawn[..., :2] - 1, torch.zeros_like(drawn[..., 2:])], -1)

    def move(self, state: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, ...]:
        v = state[..., 2:] + 0.3 * action
        x = state[..., :2] + 0.3 * v
        return torch.cat([x, v], -1), -x.square().sum(-1), (x.abs() > 3).any(-1)


class Pole(Plane):
    """A pole on a cart is kept upright: 1 a step until it falls, less what it leans."""

    def begin(self, drawn: torch.Tensor) -> torch.Tensor:
        return 0.1 * drawn - 0.05

    def move(self, state: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, ...]:
        x, v, angle, turning = state.unbind(-1)
        push = (10 * action.squeeze(-1) + 0.05 * turning**2 * angle.sin()) / 1.1
        bend = (9.8 * angle.sin() - angle.cos() * push) / (0.5 * (4 / 3 - 0.1 * angle.cos() ** 2 / 1.1))
        gain = push - 0.05 * bend * angle.cos() / 1.1
        after = torch.stack([x + 0.02 * v, v + 0.02 * gain, angle + 0.02 * turning, turning + 0.02 * bend], -1)
        lean = after[..., 2].abs() / 0.2095
        return after, 1 - lean, (after[..., 0].abs() > 2.4) | (lean > 1)


MAKERS = {
    "pendulum": lambda seed: PendulumEnv(seed=seed),
    "point": lambda seed: Point(4, 2, seed),
    "pole": lambda seed: Pole(4, 1, seed),
}
KINDS = (
    "random actions", "`CEMPlanner`", "`MPPIPlanner`",
    "beam search, pruned every 4 of 12 steps", "beam search, not pruned",
)  # fmt: skip


def planner(kind: str, env: EnvBase) -> Any:
    """Return a policy by name; None for random actions."""
    if kind == "`CEMPlanner`":
        return CEMPlanner(env, HORIZON, ROUNDS, CANDIDATES, 8)
    if kind == "`MPPIPlanner`":
        nothing = TensorDictModule(lambda done: torch.zeros(done.shape), ["done"], ["state_value"])
        value = TDLambdaEstimator(gamma=1.0, lmbda=1.0, value_network=nothing)
        return MPPIPlanner(env, value, 1.0, HORIZON, ROUNDS, CANDIDATES, 8)
    if kind == "random actions":
        return None
    return BeamSearchPlanner(env, HORIZON, ROUNDS * CANDIDATES, prune_every=HORIZON if "not" in kind else 4)


@torch.no_grad()
def measured(name: str, kind: str) -> list[float]:
    """Compute the mean return over seeds, and its standard error."""
    returns = []
    for seed in range(SEEDS):
        torch.manual_seed(seed)
        env = MAKERS[name](seed)
        found = with_rows(env, [ROWS]).rollout(STEPS[name], planner(kind, env), break_when_any_done=False)
        done = found["next", "done"].long()
        going = done.cumsum(-2) - done == 0
        returns.append((found["next", "reward"] * going).sum(-2).mean())
    return [float(torch.stack(returns).mean()), float(torch.stack(returns).std()) / SEEDS**0.5]


def main(args: Sequence[str] | None = None) -> None:
    """Print each planner's return in each environment, and write the record."""
    argparse.ArgumentParser(description=__doc__).parse_args(args)
    rows: list[list[Any]] = [[kind] for kind in KINDS]
    for name in MAKERS:
        for row in rows:
            row.append(measured(name, row[0]))
            print(f"{name:9} {row[0]:40} {row[-1][0]:7.1f} +- {row[-1][1]:.1f}", flush=True)
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.check_output(git, cwd=ROOT, text=True).strip()  # noqa: S603
    record = {
        "of": f"mean return of {ROWS} rows, {HORIZON * ROUNDS * CANDIDATES} simulated steps an action; {SEEDS} seeds",
        "made": {"commit": commit, "command": "python benchmarks/planners.py"},
        "columns": [[""], *([name, int(name != "pendulum")] for name in MAKERS)],
        "rows": rows,
    }
    RECORD.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
