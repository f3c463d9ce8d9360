"""Behavioural cloning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, dispatch
from torch import Tensor
from torch.distributions import Categorical, Distribution
from torchrl.objectives.common import LossModule


class BCLoss(LossModule):
    """Negative log-likelihood of expert actions under a stochastic actor (paper, II-B).

    Unlike TorchRL's class of this name it takes its distribution from the actor whatever the keys are called,
    and leaves padded agents out. Also for other labels drawn from a distribution, such as goals.

    Args:
        actor_network: probabilistic module with a `get_dist`.
        reduction: `"mean"` over the valid entries (0 if there are none), `"sum"`, or `"none"`, which keeps the
            shape `[...]` of the log-probability, with zeros at invalid entries.
        label_smoothing: share of the target spread evenly over all categories, in [0, 1); categorical actors only.
        use_mask: whether the TensorDict holds a mask under the `valid` key. A mask that is expected but
            absent is an error: training on padding would go unnoticed.

    Writes `loss_bc`, and for categorical actors, detached, `entropy` of the actor and `accuracy` of its mode
    (means over the valid entries; without reduction per entry like the loss).

    Raises:
        KeyError: at the call, if the action or the mask is missing.
        ValueError: for a bad `label_smoothing` or `reduction`, or a mask of another shape than the log-probability.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set by `.set_keys(name=key)`.

        Attributes:
            action (NestedKey): the expert's action. Defaults to `("agents", "action")`.
            valid (NestedKey): bool mask, True where an agent counts. Defaults to `("agents", "valid")`.
        """

        action: NestedKey = ("agents", "action")
        valid: NestedKey = ("agents", "valid")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential | ProbabilisticTensorDictModule,
        *,
        reduction: Literal["mean", "sum", "none"] | None = None,
        label_smoothing: float = 0.0,
        use_mask: bool = True,
    ) -> None:
        super().__init__()
        self._in_keys: list[NestedKey] | None = None
        self.reduction = "mean" if reduction is None else reduction
        if self.reduction not in ("mean", "sum", "none"):
            raise ValueError(f"unknown reduction {reduction!r}, expected 'mean', 'sum' or 'none'")
        if not 0.0 <= label_smoothing < 1.0:
            raise ValueError(f"label_smoothing must be in [0, 1), is {label_smoothing}")
        self.convert_to_functional(actor_network, "actor_network")
        self.categorical = _is_categorical(actor_network)
        if label_smoothing and not self.categorical:
            raise ValueError("label_smoothing needs an actor whose distribution is a torch Categorical")
        self.label_smoothing = label_smoothing
        self.use_mask = use_mask
        self.out_keys = ["loss_bc", "entropy", "accuracy"] if self.categorical else ["loss_bc"]

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        pass

    def set_keys(self, **kwargs: Any) -> None:
        """Set the keys; None restores a default. Raises ValueError for an unknown name."""
        super().set_keys(**kwargs)
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the loss reads: the actor's inputs, the action and, where used, the mask."""
        if self._in_keys is None:
            keys = [*self.actor_network.in_keys, self.tensor_keys.action]
            if self.use_mask:
                keys.append(self.tensor_keys.valid)
            self._in_keys = list(dict.fromkeys(keys))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss of a batch that holds :attr:`in_keys`; the input is left as it is."""
        action = tensordict.get(self.tensor_keys.action, default=None)
        if action is None:
            raise KeyError(f"no expert action under {self.tensor_keys.action!r}")
        with self.actor_network_params.to_module(self.actor_network):
            dist = self.actor_network.get_dist(tensordict.copy())
        mask = self._mask(tensordict, dist)
        if mask is not None:
            # A padded entry may hold anything, such as an index that is none.
            fitted = mask.reshape(mask.shape + (1,) * (action.ndim - mask.ndim))
            action = torch.where(fitted, action, torch.zeros_like(action))
        out = {"loss_bc": self._reduce_entries(self._negative_log_likelihood(dist, action), tensordict, mask)}
        if self.categorical:
            statistics = "none" if self.reduction == "none" else "mean"
            with torch.no_grad():
                hit = (dist.logits.argmax(-1) == action).to(dist.logits.dtype)
                out["entropy"] = self._reduce_entries(dist.entropy().detach(), tensordict, mask, statistics)
                out["accuracy"] = self._reduce_entries(hit, tensordict, mask, statistics)
        result = TensorDict(out)
        self._clear_weakrefs(tensordict, result, "actor_network_params")
        return result

    def _mask(self, tensordict: TensorDictBase, dist: Distribution) -> Tensor | None:
        if not self.use_mask:
            return None
        mask = tensordict.get(self.tensor_keys.valid, default=None)
        if mask is None:
            raise KeyError(
                f"no mask under {self.tensor_keys.valid!r}; pass use_mask=False to train without one"
            )
        if mask.shape != dist.batch_shape:
            raise ValueError(
                f"mask {self.tensor_keys.valid!r} has shape {tuple(mask.shape)}, "
                f"the actor's distribution {tuple(dist.batch_shape)}"
            )
        return mask

    def _negative_log_likelihood(self, dist: Distribution, action: Tensor) -> Tensor:
        loss = -dist.log_prob(action)
        if self.label_smoothing and isinstance(dist, Categorical):
            even = -dist.logits.mean(-1)
            loss = (1.0 - self.label_smoothing) * loss + self.label_smoothing * even
        return loss

    def _reduce_entries(
        self, values: Tensor, tensordict: TensorDictBase, mask: Tensor | None, reduction: str | None = None
    ) -> Tensor:
        reduction = self.reduction if reduction is None else reduction
        if mask is not None and reduction == "none":
            # The base class would drop the masked entries and with them the shape.
            values, mask = torch.where(mask, values, torch.zeros_like(values)), None
        return self._reduce_loss(values, tensordict, mask=mask, reduction=reduction)


def _is_categorical(actor: Any) -> bool:
    """Whether the actor's distribution is a torch Categorical (over indices)."""
    heads = [m for m in actor.modules() if isinstance(m, ProbabilisticTensorDictModule)]
    kind = heads[-1].distribution_class if heads else None
    return isinstance(kind, type) and issubclass(kind, Categorical)
