"""Telling simulated states from logged ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor
from torch.nn import functional

from symphony import keys
from symphony.objectives.base import MaskedLoss, Reduction
from symphony.objectives.statistics import auc


class DiscriminatorLoss(MaskedLoss):
    """Cross entropy of a discriminator D = sigmoid(score), the probability that a state is simulated (paper, III-C).

    The sign is the paper's, `max E_sim log D + E_data log(1 - D)`: a high score is unrealistic. The loss is minus
    half that sum. Each kind has its own mean, so unequal amounts weigh equally.

    Only the discriminator receives a gradient: its inputs are detached.

    Args:
        discriminator: module that writes one logit per entry, `[..., N]`, under the `score` key.
        gradient_penalty: weight of the mean squared norm of the logit's gradient with respect to an entry's own
            inputs, added to the loss (R1 of Mescheder et al. 2018 on data; their gamma is twice this weight). It
            supposes that a logit depends on its own entry's inputs only.
        penalty_keys: inputs `[..., N, *]` of the discriminator that count for the norm; None for all its
            floating-point inputs.
        penalty_on: entries whose gradient is penalised.
        instance_noise: standard deviation of Gaussian noise added to `noise_keys` of both kinds in training mode.
        noise_keys: floating-point inputs of the discriminator that receive the noise.
        generator: source of the noise; None for the global one. Its state is not part of the state_dict.
        label_smoothing: share of the target spread evenly over both kinds, in [0, 1).
        reduction: `"mean"` as above (0 for a kind that is absent); `"sum"` over all entries that count; `"none"`,
            which keeps the shape `[..., N]`, with zeros elsewhere. The penalty is reduced and added alike.
        use_mask: whether a mask under the `valid` key is read: None where there is one, see :class:`MaskedLoss`.

    Writes `loss_discriminator` and, detached, per kind the share classified right `accuracy_simulated` and
    `accuracy_data`, the mean logits `score_simulated` and `score_data`, and `auc` of the logits (0.5: cannot tell;
    above: simulated states score higher), scalars whatever the reduction and NaN for a kind that is absent. With a
    penalty also the unweighted mean `gradient_penalty`.

    Raises:
        KeyError: at the call, if the score, the flag or the mask is missing.
        ValueError: for a bad argument, or tensors of another shape than the logit.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set by `.set_keys(name=key)`.

        Attributes:
            score (NestedKey): float `[..., N]`, the logit the discriminator writes. Defaults to
                `symphony.keys.SCORE`.
            simulated (NestedKey): bool `[..., N]`, True where the state is simulated, False where it is data.
                Defaults to `symphony.keys.SIMULATED`.
            valid (NestedKey): bool `[..., N]`, True where an agent counts. Defaults to `symphony.keys.VALID`.
        """

        score: NestedKey = keys.SCORE
        simulated: NestedKey = keys.SIMULATED
        valid: NestedKey = keys.VALID

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    discriminator: TensorDictModuleBase
    discriminator_params: TensorDictParams
    target_discriminator_params: TensorDictParams

    def __init__(
        self,
        discriminator: TensorDictModuleBase,
        *,
        gradient_penalty: float = 0.0,
        penalty_keys: Sequence[NestedKey] | None = None,
        penalty_on: Literal["data", "simulated", "both"] = "data",
        instance_noise: float = 0.0,
        noise_keys: Sequence[NestedKey] = (),
        generator: torch.Generator | None = None,
        label_smoothing: float = 0.0,
        reduction: Reduction | None = None,
        use_mask: bool | None = None,
    ) -> None:
        super().__init__(reduction, use_mask)
        for name, value in (("gradient_penalty", gradient_penalty), ("instance_noise", instance_noise)):
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name} must be at least 0, is {value}")
        if not 0.0 <= label_smoothing < 1.0:
            raise ValueError(f"label_smoothing must be in [0, 1), is {label_smoothing}")
        if penalty_on not in ("data", "simulated", "both"):
            raise ValueError(f"unknown penalty_on {penalty_on!r}, expected 'data', 'simulated' or 'both'")
        if instance_noise and not noise_keys:
            raise ValueError("instance_noise needs noise_keys")
        self.convert_to_functional(discriminator, "discriminator")
        self.penalty_keys = None if penalty_keys is None else self._inputs("penalty_keys", penalty_keys)
        self.noise_keys = self._inputs("noise_keys", noise_keys)
        self.gradient_penalty = gradient_penalty
        self.penalty_on = penalty_on
        self.instance_noise = instance_noise
        self.generator = generator
        self.label_smoothing = label_smoothing
        self.out_keys = [
            "loss_discriminator",
            "accuracy_simulated",
            "accuracy_data",
            "score_simulated",
            "score_data",
            "auc",
            *(["gradient_penalty"] if gradient_penalty else []),
        ]

    def _inputs(self, name: str, given: Sequence[NestedKey]) -> list[NestedKey]:
        wanted = [unravel_key(key) for key in given]
        strange = [key for key in wanted if key not in self.discriminator.in_keys]
        if strange:
            raise ValueError(f"{name}: the discriminator does not read {strange}")
        return wanted

    def _read_keys(self) -> list[NestedKey]:
        return [*self.discriminator.in_keys, self.tensor_keys.simulated]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss of a batch that holds :attr:`in_keys`; the input is left as it is."""
        training = torch.is_grad_enabled()
        penalised = bool(self.gradient_penalty)
        # The penalty takes a gradient, also where its caller wants none.
        with torch.set_grad_enabled(training or penalised):
            inputs = self._noisy(tensordict.select(*self.discriminator.in_keys).detach())
            leaves = self._leaves(inputs) if penalised else []
            with self.discriminator_params.to_module(self.discriminator):
                logit = self.discriminator(inputs).get(self.tensor_keys.score, default=None)
            if logit is None:
                raise KeyError(f"the discriminator writes no score under {self.tensor_keys.score!r}")
            simulated = self._flags(tensordict, self.tensor_keys.simulated, "flag", logit.shape)
            counted = self._counted(tensordict, logit.shape, logit.device)
            fake, real = counted & simulated, counted & ~simulated
            loss = self._cross_entropy(logit, fake, real)
            statistics = self._statistics(logit.detach(), fake, real)
            if penalised:
                where = {"data": real, "simulated": fake, "both": counted}[self.penalty_on]
                squared = _squared_norm(logit, leaves, where, create_graph=training)
                loss = loss + self.gradient_penalty * self._reduced(squared, where)
                statistics["gradient_penalty"] = self._reduced(squared.detach(), where, "mean")
        result = TensorDict({"loss_discriminator": loss if training else loss.detach(), **statistics})
        self._clear_weakrefs(tensordict, result, "discriminator_params")
        return result

    def _noisy(self, inputs: TensorDictBase) -> TensorDictBase:
        if not (self.instance_noise and self.training):
            return inputs
        for key in self.noise_keys:
            value = self._floating(inputs, key)
            source = value.device if self.generator is None else self.generator.device
            noise = torch.randn(value.shape, generator=self.generator, dtype=value.dtype, device=source)
            inputs.set(key, value + self.instance_noise * noise.to(value.device))
        return inputs

    def _leaves(self, inputs: TensorDictBase) -> list[Float[Tensor, "*_"]]:
        """The inputs to differentiate by, put in place as leaves."""
        chosen = self.penalty_keys
        if chosen is None:
            chosen = [key for key in self.discriminator.in_keys if inputs.get(key).is_floating_point()]
        leaves = [self._floating(inputs, key).detach().requires_grad_() for key in chosen]
        for key, leaf in zip(chosen, leaves, strict=True):
            inputs.set(key, leaf)
        return leaves

    @staticmethod
    def _floating(inputs: TensorDictBase, key: NestedKey) -> Float[Tensor, "*_"]:
        value = inputs.get(key)
        if not value.is_floating_point():
            raise ValueError(f"{key!r} is {value.dtype}, expected floating point")
        return value

    def _cross_entropy(
        self, logit: Float[Tensor, "*b"], fake: Bool[Tensor, "*b"], real: Bool[Tensor, "*b"]
    ) -> Float[Tensor, ""] | Float[Tensor, "*b"]:
        target = fake.to(logit.dtype) * (1.0 - self.label_smoothing) + 0.5 * self.label_smoothing
        entropy = functional.binary_cross_entropy_with_logits(logit, target, reduction="none")
        if self.reduction != "mean":
            return self._reduced(entropy, fake | real)
        return 0.5 * (self._reduced(entropy, fake) + self._reduced(entropy, real))

    def _statistics(
        self, logit: Float[Tensor, "*b"], fake: Bool[Tensor, "*b"], real: Bool[Tensor, "*b"]
    ) -> dict[str, Float[Tensor, ""]]:
        def mean(values: Float[Tensor, "*b"], where: Bool[Tensor, "*b"]) -> Float[Tensor, ""]:
            return torch.where(where, values, 0.0).sum() / self._number(where)

        return {
            "accuracy_simulated": mean((logit > 0).to(logit.dtype), fake),
            "accuracy_data": mean((logit < 0).to(logit.dtype), real),
            "score_simulated": mean(logit, fake),
            "score_data": mean(logit, real),
            "auc": auc(logit, fake, fake | real),
        }


def _squared_norm(
    logit: Float[Tensor, "*b"],
    leaves: list[Float[Tensor, "*_"]],
    where: Bool[Tensor, "*b"],
    *,
    create_graph: bool,
) -> Float[Tensor, "*b"]:
    """Squared norm `[..., N]` of each logit's gradient with respect to its own entry's inputs."""
    total = torch.where(where, logit, 0.0).sum()
    gradients = torch.autograd.grad(total, leaves, create_graph=create_graph, allow_unused=True)
    squared = torch.zeros_like(logit)
    for gradient in gradients:
        if gradient is None:
            continue
        if gradient.shape[: logit.ndim] != logit.shape:
            raise ValueError(
                f"a penalised input has shape {tuple(gradient.shape)}, expected {tuple(logit.shape)} in front"
            )
        squared = squared + gradient.reshape(*logit.shape, -1).square().sum(-1)
    return squared
