"""Agents by name: baselines, and the folders of trained ones."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import torch
from tensordict.nn import TensorDictModuleBase

from symphony.config import SearchConfig, TrainConfig, from_dict
from symphony.envs.baselines import ConstantVelocity
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import ObservationConfig
from symphony.errors import ConfigError
from symphony.trainers.checkpoint import latest, load_checkpoint
from symphony.trainers.networks import build_networks, observation_config

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
        goals: draws routes from first states; None for agents that follow none.
        discriminator: scores states; None for agents trained without search.
        search: how branches are pruned, where there is a discriminator.
    """

    name: str
    policy: TensorDictModuleBase | None
    dynamics: Bicycle | Displacement
    observation: ObservationConfig
    interactive: int = 2
    goals: TensorDictModuleBase | None = None
    discriminator: TensorDictModuleBase | None = None
    search: SearchConfig = field(default_factory=SearchConfig)


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
    networks = build_networks(config, dynamics)
    load_checkpoint(newest, modules=networks.present(), partial=True, restore_rng=False)
    for module in networks.present().values():
        module.to(torch.device(device)).eval()
    return Agent(
        name,
        networks.policy,
        dynamics,
        observation_config(config),
        config.agent.interactive,
        networks.goals,
        networks.discriminator,
        config.search,
    )


def read_config(folder: Path) -> TrainConfig:
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
    return from_dict(TrainConfig, values, file=path)
