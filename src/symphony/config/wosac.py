"""How rollouts for the WOSAC score are made."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal, Self, get_args

from symphony.config.checks import not_negative, one_of, positive
from symphony.config.evaluation import EvaluateConfig, Goals, Search
from symphony.errors import ConfigError

WosacScore = Literal["agent", "discriminator", "rule"]
"""Without the true flags: what is simulated must not know beforehand what it is scored by."""
FUTURE, DT = 80, 0.1
"""Steps that the challenge asks for, and the seconds between them."""


@dataclass(frozen=True, kw_only=True)
class WosacSettings:
    """How the agent is simulated."""

    search: Search = "agent"
    """`agent`: as it was trained; `none`; `tree`: beam search; `backtrack`: rollouts that go back where they are bad;
    `best`: the best of independent rollouts. Each of the 32 rollouts of a search comes from a tree of its own."""
    score: WosacScore = "agent"
    """What a search looks for: as is best for the `agent`, what the `discriminator` calls unreal, or by a `rule`:
    collisions, also those within half a second, were everyone to keep speed and course, and time off the road."""
    branches: int = 0
    """Branches of each tree; 0: as many as the agent's `search.test-branches`."""
    rule: str = "agent"
    """How trees are pruned: `agent` as it was trained, else see `search.rule` of training."""
    prune_every: int = 0
    """Steps between prunings; 0: as the agent was trained."""
    temperature: float = 0.0
    """Of rule `systematic`; 0: as the agent was trained."""
    threshold: float | None = None
    """Of rule `replace`; by default as the agent was trained."""
    goals: Goals = "agent"
    """Who draws goals together: all branches of a `tree`, or each `branch` alone; `agent`: as it is meant."""
    logged_goals: bool = False
    """Give agents the routes of the log instead of sampled ones; of the score alone, since it tells them the
    future."""
    action_temperature: float = 1.0
    """Of the draw of discrete actions: below 1 likely ones become likelier, above 1 the rare ones."""
    horizon: float = 8.0
    """Seconds that are simulated and scored: the challenge's 8, or less for logs that are shorter. Scores of another
    horizon are those of an easier task; a submission has 8."""
    seed: int = 0
    """Of everything drawn at random."""
    device: str = "cpu"
    """`cpu`, `cuda` or `cuda:N`."""
    workers: int = 1
    """Processes that share the run segments, with one thread each (changes speed, not results)."""

    def __post_init__(self) -> None:
        one_of(self, "score", get_args(WosacScore))
        not_negative(self, "branches", "seed")
        positive(self, "workers")
        if not 1.0 <= self.horizon <= FUTURE * DT or abs(self.horizon / DT - self.future) > 1e-6:
            raise ConfigError(f"horizon is 1 to 8 s, in steps of {DT:g} s, is {self.horizon:g}")
        self.config(1, self.seed)  # or complain now

    @property
    def future(self) -> int:
        """Steps that are simulated and scored."""
        return round(self.horizon / DT)

    @classmethod
    def of(cls, config: EvaluateConfig) -> Self:
        """The same simulation, of everyone.

        Raises:
            ConfigError: it searches by the true flags.
        """
        return cls(**{name: getattr(config, name) for name in _shared()})

    def config(self, rollouts: int, seed: int) -> EvaluateConfig:
        """Of some rollouts, each from a tree of its own where there is a search."""
        same = {name: getattr(self, name) for name in _shared()}
        return EvaluateConfig(**same | {"rollouts": rollouts, "trees": rollouts, "seed": seed})


def _shared() -> list[str]:
    """Settings that evaluations have, too."""
    names = {field.name for field in dataclasses.fields(EvaluateConfig)}
    return [field.name for field in dataclasses.fields(WosacSettings) if field.name in names]
