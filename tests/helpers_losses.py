"""Every loss with all that it needs, tiny; as a program it takes all once, with all signatures of tensors checked."""

from __future__ import annotations

import jaxtyping

if __name__ == "__main__":  # before the package is first imported
    jaxtyping.install_import_hook(["symphony"], "helpers_shapes.tensors_only")

from typing import Any

import torch
from tensordict import TensorDict

from helpers_segments import crossing, straight_road
from symphony import keys
from symphony.agents import build_agent
from symphony.collectors import Systematic
from symphony.config import AgentConfig, AgentSpec, DiscriminatorConfig
from symphony.envs import DrivingEnv, collate, scene
from symphony.objectives import BCLoss, DiscriminatorLoss, DistillationLoss, GoalLoss, MGAILLoss
from symphony.roadgraph import LaneGraph
from symphony.rollouts.search import search
from symphony.rollouts.unroll import start_states

LOGGED = 3  # a search of them prunes once
SCENES = collate(
    [scene(s, [0, 1], LaneGraph(s.road)) for s in (straight_road(steps=LOGGED), crossing(6, steps=LOGGED))]
)
ROWS = 4
CASES = [
    *[(name, "bicycle") for name in ("bc", "distillation", "goal", "discriminator")],
    *[("mgail", space) for space in ("displacement", "histogram")],
]
"""Names of losses, and the action spaces they are for."""


def spec(space: Any) -> AgentSpec:
    cells = 3 if space == "histogram" else 0
    return AgentSpec(
        action_space="displacement" if cells else space, dt=0.2, goals=True,
        agent=AgentConfig(
            num_points=20, num_lights=0 if cells else 2, features="paper" if cells else "gaps", cells=cells, hidden=8
        ),
        discriminator=DiscriminatorConfig(features="paper" if cells else "foresight", hidden=8), searches=True,
    )  # fmt: skip


def losses(agent: Any, env: DrivingEnv) -> dict[str, Any]:
    return {
        "bc": BCLoss(agent.policy), "distillation": DistillationLoss(agent.policy), "goal": GoalLoss(agent.goals),
        "discriminator": DiscriminatorLoss(agent.discriminator, gradient_penalty=1.0),
        "mgail": MGAILLoss(agent.policy, agent.discriminator, env, horizon=2),
    }  # fmt: skip


def world(space: Any, device: Any = "cpu", scenes: Any = SCENES) -> tuple[Any, DrivingEnv]:
    """An agent, always the same, and an environment, there."""
    torch.manual_seed(0)
    agent = build_agent("agent", spec(space)).to(device)
    return agent, DrivingEnv(scenes.to(device), agent.dynamics, agent.observation)


def batch_for(name: str, env: DrivingEnv, device: Any = "cpu") -> TensorDict:
    """States with what a loss reads; MGAIL acts by itself."""
    row = torch.arange(ROWS, device=device) % 2
    batch = batch_of(env, env.start(row, row))
    return batch.exclude(keys.ACTION) if name == "mgail" else batch


def batch_of(env: DrivingEnv, state: TensorDict) -> TensorDict:
    """States with everything that any loss reads."""
    batch = env.choices(env.with_goals(state))
    valid = batch.get(keys.VALID)
    action = torch.zeros_like(valid, dtype=torch.int64)
    batch.set(keys.ACTION, action if env.dynamics.discrete else action[..., None].expand(*valid.shape, 2) + 0.5)
    batch.set(keys.ROLLOUT, torch.zeros_like(valid))
    batch.set(keys.SIMULATED, torch.zeros_like(valid))
    batch.set(keys.GOAL_SET, batch.get(keys.ROUTES_MASK))
    return batch


def searched(agent: Any, env: DrivingEnv, rule: Any, start: TensorDict | None = None) -> Any:
    """A search of both scenes."""
    if start is None:
        start = start_states(env, agent.goals, trees=1, branches=4, seed=0)
    how: Any = {"rule": rule, "prune_every": 1, "leaves": 3}
    with torch.no_grad():
        return search(env, agent.policy, agent.discriminator, start, seed=0, **how)


def main() -> None:
    """Tell of each loss that is a number and has a gradient."""
    for name, space in CASES:
        agent, env = world(space)
        searched(agent, env, Systematic(0.6))
        out = losses(agent, env)[name](batch_for(name, env))
        total = sum(value for key, value in out.items() if key.startswith("loss"))
        total.backward()
        if total.isfinite():
            print(name, space)  # noqa: T201


if __name__ == "__main__":
    main()
