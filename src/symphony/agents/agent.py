"""Agents by name: baselines, and the folders of trained ones."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import torch
from tensordict.nn import TensorDictModuleBase

from symphony.agents.checkpoint import load_checkpoint
from symphony.agents.choice import choose, split_name
from symphony.agents.included import PREFIX
from symphony.agents.networks import Networks, build_networks, dynamics_of, observation_config
from symphony.config import SearchConfig, TrainConfig, from_dict
from symphony.envs.baselines import ConstantVelocity
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import ObservationConfig
from symphony.errors import ConfigError

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
        discriminator: scores states; None for agents trained without.
        search: how branches are pruned, where there is a discriminator.
        searches: whether it is meant to be simulated with the search.
        duration: seconds of a segment it was trained with; 0 for all.
    """

    name: str
    policy: TensorDictModuleBase | None
    dynamics: Bicycle | Displacement
    observation: ObservationConfig
    interactive: int = 2
    goals: TensorDictModuleBase | None = None
    discriminator: TensorDictModuleBase | None = None
    search: SearchConfig = field(default_factory=SearchConfig)
    searches: bool = True
    duration: int = 0


def load_agent(name: str, device: str = "cpu") -> Agent:
    """An agent by name.

    Args:
        name: ``playback``, ``constant_velocity``, ``pretrained:NAME`` (an agent that comes with the package), or the
            folder of a run, of which the best checkpoint is taken if it was validated, else the last; ``RUN@last``,
            ``RUN@best`` or ``RUN@3000`` (a step) names another.
        device: where its weights go.

    Raises:
        ConfigError: if there is no such agent or checkpoint.
        CheckpointError: if its weights can't be read.
    """
    if name == PLAYBACK:
        return Agent(name, None, Bicycle(), ObservationConfig.nothing())
    if name == "constant_velocity":
        return Agent(name, ConstantVelocity(Bicycle()), Bicycle(), ObservationConfig.nothing())
    folder, which = split_name(name)
    config = read_config(folder)
    checkpoint = choose(folder, which)
    networks = build_networks(config)
    load_checkpoint(checkpoint, modules=networks.present(), partial=True, restore_rng=False)
    for module in networks.present().values():
        module.to(torch.device(device)).eval()
    return assemble(name, config, networks)


def assemble(name: str, config: TrainConfig, networks: Networks) -> Agent:
    """The agent that the networks of a run make, to be simulated as it was trained."""
    return Agent(
        name,
        networks.policy,
        dynamics_of(config),
        observation_config(config),
        config.agent.interactive,
        networks.goals,
        networks.discriminator,
        config.search,
        config.searches,
        config.duration,
    )


def read_config(folder: Path) -> TrainConfig:
    """The configuration a run was started with."""
    path = folder / "config.json"
    if not path.is_file():
        raise ConfigError(
            f"{folder} is no agent: expected '{PLAYBACK}', 'constant_velocity', '{PREFIX}NAME' or the folder of a "
            f"run (one with a config.json)"
        )
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ConfigError(f"{path}: not valid JSON ({error})") from error
    return from_dict(TrainConfig, values, file=path)
