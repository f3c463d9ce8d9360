"""Policies over actions and goals, random numbers keyed by their use, and draws decided by such numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Shaped
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution

from symphony import keys
from symphony.geometry.nearest import on_host
from symphony.modules.bounded import BoundedDisplacement, DisplacementHistogram, inverse_cdf, positive
from symphony.modules.encoder import ElementGroup, EncoderClass, SceneEncoder, SceneNetwork, mlp, scene_module
from symphony.streams import Stream, fold_in, uniform

NO_ROUTE = -1e4
"""Logit of a route that does not exist; finite, so that an agent without any still has a distribution."""


class RouteScores(nn.Module):
    """Logits `[..., N, G]` of routes from their geometry and the scene around the agent.

    Routes are scored one by one, so their order and number make no difference. ``route_features`` are those of one
    route, ``hidden`` is the width of the route encoder and of the layer where both meet.
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
        """Compute logits from the inputs of :class:`SceneEncoder`, routes `[..., N, G, F]` and mask `[..., N, G]`."""
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
    own_keys: Sequence[NestedKey] = (keys.OWN,),
    valid_key: NestedKey = keys.VALID,
    encoder: EncoderClass = SceneEncoder,
) -> ProbabilisticTensorDictSequential:
    """Build a categorical over each agent's feasible routes, given the first state: h(g | s_1).

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
            keys.GOAL_LOGITS,
            own_keys=own_keys,
            valid_key=valid_key,
            more_keys=(keys.ROUTES, keys.ROUTES_MASK),
        ),
        NoiseSampler(keys.GOAL_LOGITS, keys.GOAL, noise_key=keys.GOAL_NOISE),
    )


def drawn_goals(goal: Int[Tensor, "*b N"], mask: Bool[Tensor, "*b N G"]) -> Int[Tensor, "*b N"]:
    """Return goals `[..., N]` with -1 for agents that have no route in `mask` `[..., N, G]`."""
    return torch.where(mask.any(-1), goal, -1)


ACCELERATION, LATERAL = 4.0, 6.0
"""Largest accelerations in m/s^2, along and across; the second bounds the ratio of left to forward at speed."""
SLOPE, LEAST_SCALE = 0.3, 0.05
"""Largest ratio of left to forward at low speed, and smallest standard deviation of the Gaussian numbers."""
AXLE = 0.3  # distance from box centre to rear axle, as a share of the length


class _Parameters(nn.Module):
    """Maps the head's numbers, states [..., N, 4], own features and mask to the parameters.

    The numbers are the logits of cells [..., N, C], or the mean and the raw width of a Gaussian [..., N, 4].
    Padded agents, whose states may be anything, count as standing.
    """

    def __init__(self, cells: int, dt: float, size_scale: float) -> None:
        super().__init__()
        self.cells, self.dt, self.size_scale = cells, dt, size_scale

    def forward(
        self,
        head: Float[Tensor, "*b N H"],
        state: Float[Tensor, "*b N 4"],
        own: Float[Tensor, "*b N F"],
        valid: Bool[Tensor, "*b N"],
    ) -> tuple[Float[Tensor, "*_"], ...]:
        speed = torch.where(valid, state[..., 3], 0.0).clamp_min(0.0)
        # On a curve of curvature k the centre moves at an angle whose sine is k times its distance to the rear
        # axle; k v^2 is the lateral acceleration.
        arm = AXLE * self.size_scale * torch.where(valid, own[..., 1], 0.0)
        fast = speed.square() * SLOPE / (LATERAL * arm.clamp_min(0.1))
        bounds = speed * self.dt, SLOPE / (1.0 + fast.square()).sqrt()
        if self.cells:
            return head, *bounds
        return head[..., :2], LEAST_SCALE + positive(head[..., 2:], 1.0), *bounds


def displacement_policy(
    own_features: int,
    groups: Sequence[ElementGroup],
    *,
    hidden: int = 64,
    head: Sequence[int] = (128, 128),
    cells: int = 0,
    dt: float,
    size_scale: float = 5.0,
    own_keys: Sequence[NestedKey] = (keys.OWN,),
    valid_key: NestedKey = keys.VALID,
    state_key: NestedKey = keys.STATE,
    action_key: NestedKey = keys.ACTION,
    noise_key: NestedKey = keys.NOISE,
    encoder: EncoderClass = SceneEncoder,
) -> ProbabilisticTensorDictSequential:
    """Build an encoder, a head and a :class:`BoundedDisplacement` (the action space the paper gives to MGAIL, section
    III-C), or a :class:`DisplacementHistogram` in its place.

    Weights follow `torch.manual_seed`. Writes actions `[..., N, 2]` in metres, sampled with gradient
    (reparameterised) according to TorchRL's exploration type; a pair of uniform numbers under `noise_key` decides
    them where there is one (see :class:`NoiseSampler`).

    `own_features` counts those under all `own_keys`; the second of the first key is the box length, of which
    `size_scale` metres count as 1. `cells` are numbers of cells along and across, 0 for a Gaussian; `dt` are seconds
    per step. Of `state_key` `[..., N, 4]` the speed is read. An `encoder` takes what :class:`SceneEncoder` does.
    """
    if cells and (cells < 3 or cells % 2 == 0):
        raise ValueError(f"cells must be odd and at least 3, or 0 for none, is {cells}")
    if not dt > 0.0:
        raise ValueError(f"dt must be positive, is {dt}")
    encoding = encoder(own_features, [group.features for group in groups], hidden=hidden)
    network = SceneNetwork(encoding, cells**2 or 4, head=head)
    names = ("logits", "pace", "slope") if cells else ("loc", "scale", "pace", "slope")
    parameters: list[NestedKey] = [("agents", name) for name in names]
    kind: dict[str, Any] = {"forward": cells} if cells else {}
    return ProbabilisticTensorDictSequential(
        scene_module(network, groups, ("agents", "head"), own_keys=own_keys, valid_key=valid_key),
        TensorDictModule(
            _Parameters(cells, dt, size_scale),
            in_keys=[("agents", "head"), state_key, own_keys[0], valid_key],
            out_keys=parameters,
        ),
        NoiseSampler(
            dict(zip(names, parameters, strict=True)),
            action_key,
            noise_key=noise_key,
            distribution_class=DisplacementHistogram if cells else BoundedDisplacement,
            distribution_kwargs={"reach": ACCELERATION * dt**2, **kind},
        ),
    )


class SeededNoise(TensorDictModuleBase):
    """Gives every agent the random number that decides its next action.

    It depends only on the seed, the rollout's identity, the step and the agent's place (never on the batch). There
    are ``numbers`` of them per agent; 0 stands for a single one without a dimension of its own. Each is uniform; with
    a ``pace`` that share of the variance of the first one, as a normal score, is the same at all steps of a rollout,
    so that an agent is fast or slow throughout.
    """

    in_keys = [keys.STREAM, keys.STEP, keys.VALID]  # noqa: RUF012 - the type TensorDictModuleBase declares
    out_keys = [keys.NOISE]  # noqa: RUF012

    def __init__(self, seed: int, numbers: int = 0, pace: float = 0.0) -> None:
        super().__init__()
        self.seed, self.numbers, self.pace = seed, numbers, pace

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write random numbers [..., N] or [..., N, numbers] in (0, 1)."""
        agents = tensordict.get(keys.VALID).shape[-1]
        place = torch.arange(agents, device=tensordict.device)
        stream, step = fold_in(tensordict.get(keys.STREAM), place), tensordict.get(keys.STEP)
        if self.numbers:
            stream = fold_in(stream[..., None], torch.arange(self.numbers, device=stream.device))
            step = step[..., None]
        found = uniform(self.seed, stream, step)
        if self.pace:
            lasting = torch.special.ndtri(uniform(self.seed, fold_in(stream, Stream.PACE), 0))
            score = math.sqrt(self.pace) * lasting + math.sqrt(1 - self.pace) * torch.special.ndtri(found)
            paced = torch.special.ndtr(score).clamp(2.0**-24, 1 - 2.0**-24)
            # The first number decides the acceleration before the steering, or how far a displacement leads ahead.
            found = torch.cat([paced[..., :1], found[..., 1:]], -1) if self.numbers else paced
        return tensordict.set(keys.NOISE, found)


