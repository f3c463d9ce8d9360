"""What a rule decides from period to period: checked, with groups and weights carried on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from symphony.collectors.rules import (
    KeepAll,
    KeepBest,
    PruningRule,
    ReplaceBad,
    Resampling,
    takes_groups,
)


class Pruning:
    """The decisions of one search.

    Args:
        start: [*b, S].
        rule: which branches go on.
        periods: P.
        group_key: see :func:`symphony.collectors.beam_search`.
        noise: likewise.
        accumulate: likewise.

    Attributes:
        totals: of each period [*b, S].
        seen: what the rule saw of them.
        parents: the slots that slots went on from.
        active: rows [*b] in which some episode went on.
        log_weights: of the branches before each pruning, for rules that weigh.
    """

    def __init__(
        self,
        start: TensorDictBase,
        rule: PruningRule,
        periods: int,
        *,
        group_key: NestedKey | None,
        noise: Tensor | None,
        accumulate: bool,
    ) -> None:
        self.rule, self.accumulate = rule, accumulate
        self.weighs = rule if isinstance(rule, Resampling) else None
        self._groups = None if group_key is None else _groups(start, group_key)
        if group_key is not None and not takes_groups(rule):
            raise ValueError(f"{rule} knows nothing of groups: group_key is for a rule that takes groups")
        self._noises = _noises(noise, start, periods, per_slot=getattr(rule, "noise_per_slot", False))
        self.totals: list[Tensor] = []
        self.seen: list[Tensor] = []
        self.parents: list[Tensor] = []
        self.active: list[Tensor] = []
        self.log_weights: list[Tensor] = []
        self._gained: list[Tensor] = []
        self._carried: Tensor | None = None

    @torch.no_grad()
    def prune(
        self,
        totals: Float[Tensor, "*b S"],
        active: Bool[Tensor, "*b"],
        worth: Float[Tensor, "*b S"] | None = None,
        *,
        keep_all: bool = False,
    ) -> Int[Tensor, "*b S"]:
        """Parents of the slots after a period.

        Args:
            totals: of the period.
            active: rows in which some episode went on; the others are left as they are.
            worth: the value of the states it led to.
            keep_all: every slot goes on from itself.
        """
        seen = totals.detach() if self._carried is None else self._carried + totals.detach()
        carried = seen
        seen = seen if worth is None else seen + worth
        slots = torch.arange(seen.shape[-1], device=seen.device).expand(seen.shape)
        moves = active
        if keep_all:
            moves = torch.zeros_like(active)
        else:
            parents = checked(self.rule, seen, self._noises[len(self.parents)], self._groups)
            moves = moves if self.weighs is None else moves & self.weighs.resamples(seen)
            slots = torch.where(moves[..., None], parents, slots)
            self._groups = None if self._groups is None else self._groups.gather(-1, slots)
        if self.weighs is not None:
            weights = -seen.double() / self.weighs.temperature
            self.log_weights.append(weights)
            self._gained.append(torch.where(moves, _log_mean(weights), 0.0))
            # What branches were chosen for in advance is taken back, or it would count again when it comes.
            ahead = torch.zeros_like(seen) if worth is None else -worth.gather(-1, slots)
            self._carried = torch.where(moves[..., None], ahead, carried)
        elif self.accumulate:
            self._carried = carried.gather(-1, slots)
        for into, what in (
            (self.totals, totals),
            (self.seen, seen),
            (self.parents, slots),
            (self.active, active),
        ):
            into.append(what)
        return slots

    def last_weights(self) -> tuple[Float[Tensor, "*b S"], Float[Tensor, "*b"]] | None:
        """Log-weights of the slots after the last pruning, relative to their mean, and the log-evidence."""
        if self.weighs is None or self._carried is None:
            return None
        weights = -self._carried.double() / self.weighs.temperature
        mean = _log_mean(weights)
        return weights - mean[..., None], torch.stack(self._gained).sum(0) + mean


def _log_mean(log_weights: Float[Tensor, "*b S"]) -> Float[Tensor, "*b"]:
    """The logarithm of the mean weight."""
    return log_weights.logsumexp(-1) - math.log(log_weights.shape[-1])


def _groups(start: TensorDictBase, key: NestedKey) -> Int[Tensor, "*b S"]:
    """The group of each branch: its number, or the first branch that agrees with it in all of its numbers."""
    value = start.get(key)
    if value is None:
        raise ValueError(f"the start state has no entry {key!r}")
    if value.is_floating_point() or value.shape[: start.ndim] != start.shape or value.ndim > start.ndim + 1:
        raise ValueError(f"{key!r} must hold integers, one or some per branch, is {list(value.shape)}")
    if value.ndim == start.ndim:
        return value
    return (value[..., :, None, :] == value[..., None, :, :]).all(-1).int().argmax(-1)


def _noises(
    noise: Tensor | None, start: TensorDictBase, periods: int, *, per_slot: bool
) -> Sequence[Tensor | None]:
    if noise is None:
        return [None] * periods
    shape = [*start.shape[:-1], periods, *([start.shape[-1]] if per_slot else [])]
    if list(noise.shape) != shape:
        raise ValueError(f"noise must be {shape}, is {list(noise.shape)}")
    return noise.unbind(start.ndim - 1)


def checked(
    rule: PruningRule,
    totals: Float[Tensor, "*b S"],
    noise: Tensor | None = None,
    groups: Int[Tensor, "*b S"] | None = None,
) -> Int[Tensor, "*b S"]:
    """The branch each slot goes on from, by a rule.

    Raises:
        ValueError: if the rule returns something else than int64 indices of branches.
    """
    parents = rule(totals, noise, groups) if takes_groups(rule) else rule(totals, noise)
    if parents.dtype != torch.int64 or parents.shape != totals.shape:
        raise ValueError(
            f"a pruning rule must return int64 {tuple(totals.shape)}, "
            f"{rule} returned {parents.dtype} {tuple(parents.shape)}"
        )
    # Looking at the values waits for the device; only rules of others need it.
    own = isinstance(rule, KeepAll | KeepBest | Resampling | ReplaceBad)
    if not own and parents.numel() and not bool(((parents >= 0) & (parents < totals.shape[-1])).all()):
        raise ValueError(f"{rule} returned branches outside of 0 ... {totals.shape[-1] - 1}")
    return parents
