"""Likelihood of goals."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, dispatch
from torch import Tensor
from torch.distributions import Categorical
from torch.nn import functional

from symphony.objectives.base import MaskedLoss, Reduction


class GoalLoss(MaskedLoss):
    """Negative log-likelihood of the goal an expert had, under a softmax over its feasible goals (paper, III-B).

    Entries without a known goal (label -1) or without any feasible one are left out, like invalid ones. What
    the logits of goals that are not feasible hold has no influence.

    Args:
        goal_network: module that writes logits `[..., N, G]`; of a probabilistic one only the part that computes
            its parameters is run. G may differ from call to call.
        reduction: `"mean"` over the entries that count (0 if there are none), `"sum"`, or `"none"`, which keeps the
            shape `[..., N]`, with zeros at the others.
        use_mask: whether the TensorDict holds a mask under the `valid` key; see :class:`BCLoss`.

    Writes `loss_goal` and, detached, `entropy`, `accuracy` (the likeliest goal is the label) and `accuracy_top3`:
    means over the entries that count; without reduction per entry like the loss.

    Raises:
        KeyError: at the call, if logits, labels or a mask are missing.
        ValueError: for a bad `reduction`, tensors that do not fit together, or a label that is not feasible.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set by `.set_keys(name=key)`.

        Attributes:
            logits (NestedKey): float `[..., N, G]`, as the network writes them. Defaults to
                `("agents", "goal_logits")`.
            mask (NestedKey): bool `[..., N, G]`, True where a goal is feasible. Defaults to
                `("agents", "routes_mask")`.
            label (NestedKey): int64 `[..., N]`, the expert's goal, -1 for none. Defaults to `("agents", "goal")`.
            valid (NestedKey): bool `[..., N]`, True where an agent counts. Defaults to `("agents", "valid")`.
        """

        logits: NestedKey = ("agents", "goal_logits")
        mask: NestedKey = ("agents", "routes_mask")
        label: NestedKey = ("agents", "goal")
        valid: NestedKey = ("agents", "valid")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    goal_network: TensorDictModuleBase
    goal_network_params: TensorDictParams
    target_goal_network_params: TensorDictParams

    def __init__(
        self,
        goal_network: TensorDictModuleBase,
        *,
        reduction: Reduction | None = None,
        use_mask: bool = True,
    ) -> None:
        super().__init__(reduction, use_mask)
        self.convert_to_functional(goal_network, "goal_network")
        self.out_keys = ["loss_goal", "entropy", "accuracy", "accuracy_top3"]

    def _read_keys(self) -> list[NestedKey]:
        return [*self.goal_network.in_keys, self.tensor_keys.mask, self.tensor_keys.label]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss of a batch that holds :attr:`in_keys`; the input is left as it is."""
        logits = self._logits(tensordict)
        shape = logits.shape[:-1]
        label = self._entries(tensordict, self.tensor_keys.label, "label", shape)
        feasible = self._flags(tensordict, self.tensor_keys.mask, "mask of goals", logits.shape)
        if logits.shape[-1] == 0:
            logits, feasible = functional.pad(logits, (0, 1)), functional.pad(feasible, (0, 1))
        counted = self._counted(tensordict, shape, logits.device) & (label >= 0) & feasible.any(-1)
        label = self._checked(label, feasible, counted)
        # Entries that are left out get an even softmax, so that nothing they hold reaches a gradient.
        used = feasible & counted[..., None]
        lowest = torch.finfo(logits.dtype).min
        dist = Categorical(logits=logits.masked_fill(~used, lowest), validate_args=False)
        reduction: Reduction = "none" if self.reduction == "none" else "mean"
        with torch.no_grad():
            best = dist.logits.topk(min(3, logits.shape[-1]), -1).indices == label[..., None]
            statistics = {
                "entropy": dist.entropy(),
                "accuracy": best[..., 0].to(logits.dtype),
                "accuracy_top3": best.any(-1).to(logits.dtype),
            }
        result = TensorDict(
            {
                "loss_goal": self._reduced(-dist.log_prob(label), counted),
                **{name: self._reduced(value, counted, reduction) for name, value in statistics.items()},
            }
        )
        self._clear_weakrefs(tensordict, result, "goal_network_params")
        return result

    def _logits(self, tensordict: TensorDictBase) -> Tensor:
        network, inputs = self.goal_network, tensordict.copy()
        with self.goal_network_params.to_module(network):
            sampling = isinstance(network, ProbabilisticTensorDictSequential)
            out = network.get_dist_params(inputs) if sampling else network(inputs)
        logits = out.get(self.tensor_keys.logits, default=None)
        if logits is None:
            raise KeyError(f"the network writes no logits under {self.tensor_keys.logits!r}")
        return logits

    def _checked(self, label: Tensor, feasible: Tensor, counted: Tensor) -> Tensor:
        """Labels with 0 for what is left out."""
        label = torch.where(counted, label, 0)
        number = feasible.shape[-1]
        known = feasible.gather(-1, label.clamp(max=number - 1)[..., None])[..., 0] & (label < number)
        if bool((counted & ~known).any()):
            wrong = (counted & ~known).nonzero()[0].tolist()
            raise ValueError(f"label {self.tensor_keys.label!r} at {wrong} is not one of the feasible goals")
        return label
