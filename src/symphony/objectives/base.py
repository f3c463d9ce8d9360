"""The shared parts of the losses: settable keys, masks, reductions; and the base of those that imitate actions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Num, Shaped
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, dispatch
from torch import Tensor
from torch.distributions import Categorical
from torchrl.objectives.common import LossModule

Reduction = Literal["mean", "sum", "none"]


class MaskedLoss(LossModule):
    """A loss over entries `[...]` (times, agents) of which some are padding.

    A subclass declares its keys, among them `valid`, and lists what it reads in `_read_keys`.

    Args:
        reduction: `"mean"` (also for None), `"sum"` or `"none"`.

    A mask under the `valid` key counts where there is one, and must be there if the network (or the environment)
    reads it, too, so that no padding is trained on unnoticed.

    Attributes:
        share_count: set where processes train together: takes a count of this process to the mean over all, so that
            the mean of their losses is the loss of the joint batch, however uneven its shards are.
    """

    share_count: Callable[[Int[Tensor, ""]], Num[Tensor, ""]] | None = None

    def __init__(self, reduction: Reduction | None) -> None:
        super().__init__()
        self._in_keys: list[NestedKey] | None = None
        self.reduction: Reduction = "mean" if reduction is None else reduction
        if self.reduction not in ("mean", "sum", "none"):
            raise ValueError(f"unknown reduction {reduction!r}, expected 'mean', 'sum' or 'none'")

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        pass

    def _read_keys(self) -> list[NestedKey]:
        """Return the keys that the loss reads besides the mask."""
        raise NotImplementedError

    def set_keys(self, **kwargs: Any) -> None:
        """Set the keys; None restores a default. Raises ValueError for an unknown name."""
        super().set_keys(**kwargs)
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys that the loss reads: the network's inputs, the labels and, where there is one, the mask."""
        if self._in_keys is None:
            self._in_keys = list(dict.fromkeys([*self._read_keys(), self.tensor_keys.valid]))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def _mask(self, tensordict: TensorDictBase) -> Shaped[Tensor, "*b"] | None:
        """Return the entry under the `valid` key, if there is one; it must be there if the network reads it, too."""
        key = unravel_key(self.tensor_keys.valid)
        mask = tensordict.get(key, default=None)
        if mask is None and key in self._read_keys():
            raise KeyError(f"no mask under {key!r}, which the network reads")
        return mask

    def _entries(
        self, tensordict: TensorDictBase, key: NestedKey, what: str, shape: torch.Size
    ) -> Shaped[Tensor, "*b"]:
        """Return a tensor with one number per entry; KeyError if it is absent, ValueError for another shape."""
        value = tensordict.get(key, default=None)
        if value is None:
            raise KeyError(f"no {what} under {key!r}")
        if value.shape != shape:
            raise ValueError(f"{what} {key!r} has shape {tuple(value.shape)}, the network's output {tuple(shape)}")
        return value

    def _flags(self, tensordict: TensorDictBase, key: NestedKey, what: str, shape: torch.Size) -> Bool[Tensor, "*b"]:
        """Return a bool tensor with one flag per entry: `~` of an integer would silently be another integer."""
        value = self._entries(tensordict, key, what, shape)
        if value.dtype != torch.bool:
            raise ValueError(f"{what} {key!r} is {value.dtype}, expected torch.bool")
        return value

    def _counted(self, tensordict: TensorDictBase, shape: torch.Size, device: torch.device) -> Bool[Tensor, "*b"]:
        """Return a bool mask of the entries that are valid and that no mask written by TorchRL itself leaves out."""
        counted = torch.ones(shape, dtype=torch.bool, device=device)
        if self._mask(tensordict) is not None:
            counted = self._flags(tensordict, self.tensor_keys.valid, "mask", shape)
        for key in self._loss_mask_keys():
            mask = tensordict.get(key, default=None)
            if mask is not None:
                counted = counted & self._expand_loss_mask(mask, counted)
        return counted

    def _reduced(
        self, values: Float[Tensor, "*b"], counted: Bool[Tensor, "*b"], reduction: Reduction | None = None
    ) -> Float[Tensor, ""] | Float[Tensor, "*b"]:
        """Return mean (0 without entries) or sum over the counted entries, or their values with zeros elsewhere."""
        reduction = self.reduction if reduction is None else reduction
        # Selected, not multiplied: what is left out may not be finite.
        values = torch.where(counted, values, torch.zeros_like(values))
        if reduction == "none":
            return values
        if reduction == "sum":
            return values.sum()
        number = self._number(counted)
        return values.sum() / torch.where(number > 0, number, 1)

    def _number(self, counted: Bool[Tensor, "*b"]) -> Num[Tensor, ""]:
        """Return how many entries count, averaged over processes that train together."""
        return counted.sum() if self.share_count is None else self.share_count(counted.sum())


