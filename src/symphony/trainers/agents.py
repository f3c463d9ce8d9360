"""Agents by name: baselines, and the folders of trained ones."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict.nn import TensorDictModuleBase

from symphony import keys
from symphony.config import AgentConfig, BCConfig, from_dict
from symphony.envs.baselines import ConstantVelocity
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES, ObservationConfig
from symphony.errors import ConfigError
from symphony.modules import ElementGroup, discrete_policy
from symphony.trainers.checkpoint import latest, load_checkpoint

PLAYBACK = "playback"
"""Name of the logged trajectories themselves, judged like an agent."""


@dataclass(frozen=True)
class Agent:
    """A policy and what it needs around it.

    Attributes:
        name: as given by the user.
        policy: writes actions; None for log playback.
        dynamics: the action space it acts in.
        observation: what it sees.
        interactive: how many agents a segment it was trained with.
    """

    name: str
    policy: TensorDictModuleBase | None
    dynamics: Bicycle | Displacement
    observation: ObservationConfig
    interactive: int = 2


def observation_config(config: AgentConfig) -> ObservationConfig:
    """The part of an agent's configuration that the environment needs."""
    return ObservationConfig(num_objects=config.num_objects, num_points=config.num_points)


def build_policy(config: AgentConfig, dynamics: Bicycle) -> TensorDictModuleBase:
    """A freshly initialised policy; seed torch beforehand."""
    groups = (
        ElementGroup(keys.OBJECTS, keys.OBJECTS_MASK, OBJECT_FEATURES),
        ElementGroup(keys.POINTS, keys.POINTS_MASK, POINT_FEATURES),
    )
    return discrete_policy(
        SELF_FEATURES,
        groups,
        actions=dynamics.num_actions,
        hidden=config.hidden,
        head=(config.head, config.head),
    )


def load_agent(name: str, device: str = "cpu") -> Agent:
    """An agent by name.

    Args:
        name: ``playback``, ``constant_velocity``, or the folder of a run (its last checkpoint is taken).
        device: where its weights go.

    Raises:
        ConfigError: if there is no such agent.
        CheckpointError: if its weights can't be read.
    """
    if name == PLAYBACK:
        return Agent(name, None, Bicycle(), ObservationConfig(num_points=1))
    if name == "constant_velocity":
        return Agent(name, ConstantVelocity(Bicycle()), Bicycle(), ObservationConfig(num_points=1))
    folder = Path(name)
    config = read_config(folder)
    newest = latest(folder / "checkpoints")
    if newest is None:
        raise ConfigError(f"{folder}: the run has no checkpoint yet")
    dynamics = Bicycle()
    policy = build_policy(config.agent, dynamics)
    load_checkpoint(newest, modules={"policy": policy}, partial=True, restore_rng=False)
    return Agent(
        name,
        policy.to(torch.device(device)).eval(),
        dynamics,
        observation_config(config.agent),
        config.agent.interactive,
    )


def read_config(folder: Path) -> BCConfig:
    """The configuration a run was started with."""
    path = folder / "config.json"
    if not path.is_file():
        raise ConfigError(
            f"{folder} is no agent: expected '{PLAYBACK}', 'constant_velocity' or the folder of a run "
            f"(one with a config.json)"
        )
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ConfigError(f"{path}: not valid JSON ({error})") from error
    return from_dict(BCConfig, values, file=path)
