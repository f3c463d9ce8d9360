"""What a driving environment says of its entries: shapes, kinds and ranges, as TorchRL's specs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torchrl.data import Binary, Categorical, Composite, Unbounded

from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import ObservationConfig, observation_spec


class Specs(NamedTuple):
    """Those of :class:`symphony.envs.DrivingEnv`, each a composite without a batch."""

    observation: Composite
    state: Composite
    action: Composite
    reward: Composite
    done: Composite


def make_specs(
    config: ObservationConfig,
    dynamics: Bicycle | Displacement,
    agents: int,
    open_traffic: bool,
    device: torch.device | None,
) -> Specs:
    """Specs of N agents.

    Args:
        config: what they observe.
        dynamics: what their actions are.
        agents: N.
        open_traffic: whether agents wait until they can enter.
        device: of the entries.
    """

    def floats(*shape: int) -> Unbounded:
        return Unbounded(shape=shape, dtype=torch.float32, device=device)

    def flags(*shape: int) -> Binary:
        return Binary(shape=shape, dtype=torch.bool, device=device)

    def numbers(*shape: int) -> Unbounded:
        return Unbounded(shape=shape, dtype=torch.int64, device=device)

    def each(entries: dict[str, Any]) -> Composite:
        return Composite(entries, shape=(agents,))

    parts: dict[str, Callable[[], Any]] = {
        "valid": lambda: flags(agents),
        "state": lambda: floats(agents, 4),
        "goal": lambda: numbers(agents),
        "progress": lambda: floats(agents),
    }
    if open_traffic:
        parts["waiting"] = lambda: flags(agents)
    if config.persona:
        parts["persona"] = lambda: floats(agents, 2)
    seen = observation_spec(config, agents, device)
    observed = {} if seen.is_empty() else {"observation": seen}
    outcome = {"collision": flags(agents, 1), "offroad": flags(agents, 1)}

    def progress() -> dict[str, Any]:
        return {name: numbers(1) for name in ("scene", "step", "stream")}

    def agent() -> dict[str, Any]:
        return {name: spec() for name, spec in parts.items()}

    action: Categorical | Unbounded = floats(agents, 2)
    if dynamics.discrete:
        action = Categorical(dynamics.num_actions, shape=(agents,), dtype=torch.int64, device=device)
    return Specs(
        observation=Composite(
            {**progress(), "segment": numbers(1), "agents": each({**agent(), **observed, **outcome})}
        ),
        state=Composite({**progress(), "agents": each(agent())}),
        action=Composite({"agents": each({"action": action})}),
        reward=Composite({"agents": each({"reward": floats(agents, 1)})}),
        done=Composite({name: flags(1) for name in ("done", "terminated", "truncated")}),
    )
