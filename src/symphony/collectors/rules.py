"""The decisions of a search: scores of steps, totals of periods, and rules for which branches are copied."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Int
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

PruningRule = Callable[..., Tensor]
"""Any callable ``rule(totals, noise) -> parents``: totals [*b, S] float, where a *high* number is bad; noise [*b] in
[0, 1) or None, by which alone it may draw; parents [*b, S] int64, the branch that each slot is continued from. One
with ``takes_groups = True`` is called with groups [*b, S] (or None), too, and decides what they mean.
"""


def _sum(values: Float[Tensor, "*_"], dim: int) -> Float[Tensor, "*_"]:
    # Added one by one: how many padded agents follow would change the last bit of `Tensor.sum`.
    return values.cumsum(dim).select(dim, -1)


@dataclass(frozen=True)
class Aggregate:
    """Aggregates the scores of a period [*b, S, T_p, N] to totals [*b, S]: first over time, then over agents.

    Args:
        time: how the T_p steps are joined, those before the end of an episode alone.
        agents: how the N agents are joined. Scores of padded agents are 0, which only a sum ignores.
    """

    time: Literal["max", "mean", "sum", "last"] = "max"
    agents: Literal["sum", "max", "mean"] = "sum"

    def __post_init__(self) -> None:
        if self.time not in (known := ("max", "mean", "sum", "last")) or self.agents not in known[:3]:
            raise ValueError(f"time is one of {known}, agents of {known[:3]}: {self.time!r}, {self.agents!r}")

    def __call__(
        self, scores: Float[Tensor, "*b S T N"], alive: Bool[Tensor, "*b S T _"] | None = None
    ) -> Float[Tensor, "*b S"]:
        """Return the totals; an agent none of whose steps counts has 0.

        Args:
            scores: the scores of all steps.
            alive: which of them count, the first ones; all of them if None.
        """
        alive = torch.ones_like(scores[..., :1], dtype=torch.bool) if alive is None else alive
        number = alive.sum(-2)
        if self.time == "max":
            found = scores.masked_fill(~alive, -torch.inf).amax(-2)
            joined = torch.where(alive[..., 0, :], found, 0.0)
        elif self.time == "last":
            last = (number - 1).clamp_min(0).expand(scores.select(-2, 0).shape)
            joined = torch.where(alive, scores, 0.0).gather(-2, last.unsqueeze(-2)).squeeze(-2)
        else:
            joined = _sum(torch.where(alive, scores, 0.0), -2)
            joined = joined / number.clamp_min(1) if self.time == "mean" else joined
        if self.agents == "max":
            return joined.amax(-1)
        total = _sum(joined, -1)
        return total / joined.shape[-1] if self.agents == "mean" else total


max_then_sum = Aggregate("max", "sum")
"""The paper's aggregate: the worst moment of each agent, added up."""
mean_then_sum = Aggregate("mean", "sum")
"""The average of each agent over the period, added up."""


@dataclass(frozen=True)
class KeyScore:
    """A score read from an entry of the TensorDict, written there by the environment or by a module.

    Args:
        key: [*b, S], [*b, S, N] or [*b, S, N, 1], any number or bool.
        module: a module called first, on a shallow copy, if the entry is its output.
        negate: for entries of which *high* is good, such as a reward.
        valid_key: [*b, S, N] bool, if scores of padded agents are to be 0.
    """

    key: NestedKey
    module: Callable[[TensorDictBase], TensorDictBase] | None = None
    negate: bool = False
    valid_key: NestedKey | None = None

    def __call__(self, tensordict: TensorDictBase) -> Float[Tensor, "*b S N"]:
        """Return the scores; KeyError if an entry is absent, ValueError if the mask does not fit the agents."""
        if self.module is not None:
            # Modules write into what they are given, and whatever is in the state is carried to the next step.
            tensordict = self.module(tensordict.copy())
        score, batch = _entry(tensordict, self.key), tensordict.batch_dims
        score = score if score.is_floating_point() else score.float()
        score = score.unsqueeze(-1) if score.ndim == batch else score
        score = score.squeeze(-1) if score.ndim == batch + 2 and score.shape[-1] == 1 else score
        score = -score if self.negate else score
        if self.valid_key is None:
            return score
        valid = _entry(tensordict, self.valid_key)
        if valid.shape != score.shape:  # broadcast, the score of a branch would count for each of its agents
            shapes = f"{list(valid.shape)}, scores of agents are {list(score.shape)}"
            raise ValueError(f"{self.valid_key!r} is {shapes}")
        # Not a product: a padded agent may hold NaN.
        return score.where(valid, score.new_zeros(()))


