"""The goal policy: which of its feasible routes an agent takes (paper, sections III-B and IV-B)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int, Shaped
from tensordict import NestedKey
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn

from symphony.geometry.nearest import on_host
from symphony.keys import GOAL, GOAL_LOGITS, GOAL_NOISE, OWN, ROUTES, ROUTES_MASK, VALID
from symphony.modules.encoder import ElementGroup, EncoderClass, SceneEncoder, mlp, scene_module
from symphony.modules.policy import NoiseSampler

NO_ROUTE = -1e4
"""Logit of a route that does not exist; finite, so that an agent without any still has a distribution."""


class RouteScores(nn.Module):
    """Logits `[..., N, G]` of routes from their geometry and the scene around the agent.

    Routes are scored one by one, so their order and number make no difference.

    Args:
        encoder: of the scene; not shared with another network.
        route_features: of one route.
        hidden: width of the route encoder and of the layer where both meet.
    """

    def __init__(self, encoder: SceneEncoder, route_features: int, *, hidden: int = 64) -> None:
        super().__init__()
        self.encoder = encoder
        self.route = mlp((route_features, hidden, hidden))
        self.scene = nn.Linear(encoder.width, hidden)
        self.head = mlp((hidden, hidden, 1))

    def forward(
        self, own: Float[Tensor, "*b N F"], valid: Bool[Tensor, "*b N"], *inputs: Shaped[Tensor, "*_"]
    ) -> Float[Tensor, "*b N G"]:
        """Inputs as for :class:`SceneEncoder`, then routes `[..., N, G, F]` and their mask `[..., N, G]`."""
        *elements, routes, mask = inputs
        around = self.scene(self.encoder(own, valid, *elements))
        if not on_host(mask):
            # Nothing of a route that is padding gets through, whatever its features hold.
            routes = torch.where(mask[..., None], routes, 0.0)
            return torch.where(mask & valid[..., None], self._scores(routes, around[..., None, :]), NO_ROUTE)
        # Most are padding, as some agents have ten times as many routes as others.
        place = (mask & valid[..., None]).flatten().nonzero().squeeze(-1)
        met = around.reshape(-1, around.shape[-1]).index_select(0, place // mask.shape[-1])
        found = self._scores(routes.reshape(-1, routes.shape[-1]).index_select(0, place), met)
        return found.new_full((mask.numel(),), NO_ROUTE).index_copy(0, place, found).view(mask.shape)

    def _scores(self, routes: Float[Tensor, "*b F"], around: Float[Tensor, "*#b H"]) -> Float[Tensor, "*b"]:
        met = torch.relu(self.route(routes) + around)
        return self.head(met).squeeze(-1)


def goal_policy(
    own_features: int,
    groups: Sequence[ElementGroup],
    route_features: int,
    *,
    hidden: int = 64,
    own_keys: Sequence[NestedKey] = (OWN,),
    valid_key: NestedKey = VALID,
    encoder: EncoderClass = SceneEncoder,
) -> ProbabilisticTensorDictSequential:
    """A categorical over each agent's feasible routes, given the first state: h(g | s_1).

    Writes logits `[..., N, G]` and goals `[..., N]` int64 (meaningless for agents without a route: see
    :func:`drawn_goals`). A uniform number under `GOAL_NOISE`, if there is one, decides the draw. Another `encoder`
    takes the arguments of :class:`SceneEncoder`.
    """
    encoding = encoder(own_features, [group.features for group in groups], hidden=hidden)
    network = RouteScores(encoding, route_features, hidden=hidden)
    return ProbabilisticTensorDictSequential(
        scene_module(
            network,
            groups,
            GOAL_LOGITS,
            own_keys=own_keys,
            valid_key=valid_key,
            more_keys=(ROUTES, ROUTES_MASK),
        ),
        NoiseSampler(GOAL_LOGITS, GOAL, noise_key=GOAL_NOISE),
    )


def drawn_goals(goal: Int[Tensor, "*b N"], mask: Bool[Tensor, "*b N G"]) -> Int[Tensor, "*b N"]:
    """Goals `[..., N]` with -1 for agents that have no route in `mask` `[..., N, G]`."""
    return torch.where(mask.any(-1), goal, -1)
