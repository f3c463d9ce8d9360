"""Agents: networks with what it takes to simulate them, by name and on disk."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from torch import nn

from symphony import keys, modules
from symphony.agents.checkpoint import CheckpointError, load_checkpoint
from symphony.agents.choice import PREFIX, choose, split_name
from symphony.config import AgentConfig, AgentSpec, EvaluateConfig, SearchConfig, read_json
from symphony.envs.dynamics import Bicycle, ConstantVelocity, Displacement, RandomActions
from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES, ObservationConfig
from symphony.envs.routes import ALONG_FEATURES, CHOICE_FEATURES, ROUTE_FEATURES
from symphony.errors import ConfigError, DataWarning
from symphony.imports import build_object, load_object
from symphony.modules.encoder import FORESIGHT, ElementGroup, SceneEncoder

RADIUS = 20.0  # metres around an agent that its discriminator observes


def dynamics_of(spec: AgentSpec) -> Bicycle | Displacement:
    """Return the action space of an agent: MGAIL needs a differentiable one (paper, section III-C)."""
    return Displacement() if spec.action_space == "displacement" else bicycle(spec.agent)


def bicycle(config: AgentConfig) -> Bicycle:
    """Return the bicycle model with the discrete actions of an agent."""
    return Bicycle(num_acceleration=config.accelerations)


def observation_of(spec: AgentSpec, *, discriminator: bool = True) -> ObservationConfig:
    """Return the configuration of the observation, with or without the clearances that the discriminator reads."""
    features = spec.discriminator.features if discriminator and spec.discriminator is not None else "paper"
    gaps = spec.agent.features != "paper"
    return ObservationConfig(
        num_points=spec.agent.num_points,
        num_lights=spec.agent.num_lights,
        route=spec.goals,
        along=gaps and spec.goals,
        gaps=gaps,
        clearance=features != "paper",
        foresight=FORESIGHT if gaps or features == "foresight" else (),
    )


def _groups(spec: AgentSpec, *, route: bool) -> tuple[ElementGroup, ...]:
    """Return the groups of elements that a network sees around an agent, with or without a route."""
    along, gaps = 0, 0
    if spec.agent.features != "paper":
        along, gaps = ALONG_FEATURES * (route and spec.goals), 3 * (1 + len(FORESIGHT))
    more: dict[str, Any] = {"more_keys": (keys.ALONG,) if along else ()}
    more["gap_keys"] = (keys.GAP, keys.GAP_AHEAD) if gaps else ()
    objects = ElementGroup(keys.OBJECTS, keys.OBJECTS_MASK, OBJECT_FEATURES + along + gaps, **more)
    points = ElementGroup(keys.POINTS, keys.POINTS_MASK, POINT_FEATURES)
    lights = ElementGroup(keys.LIGHTS, keys.LIGHTS_MASK, POINT_FEATURES)
    return (objects, points, lights) if spec.agent.num_lights else (objects, points)


def policy_network(spec: AgentSpec) -> ProbabilisticTensorDictSequential:
    """Return a network from observations (and the route that is the goal) to actions: a categorical over the joint
    actions of the bicycle, or a Gaussian or a histogram over displacements. Seed torch beforehand.
    """
    if spec.agent.policy != "paper":
        return build_object(spec.agent.policy, spec)
    sizes: dict[str, Any] = {
        "hidden": spec.agent.hidden,
        "head": (2 * spec.agent.hidden, 2 * spec.agent.hidden),
        "own_keys": _own_keys(spec),
        "encoder": _encoder(spec),
    }
    own, dynamics, groups = _own_features(spec), dynamics_of(spec), _groups(spec, route=True)
    if isinstance(dynamics, Bicycle):
        return modules.discrete_policy(own, groups, actions=dynamics.num_actions, **sizes)
    sizes |= {"size_scale": observation_of(spec).size_scale, "cells": spec.agent.cells}
    return modules.displacement_policy(own, groups, dt=spec.dt, **sizes)


def goal_network(spec: AgentSpec) -> ProbabilisticTensorDictSequential:
    """Return the network that draws routes from first states, with an encoder of its own (paper, section III-B)."""
    sizes: dict[str, Any] = {"hidden": spec.agent.hidden, "encoder": _encoder(spec)}
    return modules.goal_policy(SELF_FEATURES, _groups(spec, route=False), CHOICE_FEATURES, **sizes)


def discriminator_network(spec: AgentSpec) -> TensorDictModule:
    """Return the network that judges how simulated a state looks, given the goal."""
    config = spec.discriminator
    if config is None:
        raise ValueError("the specification has no discriminator")
    if config.network != "paper":
        return build_object(config.network, spec)
    return modules.discriminator(
        _own_features(spec),
        OBJECT_FEATURES,
        POINT_FEATURES,
        own_keys=_own_keys(spec),
        radius=RADIUS / observation_of(spec).distance_scale,
        hidden=config.hidden,
        head=(2 * config.hidden,),
        features=config.features,
    )


def _own_keys(spec: AgentSpec) -> tuple[keys.Key, ...]:
    return (keys.OWN, keys.ROUTE) if spec.goals else (keys.OWN,)


def _own_features(spec: AgentSpec) -> int:
    return SELF_FEATURES + (ROUTE_FEATURES if spec.goals else 0)


def _encoder(spec: AgentSpec) -> Any:
    return SceneEncoder if spec.agent.encoder == "paper" else partial(build_object, spec.agent.encoder)


PLAYBACK = "playback"  # name of the logged trajectories themselves, evaluated like an agent
FILE = "agent.json"  # file in a run's folder that holds the agent's specification


class SearchPlan(NamedTuple):
    """The way in which the rollouts of a run segment are simulated, with no setting left open."""

    kind: Literal["log", "none", "tree", "backtrack"]  # of search; log for playback
    trees: int  # of the run segment; independent rollouts are trees of one branch
    branches: int  # of each tree
    taken: int  # rollouts taken from each tree
    search: SearchConfig  # how branches are pruned


@dataclass(frozen=True)
class Agent:
    """A policy with the other networks and the settings that its simulation needs."""

    name: str  # as given by the user
    policy: TensorDictModuleBase | None  # writes actions; None for log playback
    spec: AgentSpec | None = None  # what its networks are and how it is simulated; None for baselines
    goals: TensorDictModuleBase | None = None  # draws routes from first states; None where it follows none
    discriminator: TensorDictModuleBase | None = None  # scores states; None for agents trained without
    # What drives in place of the policy, along the routes of the log (see symphony.rollouts.driving.RULES)
    rule: Literal["idm"] | None = None

    @property
    def dynamics(self) -> Bicycle | Displacement:
        """The action space in which it acts."""
        return Bicycle() if self.spec is None else dynamics_of(self.spec)

    @property
    def observation(self) -> ObservationConfig:
        """The configuration of its observation, including the input of its discriminator."""
        return ObservationConfig.nothing() if self.spec is None else observation_of(self.spec)

    @property
    def interactive(self) -> int:
        """The number of agents of a run segment that it was trained with (2 for baselines)."""
        return 2 if self.spec is None else self.spec.agent.interactive

    @property
    def duration(self) -> int:
        """The seconds of a run segment that it was trained with; 0 for all."""
        return 0 if self.spec is None else self.spec.duration

    @property
    def search(self) -> SearchConfig:
        """The settings by which its branches are pruned, where there is a discriminator."""
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
        """The networks of the agent by their names."""
        parts = {"policy": self.policy, "goals": self.goals, "discriminator": self.discriminator}
        return {name: module for name, module in parts.items() if module is not None}

    def plan(self, config: EvaluateConfig) -> SearchPlan:
        """Return how the rollouts of a run segment are simulated.

        Raises a :class:`ConfigError` where the search needs a discriminator that it lacks, or trees are too small.
        """
        search = config.pruning(self.search)
        blind = search.score == "discriminator" and self.discriminator is None
        kind: Literal["log", "none", "tree", "backtrack"] = "log"
        if self.policy is not None and config.search != "agent":
            kind = config.search
        elif self.policy is not None:
            kind = search.way if self.searches and not blind else "none"
        if kind not in ("log", "none") and blind:
            what = f"search '{kind}' needs an agent with a discriminator, {self.name} has none"
            raise ConfigError(f"{what}, or another score: --score rule")
        branches, trees = search.test_branches, config.trees
        if kind != "tree":
            return SearchPlan(kind, config.rollouts, 1, 1, search)
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
        """Raise ConfigError if the agent learned with a time step other than ``dt`` seconds."""
        if self.spec is not None and abs(self.spec.dt - dt) > 1e-6:
            raise ConfigError(
                f"{self.name} learned steps of {self.spec.dt:g} s and can't drive in steps of {dt:g} s; "
                f"convert the logs with --rate {1 / self.spec.dt:g}"
            )


def build_agent(name: str, spec: AgentSpec) -> Agent:
    """Build an agent with fresh networks; seed torch beforehand."""
    policy, goals = policy_network(spec), goal_network(spec) if spec.goals else None
    discriminator = None if spec.discriminator is None else discriminator_network(spec)
    agent = Agent(name, policy, spec, goals, discriminator)
    for module in agent.modules.values() if torch.get_default_dtype() != torch.float32 else ():
        module.float()  # as what they observe is
    return agent


def load_agent(name: str, device: str = "cpu", *, trust_code: bool = False) -> Agent:
    """Load an agent by its name.

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
    place = usable_device(device)
    if name == PLAYBACK:
        return Agent(name, None)
    if name in ("constant_velocity", "idm"):
        return Agent(name, ConstantVelocity(Bicycle()), rule="idm" if name == "idm" else None)
    if name == "random":
        return Agent(name, RandomActions(Bicycle()))
    folder, which = split_name(name)
    if not name.startswith(PREFIX):  # `./RUN` and `RUN/` are the same agent
        name = f"{folder}@{which}" if which else str(folder)
    spec = read_spec(folder)
    _check_code(spec, folder / FILE, trust_code)
    checkpoint = choose(folder, which)
    if not spec.code:
        _check_sizes(name, spec, folder / FILE, checkpoint)
    agent = build_agent(name, spec)
    load_checkpoint(checkpoint, modules=agent.modules, partial=True, restore_rng=False)
    for module in agent.modules.values():
        module.eval()
    return agent.to(place)


def _check_code(spec: AgentSpec, file: Path, trusted: bool) -> None:
    """Check that a specification from a file names code only where the user trusts it, and import that code."""
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
    """Check that networks are no larger than their weights on disk, before they take memory."""
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
    """Return the device of a name; raise a ConfigError if there is none of that name."""
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ConfigError(f"unknown device '{name}'") from error
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f"device '{name}': this PyTorch sees no such CUDA device")
    if device.type in ("cuda", "cpu"):
        return device
    try:
        # Not asked of CUDA, where each process would begin to use the first device.
        torch.zeros(1, device=device).item()
    except Exception as error:  # each kind of device has its own
        raise ConfigError(f"device '{name}' can't be used: {' '.join(str(error).split())[:160]}") from error
    return device


def read_spec(folder: Path) -> AgentSpec:
    """Return the specification of the agent that a run trains; raise a ConfigError if the folder is not a run."""
    path = folder / FILE
    if not path.is_file():
        known = f"'{PLAYBACK}', 'constant_velocity', 'idm', 'random', '{PREFIX}NAME'"
        raise ConfigError(f"{folder} is not an agent: expected {known} or the folder of a run (one with an {FILE})")
    return read_json(AgentSpec, path)
