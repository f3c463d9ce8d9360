"""Agents: their networks, their weights on disk, and how they are named."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.agents.agent import (
        Agent,
        bicycle,
        build_agent,
        discriminator_network,
        dynamics_of,
        goal_network,
        load_agent,
        observation_of,
        policy_network,
    )

__all__ = [
    "Agent", "bicycle", "build_agent", "discriminator_network", "dynamics_of", "goal_network", "load_agent",
    "observation_of", "policy_network",
]  # fmt: skip

__getattr__, __dir__ = lazily(__name__)
