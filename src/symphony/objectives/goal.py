"""The likelihood of goals as a loss."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase, dispatch
from torch import Tensor
from torch.distributions import Categorical
from torch.nn import functional

from symphony.objectives.base import MaskedLoss, Reduction


class GoalLoss(MaskedLoss):
    """Negative log-likelihood of an expert's goal, under a softmax over its feasible goals (paper, III-B).

    Where the log does not tell which of several goals it was, the label may be their set: the loss is then minus the
    logarithm of their summed probability, and any of them is right. A set of one is that label.

    Entries without a known goal (label -1, an empty set) or without any feasible one are left out, like invalid ones.
    The logits of infeasible goals have no influence.

    Args:
        goal_network: module that writes logits `[..., N, G]`; of a probabilistic one only the part that computes
            its parameters is run. G may differ from call to call.
        reduction: `"mean"` over the entries that count (0 if there are none), `"sum"`, or `"none"`, which keeps the
            shape `[..., N]`, with zeros at the others.

    Writes `loss_goal` and, detached, `entropy`, `accuracy` (the likeliest goal is the label, or in its set) and
    `accuracy_top3`: means over the entries that count; without reduction per entry like the loss.

    Raises:
        KeyError: at the call, if logits, labels or a mask are missing.
        ValueError: for a bad `reduction`, tensors that do not fit together, or a label that is not feasible.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set by `.set_keys(name=key)`.

        Attributes:
            logits (NestedKey): float `[..., N, G]`, as the network writes them.
            mask (NestedKey): bool `[..., N, G]`, True where a goal is feasible.
            label (NestedKey): int64 `[..., N]`, the expert's goal, -1 for none.
            label_set (NestedKey): bool `[..., N, G]`, optional: equally right goals, read instead of the label.
            valid (NestedKey): bool `[..., N]`, True where an agent counts.
        """

        logits: NestedKey = ("agents", "goal_logits")
        mask: NestedKey = ("agents", "routes_mask")
        label: NestedKey = ("agents", "goal")
        label_set: NestedKey = ("agents", "goal_set")
        valid: NestedKey = ("agents", "valid")

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    goal_network: TensorDictModuleBase
    goal_network_params: TensorDictParams
    target_goal_network_params: TensorDictParams

    def __init__(self, goal_network: TensorDictModuleBase, *, reduction: Reduction | None = None) -> None:
        super().__init__(reduction)
        self.convert_to_functional(goal_network, "goal_network")
        self.out_keys = ["loss_goal", "entropy", "accuracy", "accuracy_top3"]

    def _read_keys(self) -> list[NestedKey]:
        names = self.tensor_keys
        return [*self.goal_network.in_keys, names.mask, names.label, names.label_set]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss of a batch that holds :attr:`in_keys`; the input is left as it is."""
        logits = self._logits(tensordict)
        shape = logits.shape[:-1]
        feasible = self._flags(tensordict, self.tensor_keys.mask, "mask of goals", logits.shape)
        right, known = self._right(tensordict, logits.shape)
        if logits.shape[-1] == 0:
            logits, feasible, right = (functional.pad(x, (0, 1)) for x in (logits, feasible, right))
        counted = self._counted(tensordict, shape, logits.device) & known & feasible.any(-1)
        self._check(right, feasible, counted)
        # Entries that are left out get an even softmax, so that nothing they hold reaches a gradient.
        used, right = feasible & counted[..., None], right | ~counted[..., None]
        lowest = torch.finfo(logits.dtype).min
        dist = Categorical(logits=logits.masked_fill(~used, lowest), validate_args=False)
        nll = -dist.logits.masked_fill(~right, lowest).logsumexp(-1)
        reduction: Reduction = "none" if self.reduction == "none" else "mean"
        with torch.no_grad():
            best = right.gather(-1, dist.logits.topk(min(3, logits.shape[-1]), -1).indices)
            statistics = {
                "entropy": dist.entropy(),
                "accuracy": best[..., 0].to(logits.dtype),
                "accuracy_top3": best.any(-1).to(logits.dtype),
            }
        found = {name: self._reduced(value, counted, reduction) for name, value in statistics.items()}
        result = TensorDict({"loss_goal": self._reduced(nll, counted), **found})
        self._clear_weakrefs(tensordict, result, "goal_network_params")
        return result

    def _logits(self, tensordict: TensorDictBase) -> Float[Tensor, "*b N G"]:
        network, inputs = self.goal_network, tensordict.copy()
        with self.goal_network_params.to_module(network):
            sampling = isinstance(network, ProbabilisticTensorDictSequential)
            out = network.get_dist_params(inputs) if sampling else network(inputs)
        logits = out.get(self.tensor_keys.logits, default=None)
        if logits is None:
            raise KeyError(f"the network writes no logits under {self.tensor_keys.logits!r}")
        return logits

    def _right(
        self, tensordict: TensorDictBase, shape: torch.Size
    ) -> tuple[Bool[Tensor, "*b N G"], Bool[Tensor, "*b N"]]:
        """Return the right goals `[..., N, G]`, and where any is known `[..., N]`."""
        if tensordict.get(self.tensor_keys.label_set, default=None) is not None:
            right = self._flags(tensordict, self.tensor_keys.label_set, "set of labels", shape)
            return right, right.any(-1)
        label = self._entries(tensordict, self.tensor_keys.label, "label", shape[:-1])
        return label[..., None] == torch.arange(shape[-1], device=label.device), label >= 0

    def _check(
        self, right: Bool[Tensor, "*b N G"], feasible: Bool[Tensor, "*b N G"], counted: Bool[Tensor, "*b N"]
    ) -> None:
        """Raise ValueError for a label that is not a feasible goal; an accelerator stops with an error of its own."""
        wrong = counted & (~right.any(-1) | (right & ~feasible).any(-1))
        key = self.tensor_keys.label
        if wrong.device.type != "cpu":
            # Found out on the device: to look at the numbers would wait for it.
            torch._assert_async(~wrong.any(), f"label {key!r} is not one of the feasible goals")
        elif bool(wrong.any()):
            raise ValueError(f"label {key!r} at {wrong.nonzero()[0].tolist()} is not one of the feasible goals")