class Fit(NamedTuple):
    """The fit of an actor to the actions of a batch. All `[...]`.

    Attributes:
        cost: negative log-likelihood.
        counted: bool, entries that count.
        entropy: entropy of the actor, detached; None unless it is categorical.
        hit: 1.0 where the actor's mode is the action; None unless it is categorical.
    """

    cost: Float[Tensor, "*b"]
    counted: Bool[Tensor, "*b"]
    entropy: Float[Tensor, "*b"] | None
    hit: Float[Tensor, "*b"] | None


class ActorLoss(MaskedLoss):
    """A loss on the likelihood of actions under a stochastic actor.

    Args:
        actor_network: probabilistic module with a `get_dist`.
        reduction: see :class:`MaskedLoss`.
    """

    losses: ClassVar[tuple[str, ...]] = ()
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential | ProbabilisticTensorDictModule,
        *,
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__(reduction)
        self.convert_to_functional(actor_network, "actor_network")
        heads = [m for m in actor_network.modules() if isinstance(m, ProbabilisticTensorDictModule)]
        kind = heads[-1].distribution_class if heads else None
        self.categorical = isinstance(kind, type) and issubclass(kind, Categorical)  # or one-hot, as TorchRL's
        self.out_keys = [*self.losses, *(["entropy", "accuracy"] if self.categorical else [])]

    def _read_keys(self) -> list[NestedKey]:
        return [*self.actor_network.in_keys, self.tensor_keys.action]

    def _fit(self, tensordict: TensorDictBase) -> Fit:
        action = tensordict.get(self.tensor_keys.action, default=None)
        if action is None:
            raise KeyError(f"no expert action under {self.tensor_keys.action!r}")
        with self.actor_network_params.to_module(self.actor_network):
            dist = self.actor_network.get_dist(tensordict.copy())
        counted = self._counted(tensordict, dist.batch_shape, action.device)
        # TorchRL's one-hot categoricals are Categoricals, too, and give the shape of an index as their own.
        one_hot = isinstance(dist, Categorical) and action.shape == dist.logits.shape != counted.shape
        if not one_hot and action.shape != dist.batch_shape + dist.event_shape:
            # It would be broadcast, to the mean over pairs of actions and distributions of others.
            expected = tuple(dist.batch_shape + dist.event_shape)
            raise ValueError(
                f"action {self.tensor_keys.action!r} has shape {tuple(action.shape)}, the actor's are {expected}"
            )
        # A padded entry may hold anything, such as an invalid index, and 0 may lie outside the support: an action
        # that counts, if any does, stands in for it.
        fitted = counted.reshape(counted.shape + (1,) * (action.ndim - counted.ndim))
        if counted.numel():
            flat = action.reshape(counted.numel(), *action.shape[counted.ndim :])
            one = flat[counted.flatten().int().argmax(0, keepdim=True)]
            action = torch.where(fitted, action, torch.where(counted.any(), one.squeeze(0), 0))
        cost = -dist.log_prob(action)
        if not isinstance(dist, Categorical):
            return Fit(cost, counted, None, None)
        with torch.no_grad():
            index = action.argmax(-1) if one_hot else action
            hit = (dist.logits.argmax(-1) == index).to(dist.logits.dtype)
            return Fit(cost, counted, dist.entropy(), hit)

    def _statistics(self, fit: Fit, counted: Bool[Tensor, "*b"]) -> dict[str, Float[Tensor, "*_"]]:
        """Return entropy and accuracy over some entries, of a categorical actor."""
        if fit.entropy is None or fit.hit is None:
            return {}
        reduction: Reduction = "none" if self.reduction == "none" else "mean"
        parts = {"entropy": fit.entropy, "accuracy": fit.hit}
        return {name: self._reduced(part, counted, reduction) for name, part in parts.items()}


