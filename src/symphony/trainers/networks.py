"""The networks of an agent, built from its configuration."""

from __future__ import annotations

from dataclasses import dataclass, fields

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn

from symphony import keys
from symphony.config import TrainConfig
from symphony.envs.dynamics import Bicycle
from symphony.envs.observation import OBJECT_FEATURES, POINT_FEATURES, SELF_FEATURES, ObservationConfig
from symphony.envs.routes import CHOICE_FEATURES, ROUTE_FEATURES
from symphony.modules import FORESIGHT, ElementGroup, discrete_policy, discriminator, goal_policy


@dataclass
class Networks:
    """What is learned.

    Attributes:
        policy: actions from observations, and from a route with H.
        goals: routes from first states; None without H.
        discriminator: how simulated a state looks; None without TS.
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
    features = config.discriminator.features if config.searches else "paper"
    return ObservationConfig(
        num_objects=config.agent.num_objects,
        num_points=config.agent.num_points,
        route=config.hierarchical,
        clearance=features != "paper",
        foresight=FORESIGHT if features == "foresight" else (),
    )


def build_networks(config: TrainConfig, dynamics: Bicycle) -> Networks:
    """Freshly initialised networks; seed torch beforehand."""
    groups = (
        ElementGroup(keys.OBJECTS, keys.OBJECTS_MASK, OBJECT_FEATURES),
        ElementGroup(keys.POINTS, keys.POINTS_MASK, POINT_FEATURES),
    )
    own_keys = (keys.OWN, keys.ROUTE) if config.hierarchical else (keys.OWN,)
    own = SELF_FEATURES + (ROUTE_FEATURES if config.hierarchical else 0)
    agent, judge = config.agent, config.discriminator
    networks = Networks(
        discrete_policy(
            own,
            groups,
            actions=dynamics.num_actions,
            hidden=agent.hidden,
            head=(agent.head, agent.head),
            own_keys=own_keys,
        )
    )
    if config.hierarchical:
        networks.goals = goal_policy(SELF_FEATURES, groups, CHOICE_FEATURES, hidden=agent.hidden)
    if config.searches:
        networks.discriminator = discriminator(
            own,
            OBJECT_FEATURES,
            POINT_FEATURES,
            own_keys=own_keys,
            radius=judge.radius / observation_config(config).distance_scale,
            hidden=judge.hidden,
            head=(judge.head,),
            features=judge.features,
        )
    return networks
