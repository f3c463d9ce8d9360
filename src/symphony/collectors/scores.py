"""Scores of steps, and their aggregates over a period."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from symphony.errors import ConfigError

# Added one by one: how many padded agents follow would change the last bit of `Tensor.sum`.
_REDUCTIONS: dict[str, Callable[[Tensor, int], Tensor]] = {
    "max": lambda x, dim: x.amax(dim),
    "mean": lambda x, dim: x.cumsum(dim).select(dim, -1) / x.shape[dim],
    "sum": lambda x, dim: x.cumsum(dim).select(dim, -1),
    "last": lambda x, dim: x.select(dim, -1),
}


@dataclass(frozen=True)
class Aggregate:
    """Scores of a period [*b, S, T_p, N] to totals [*b, S]: first over time, then over agents.

    Args:
        time: how the T_p steps are joined.
        agents: how the N agents are joined. Scores of padded agents are 0: a sum does not change with how many there
            are, a maximum or a mean does.
    """

    time: Literal["max", "mean", "sum", "last"] = "max"
    agents: Literal["sum", "max", "mean"] = "sum"

    def __post_init__(self) -> None:
        if self.time not in _REDUCTIONS:
            raise ConfigError(f"time is one of {', '.join(_REDUCTIONS)}, not {self.time!r}")
        if self.agents not in ("sum", "max", "mean"):
            raise ConfigError(f"agents is one of sum, max, mean, not {self.agents!r}")

    def __call__(self, scores: Float[Tensor, "*b S T N"]) -> Float[Tensor, "*b S"]:
        """The totals."""
        return _REDUCTIONS[self.agents](_REDUCTIONS[self.time](scores, -2), -1)


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
        """The scores; KeyError if an entry is absent, ConfigError if the mask is not one of these agents."""
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
                raise ConfigError(
                    f"{self.valid_key!r} is {list(valid.shape)}, scores of agents are {list(score.shape)}"
                )
            # not a product: a padded agent may hold NaN
            score = score.where(valid, score.new_zeros(()))
        return score
