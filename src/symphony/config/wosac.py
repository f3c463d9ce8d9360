"""How rollouts for the WOSAC score are made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from symphony.config.checks import not_negative, one_of
from symphony.config.evaluation import EvaluateConfig

WosacSearch = Literal["agent", "none", "tree", "best"]
"""Without the search by true flags: what is simulated must not know them beforehand."""


@dataclass(frozen=True, kw_only=True)
class WosacSettings:
    """How the learned agent is simulated."""

    search: WosacSearch = "agent"
    """`agent`: as it was trained; `none`; `tree`: beam search by its discriminator; `best`: the best of independent
    rollouts. Each of the 32 rollouts of a search comes from a tree of its own."""
    branches: int = 0
    """Branches of each tree; 0: as many as the agent's `search.test-branches`."""
    seed: int = 0
    """Of everything drawn at random."""
    device: str = "cpu"
    """`cpu`, `cuda` or `cuda:N`."""

    def __post_init__(self) -> None:
        one_of(self, "search", get_args(WosacSearch))
        not_negative(self, "branches", "seed")

    def config(self, rollouts: int, seed: int) -> EvaluateConfig:
        """Of some rollouts, each from a tree of its own where there is a search."""
        return EvaluateConfig(
            rollouts=rollouts,
            trees=rollouts,
            search=self.search,
            branches=self.branches,
            seed=seed,
            device=self.device,
        )
