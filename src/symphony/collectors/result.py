"""What a beam search returns, and how its leaves are traced back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from tensordict import TensorDictBase
from torch import Tensor


@dataclass(frozen=True)
class BeamSearchResult:
    """What a search found: *b rows, S branches, L leaves, T steps in P periods, N agents.

    A *leaf* is what a slot holds at the end; its history was simulated in other slots before each fork. All S
    leaves come in the order of their slots: with :class:`KeepBest`, slot 0 holds the best of the last period.

    Attributes:
        trajectories: [*b, L, T] of the leaves, laid out and named as by ``env.rollout``, kept entries only.
        scores: [*b, L, T, N] of the leaves' histories; `scores[..., t, :]` is of ``("next", ...)`` of step t.
        slots: [*b, P, L] int64, the slot in which each period of each leaf's history was simulated.
        totals: [*b, P, S] aggregate of each period, by the slot that simulated it.
        parents: [*b, P, S] int64; after period p slot s was continued from slot `parents[..., p, s]`. The last
            row is the identity if the last period was not pruned.
        simulated_scores: [*b, S, T, N] by the slot that simulated the step, the pruned ones included.
        tree: [*b, S, T] all simulated steps by slot, if asked for.
        prune_every: T_p; the last period may be shorter.
        simulated_steps: branch-steps that were simulated.
    """

    trajectories: TensorDictBase
    scores: Float[Tensor, "*b L T N"]
    slots: Int[Tensor, "*b P L"]
    totals: Float[Tensor, "*b P S"]
    parents: Int[Tensor, "*b P S"]
    simulated_scores: Float[Tensor, "*b S T N"]
    tree: TensorDictBase | None
    prune_every: int
    simulated_steps: int

    @property
    def leaf_totals(self) -> Float[Tensor, "*b P L"]:
        """Totals of the periods of each leaf's history."""
        return self.totals.gather(-1, self.slots)

    @property
    def ranking(self) -> Int[Tensor, "*b L"]:
        """The leaves from best to worst by their last period, repeated copies of one history after all others."""
        return ranking(self.totals[..., -1, :], self.slots[..., -1, :])

    @property
    def survived(self) -> Bool[Tensor, "*b P S"]:
        """Whether what a slot simulated in a period survived the pruning right after it."""
        return _named(self.parents, self.parents.shape[-1])

    @property
    def reaches_leaf(self) -> Bool[Tensor, "*b P S"]:
        """Whether what a slot simulated in a period is part of the history of one of the L leaves."""
        return _named(self.slots, self.parents.shape[-1])


def lineage(parents: Int[Tensor, "*b P S"]) -> Int[Tensor, "*b P S"]:
    """The slot that held, during each of the P periods, what each of the S slots holds after the last pruning."""
    slots = [parents[..., -1, :]]
    for period in reversed(range(parents.shape[-2] - 1)):
        slots.append(parents[..., period, :].gather(-1, slots[-1]))
    return torch.stack(slots[::-1], -2)


def _named(slots: Int[Tensor, "*b L"], branches: int) -> Bool[Tensor, "*b S"]:
    """Which of the slots occur among `slots` [..., L]."""
    found = torch.zeros(*slots.shape[:-1], branches, dtype=torch.bool, device=slots.device)
    return found.scatter(-1, slots, True)


def ranking(totals: Float[Tensor, "*b S"], slots: Int[Tensor, "*b L"]) -> Int[Tensor, "*b L"]:
    """Leaves from best to worst by the totals of their slots, repeated copies of one slot after all others."""
    # Two stable sorts: by total, then by how many copies of the same history come before.
    copies = (slots[..., :, None] == slots[..., None, :]).tril(-1).sum(-1)
    order = totals.gather(-1, slots).argsort(dim=-1, stable=True)
    return order.gather(-1, copies.gather(-1, order).argsort(dim=-1, stable=True))
