"""Training runs that take a second."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from symphony.agents import load_agent
from symphony.config import AgentConfig, DiscriminatorConfig, SearchConfig, TrainConfig


def tiny(method: Any, store: Path, out: Path, **changes: Any) -> TrainConfig:
    """A configuration of the smallest networks and batches."""
    base = TrainConfig(
        method,
        data=store,
        out=out,
        steps=4,
        agent=AgentConfig(num_objects=4, num_points=12, hidden=8, head=8),
        segments=2,
        states=16,
        goals=8,
        search=SearchConfig(branches=2, prune_every=4, segments=2, updates=2, states=8, test_branches=2),
        discriminator=DiscriminatorConfig(hidden=8, head=8, states=8),
        checkpoint_every=2,
        log_every=1,
        wandb="disabled",
    )
    return replace(base, **changes)


def weights(run: Path | str) -> dict[str, Tensor]:
    """Copies of all weights of a run's agent."""
    agent = load_agent(str(run))
    found = {"policy": agent.policy, "goals": agent.goals, "discriminator": agent.discriminator}
    return {
        f"{name}.{key}": value.clone()
        for name, module in found.items()
        if isinstance(module, torch.nn.Module)
        for key, value in module.state_dict().items()
    }


def same_weights(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    """Whether they are the same to the last bit."""
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