class BCLoss(ActorLoss):
    """Negative log-likelihood of expert actions under a stochastic actor (paper, II-B).

    Unlike TorchRL's class of this name it takes its distribution from the actor whatever the keys are called, and
    leaves padded agents out. It also serves other labels drawn from a distribution, such as goals.

    Args:
        actor_network: probabilistic module with a `get_dist`.
        reduction: `"mean"` over the valid entries (0 if there are none), `"sum"`, or `"none"`, which keeps the
            shape `[...]` of the log-probability, with zeros at invalid entries.

    Writes `loss_bc`, and for categorical actors, detached, `entropy` of the actor and `accuracy` of its mode
    (means over the valid entries; without reduction per entry like the loss).

    Raises:
        KeyError: at the call, if the action or the mask is missing.
        ValueError: for a bad `reduction`, or an action or a mask of another shape.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set by `.set_keys(name=key)`.

        Attributes:
            action (NestedKey): the expert's action.
            valid (NestedKey): bool mask, True where an agent counts.
        """

        action: NestedKey = ("agents", "action")
        valid: NestedKey = ("agents", "valid")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    losses = ("loss_bc",)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss of a batch that holds :attr:`in_keys`; the input is left as it is."""
        fit = self._fit(tensordict)
        result = TensorDict({"loss_bc": self._reduced(fit.cost, fit.counted), **self._statistics(fit, fit.counted)})
        self._clear_weakrefs(tensordict, result, "actor_network_params")
        return result


class DistillationLoss(ActorLoss):
    """Likelihood of expert actions and of actions in rollouts that survived a search (paper, III).

    The mean negative log-likelihood over the valid expert entries plus that over the valid rollout entries: each
    kind has its own mean, so the balance does not depend on how many of each a batch holds. With weights, such as
    advantages, those of rollouts are a policy gradient.

    Args:
        actor_network: probabilistic module with a `get_dist`, over discrete or continuous actions.
        reduction: `"mean"` as above (0 for a kind that is absent), `"sum"`, or `"none"`, which keeps the shape
            `[...]` of the log-probability, zeros where an entry does not count.

    Writes `loss_distillation` and, detached, `nll_expert` and `nll_rollout` (unweighted);
    for categorical actors also `entropy` and `accuracy` on the expert entries, as :class:`BCLoss` does. They are
    means over the entries that count, 0 without one; without reduction they are per entry like the loss.

    Raises:
        KeyError: at the call, if the action, a flag or the mask is missing.
        ValueError: for a bad argument, or an action or flags of another shape.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set by `.set_keys(name=key)`.

        Attributes:
            action (NestedKey): the action to imitate.
            valid (NestedKey): bool mask, True where an agent counts.
            rollout (NestedKey): bool, True where the action comes from a rollout, False where from an expert.
            weight (NestedKey): of each rollout entry; 1 where a batch has none.
        """

        action: NestedKey = ("agents", "action")
        valid: NestedKey = ("agents", "valid")
        rollout: NestedKey = ("agents", "rollout")
        weight: NestedKey = ("agents", "weight")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    losses = ("loss_distillation", "nll_expert", "nll_rollout")

    def _read_keys(self) -> list[NestedKey]:
        return [*super()._read_keys(), self.tensor_keys.rollout, self.tensor_keys.weight]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss of a batch that holds :attr:`in_keys`; the input is left as it is."""
        fit = self._fit(tensordict)
        shape = fit.counted.shape
        rollout = self._flags(tensordict, self.tensor_keys.rollout, "rollout flag", shape)
        expert, rollout = fit.counted & ~rollout, fit.counted & rollout
        cost = fit.cost
        if tensordict.get(self.tensor_keys.weight, None) is not None:
            cost = cost * self._entries(tensordict, self.tensor_keys.weight, "weight", shape).where(rollout, 1.0)
        reduction: Reduction = "none" if self.reduction == "none" else "mean"
        nll = [self._reduced(fit.cost.detach(), kind, reduction) for kind in (expert, rollout)]
        loss = self._reduced(fit.cost, expert) + self._reduced(cost, rollout)
        found = {"loss_distillation": loss, "nll_expert": nll[0], "nll_rollout": nll[1]}
        result = TensorDict(found | self._statistics(fit, expert))
        self._clear_weakrefs(tensordict, result, "actor_network_params")
        return result
