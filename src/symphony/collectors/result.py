"""What a beam search returns, and how its leaves are traced back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from tensordict import TensorDictBase
from torch import Tensor

from symphony.collectors.rules import sample_size


@dataclass(frozen=True)
class BeamSearchResult:
    """What a search found: *b rows, S branches, L leaves, T steps in P periods, N agents.

    A *leaf* is what a slot holds at the end; its history was simulated in other slots before each fork. All S
    leaves come in the order of their slots: with :class:`KeepBest`, slot 0 holds the best of the last period.

    Attributes:
        trajectories: [*b, L, T] of the leaves, laid out and named as by ``env.rollout``, kept entries only.
        scores: [*b, L, T, N] of the leaves' histories; `scores[..., t, :]` is of ``("next", ...)`` of step t, 0 after
            the end of an episode.
        alive: [*b, L, T] steps before (and with) the end of their episodes.
        slots: [*b, P, L] int64, the slot in which each period of each leaf's history was simulated.
        totals: [*b, P, S] aggregate of each period, by the slot that simulated it.
        parents: [*b, P, S] int64; after period p slot s was continued from slot `parents[..., p, s]`. The last
            row is the identity if the last period was not pruned.
        simulated_scores: [*b, S, T, N] by the slot that simulated the step, the pruned ones included.
        tree: [*b, S, T] all simulated steps by slot, if asked for.
        prune_every: T_p; the last period may be shorter.
        simulated_steps: branch-steps that were simulated.
        leaf_costs: [*b, L] what the rule saw of the leaves in the last period in which their row had not ended.
        log_weights: [*b, P, S] of a :class:`Resampling` rule, before each pruning: minus the totals since the row was
            last resampled, by the temperature; None with other rules, like the following.
        leaf_log_weights: [*b, L] after the last pruning, relative to the mean weight; 0 where it resampled.
        log_evidence: [*b] estimate of the logarithm of the mean weight of unpruned branches, whose exponential has no
            bias: of the evidence, where totals are negative log-likelihoods and the temperature is 1.
    """

    trajectories: TensorDictBase
    scores: Float[Tensor, "*b L T N"]
    alive: Bool[Tensor, "*b L T"]
    slots: Int[Tensor, "*b P L"]
    totals: Float[Tensor, "*b P S"]
    parents: Int[Tensor, "*b P S"]
    simulated_scores: Float[Tensor, "*b S T N"]
    tree: TensorDictBase | None
    prune_every: int
    simulated_steps: int
    leaf_costs: Float[Tensor, "*b L"] | None = None
    log_weights: Float[Tensor, "*b P S"] | None = None
    leaf_log_weights: Float[Tensor, "*b L"] | None = None
    log_evidence: Float[Tensor, "*b"] | None = None

    @property
    def leaf_totals(self) -> Float[Tensor, "*b P L"]:
        """Totals of the periods of each leaf's history."""
        return self.totals.gather(-1, self.slots)

    @property
    def sample_size(self) -> Float[Tensor, "*b P"] | None:
        """Effective sample size before each pruning, between 1 and S."""
        return None if self.log_weights is None else sample_size(self.log_weights)

    @property
    def descendants(self) -> Int[Tensor, "*b P S"]:
        """How many of the leaves have what a slot simulated in a period in their history."""
        return torch.zeros_like(self.parents).scatter_add(-1, self.slots, torch.ones_like(self.slots))

    @property
    def survived(self) -> Bool[Tensor, "*b P S"]:
        """Whether what a slot simulated in a period survived the pruning right after it."""
        return torch.zeros_like(self.parents, dtype=torch.bool).scatter(-1, self.parents, True)

    @property
    def reaches_leaf(self) -> Bool[Tensor, "*b P S"]:
        """Whether what a slot simulated in a period is part of the history of one of the L leaves."""
        return self.descendants > 0


def lineage(parents: Int[Tensor, "*b P S"]) -> Int[Tensor, "*b P S"]:
    """The slot that held, during each of the P periods, what each of the S slots holds after the last pruning."""
    slots = [parents[..., -1, :]]
    for period in reversed(range(parents.shape[-2] - 1)):
        slots.append(parents[..., period, :].gather(-1, slots[-1]))
    return torch.stack(slots[::-1], -2)


def ranking(costs: Float[Tensor, "*b L"], slots: Int[Tensor, "*b L"]) -> Int[Tensor, "*b L"]:
    """Leaves from best to worst by their costs, repeated copies of one slot after all others."""
    # Two stable sorts: by cost, then by how many copies of the same history come before.
    copies = (slots[..., :, None] == slots[..., None, :]).tril(-1).sum(-1)
    order = costs.argsort(dim=-1, stable=True)
    return order.gather(-1, copies.gather(-1, order).argsort(dim=-1, stable=True))
