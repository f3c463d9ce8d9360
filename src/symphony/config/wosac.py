"""How rollouts for the WOSAC score are made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self, get_args

from symphony.config.checks import not_negative, one_of
from symphony.config.evaluation import EvaluateConfig, SimulationConfig
from symphony.errors import ConfigError

WosacScore = Literal["agent", "discriminator", "rule"]
"""Scores without the true flags: what is simulated must not know beforehand what it is scored by."""
FUTURE, DT = 80, 0.1
"""Steps that the challenge asks for, and the seconds between them."""


@dataclass(frozen=True, kw_only=True)
class WosacSettings(SimulationConfig):
    """How the agent is simulated; each of the 32 rollouts of a search comes from a tree of its own."""

    score: WosacScore = "agent"
    """Score that a search lowers. `agent`: as is best for the agent; `discriminator`: what the agent's own calls
    unreal; `rule`: collisions, also those within half a second, were everyone to keep speed and course, and time off
    the road."""
    logged_goals: bool = False
    """Give agents the routes of the log instead of sampled ones; of the score alone, since it tells them the
    future."""
    horizon: float = 8.0
    """Seconds that are simulated and scored: the challenge's 8, or less for logs that are shorter. Scores of another
    horizon are those of an easier task; a submission has 8."""

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of(self, "score", get_args(WosacScore))
        not_negative(self, "seed")
        if not 1.0 <= self.horizon <= FUTURE * DT or abs(self.horizon / DT - self.future) > 1e-6:
            raise ConfigError(f"horizon is 1 to 8 s, in steps of {DT:g} s, is {self.horizon:g}")

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
        return cls(**config.simulation, logged_goals=config.logged_goals)

    def config(self, rollouts: int, seed: int) -> EvaluateConfig:
        """The settings of some rollouts, each from a tree of its own where there is a search."""
        same = self.simulation | {"logged_goals": self.logged_goals, "seed": seed}
        return EvaluateConfig(**same, rollouts=rollouts, trees=rollouts)
