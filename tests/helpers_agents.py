"""A small agent for tests to which it does not matter how well one drives."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import torch

from symphony.agents import Agent, build_agent
from symphony.config import AgentConfig, AgentSpec, DiscriminatorConfig, SearchConfig


def make_agent(space: Any = "bicycle", cells: int = 0, seed: int = 0, search: Any = (), **more: Any) -> Agent:
    """Untrained, with goals and a discriminator; a fifth of the time of one that comes with the package."""
    torch.manual_seed(seed)
    spec = AgentSpec(
        action_space=space, dt=0.2, goals=True, agent=AgentConfig(num_points=12, hidden=8, cells=cells),
        discriminator=DiscriminatorConfig(hidden=8), searches=True,
        search=SearchConfig(**{"test_branches": 2, "prune_every": 3, **dict(search)}),
    )  # fmt: skip
    return build_agent("tiny", replace(spec, **more))


small = cache(make_agent)
"""The same for all, for those that leave it as it is."""
