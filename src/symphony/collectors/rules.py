"""Pruning rules: which branches go on, and in how many copies.

A rule is any callable ``rule(totals, noise) -> parents``: totals [*b, S] float, where a *high* number is bad;
noise [*b] in [0, 1) or None; parents [*b, S] int64, the branch that each slot is continued from. One with
``takes_groups = True`` is called with groups [*b, S] (or None), too, and decides what they mean. A
:class:`Resampling` rule weighs branches: what it sees are the totals since a row was last resampled.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

PruningRule = Callable[..., Tensor]
"""What :func:`beam_search` calls at a pruning point: see the module. Rows are independent, and nothing is drawn but
by the given noise. This one drops the worst branch for the best:

>>> import torch
>>> def drop_worst(totals, noise=None):
...     slots = torch.arange(totals.shape[-1]).expand(totals.shape).clone()
...     best, worst = totals.argmin(-1, keepdim=True), totals.argmax(-1, keepdim=True)
...     return slots.scatter(-1, worst, best)
>>> drop_worst(torch.tensor([[0.5, 3.0, 0.1, 1.0]])).tolist()
[[0, 2, 2, 3]]
"""


def takes_groups(rule: object) -> bool:
    """Whether a rule wants to see the groups."""
    return bool(getattr(rule, "takes_groups", False))


@dataclass(frozen=True)
class KeepBest:
    """Keep the share of branches with the lowest totals, copied in order of rank until all slots are full.

    The paper's rule with the default of one half. Of S branches ceil(fraction S) survive, at least one; slot i
    goes on from the survivor of rank i modulo that number, so slot 0 holds the best. Among equals the lower
    slot ranks first; NaN ranks last.
    """

    fraction: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.fraction <= 1.0:
            raise ValueError(f"the kept fraction must be in (0, 1], is {self.fraction}")

    def survivors(self, branches: int) -> int:
        """How many of `branches` survive."""
        # The margin takes back what rounding may add: 0.1 * 30 is a little more than 3.
        return max(1, math.ceil(self.fraction * branches - 1e-9))

    def __call__(
        self, totals: Float[Tensor, "*b S"], noise: Float[Tensor, "*b"] | None = None
    ) -> Int[Tensor, "*b S"]:
        """Parents of the S slots; needs no noise."""
        branches = totals.shape[-1]
        ranked = totals.argsort(dim=-1, stable=True)
        slots = torch.arange(branches, device=totals.device) % self.survivors(branches)
        return ranked[..., slots]


@dataclass(frozen=True)
class KeepAll:
    """Prune nothing: S independent rollouts, scored."""

    def __call__(
        self, totals: Float[Tensor, "*b S"], noise: Float[Tensor, "*b"] | None = None
    ) -> Int[Tensor, "*b S"]:
        """Every slot is its own parent."""
        return torch.arange(totals.shape[-1], device=totals.device).expand(totals.shape)


@dataclass(frozen=True)
class Resampling:
    """Resampling with weights softmax(-totals / temperature), as in particle filters; subclasses draw the copies.

    A branch of weight w gets S w copies on average over the noise. Slots are filled in order of rank, so slot 0 holds
    the best that goes on. Softer than truncation: bad branches become rarer instead of extinct.

    Args:
        temperature: in the units of the totals; 1 where they are negative log-likelihoods.
        threshold: share of S. A row whose effective sample size 1 / sum(w^2) is larger is not resampled: its branches
            go on with their weights, which the search carries to the next period.

    Source: Douc, Cappe and Moulines, "Comparison of resampling schemes for particle filtering" (2005).
    """

    temperature: float = 1.0
    threshold: float = 1.0
    noise_per_slot: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not self.temperature > 0.0:
            raise ValueError(f"the temperature must be positive, is {self.temperature}")

    def resamples(self, totals: Float[Tensor, "*b S"]) -> Bool[Tensor, "*b"]:
        """Whether a row is resampled, or its branches go on as they are."""
        if self.threshold >= 1.0:
            return torch.ones_like(totals[..., 0], dtype=torch.bool)
        return sample_size(self._logits(totals)) <= self.threshold * totals.shape[-1]

    def __call__(
        self, totals: Float[Tensor, "*b S"], noise: Float[Tensor, "*b"] | None = None
    ) -> Int[Tensor, "*b S"]:
        """Parents of the S slots, by one number [*b] for each row or [*b, S]; NaN counts as infinitely bad.

        Raises:
            ValueError: if noise is None.
        """
        if noise is None:
            raise ValueError("resampling needs noise: numbers in [0, 1) for each row and period")
        ranked = totals.argsort(dim=-1, stable=True)
        weights = torch.softmax(self._logits(totals.gather(-1, ranked)), -1)
        slots = torch.arange(totals.shape[-1], device=totals.device)
        shift = noise.double() if self.noise_per_slot else noise.double()[..., None]
        return ranked.gather(-1, self._copies(weights, slots, shift))

    def _logits(self, totals: Float[Tensor, "*b S"]) -> Float[Tensor, "*b S"]:
        # float64: in float32 the last of many cumulated weights may stay visibly below one.
        worst = torch.finfo(torch.float64).min / 4
        return (-totals.double() / self.temperature).nan_to_num(nan=worst, neginf=worst, posinf=-worst)

    def _copies(
        self, weights: Float[Tensor, "*b S"], slots: Int[Tensor, " S"], shift: Float[Tensor, "*b _"]
    ) -> Int[Tensor, "*b S"]:
        """The ranks that the slots go on from, ascending."""
        return _at(weights, (slots + shift) / len(slots))


class Systematic(Resampling):
    """Systematic resampling (Kitagawa 1996): a branch of weight w gets floor(S w) or ceil(S w) copies.

    Branches with equal totals all go on.
    """


class Stratified(Resampling):
    """Stratified resampling: one number for each slot, from a part of the weights of its own; noise is [*b, S]."""

    noise_per_slot: ClassVar[bool] = True


class Residual(Resampling):
    """Residual resampling: floor(S w) copies for sure, the others drawn systematically from what is left."""

    def _copies(
        self, weights: Float[Tensor, "*b S"], slots: Int[Tensor, " S"], shift: Float[Tensor, "*b _"]
    ) -> Int[Tensor, "*b S"]:
        share = len(slots) * weights
        sure = share.floor()
        first = sure.sum(-1, keepdim=True)
        place = slots.double().expand(weights.shape).contiguous()
        certain = torch.searchsorted(sure.cumsum(-1), place, right=True).clamp_max(len(slots) - 1)
        points = ((place - first + shift) / (len(slots) - first).clamp_min(1)).clamp(0, 1)
        return torch.where(place < first, certain, _at(share - sure, points)).sort(-1).values


def _at(weights: Float[Tensor, "*b S"], points: Float[Tensor, "*b S"]) -> Int[Tensor, "*b S"]:
    """The branches at points in [0, 1) of their cumulated weights."""
    cumulative = weights.cumsum(-1)
    drawn = torch.searchsorted(cumulative, points * cumulative[..., -1:], right=True)
    # Rounding may carry the last point up to the total, past the last branch that has any weight.
    return torch.minimum(drawn, (cumulative < cumulative[..., -1:]).sum(-1, keepdim=True))


def sample_size(log_weights: Float[Tensor, "*b S"]) -> Float[Tensor, "*b"]:
    """Effective sample size 1 / sum(w^2) of the normalised weights, between 1 and S."""
    return (2 * log_weights.logsumexp(-1) - (2 * log_weights).logsumexp(-1)).exp()


@dataclass(frozen=True)
class ReplaceBad:
    """Replace the branches with a total above a threshold by copies of the others, which keep their slots.

    Where nothing is bad nothing changes, so branches stay as diverse as they were drawn. The copies are made in turn
    of the good branches, by slot, from one on that the noise decides. With groups, such as the goals of a branch, a
    slot goes to the good branches of its own group, and to any where its group has none left. Where no branch is
    good, all stay. NaN is above every threshold.

    Args:
        threshold: in the units of the totals.
    """

    threshold: float
    takes_groups: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if math.isnan(self.threshold):
            raise ValueError("the threshold must be a number, is nan")

    def __call__(
        self,
        totals: Float[Tensor, "*b S"],
        noise: Float[Tensor, "*b"] | None = None,
        groups: Int[Tensor, "*b S"] | None = None,
    ) -> Int[Tensor, "*b S"]:
        """Parents of the S slots by one uniform number per row.

        Raises:
            ValueError: if noise is None.
        """
        if noise is None:
            raise ValueError("ReplaceBad needs noise: one number in [0, 1) per row and pruning point")
        slots = torch.arange(totals.shape[-1], device=totals.device)
        good = totals <= self.threshold
        groups = torch.zeros_like(totals, dtype=torch.int64) if groups is None else groups
        # [*b, S, S]: the slot to fill, then the branch that may fill it, or another slot that waits.
        same = groups[..., :, None] == groups[..., None, :]
        own = (good[..., None, :] & same).any(-1)
        candidates = good[..., None, :] & (same | ~own[..., :, None])
        waiting = ~good[..., None, :] & torch.where(own[..., :, None], same, ~own[..., None, :])
        # Those that wait for the same branches take them by turns, from one on that the noise picks.
        turn = (waiting & (slots < slots[:, None])).sum(-1)
        number = candidates.sum(-1)
        first = (noise.double()[..., None] * number).long()
        place = (first + turn) % number.clamp_min(1)
        chosen = candidates & (candidates.cumsum(-1) - 1 == place[..., None])
        return torch.where(good | (number == 0), slots, chosen.int().argmax(-1))
