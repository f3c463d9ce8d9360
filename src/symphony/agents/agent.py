"""Agents: networks with what it takes to simulate them, by name and on disk."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn

from symphony.agents import networks
from symphony.agents.checkpoint import CheckpointError, load_checkpoint
from symphony.agents.choice import PREFIX, choose, split_name
from symphony.agents.networks import dynamics_of, observation_of
from symphony.config import AgentSpec, EvaluateConfig, SearchConfig, read_json
from symphony.envs.dynamics import Bicycle, ConstantVelocity, Displacement, RandomActions
from symphony.envs.observation import ObservationConfig
from symphony.errors import ConfigError, DataWarning
from symphony.imports import load_object

PLAYBACK = "playback"
"""Name of the logged trajectories themselves, evaluated like an agent."""
FILE = "agent.json"
"""File in a run's folder that holds the agent's specification."""


class SearchPlan(NamedTuple):
    """How the rollouts of a run segment come about, with nothing left open."""

    kind: Literal["log", "none", "tree", "backtrack", "best"]  # of search; log for playback
    trees: int  # of the run segment; independent rollouts are trees of one branch
    branches: int  # of each tree
    taken: int  # rollouts taken from each tree
    search: SearchConfig  # how branches are pruned


@dataclass(frozen=True)
class Agent:
    """A policy and what it needs around it."""

    name: str  # as given by the user
    policy: TensorDictModuleBase | None  # writes actions; None for log playback
    spec: AgentSpec | None = None  # what its networks are and how it is simulated; None for baselines
    goals: TensorDictModuleBase | None = None  # draws routes from first states; None where it follows none
    discriminator: TensorDictModuleBase | None = None  # scores states; None for agents trained without
    # What drives in place of the policy, along the routes of the log (see symphony.rollouts.driving.RULES)
    rule: Literal["constant_velocity", "idm"] | None = None

    @property
    def dynamics(self) -> Bicycle | Displacement:
        """The action space it acts in."""
        return Bicycle() if self.spec is None else dynamics_of(self.spec)

    @property
    def observation(self) -> ObservationConfig:
        """What it observes, the input of its discriminator included."""
        return ObservationConfig.nothing() if self.spec is None else observation_of(self.spec)

    @property
    def interactive(self) -> int:
        """How many agents of a run segment it was trained with (2 for baselines)."""
        return 2 if self.spec is None else self.spec.agent.interactive

    @property
    def duration(self) -> int:
        """Seconds of a run segment it was trained with; 0 for all."""
        return 0 if self.spec is None else self.spec.duration

    @property
    def search(self) -> SearchConfig:
        """How branches are pruned, where there is a discriminator."""
        return SearchConfig() if self.spec is None else self.spec.search

    @property
    def searches(self) -> bool:
        """Whether it is meant to be simulated with the search."""
        return self.spec is not None and self.spec.searches

    @property
    def routed(self) -> bool:
        """Whether it needs scenes with routes."""
        return self.goals is not None or bool(self.rule)

    @property
    def modules(self) -> dict[str, nn.Module]:
        """The networks that it has, by name."""
        parts = {"policy": self.policy, "goals": self.goals, "discriminator": self.discriminator}
        return {name: module for name, module in parts.items() if module is not None}

    def plan(self, config: EvaluateConfig) -> SearchPlan:
        """How the rollouts of a run segment come about.

        Raises:
            ConfigError: the search needs a discriminator and the agent has none, or trees are too small.
        """
        search = config.pruning(self.search)
        blind = search.score == "discriminator" and self.discriminator is None
        kind: Literal["log", "none", "tree", "backtrack", "best"] = "log"
        if self.policy is not None and config.search != "agent":
            kind = config.search
        elif self.policy is not None:
            kind = search.way if self.searches and not blind else "none"
        if kind not in ("log", "none") and blind:
            what = f"search '{kind}' needs an agent with a discriminator, {self.name} has none"
            raise ConfigError(f"{what}, or another score: --score flags or rule")
        branches, trees = search.test_branches, config.trees
        if kind != "tree":
            return SearchPlan(kind, config.rollouts, branches if kind == "best" else 1, 1, search)
        if config.rollouts // trees > branches:
            what = f"{trees} trees of {branches} branches give less than {config.rollouts} rollouts"
            raise ConfigError(what)
        return SearchPlan(kind, trees, branches, config.rollouts // trees, search)

    def to(self, device: torch.device) -> Agent:
        """Move its networks to a device, in place."""
        for module in self.modules.values():
            module.to(device)
        return self

    def check_step(self, dt: float) -> None:
        """Raise ConfigError if the agent learned another time step than ``dt`` seconds."""
        if self.spec is not None and abs(self.spec.dt - dt) > 1e-6:
            raise ConfigError(
                f"{self.name} learned steps of {self.spec.dt:g} s and can't drive in steps of {dt:g} s; "
                f"convert the logs with --rate {1 / self.spec.dt:g}"
            )


def build_agent(name: str, spec: AgentSpec) -> Agent:
    """An agent with fresh networks; seed torch beforehand."""
    policy, goals = networks.policy_network(spec), networks.goal_network(spec) if spec.goals else None
    discriminator = None if spec.discriminator is None else networks.discriminator_network(spec)
    return Agent(name, policy, spec, goals, discriminator)


def load_agent(name: str, device: str = "cpu", *, trust_code: bool = False) -> Agent:
    """An agent by name.

    Args:
        name: ``playback``, ``constant_velocity``, ``idm`` (the intelligent driver model, along the route of the log),
            ``random``, ``pretrained:NAME`` (an agent that comes with the package), or the folder of a run, of which
            the best checkpoint is taken if it was validated, else the last; ``RUN@last``, ``RUN@best`` or
            ``RUN@3000`` (a step) names another.
        device: where its weights go.
        trust_code: let its folder name code by import paths, which then runs with all rights of this process; a
            :class:`~symphony.errors.DataWarning` says which. Without it such a folder is refused.

    Raises:
        ConfigError: if there is no such agent, checkpoint or device, or the folder names code.
        CheckpointError: if its weights can't be read, or its networks are larger than they are.
    """
    if name == PLAYBACK:
        return Agent(name, None)
    if name in ("constant_velocity", "idm"):
        return Agent(name, ConstantVelocity(Bicycle()), rule="idm" if name == "idm" else None)
    if name == "random":
        return Agent(name, RandomActions(Bicycle()))
    folder, which = split_name(name)
    spec = read_spec(folder)
    _check_code(spec, folder / FILE, trust_code)
    checkpoint = choose(folder, which)
    if not spec.code:
        _check_sizes(name, spec, folder / FILE, checkpoint)
    agent = build_agent(name, spec)
    load_checkpoint(checkpoint, modules=agent.modules, partial=True, restore_rng=False)
    for module in agent.modules.values():
        module.eval()
    return agent.to(usable_device(device))


def _check_code(spec: AgentSpec, file: Path, trusted: bool) -> None:
    """See that a specification from a file names code only where the user trusts it, and import that."""
    for setting, path in spec.code.items():
        if not trusted:
            raise ConfigError(
                f"{file}: {setting} names code, '{path}', that would run with all your rights; if you trust it, "
                "say --trust-code (in Python: trust_code=True)"
            )
        warnings.warn(f"{file}: {setting} runs code, '{path}'", DataWarning, stacklevel=3)
        try:
            load_object(path, here=False)
        except ConfigError as error:
            where = "for an agent's own code the current folder is not searched"
            raise ConfigError(f"{error}; {where}: name a file, or set PYTHONPATH") from error


def _check_sizes(name: str, spec: AgentSpec, file: Path, checkpoint: Path) -> None:
    """See that networks are no larger than their weights on the disk, before they take memory."""
    try:
        with torch.device("meta"):
            modules = build_agent(name, spec).modules
    except (RuntimeError, OverflowError) as error:  # sizes that no tensor can have
        raise ConfigError(f"{file}: no networks of these sizes: {str(error)[:200]}") from error
    for part, module in modules.items():
        asked = sum(tensor.numel() * tensor.element_size() for tensor in module.state_dict().values())
        file_of = checkpoint / f"module.{part}.safetensors"
        if file_of.is_file() and asked > (held := file_of.stat().st_size):
            raise CheckpointError(f"has {held} bytes, and {file} asks for a network of {asked}", file=file_of)


def usable_device(name: str) -> torch.device:
    """A device by its name; a ConfigError where there is none of that name."""
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"unknown device '{name}'") from error
    if device.type == "cuda":
        if (device.index or 0) >= torch.cuda.device_count():
            raise ConfigError(f"device '{name}': this PyTorch sees no such CUDA device")
        return device
    try:
        # Not asked of CUDA, where each process would begin to use the first device.
        torch.zeros(1, device=device).item()
    except Exception as error:  # each kind of device has its own
        raise ConfigError(f"device '{name}' can't be used: {' '.join(str(error).split())[:160]}") from error
    return device


def read_spec(folder: Path) -> AgentSpec:
    """The specification of the agent that a run trains; a ConfigError if the folder is no run."""
    path = folder / FILE
    if not path.is_file():
        known = f"'{PLAYBACK}', 'constant_velocity', 'idm', 'random', '{PREFIX}NAME'"
        raise ConfigError(
            f"{folder} is no agent: expected {known} or the folder of a run (one with an {FILE})"
        )
    return read_json(AgentSpec, path)
