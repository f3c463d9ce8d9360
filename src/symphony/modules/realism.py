"""The discriminator D(s | g): how much a state looks simulated (paper, sections II-C and III-C)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float
from tensordict import NestedKey
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from symphony.keys import GAP, GAP_AHEAD, OBJECTS, OBJECTS_MASK, OWN, POINTS, POINTS_MASK, ROAD, SCORE, VALID
from symphony.modules import encoder

Features = Literal["paper", "clearance", "foresight"]
_GAP, _ROAD = 3, 2 * 5


class Discriminator(nn.Module):
    """Max-pools over all objects and map points within a radius, with a head that gives one logit per agent.

    The logit is high for states that look simulated: D = sigmoid(logit) is the probability of that.

    Own features include the route where there is one; the first two of an object and of a map or light point are its
    position in the agent's frame, in whose units ``radius`` says how far it observes. ``features`` are ``paper``;
    ``clearance``, which adds the signed gap to the box of each object and the signed distances of centre and corners
    to the edge of the road; or ``foresight``, which adds the gaps at :data:`FORESIGHT` if all keep speed and course.
    """

    def __init__(
        self,
        own_features: int,
        object_features: int,
        point_features: int,
        *,
        radius: float = 1.0,
        hidden: int = 32,
        head: Sequence[int] = (64,),
        features: Features = "clearance",
    ) -> None:
        super().__init__()
        self.radius, self.clearance = radius, features != "paper"
        widths = (own_features, object_features, point_features)
        if self.clearance:
            gaps = 1 + len(encoder.FORESIGHT) if features == "foresight" else 1
            widths = (own_features + _ROAD, object_features + _GAP * gaps, point_features)
        self.network = encoder.SceneNetwork(encoder.SceneEncoder(widths[0], widths[1:], hidden=hidden), 1, head=head)

    def forward(
        self,
        own: Float[Tensor, "*b N F"],
        valid: Bool[Tensor, "*b N"],
        objects: Float[Tensor, "*b N O Fo"],
        objects_mask: Bool[Tensor, "*b N O"],
        points: Float[Tensor, "*b N P Fp"],
        points_mask: Bool[Tensor, "*b N P"],
        road: Float[Tensor, "*b N 5"] | None = None,
        *gaps: Float[Tensor, "*b N O"] | Float[Tensor, "*b N O H"],
    ) -> Float[Tensor, "*b N"]:
        """Compute logits `[..., N]`, 0 for padded agents; shapes as for :class:`SceneEncoder`, road `[..., N, 5]`,
        gaps `[..., N, O]` and with foresight `[..., N, O, H]`.
        """
        objects_mask = objects_mask & self._near(objects)
        points_mask = points_mask & self._near(points)
        if road is not None and self.clearance:
            own = torch.cat([own, (road / 0.5).tanh(), (road / 3.0).tanh()], -1)  # two numbers of order one for each
            known = [encoder.gap_features(gap).flatten(objects.ndim - 1) for gap in gaps]
            objects = torch.cat([objects, *known], -1)
        logits = self.network(own, valid, objects, objects_mask, points, points_mask)
        return torch.where(valid, logits.squeeze(-1), 0.0)

    def _near(self, elements: Float[Tensor, "*e F"]) -> Bool[Tensor, "*e"]:
        # Component by component: sums over a last dimension of 2 are slow.
        x, y = elements[..., :2].detach().unbind(-1)
        return x.square() + y.square() <= self.radius**2


def discriminator(
    own_features: int,
    object_features: int,
    point_features: int,
    *,
    own_keys: Sequence[NestedKey] = (OWN,),
    valid_key: NestedKey = VALID,
    out_key: NestedKey = SCORE,
    radius: float = 1.0,
    hidden: int = 32,
    head: Sequence[int] = (64,),
    features: Features = "clearance",
) -> TensorDictModule:
    """Build a :class:`Discriminator` that reads an observation and writes its logits `[..., N]`."""
    network = Discriminator(
        own_features, object_features, point_features, radius=radius, hidden=hidden, head=head, features=features
    )
    groups = (
        encoder.ElementGroup(OBJECTS, OBJECTS_MASK, object_features),
        encoder.ElementGroup(POINTS, POINTS_MASK, point_features),
    )
    more = {"paper": (), "clearance": (ROAD, GAP), "foresight": (ROAD, GAP, GAP_AHEAD)}[features]
    return encoder.scene_module(network, groups, out_key, own_keys=own_keys, valid_key=valid_key, more_keys=more)
