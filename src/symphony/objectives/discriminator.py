"""The loss of a discriminator between simulated and logged states."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor
from torch.nn import functional

from symphony.objectives.base import MaskedLoss, Reduction
from symphony.objectives.statistics import auc


class DiscriminatorLoss(MaskedLoss):
    """Cross entropy of a discriminator D = sigmoid(score), the probability that a state is simulated (paper, III-C).

    The sign is the paper's, `max E_sim log D + E_data log(1 - D)`: a high score is unrealistic. The loss is minus
    half that sum. Each kind has its own mean, so unequal amounts weigh equally.

    Only the discriminator receives a gradient: its inputs are detached.

    Args:
        discriminator: module that writes one logit per entry, `[..., N]`, under the `score` key.
        gradient_penalty: weight of the mean squared norm, over data, of the logit's gradient with respect to an
            entry's own floating-point inputs `[..., N, *]`, added to the loss (R1 of Mescheder et al. 2018; their
            gamma is twice this weight). It supposes that a logit depends on its own entry's inputs only.
        reduction: `"mean"` as above (0 for a kind that is absent); `"sum"` over all entries that count; `"none"`,
            which keeps the shape `[..., N]`, with zeros elsewhere. The penalty is reduced and added alike.

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
            score (NestedKey): float `[..., N]`, the logit the discriminator writes.
            simulated (NestedKey): bool `[..., N]`, True where the state is simulated, False where it is data.
            valid (NestedKey): bool `[..., N]`, True where an agent counts.
        """

        score: NestedKey = ("agents", "score")
        simulated: NestedKey = ("agents", "simulated")
        valid: NestedKey = ("agents", "valid")

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
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__(reduction)
        if not (math.isfinite(gradient_penalty) and gradient_penalty >= 0.0):
            raise ValueError(f"gradient_penalty must be at least 0, is {gradient_penalty}")
        self.convert_to_functional(discriminator, "discriminator")
        self.gradient_penalty = gradient_penalty
        self.out_keys = [
            "loss_discriminator",
            "accuracy_simulated",
            "accuracy_data",
            "score_simulated",
            "score_data",
            "auc",
            *(["gradient_penalty"] if gradient_penalty else []),
        ]

    def _read_keys(self) -> list[NestedKey]:
        return [*self.discriminator.in_keys, self.tensor_keys.simulated]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss of a batch that holds :attr:`in_keys`; the input is left as it is."""
        training, penalised = torch.is_grad_enabled(), bool(self.gradient_penalty)
        # The penalty takes a gradient, also where its caller wants none.
        inference = torch.is_inference_mode_enabled() and not penalised
        with torch.inference_mode(inference), torch.set_grad_enabled(training or penalised):
            inputs = tensordict.select(*self.discriminator.in_keys).detach()
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
                squared = _squared_norm(logit, leaves, real, create_graph=training)
                loss = loss + self.gradient_penalty * self._reduced(squared, real)
                statistics["gradient_penalty"] = self._reduced(squared.detach(), real, "mean")
        result = TensorDict({"loss_discriminator": loss if training else loss.detach(), **statistics})
        self._clear_weakrefs(tensordict, result, "discriminator_params")
        return result

    def _leaves(self, inputs: TensorDictBase) -> list[Float[Tensor, "*_"]]:
        """Return the inputs to differentiate by, put in place as leaves."""
        chosen = [key for key in self.discriminator.in_keys if inputs.get(key).is_floating_point()]
        leaves = [inputs.get(key).clone().detach().requires_grad_() for key in chosen]
        for key, leaf in zip(chosen, leaves, strict=True):
            inputs.set(key, leaf)
        return leaves

    def _cross_entropy(
        self, logit: Float[Tensor, "*b"], fake: Bool[Tensor, "*b"], real: Bool[Tensor, "*b"]
    ) -> Float[Tensor, ""] | Float[Tensor, "*b"]:
        entropy = functional.binary_cross_entropy_with_logits(logit, fake.to(logit.dtype), reduction="none")
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
    logit: Float[Tensor, "*b"], leaves: list[Float[Tensor, "*_"]], where: Bool[Tensor, "*b"], *, create_graph: bool
) -> Float[Tensor, "*b"]:
    """Return the squared norm `[..., N]` of each logit's gradient with respect to its own entry's inputs."""
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
        squared = squared + gradient[..., None].square().flatten(logit.ndim).sum(-1)
    return squared
