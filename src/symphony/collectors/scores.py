"""Scores of steps, and their aggregates over a period."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from tensordict import NestedKey, TensorDictBase
from torch import Tensor


def _sum(values: Float[Tensor, "*_"], dim: int) -> Float[Tensor, "*_"]:
    # Added one by one: how many padded agents follow would change the last bit of `Tensor.sum`.
    return values.cumsum(dim).select(dim, -1)


@dataclass(frozen=True)
class Aggregate:
    """Scores of a period [*b, S, T_p, N] to totals [*b, S]: first over time, then over agents.

    Args:
        time: how the T_p steps are joined, those before the end of an episode alone.
        agents: how the N agents are joined. Scores of padded agents are 0: a sum does not change with how many there
            are, a maximum or a mean does.
    """

    time: Literal["max", "mean", "sum", "last"] = "max"
    agents: Literal["sum", "max", "mean"] = "sum"

    def __post_init__(self) -> None:
        if self.time not in ("max", "mean", "sum", "last"):
            raise ValueError(f"time is one of max, mean, sum, last, not {self.time!r}")
        if self.agents not in ("sum", "max", "mean"):
            raise ValueError(f"agents is one of sum, max, mean, not {self.agents!r}")

    def __call__(
        self, scores: Float[Tensor, "*b S T N"], alive: Bool[Tensor, "*b S T _"] | None = None
    ) -> Float[Tensor, "*b S"]:
        """The totals; an agent none of whose steps counts has 0.

        Args:
            scores: of all steps.
            alive: which of them count; all of them if None. They are the first ones.
        """
        joined = self._over_time(scores, alive)
        if self.agents == "max":
            return joined.amax(-1)
        total = _sum(joined, -1)
        return total / joined.shape[-1] if self.agents == "mean" else total

    def _over_time(self, scores: Tensor, alive: Tensor | None) -> Tensor:
        if alive is None:
            alive = torch.ones_like(scores[..., :1], dtype=torch.bool)
        if self.time == "max":
            found = scores.masked_fill(~alive, -torch.inf).amax(-2)
            return torch.where(alive[..., 0, :], found, 0.0)
        scores = torch.where(alive, scores, 0.0)
        if self.time == "sum":
            return _sum(scores, -2)
        number = alive.sum(-2)
        if self.time == "mean":
            return _sum(scores, -2) / number.clamp_min(1)
        last = (number - 1).clamp_min(0).expand(scores.select(-2, 0).shape)
        return scores.gather(-2, last.unsqueeze(-2)).squeeze(-2)


max_then_sum = Aggregate("max", "sum")
"""The paper's: the worst moment of each agent, added up."""
mean_then_sum = Aggregate("mean", "sum")
"""The average of each agent over the period, added up."""


@dataclass(frozen=True)
class KeyScore:
    """Score that is read from an entry of the TensorDict, written there by the environment or by a module.

    Args:
        key: [*b, S], [*b, S, N] or [*b, S, N, 1], any number or bool.
        module: called first, on a shallow copy, if the entry is its output.
        negate: for entries of which *high* is good, such as a reward.
        valid_key: [*b, S, N] bool, if scores of padded agents are to be 0.
    """

    key: NestedKey
    module: Callable[[TensorDictBase], TensorDictBase] | None = None
    negate: bool = False
    valid_key: NestedKey | None = None

    def __call__(self, tensordict: TensorDictBase) -> Float[Tensor, "*b S N"]:
        """The scores; KeyError if an entry is absent, ValueError if the mask is not one of these agents."""
        if self.module is not None:
            # Modules write into what they are given, and whatever is in the state is carried to the next step.
            tensordict = self.module(tensordict.copy())
        score = tensordict.get(self.key)
        if score is None:
            raise KeyError(f"no entry {self.key!r} to score")
        score = score if score.is_floating_point() else score.float()
        batch = tensordict.batch_dims
        score = score.unsqueeze(-1) if score.ndim == batch else score
        score = score.squeeze(-1) if score.ndim == batch + 2 and score.shape[-1] == 1 else score
        score = -score if self.negate else score
        if self.valid_key is not None:
            valid = tensordict.get(self.valid_key)
            if valid is None:
                raise KeyError(f"no entry {self.valid_key!r} to mask the score with")
            if valid.shape != score.shape:
                # Broadcast, the score of a branch would count for each of its agents.
                raise ValueError(
                    f"{self.valid_key!r} is {list(valid.shape)}, scores of agents are {list(score.shape)}"
                )
            # not a product: a padded agent may hold NaN
            score = score.where(valid, score.new_zeros(()))
        return score
