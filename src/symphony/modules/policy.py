"""Policies over discrete actions, and draws decided by given numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
)
from tensordict.nn.probabilistic import interaction_type
from torch.distributions import Categorical, Distribution

from symphony.keys import ACTION, LOG_PROB, LOGITS, NOISE, OWN, VALID
from symphony.modules.encoder import ElementGroup, EncoderClass, SceneEncoder, SceneNetwork, scene_module
from symphony.modules.pooling import PoolMode
from symphony.modules.sampling import inverse_cdf


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
    pool: PoolMode = "auto",
    encoder: EncoderClass = SceneEncoder,
) -> ProbabilisticTensorDictSequential:
    """Encoder, head and a categorical over joint actions (147 = 7 accelerations x 21 steering angles: paper, III-C).

    Weights follow `torch.manual_seed`; `own_features` counts those under all `own_keys`. Reads each
    group's keys, the own features and the agents' mask; writes logits `[..., N, actions]` and actions `[..., N]`
    int64, sampled according to TorchRL's exploration type (RANDOM unless set; see :class:`NoiseSampler`). It does not
    depend on the number of agents or elements. Another `encoder` takes the arguments of :class:`SceneEncoder`.
    """
    encoding = encoder(own_features, [group.features for group in groups], hidden=hidden, pool=pool)
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