class NoiseSampler(ProbabilisticTensorDictModule):
    """A draw decided by numbers found in the TensorDict, if there are any.

    With exploration type RANDOM and uniform numbers under `noise_key`, the action is their quantile
    (:func:`symphony.modules.inverse_cdf` of one number `[...]` for a categorical, else the distribution's `icdf`):
    the same scene and numbers give the same action in any batch. Without them, or with another exploration type,
    it samples as its base class does.

    Takes the key of the logits `[..., C]`, or the keys of all parameters by their names; a categorical, or a class
    with an `icdf`, and what else that takes. `return_log_prob` also writes the log-probability `[...]`.
    """

    def __init__(
        self,
        parameters: NestedKey | dict[str, NestedKey] = keys.LOGITS,
        action_key: NestedKey = keys.ACTION,
        *,
        noise_key: NestedKey = keys.NOISE,
        distribution_class: type[Distribution] = Categorical,
        distribution_kwargs: dict[str, Any] | None = None,
        return_log_prob: bool = False,
        log_prob_key: NestedKey = keys.LOG_PROB,
    ) -> None:
        super().__init__(
            in_keys=parameters if isinstance(parameters, dict) else {"logits": parameters},
            out_keys=[action_key],
            distribution_class=distribution_class,
            # Validation would wait for the device at each draw.
            distribution_kwargs={"validate_args": False, **(distribution_kwargs or {})},
            default_interaction_type=InteractionType.RANDOM,
            return_log_prob=return_log_prob,
            log_prob_key=log_prob_key if return_log_prob else None,
        )
        self.noise_key = noise_key

    def forward(
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        _requires_sample: bool = True,
        **kwargs: Any,
    ) -> TensorDictBase:
        """Write the action, and its log-probability where asked for."""
        kind = interaction_type() or self.default_interaction_type
        noise = tensordict.get(self.noise_key, default=None)
        if noise is None or kind is not InteractionType.RANDOM or not _requires_sample:
            return super().forward(tensordict, tensordict_out, _requires_sample, **kwargs)
        out = tensordict if tensordict_out is None else tensordict_out
        dist = self.get_dist(tensordict)
        action = inverse_cdf(dist.logits, noise) if isinstance(dist, Categorical) else dist.icdf(noise)
        out.set(self.dist_sample_keys[0], action)
        if self.return_log_prob:
            out.set(self.log_prob_key, dist.log_prob(action))
        return out


