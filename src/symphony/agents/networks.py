"""The networks of an agent, built from its configuration."""

from __future__ import annotations

from dataclasses import dataclass, fields

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn

from symphony import keys
from symphony.config import TrainConfig
from symphony.envs.dynamics import Bicycle, Displacement
from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES, ObservationConfig
from symphony.envs.routes import CHOICE_FEATURES, ROUTE_FEATURES
from symphony.modules import (
    FORESIGHT,
    ElementGroup,
    discrete_policy,
    discriminator,
    displacement_policy,
    goal_policy,
)


@dataclass
class Networks:
    """What is learned.

    Attributes:
        policy: actions from observations, and from a route with H.
        goals: routes from first states; None without H.
        discriminator: how simulated a state looks; None for behavioural cloning without TS.
    """

    policy: ProbabilisticTensorDictSequential
    goals: ProbabilisticTensorDictSequential | None = None
    discriminator: TensorDictModule | None = None

    def present(self) -> dict[str, nn.Module]:
        """Those that there are, by name."""
        found = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: module for name, module in found.items() if module is not None}


def observation_config(config: TrainConfig) -> ObservationConfig:
    """What the networks need to see."""
    features = config.discriminator.features if config.judged else "paper"
    return ObservationConfig(
        num_objects=config.agent.num_objects,
        num_points=config.agent.num_points,
        route=config.hierarchical,
        clearance=features != "paper",
        foresight=FORESIGHT if features == "foresight" else (),
    )


def dynamics_of(config: TrainConfig) -> Bicycle | Displacement:
    """The action space: MGAIL needs one that its gradient can pass (paper, section V-A)."""
    return Displacement() if config.adversarial else Bicycle()


def build_networks(config: TrainConfig) -> Networks:
    """Freshly initialised networks; seed torch beforehand."""
    groups = (
        ElementGroup(keys.OBJECTS, keys.OBJECTS_MASK, OBJECT_FEATURES),
        ElementGroup(keys.POINTS, keys.POINTS_MASK, POINT_FEATURES),
    )
    own_keys = (keys.OWN, keys.ROUTE) if config.hierarchical else (keys.OWN,)
    own = SELF_FEATURES + (ROUTE_FEATURES if config.hierarchical else 0)
    agent, judge = config.agent, config.discriminator
    head, sees, dynamics = (agent.head, agent.head), observation_config(config), dynamics_of(config)
    if isinstance(dynamics, Bicycle):
        policy = discrete_policy(
            own,
            groups,
            actions=dynamics.num_actions,
            hidden=agent.hidden,
            head=head,
            own_keys=own_keys,
        )
    else:
        policy = displacement_policy(
            own, groups, hidden=agent.hidden, head=head, size_scale=sees.size_scale, own_keys=own_keys
        )
    networks = Networks(policy)
    if config.hierarchical:
        networks.goals = goal_policy(SELF_FEATURES, groups, CHOICE_FEATURES, hidden=agent.hidden)
    if config.judged:
        networks.discriminator = discriminator(
            own,
            OBJECT_FEATURES,
            POINT_FEATURES,
            own_keys=own_keys,
            radius=judge.radius / sees.distance_scale,
            hidden=judge.hidden,
            head=(judge.head,),
            features=judge.features,
        )
    return networks
