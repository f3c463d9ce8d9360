"""Policies over discrete actions, random numbers as a function of what they are for, and draws decided by them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor
from torch.distributions import Categorical, Distribution

from symphony.keys import ACTION, LOG_PROB, LOGITS, NOISE, OWN, STEP, STREAM, VALID
from symphony.modules.encoder import ElementGroup, EncoderClass, SceneEncoder, SceneNetwork, scene_module
from symphony.streams import fold_in, uniform


def inverse_cdf(logits: Float[Tensor, "*b C"], noise: Float[Tensor, "*b"]) -> Int[Tensor, "*b"]:
    """Draw categories `[...]` int64 from logits `[..., C]` by uniform numbers `[...]` in [0, 1].

    The category is the one whose interval of the cumulative distribution holds the number; a category of
    probability zero is never drawn. Where there is no category at all it is 0.
    """
    if logits.shape[-1] == 0:
        return torch.zeros_like(noise, dtype=torch.int64)
    cumulative = torch.softmax(logits.detach(), -1).cumsum(-1)
    total = cumulative[..., -1:].contiguous()
    # It never falls, so a place in it is the number of elements at most, or less than, a value.
    drawn = torch.searchsorted(cumulative, noise[..., None] * total, right=True)
    # Rounding may carry the product up to the total, past the last category that is possible at all. Where logits are
    # not numbers no place is right, but one must be named.
    last = torch.searchsorted(cumulative, total).clamp_max(logits.shape[-1] - 1)
    return torch.minimum(drawn, last).squeeze(-1)


class SeededNoise(TensorDictModuleBase):
    """Gives every agent the random number its next action is decided by.

    It depends on the seed, the rollout's identity, the step and the agent's place alone (never on the batch).

    Args:
        seed: of all rollouts.
        numbers: per agent; 0 for a single one without a dimension of its own.
    """

    in_keys = [STREAM, STEP, VALID]  # noqa: RUF012 - the type TensorDictModuleBase declares
    out_keys = [NOISE]  # noqa: RUF012

    def __init__(self, seed: int, numbers: int = 0) -> None:
        super().__init__()
        self.seed, self.numbers = seed, numbers

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write numbers [..., N] or [..., N, numbers] in (0, 1)."""
        agents = tensordict.get(VALID).shape[-1]
        place = torch.arange(agents, device=tensordict.device)
        stream, step = fold_in(tensordict.get(STREAM), place), tensordict.get(STEP)
        if self.numbers:
            stream = fold_in(stream[..., None], torch.arange(self.numbers, device=stream.device))
            step = step[..., None]
        return tensordict.set(NOISE, uniform(self.seed, stream, step))


class NoiseSampler(ProbabilisticTensorDictModule):
    """A draw decided by numbers found in the TensorDict, if there are any.

    With exploration type RANDOM and uniform numbers under `noise_key`, the action is their quantile
    (:func:`symphony.modules.inverse_cdf` of one number `[...]` for a categorical, else the distribution's `icdf`):
    the same scene and numbers give the same action in any batch. Without them, or with another exploration type,
    it samples as its base class does.

    Args:
        parameters: key of the logits `[..., C]`, or the keys of all parameters by their names.
        action_key: written.
        noise_key: float in (0, 1), optional in the TensorDict.
        distribution_class: a categorical, or one with an `icdf`.
        distribution_kwargs: what else it takes.
        return_log_prob: write the action's log-probability `[...]` under `log_prob_key`.
    """

    def __init__(
        self,
        parameters: NestedKey | dict[str, NestedKey] = LOGITS,
        action_key: NestedKey = ACTION,
        *,
        noise_key: NestedKey = NOISE,
        distribution_class: type[Distribution] = Categorical,
        distribution_kwargs: dict[str, Any] | None = None,
        return_log_prob: bool = False,
        log_prob_key: NestedKey = LOG_PROB,
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
    own_keys: Sequence[NestedKey] = (OWN,),
    valid_key: NestedKey = VALID,
    logits_key: NestedKey = LOGITS,
    action_key: NestedKey = ACTION,
    noise_key: NestedKey = NOISE,
    return_log_prob: bool = False,
    log_prob_key: NestedKey = LOG_PROB,
    encoder: EncoderClass = SceneEncoder,
) -> ProbabilisticTensorDictSequential:
    """Encoder, head and a categorical over joint actions (147 = 7 accelerations x 21 steering angles: paper, III-C).

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
            logits_key,
            action_key,
            noise_key=noise_key,
            return_log_prob=return_log_prob,
            log_prob_key=log_prob_key,
        ),
    )
