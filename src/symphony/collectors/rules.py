"""Pruning rules: which branches go on, and in how many copies.

A rule is any callable ``rule(totals, noise) -> parents``: totals [*b, S] float, where a *high* number is bad;
noise [*b] in [0, 1) or None; parents [*b, S] int64, the branch that each slot is continued from. Most rules know
nothing of groups, and :func:`prune` shows them one group at a time; a :class:`GroupRule` sees all at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeGuard

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from symphony.errors import ConfigError


class PruningRule(Protocol):
    """What :func:`beam_search` calls at a pruning point; a plain function will do.

    Rows are independent, and nothing is drawn but by the given noise. To drop the worst branch for the best:

    >>> import torch
    >>> def drop_worst(totals, noise=None):
    ...     slots = torch.arange(totals.shape[-1]).expand(totals.shape).clone()
    ...     best, worst = totals.argmin(-1, keepdim=True), totals.argmax(-1, keepdim=True)
    ...     return slots.scatter(-1, worst, best)
    >>> drop_worst(torch.tensor([[0.5, 3.0, 0.1, 1.0]])).tolist()
    [[0, 2, 2, 3]]

    It is passed as ``rule=drop_worst``. What goes to other processes must be defined in a module, not in a script's
    ``main``; a frozen dataclass with a ``__call__`` also carries parameters.
    """

    def __call__(
        self, totals: Float[Tensor, "*b S"], noise: Float[Tensor, "*b"] | None
    ) -> Int[Tensor, "*b S"]:
        """Parents of the S slots; see the module."""


class GroupRule(Protocol):
    """A rule that decides itself what groups mean; they may be of any size, and branches may change theirs."""

    takes_groups: ClassVar[bool] = True

    def __call__(
        self,
        totals: Float[Tensor, "*b S"],
        noise: Float[Tensor, "*b"] | None,
        groups: Int[Tensor, "*b S"] | None = None,
    ) -> Int[Tensor, "*b S"]:
        """Parents of the S slots; groups are given where the search has a ``group_key``."""


def takes_groups(rule: object) -> TypeGuard[GroupRule]:
    """Whether a rule wants to see the groups itself."""
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
            raise ConfigError(f"the kept fraction must be in (0, 1], is {self.fraction}")

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
class Systematic:
    """Systematic resampling with weights softmax(-totals / temperature), as in particle filters.

    A branch of weight w gets floor(S w) or ceil(S w) copies, S w on average over the noise; slots are filled in
    order of rank, so slot 0 holds the best that goes on. Softer than truncation: bad branches become rarer instead
    of extinct, and branches with equal totals all go on.

    Source: Kitagawa, "Monte Carlo filter and smoother", J. Comput. Graph. Stat. 5 (1996).
    """

    temperature: float = 1.0

    def __post_init__(self) -> None:
        if not self.temperature > 0.0:
            raise ConfigError(f"the temperature must be positive, is {self.temperature}")

    def __call__(
        self, totals: Float[Tensor, "*b S"], noise: Float[Tensor, "*b"] | None = None
    ) -> Int[Tensor, "*b S"]:
        """Parents of the S slots by one uniform number per row; NaN counts as infinitely bad.

        Raises:
            ConfigError: if noise is None.
        """
        if noise is None:
            raise ConfigError(
                "systematic resampling needs noise: one number in [0, 1) per row and pruning point"
            )
        branches = totals.shape[-1]
        ranked = totals.argsort(dim=-1, stable=True)
        # float64: in float32 the last of many cumulated weights may stay visibly below one.
        worst = torch.finfo(torch.float64).min / 4
        logits = -totals.gather(-1, ranked).double() / self.temperature
        logits = logits.nan_to_num(nan=worst, neginf=worst, posinf=-worst)
        cumulative = torch.softmax(logits, -1).cumsum(-1)
        slots = torch.arange(branches, device=totals.device)
        points = (slots + noise.double()[..., None]) / branches
        drawn = torch.searchsorted(cumulative, points * cumulative[..., -1:], right=True)
        # Rounding may carry the last point up to the total, past the last branch that has any weight.
        drawn = torch.minimum(drawn, (cumulative < cumulative[..., -1:]).sum(-1, keepdim=True))
        return ranked.gather(-1, drawn)


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
            raise ConfigError("the threshold must be a number, is nan")

    def __call__(
        self,
        totals: Float[Tensor, "*b S"],
        noise: Float[Tensor, "*b"] | None = None,
        groups: Int[Tensor, "*b S"] | None = None,
    ) -> Int[Tensor, "*b S"]:
        """Parents of the S slots by one uniform number per row.

        Raises:
            ConfigError: if noise is None.
        """
        if noise is None:
            raise ConfigError("ReplaceBad needs noise: one number in [0, 1) per row and pruning point")
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


def group_members(groups: Int[Tensor, "*b S"]) -> Int[Tensor, "*b G M"]:
    """The slots of each of the G groups of M branches, groups by id, slots ascending.

    Raises:
        ConfigError: if the groups of all rows together are not equally many and equally large.
    """
    branches = groups.shape[-1]
    by_group, order = groups.sort(dim=-1, stable=True)
    starts = torch.ones_like(by_group, dtype=torch.bool)
    starts[..., 1:] = by_group[..., 1:] != by_group[..., :-1]
    counts = starts.sum(-1)
    number = int(counts.max())
    size = branches // number
    expected = torch.arange(branches, device=groups.device) % size == 0
    if size * number != branches or not bool((starts == expected).all()):
        raise ConfigError(
            f"{branches} branches must split into equally many groups of one size in every row, "
            f"found {int(counts.min())} to {number} groups in a row"
        )
    return order.unflatten(-1, (number, size))


def prune(
    rule: PruningRule | GroupRule,
    totals: Float[Tensor, "*b S"],
    noise: Float[Tensor, "*b"] | None = None,
    members: Int[Tensor, "*b G M"] | None = None,
    groups: Int[Tensor, "*b S"] | None = None,
) -> Int[Tensor, "*b S"]:
    """Apply a rule, inside each group if groups are given, and check what it returns.

    Args:
        rule: see the module.
        totals: of each branch; high is bad.
        noise: one number in [0, 1) per row, which all groups of the row share.
        members: from :func:`group_members`. Survivors stay in the slots of their group.
        groups: for a :class:`GroupRule`, which gets them as they are.

    Returns:
        The branch each slot goes on from.

    Raises:
        ConfigError: if the rule returns something else than int64 indices of branches.
    """
    if takes_groups(rule):
        return _checked(rule, rule(totals, noise, groups), totals)
    if members is None:
        return _checked(rule, rule(totals, noise), totals)
    inside = totals.gather(-1, members.flatten(-2)).unflatten(-1, members.shape[-2:])
    shared = None if noise is None else noise[..., None].expand(inside.shape[:-1])
    chosen = _checked(rule, rule(inside, shared), inside)
    parents = members.gather(-1, chosen)
    return torch.empty_like(members.flatten(-2)).scatter(-1, members.flatten(-2), parents.flatten(-2))


def _checked(
    rule: object, parents: Shaped[Tensor, "*_"], totals: Float[Tensor, "*b S"]
) -> Int[Tensor, "*b S"]:
    if parents.dtype != torch.int64 or parents.shape != totals.shape:
        raise ConfigError(
            f"a pruning rule must return int64 {tuple(totals.shape)}, "
            f"{rule} returned {parents.dtype} {tuple(parents.shape)}"
        )
    # Looking at the values waits for the device; only rules of others need it.
    own = isinstance(rule, KeepAll | KeepBest | Systematic | ReplaceBad)
    if not own and parents.numel() and not bool(((parents >= 0) & (parents < totals.shape[-1])).all()):
        raise ConfigError(f"{rule} returned branches outside of 0 ... {totals.shape[-1] - 1}")
    return parents