def _entry(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    value = tensordict.get(key)
    if value is None:
        raise KeyError(f"no entry {key!r} to score with")
    return value


def takes_groups(rule: object) -> bool:
    """Return whether a rule takes groups."""
    return bool(getattr(rule, "takes_groups", False))


def _needed(noise: Tensor | None) -> Tensor:
    if noise is None:
        raise ValueError("the rule needs noise: numbers in [0, 1) for each row and period")
    return noise


def _slots(totals: Float[Tensor, "*b S"]) -> Int[Tensor, "*b S"]:
    """Return the parents if every slot continues itself."""
    return torch.arange(totals.shape[-1], device=totals.device).expand(totals.shape)


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

    def __call__(self, totals: Float[Tensor, "*b S"], noise: Tensor | None = None) -> Int[Tensor, "*b S"]:
        """Return parents of the S slots; needs no noise."""
        ranked = totals.argsort(dim=-1, stable=True)
        slots = torch.arange(totals.shape[-1], device=totals.device)
        # The margin takes back what rounding may add: 0.1 * 30 is a little more than 3.
        return ranked[..., slots % max(1, math.ceil(self.fraction * len(slots) - 1e-9))]


@dataclass(frozen=True)
class KeepAll:
    """Prune nothing: S independent rollouts, scored."""

    def __call__(self, totals: Float[Tensor, "*b S"], noise: Tensor | None = None) -> Int[Tensor, "*b S"]:
        """Return every slot as its own parent."""
        return _slots(totals)


@dataclass(frozen=True)
class Systematic:
    """Systematic resampling with weights softmax(-totals / temperature), as in particle filters.

    A branch of weight w gets floor(S w) or ceil(S w) copies, and slot 0 holds the best that goes on. What the
    rule sees are the totals since a row was last resampled.

    Args:
        temperature: the temperature in the units of the totals; 1 where they are negative log-likelihoods.
        threshold: share of S. A row whose effective sample size 1 / sum(w^2) is larger is not resampled: its branches
            go on with their weights, which the search carries to the next period.

    Source: Douc, Cappe and Moulines, "Comparison of resampling schemes for particle filtering" (2005).
    """

    temperature: float = 1.0
    threshold: float = 1.0

    def __post_init__(self) -> None:
        if not self.temperature > 0.0:
            raise ValueError(f"the temperature must be positive, is {self.temperature}")

    def resamples(self, totals: Float[Tensor, "*b S"]) -> Bool[Tensor, "*b"]:
        """Return which rows are resampled; the branches of the others go on as they are."""
        if self.threshold >= 1.0:
            return torch.ones_like(totals[..., 0], dtype=torch.bool)
        return sample_size(self._logits(totals)) <= self.threshold * totals.shape[-1]

    def __call__(self, totals: Float[Tensor, "*b S"], noise: Tensor | None = None) -> Int[Tensor, "*b S"]:
        """Return parents of the S slots; NaN counts as infinitely bad. Raises ValueError without noise."""
        noise = _needed(noise)
        ranked = totals.argsort(dim=-1, stable=True)
        weights = torch.softmax(self._logits(totals.gather(-1, ranked)), -1)
        slots = torch.arange(totals.shape[-1], device=totals.device)
        return ranked.gather(-1, _at(weights, (slots + noise.double()[..., None]) / len(slots)))

    def _logits(self, totals: Float[Tensor, "*b S"]) -> Float[Tensor, "*b S"]:
        # float64: in float32 the last of many cumulated weights may stay visibly below one.
        worst = torch.finfo(torch.float64).min / 4
        return (-totals.double() / self.temperature).nan_to_num(nan=worst, neginf=worst, posinf=-worst)


def _at(weights: Float[Tensor, "*b S"], points: Float[Tensor, "*b S"]) -> Int[Tensor, "*b S"]:
    """Return the branches at points in [0, 1) of their cumulated weights."""
    cumulative = weights.cumsum(-1)
    drawn = torch.searchsorted(cumulative, points * cumulative[..., -1:], right=True)
    # Rounding may carry the last point up to the total, past the last branch that has any weight.
    return torch.minimum(drawn, (cumulative < cumulative[..., -1:]).sum(-1, keepdim=True))


def sample_size(log_weights: Float[Tensor, "*b S"]) -> Float[Tensor, "*b"]:
    """Return effective sample size 1 / sum(w^2) of the normalised weights, between 1 and S."""
    return (2 * log_weights.logsumexp(-1) - (2 * log_weights).logsumexp(-1)).exp()


@dataclass(frozen=True)
class ReplaceBad:
    """Replace the branches with a total above a threshold by copies of the others, which keep their slots.

    Where nothing is bad nothing changes, so branches stay as diverse as they were drawn. The copies are made in turn
    of the good branches, by slot, from one on that the noise decides. With groups, such as the goals of a branch, a
    slot goes to the good branches of its own group, and to any where its group has none left. Where no branch is
    good, all stay. NaN is above every threshold.

    Args:
        threshold: the threshold in the units of the totals.
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
        """Return parents of the S slots by one uniform number per row. Raises ValueError without noise."""
        noise = _needed(noise)
        slots, good = _slots(totals), totals <= self.threshold
        groups = torch.zeros_like(slots) if groups is None else groups
        # [*b, S, S]: the slot to fill, then the branch that may fill it, or another slot that waits.
        same = groups[..., :, None] == groups[..., None, :]
        own = (good[..., None, :] & same).any(-1)
        candidates = good[..., None, :] & (same | ~own[..., :, None])
        waiting = ~good[..., None, :] & torch.where(own[..., :, None], same, ~own[..., None, :])
        # Those that wait for the same branches take them in turn, from one on that the noise picks.
        turn = (waiting & (slots[..., None, :] < slots[..., :, None])).sum(-1)
        number = candidates.sum(-1)
        first = (noise.double()[..., None] * number).long()
        place = (first + turn) % number.clamp_min(1)
        chosen = candidates & (candidates.cumsum(-1) - 1 == place[..., None])
        return torch.where(good | (number == 0), slots, chosen.int().argmax(-1))


class Pruning:
    """The decisions of a rule over the periods of one search, with groups and weights carried on.

    The arguments are those of :func:`symphony.collectors.beam_search`.

    Attributes:
        totals: the totals of each period [*b, S].
        seen: what the rule saw of them.
        parents: the slots that each slot continued from.
        active: rows [*b] in which some episode went on.
        log_weights: log-weights of the branches before each pruning, for rules that weigh.
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
        self.weighs = rule if isinstance(rule, Systematic) else None
        self._groups = None if group_key is None else _groups(start, group_key)
        if group_key is not None and not takes_groups(rule):
            raise ValueError(f"{rule} takes no groups: group_key is for a rule that takes groups")
        self._noises: Sequence[Tensor | None] = [None] * periods
        if noise is not None:
            shape = [*start.shape[:-1], periods]
            if list(noise.shape) != shape:
                raise ValueError(f"noise must be {shape}, is {list(noise.shape)}")
            self._noises = noise.unbind(start.ndim - 1)
        self.totals, self.seen, self.parents = list[Tensor](), list[Tensor](), list[Tensor]()
        self.active, self.log_weights, self._gained = list[Tensor](), list[Tensor](), list[Tensor]()
        self._carried: Tensor | None = None

    @torch.no_grad()
    def prune(
        self,
        totals: Float[Tensor, "*b S"],
        active: Bool[Tensor, "*b"],
        worth: Float[Tensor, "*b S"] | None = None,
        kept: Bool[Tensor, "*b"] | None = None,
    ) -> Int[Tensor, "*b S"]:
        """Return the parents of the slots after a period, which went on in `active` rows and led to states of value
        `worth`; the slots themselves in rows that are `kept`.
        """
        carried = totals.detach() if self._carried is None else self._carried + totals.detach()
        seen = carried if worth is None else carried + worth
        moves = active if kept is None else active & ~kept
        parents = checked(self.rule, seen, self._noises[len(self.parents)], self._groups)
        moves = moves if self.weighs is None else moves & self.weighs.resamples(seen)
        slots = torch.where(moves[..., None], parents, _slots(seen))
        self._groups = None if self._groups is None else self._groups.gather(-1, slots)
        if self.weighs is not None:
            weights = self.weighs._logits(seen)
            self.log_weights.append(weights)
            self._gained.append(torch.where(moves, _log_mean(weights), 0.0))
            # What branches were chosen for in advance is taken back, or it would count again when it comes.
            ahead = torch.zeros_like(seen) if worth is None else -worth.gather(-1, slots)
            self._carried = torch.where(moves[..., None], ahead, carried)
        elif self.accumulate:
            self._carried = carried.gather(-1, slots)
        self.totals.append(totals)
        self.seen.append(seen)
        self.parents.append(slots)
        self.active.append(active)
        return slots

    def last_weights(self) -> tuple[Float[Tensor, "*b S"] | None, Float[Tensor, "*b"] | None]:
        """Return log-weights of the slots after the last pruning, relative to their mean, and the log-evidence."""
        if self.weighs is None or self._carried is None:
            return None, None
        weights = self.weighs._logits(self._carried)
        mean = _log_mean(weights)
        return weights - mean[..., None], torch.stack(self._gained).sum(0) + mean


def _log_mean(log_weights: Float[Tensor, "*b S"]) -> Float[Tensor, "*b"]:
    return log_weights.logsumexp(-1) - math.log(log_weights.shape[-1])


def _groups(start: TensorDictBase, key: NestedKey) -> Int[Tensor, "*b S"]:
    """Return the group of each branch: its number, or the first branch that agrees with it in all of its numbers."""
    value = start.get(key, torch.zeros(()))
    if value.is_floating_point() or value.shape[: start.ndim] != start.shape or value.ndim > start.ndim + 1:
        raise ValueError(f"{key!r} in the start state must be integers, one or some per branch")
    if value.ndim == start.ndim:
        return value
    return (value[..., :, None, :] == value[..., None, :, :]).all(-1).int().argmax(-1)


def checked(
    rule: PruningRule,
    totals: Float[Tensor, "*b S"],
    noise: Tensor | None = None,
    groups: Int[Tensor, "*b S"] | None = None,
) -> Int[Tensor, "*b S"]:
    """Return the branch that each slot continues from; ValueError if a rule fails or returns anything else."""
    own = isinstance(rule, KeepAll | KeepBest | Systematic | ReplaceBad)
    try:
        parents = rule(totals, noise, groups) if takes_groups(rule) else rule(totals, noise)
        what = f"{parents.dtype} {tuple(parents.shape)}"
    except Exception as error:  # whatever a user's rule raises
        if own or isinstance(error, torch.OutOfMemoryError):
            raise
        raise ValueError(f"{rule}: {type(error).__name__}: {error}") from error
    if parents.dtype != torch.int64 or parents.shape != totals.shape:
        raise ValueError(f"a pruning rule must return int64 {tuple(totals.shape)}, {rule} returned {what}")
    # Looking at the values waits for the device; only users' rules need it.
    if not own and parents.numel() and not bool(((parents >= 0) & (parents < totals.shape[-1])).all()):
        raise ValueError(f"{rule} returned branches outside of 0 ... {totals.shape[-1] - 1}")
    return parents
