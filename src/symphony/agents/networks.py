"""The networks of an agent, from what its specification says."""

from __future__ import annotations

from functools import partial
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule

from symphony import keys, modules
from symphony.config import AgentConfig, AgentSpec
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES, ObservationConfig
from symphony.envs.routes import ALONG_FEATURES, CHOICE_FEATURES, ROUTE_FEATURES, TURN_FEATURES
from symphony.imports import build_object
from symphony.modules.encoder import FORESIGHT, ElementGroup, SceneEncoder

RADIUS = 20.0
"""Metres around an agent that its discriminator observes."""


def dynamics_of(spec: AgentSpec) -> Bicycle | Displacement:
    """The action space: MGAIL needs one that its gradient can pass (paper, section V-A)."""
    return Displacement() if spec.action_space == "displacement" else bicycle(spec.agent)


def bicycle(config: AgentConfig) -> Bicycle:
    """The discrete actions of an agent."""
    return Bicycle(num_acceleration=config.accelerations)


def observation_of(spec: AgentSpec, *, discriminator: bool = True) -> ObservationConfig:
    """What the networks observe.

    Args:
        spec: of the agent.
        discriminator: whether the discriminator looks too; clearances are costly, and only it reads them.
    """
    features = spec.discriminator.features if discriminator and spec.discriminator is not None else "paper"
    gaps = spec.agent.features != "paper"
    return ObservationConfig(
        num_points=spec.agent.num_points,
        num_lights=spec.agent.num_lights,
        route=spec.goals,
        turns=spec.goals and spec.agent.goal_features == "turns",
        along=gaps and spec.goals,
        gaps=gaps,
        clearance=features != "paper",
        foresight=FORESIGHT if gaps or features == "foresight" else (),
    )


def _groups(spec: AgentSpec, *, route: bool) -> tuple[ElementGroup, ...]:
    """What a network sees around an agent, that follows a route or not."""
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
    """Actions from observations, and from the route that is the goal: a categorical over the joint actions of the
    bicycle, or a Gaussian or a histogram over displacements. Seed torch beforehand.
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
    """Routes from first states, by an encoder of its own (paper, section III-B)."""
    features = CHOICE_FEATURES + TURN_FEATURES * (spec.agent.goal_features == "turns")
    sizes: dict[str, Any] = {"hidden": spec.agent.hidden, "encoder": _encoder(spec)}
    return modules.goal_policy(SELF_FEATURES, _groups(spec, route=False), features, **sizes)


def discriminator_network(spec: AgentSpec) -> TensorDictModule:
    """How simulated a state looks, given the goal."""
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
