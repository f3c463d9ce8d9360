"""Agents: their networks, their weights on disk, and how they are named."""

from __future__ import annotations

from symphony.agents.agent import Agent, load_agent

__all__ = ["Agent", "load_agent"]
