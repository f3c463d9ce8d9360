"""Behavioural cloning."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, dispatch

from symphony.objectives.base import ActorLoss, Reduction


class BCLoss(ActorLoss):
    """Negative log-likelihood of expert actions under a stochastic actor (paper, II-B).

    Unlike TorchRL's class of this name it takes its distribution from the actor whatever the keys are called,
    and leaves padded agents out. Also for other labels drawn from a distribution, such as goals.

    Args:
        actor_network: probabilistic module with a `get_dist`.
        reduction: `"mean"` over the valid entries (0 if there are none), `"sum"`, or `"none"`, which keeps the
            shape `[...]` of the log-probability, with zeros at invalid entries.
        label_smoothing: share of the target spread evenly over all possible categories, in [0, 1); categorical actors
            only.
        use_mask: whether a mask under the `valid` key is read: None where there is one, see :class:`MaskedLoss`.

    Writes `loss_bc`, and for categorical actors, detached, `entropy` of the actor and `accuracy` of its mode
    (means over the valid entries; without reduction per entry like the loss).

    Raises:
        KeyError: at the call, if the action or the mask is missing.
        ValueError: for a bad `label_smoothing` or `reduction`, or an action or a mask of another shape.
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

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential | ProbabilisticTensorDictModule,
        *,
        reduction: Reduction | None = None,
        label_smoothing: float = 0.0,
        use_mask: bool | None = None,
    ) -> None:
        super().__init__(actor_network, reduction, label_smoothing, use_mask)
        self.out_keys = ["loss_bc", "entropy", "accuracy"] if self.categorical else ["loss_bc"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss of a batch that holds :attr:`in_keys`; the input is left as it is."""
        fit = self._fit(tensordict)
        result = TensorDict(
            {"loss_bc": self._reduced(fit.cost, fit.counted), **self._statistics(fit, fit.counted)}
        )
        self._clear_weakrefs(tensordict, result, "actor_network_params")
        return result
