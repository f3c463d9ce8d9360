"""Distilling a search over rollouts back into the policy."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, dispatch

from symphony.objectives.base import ActorLoss, Reduction


class DistillationLoss(ActorLoss):
    """Likelihood of expert actions and of actions in rollouts that survived a search (paper, III).

    The mean negative log-likelihood over the valid expert entries plus that over the valid rollout entries: each
    kind has its own mean, so the balance does not depend on how many of each a batch holds.

    Args:
        actor_network: probabilistic module with a `get_dist`, over discrete or continuous actions.
        reduction: `"mean"` as above (0 for a kind that is absent), `"sum"`, or `"none"`, which keeps the shape
            `[...]` of the log-probability, zeros where an entry does not count.
        label_smoothing: share of the target spread evenly over all possible categories, in [0, 1); categorical actors
            only.
        use_mask: whether a mask under the `valid` key is read: None where there is one, see :class:`MaskedLoss`.

    Writes `loss_distillation` and, detached, `nll_expert` and `nll_rollout` (unweighted, without label smoothing);
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
        """

        action: NestedKey = ("agents", "action")
        valid: NestedKey = ("agents", "valid")
        rollout: NestedKey = ("agents", "rollout")

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
        statistics = ["entropy", "accuracy"] if self.categorical else []
        self.out_keys = ["loss_distillation", "nll_expert", "nll_rollout", *statistics]

    def _read_keys(self) -> list[NestedKey]:
        return [*super()._read_keys(), self.tensor_keys.rollout]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss of a batch that holds :attr:`in_keys`; the input is left as it is."""
        fit = self._fit(tensordict)
        shape = fit.counted.shape
        rollout = self._flags(tensordict, self.tensor_keys.rollout, "rollout flag", shape)
        expert, rollout = fit.counted & ~rollout, fit.counted & rollout
        reduction: Reduction = "none" if self.reduction == "none" else "mean"
        result = TensorDict(
            {
                "loss_distillation": self._reduced(fit.cost, expert) + self._reduced(fit.cost, rollout),
                "nll_expert": self._reduced(fit.nll, expert, reduction),
                "nll_rollout": self._reduced(fit.nll, rollout, reduction),
                **self._statistics(fit, expert),
            }
        )
        self._clear_weakrefs(tensordict, result, "actor_network_params")
        return result
