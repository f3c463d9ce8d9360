"""Agents: their networks, their weights on disk, and how they are named."""

from __future__ import annotations

from typing import TYPE_CHECKING

from symphony.imports import lazily

if TYPE_CHECKING:
    from symphony.agents.agent import Agent, build_agent, load_agent
    from symphony.agents.networks import (
        bicycle,
        discriminator_network,
        dynamics_of,
        goal_network,
        observation_of,
        policy_network,
    )

__all__ = [
    "Agent",
    "bicycle",
    "build_agent",
    "discriminator_network",
    "dynamics_of",
    "goal_network",
    "load_agent",
    "observation_of",
    "policy_network",
]

__getattr__, __dir__ = lazily(__name__)
