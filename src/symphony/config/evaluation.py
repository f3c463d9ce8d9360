"""How agents are simulated and evaluated."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, get_args

from symphony.config.agent import RULES, SearchConfig
from symphony.config.checks import not_negative, one_of, positive
from symphony.errors import ConfigError

Search = Literal["agent", "none", "tree", "backtrack", "best"]
ScoreName = Literal["agent", "discriminator", "flags", "rule"]
Goals = Literal["agent", "tree", "branch"]
Others = Literal["log", "constant_velocity", "idm", "learned"]
Engine = Literal["local", "ray"]
Setting = Literal["main", "long", "many"]
"""Tables of the paper: 10 s with 2 interactive agents, 20 s with 2, 10 s with 8."""
PaperData = Literal["proprietary", "womd"]
"""Data sets whose figures the paper gives."""
TableFormat = Literal["text", "markdown", "latex", "json"]
TableColumns = Literal["split", "standing", "corrected", "goals"]
"""Columns of a table on request: collisions with playback agents and the rest, who stands at the end, divergence
corrected for sampling, what the search made of the goals.
"""
MOST = 128
"""Agents of a run segment that are driven, at most."""
TOGETHER = 64
"""Run segments simulated at a time, at most, unless more are asked for: with more, each costs no less."""
MOST_SECONDS = 1e6
"""Seconds that a planner can be given for an answer, at most."""
PERSONA_PARTS = ("headway", "speed")
"""What a persona consists of, in the order of its numbers."""


def persona_quantiles(text: str) -> dict[str, float]:
    """From ``headway=.8,speed=.3`` to numbers by name; either may be missing.

    Raises:
        ConfigError: it can't be read, names something twice, or a number is not between 0 and 1.
    """
    found: dict[str, float] = {}
    for part in text.split(",") if text else []:
        name, _, number = part.partition("=")
        twice = name in found
        try:
            found[name] = float(number)
        except ValueError:
            found[name] = -1.0
        if twice or name not in PERSONA_PARTS or not 0 <= found[name] <= 1:
            raise ConfigError(
                f"a persona is such as headway=.8,speed=.3 (quantiles from 0 to 1), not '{text}'"
            )
    return found


def check_planner_seconds(seconds: float) -> None:
    """Raise ConfigError for a time limit that is not above 0, or longer than any clock can be set to."""
    if not 0 < seconds <= MOST_SECONDS:
        raise ConfigError(f"--planner-seconds must be above 0 and at most {MOST_SECONDS:g}, is {seconds}")


@dataclass(frozen=True, kw_only=True)
class SimulationConfig:
    """How an agent is simulated, whatever the rollouts are for."""

    search: Search = "agent"
    """Search that the rollouts come from. `agent`: as the agent was trained; `none`; `tree`: beam search;
    `backtrack`: independent rollouts, each of which goes back and tries again where it is bad; `best`: independent
    rollouts, of which that with the best score counts."""
    score: ScoreName = "agent"
    """Score that a search lowers. `agent`: as is best for the agent (the discriminator, unless its card says
    something else); `discriminator`: what the agent's own calls unreal; `flags`: collisions and time off the road;
    `rule`: the same, and collisions within half a second, were everyone to keep speed and course."""
    branches: int = 0
    """Branches of each tree; 0: as many as the agent's `search.test-branches`."""
    rule: str = "agent"
    """Rule that prunes trees: `agent` as it was trained, else see `search.rule` of training."""
    prune_every: int = 0
    """Steps between prunings, or after which a rollout may go back; 0: as the agent was trained."""
    temperature: float = 0.0
    """Temperature of rule `systematic`; 0: as the agent was trained."""
    threshold: float | None = None
    """Highest total of a good branch, for rule `replace` and for `backtrack`; by default as the agent was trained,
    and 0 where a score is 1 for each agent that is bad (`flags`, `rule`)."""
    goals: Goals = "agent"
    """Branches that draw goals together: all of a `tree` (the paper), or each `branch` alone; `agent`: as the agent
    is meant to."""
    action_temperature: float = 1.0
    """Temperature of the draw of discrete actions: below 1 likely ones become likelier, above 1 the rare ones."""
    seed: int = 0
    """Seed of everything that is drawn at random in the rollouts."""
    device: str = "cpu"
    """Device that simulates: `cpu`, `cuda` or `cuda:N`."""
    workers: int = 1
    """Processes that share the batches of run segments, with one thread each (changes speed, not results)."""

    def __post_init__(self) -> None:
        one_of(self, "search", get_args(Search))
        one_of(self, "score", get_args(ScoreName))
        one_of(self, "goals", get_args(Goals))
        one_of(self, "rule", ["agent", *RULES], path=True)
        positive(self, "workers", "action_temperature")
        not_negative(self, "branches", "prune_every", "temperature")

    @property
    def simulation(self) -> dict[str, Any]:
        """The settings that every simulation has, by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(SimulationConfig)}

    def pruning(self, trained: SearchConfig) -> SearchConfig:
        """The search: as in training, but for what is set here."""
        score = trained.score if self.score == "agent" else self.score
        # A threshold of logits says nothing of flags: with one of them a branch is bad.
        threshold = trained.threshold if score == "discriminator" else 0.0
        return dataclasses.replace(
            trained,
            score=score,
            test_branches=self.branches or trained.test_branches,
            rule=trained.rule if self.rule == "agent" else self.rule,
            prune_every=self.prune_every or trained.prune_every,
            temperature=self.temperature or trained.temperature,
            threshold=threshold if self.threshold is None else self.threshold,
            goals=trained.goals if self.goals == "agent" else self.goals,
        )


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(SimulationConfig):
    """How agents are evaluated."""

    rollouts: int = 16
    """Rollouts per run segment that count."""
    trees: int = 1
    """Search trees per run segment, each with goals of its own; each gives its share of the rollouts. Where that is
    less than all of its leaves, take `goals` of the tree: among those of branches the discriminator would choose."""
    persona: str = ""
    """Style of all agents that the agent drives, such as `headway=.8,speed=.3`: quantiles among the vehicles it
    learned from; what is not given is drawn for each (agents trained with `agent.persona`)."""
    logged_goals: bool = False
    """Give agents the routes of the log instead of sampled ones."""
    duration: int = 0
    """Seconds of each run segment that are simulated; 0: as many as the agent was trained with."""
    interactive: int | Literal["all"] = 0
    """Agents per run segment that the agent drives, at most 128: the ego, then the nearest (in a segment with fewer
    those that there are); 0: as many as it was trained with (2 for the baselines). `all`: every vehicle that moves or
    stands in a lane, in open traffic."""
    radius: float = 0.0
    """Metres from the ego within which vehicles beyond the first two must come in the log to be driven; 0: no
    limit."""
    open_traffic: bool = False
    """Vehicles enter where the log brings them in and leave at the edge of the map, as they do with `all`; otherwise
    the same ones are driven from the first step to the last."""
    others: Others = "log"
    """Driver of the other vehicles: the `log`, `constant_velocity`, `idm` (a car-follower, along the route of the
    log) or the agent itself (`learned`). Nobody evaluates them; traffic is open for all but the log."""
    metric: tuple[str, ...] = ()
    """Import paths of metrics of your own, functions from scenes and rollouts to a number per rollout."""
    batch: int = 0
    """Run segments simulated at a time (changes memory and speed, not results); 0: up to 64, or 16 with a
    planner, fewer where their agents see many points."""
    engine: Engine = "local"
    """Engine that runs the worker processes: `local`, on this machine, or `ray`, on a Ray cluster (at RAY_ADDRESS,
    else one is started here)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of(self, "engine", get_args(Engine))
        one_of(self, "others", get_args(Others))
        positive(self, "rollouts", "trees")
        not_negative(self, "radius", "batch", "duration")
        if self.engine == "ray" and self.device != "cpu":
            raise ConfigError(f"engine 'ray' works on CPUs only, device is '{self.device}'")
        if self.rollouts % self.trees:
            raise ConfigError(f"rollouts ({self.rollouts}) must be a multiple of trees ({self.trees})")
        persona_quantiles(self.persona)
        if self.interactive != "all" and not 0 <= self.interactive <= MOST:
            raise ConfigError(f"interactive is 'all' or a number up to {MOST}, is {self.interactive}")
        for path in self.metric:
            if ":" not in path:
                raise ConfigError(f"metric is an import path such as my.metrics:jerk, not '{path}'")