def discrete_policy(
    own_features: int,
    groups: Sequence[ElementGroup],
    *,
    actions: int = 147,
    hidden: int = 64,
    head: Sequence[int] = (128, 128),
    own_keys: Sequence[NestedKey] = (keys.OWN,),
    valid_key: NestedKey = keys.VALID,
    logits_key: NestedKey = keys.LOGITS,
    action_key: NestedKey = keys.ACTION,
    noise_key: NestedKey = keys.NOISE,
    return_log_prob: bool = False,
    log_prob_key: NestedKey = keys.LOG_PROB,
    encoder: EncoderClass = SceneEncoder,
) -> ProbabilisticTensorDictSequential:
    """Build encoder, head and a categorical over joint actions (147 = 7 accelerations x 21 steering angles: III-C).

    Weights follow `torch.manual_seed`; `own_features` counts those under all `own_keys`. Reads each
    group's keys, the own features and the agents' mask; writes logits `[..., N, actions]` and actions `[..., N]`
    int64, sampled according to TorchRL's exploration type (RANDOM unless set; see :class:`NoiseSampler`). It does not
    depend on the number of agents or elements. Another `encoder` takes the arguments of :class:`SceneEncoder`.
    """
    encoding = encoder(own_features, [group.features for group in groups], hidden=hidden)
    network = SceneNetwork(encoding, actions, head=head)
    return ProbabilisticTensorDictSequential(
        scene_module(network, groups, logits_key, own_keys=own_keys, valid_key=valid_key),
        NoiseSampler(
            logits_key, action_key, noise_key=noise_key, return_log_prob=return_log_prob, log_prob_key=log_prob_key
        ),
    )
