"""Settings of simulation and evaluation."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from tyro.conf import Fixed, Suppress

from symphony.config.agent import SearchConfig
from symphony.config.checks import Bounds, Count, Names, Natural, NotNegative, Settings
from symphony.errors import ConfigError

Search = Literal["agent", "none", "tree", "backtrack"]
ScoreName = Literal["agent", "discriminator", "flags", "rule"]
Goals = Literal["agent", "tree", "branch"]
Others = Literal["log", "constant_velocity", "idm", "learned"]
Engine = Literal["local", "ray"]
Compile = Literal["auto", "yes", "no"]
AfterCollision = Literal["go-on", "stop", "remove", "respawn"]
MOST_INFLOW = 1.0
"""Vehicles per second that want to enter on a lane, at most: twice what one can carry."""
Setting = Literal["main", "long", "many"]
"""Tables of the paper: 10 s with 2 interactive agents, 20 s with 2, 10 s with 8."""
PaperData = Literal["proprietary", "womd"]
"""Data sets whose figures the paper gives."""
TableFormat = Literal["markdown", "json"]
MOST = 128
"""Agents of a run segment that are driven, at most."""
TOGETHER = 64
"""Run segments simulated at a time, at most, unless more are asked for: with more, each costs no less."""
SEARCHES = 600
"""Searches in a row from which on compiling their steps pays off on a device: each saves some .4 s."""
MOST_SECONDS = 1e6
"""Seconds that a planner can be given for an answer, at most."""
OF_TREES = ("branches", "trees", "rule", "temperature", "goals")
OF_SEARCHES = (*OF_TREES, "prune_every", "threshold", "score")
"""Settings that have an effect on trees alone, and on any search."""


def compiles(choice: Compile, device: str, searches: int) -> bool:
    """Return whether the steps of this many searches (or batches of rollouts) are compiled on a device."""
    return choice == "yes" or (choice == "auto" and not device.startswith("cpu") and searches >= SEARCHES)


def check_planner_seconds(seconds: float) -> None:
    """Raise ConfigError for a time limit that is not above 0, or longer than any clock can be set to."""
    if not 0 < seconds <= MOST_SECONDS:
        raise ConfigError(f"--planner-seconds must be above 0 and at most {MOST_SECONDS:g}, is {seconds}")


@dataclass(frozen=True, kw_only=True)
class SimulationConfig(Settings):
    """Settings of a simulation, whatever the rollouts are for."""

    #: Search that the rollouts come from. `agent`: the one that the agent comes with; `none`: no search; `tree`: beam
    #: search; `backtrack`: independent rollouts, each of which goes back and tries again where it went wrong.
    search: Search = "agent"
    #: Score that a search keeps low. `agent`: the one that suits the agent best (the discriminator, unless its card
    #: names another); `discriminator`: how simulated a state looks to the agent's discriminator; `flags`: collisions
    #: and time off the road; `rule`: these, and collisions half a second later if all keep speed and course.
    score: ScoreName = "agent"
    branches: Natural = 0  # Branches of each tree; 0: as many as the agent's `search.test-branches`.
    #: Rule that prunes trees. `agent`: the one of the agent's training; `symphony train --help` explains the others.
    rule: Annotated[str, Names(["agent", "best", "systematic", "replace"])] = "agent"
    #: Steps between prunings, or after which a rollout may go back; 0: as the agent was trained.
    prune_every: Natural = 0
    temperature: NotNegative = 0.0  # Temperature of rule `systematic`; 0: as the agent was trained.
    #: Score above which a branch is bad, for `--rule replace` and `--search backtrack`; by default that of the
    #: agent's training, or 0 with the scores `flags` and `rule`, which count mistakes.
    threshold: float | None = None
    #: Whether branches share goals. `tree`: all branches of a tree do (the paper); `branch`: each draws its own;
    #: and with `agent` they do as in the agent's training.
    goals: Goals = "agent"
    #: Share of the variance of an agent's random numbers that is drawn once per rollout, so that some agents are fast
    #: throughout and others slow; 0: every step draws anew. Branches that are copied or go back draw it again.
    pace: Annotated[float, Bounds(0, 1)] = 0.0
    seed: int = 0  # Seed of everything that is drawn at random in the rollouts.
    device: str = "cpu"  # Device that simulates: `cpu`, `cuda` or `cuda:N`.
    #: Processes that share the batches of run segments, with one thread each (changes speed, not results).
    workers: Count = 1

    @property
    def simulation(self) -> dict[str, Any]:
        """The settings that every simulation has, by name."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(SimulationConfig)}

    def pruning(self, trained: SearchConfig) -> SearchConfig:
        """Return the settings of the search: as in training, except for what is set here."""
        names = ("score", "rule", "prune_every", "temperature", "goals")
        asked = {"test_branches": self.branches} | {name: getattr(self, name) for name in names}
        given = {name: value for name, value in asked.items() if value not in ("agent", 0)}
        # A threshold of logits says nothing of flags: with one of them a branch is bad.
        own = trained.threshold if given.get("score", trained.score) == "discriminator" else 0.0
        given["threshold"] = own if self.threshold is None else self.threshold
        return dataclasses.replace(trained, **given)


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig(SimulationConfig):
    """Settings of an evaluation."""

    rollouts: Count = 16  # Rollouts of each run segment.
    #: Search trees per run segment, each with its own goals; each gives an equal share of the rollouts. If a tree has
    #: more branches than it gives rollouts, use `--goals tree`; otherwise the score would also choose among goals.
    trees: Count = 1
    logged_goals: bool = False  # Give agents the routes of the log instead of sampled ones.
    #: Seconds of each run segment that are simulated; 0: as many as the agent was trained with.
    duration: Natural = 0
    #: Agents per run segment that the agent drives, at most 128: the ego, then the nearest (all of them in a segment
    #: with fewer); 0: as many as it was trained with (2 for the baselines). `all`: every vehicle that moves or stands
    #: in a lane, in open traffic.
    interactive: int | Literal["all"] = 0
    #: Drive vehicles beyond the first two only if they come within this many metres of the ego in the log; 0: no
    #: limit.
    radius: NotNegative = 0.0
    #: Vehicles enter where the log brings them in and leave at the edge of the map, as they do with `all`; otherwise
    #: the same agents are driven from the first step to the last.
    open_traffic: bool = False
    #: Driver of the other vehicles: the `log`, `constant_velocity`, `idm` (a car-follower, along the route of the
    #: log) or the agent itself (`learned`). They are not evaluated; traffic is open for all but the log.
    others: Others = "log"
    metric: Annotated[tuple[str, ...], Fixed, Suppress] = ()  # Import paths of metrics of your own.
    #: Run segments simulated at a time (changes memory, speed and rounding); 0: at most 64 (1 024 on a GPU, 16 with a
    #: planner), fewer where agents see many points, and four times as many with `--search backtrack`.
    batch: Natural = 0
    #: Engine that runs the worker processes: `local`, or `ray`, on the cluster at RAY_ADDRESS or one started here.
    engine: Engine = "local"
    #: Compile the steps of simulations, which takes minutes; `auto`: only on a GPU, if a run is long enough.
    compile: Compile = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.engine == "ray" and not self.device.startswith("cpu"):
            raise ConfigError(f"engine 'ray' works on CPUs only, device is '{self.device}'")
        if self.rollouts % self.trees:
            raise ConfigError(f"rollouts ({self.rollouts}) must be a multiple of trees ({self.trees})")
        if self.interactive != "all" and not 0 <= self.interactive <= MOST:
            raise ConfigError(f"interactive is 'all' or a number up to {MOST}, is {self.interactive}")
        for path in self.metric:
            if ":" not in path:
                raise ConfigError(f"metric is an import path such as my.metrics:jerk, not '{path}'")


@dataclass(frozen=True, kw_only=True)
class SimulateConfig(EvaluateConfig):
    """Settings of a simulation that is not compared with the log, so that open traffic can go on past its end."""

    #: Vehicles per second that want to enter on each lane that begins at the edge of the map, past the end of a log
    #: that is shorter than `duration`; by default as many as came in the log.
    inflow: Annotated[float | None, Bounds(0.0, MOST_INFLOW)] = None
    #: Seconds of green, amber and all red of each phase of the traffic lights past the end of the log; by default
    #: they keep the cycle that the log shows, or take 25, 3 and 2.
    lights: tuple[float, ...] = ()
    #: What happens to agents whose boxes overlap. `go-on`: nothing; `stop`: they stand still while they overlap;
    #: with `remove` they are gone from the next step on, with `respawn` until there is room where they began.
    after_collision: AfterCollision = "go-on"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lights and not (
            len(self.lights) == 3 and self.lights[0] > 0 and all(0 <= x < math.inf for x in self.lights)
        ):
            raise ConfigError(f"lights are three lengths in seconds, green above 0: not {self.lights}")


WosacScore = Literal["agent", "discriminator", "rule"]
"""Scores without the true flags: a simulation must not know beforehand what it is scored by."""
FUTURE, DT = 80, 0.1
"""Steps that the challenge asks for, and the seconds between them."""


@dataclass(frozen=True, kw_only=True)
class WosacSettings(SimulationConfig):
    """Settings of the simulation; each of the 32 rollouts of a search comes from a tree of its own."""

    #: Score that a search lowers. `agent`: as is best for the agent; `discriminator`: what its own one calls unreal;
    #: `rule`: collisions, also those half a second later if all keep speed and course, and time off the road.
    score: WosacScore = "agent"
    #: Share of the variance of an agent's random numbers that is drawn once per rollout, so that some agents are fast
    #: throughout and others slow; 0: every step draws anew. Logged drivers have .17 (simulated towns) or .32 (NGSIM).
    pace: Annotated[float, Bounds(0, 1)] = 0.25
    #: Give agents the routes of the log instead of sampled ones; for the score only, since it tells them the future.
    logged_goals: bool = False
    #: Seconds that are simulated and scored: the challenge's 8, or less for logs that are shorter. Scores of another
    #: horizon are those of an easier task; a submission has 8.
    horizon: float = 8.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seed < 0:
            raise ConfigError(f"seed must not be negative, is {self.seed}")
        if not 1.0 <= self.horizon <= FUTURE * DT or abs(self.horizon / DT - self.future) > 1e-6:
            raise ConfigError(f"horizon is 1 to 8 s, in steps of {DT:g} s, is {self.horizon:g}")

    @property
    def future(self) -> int:
        """The number of steps that are simulated and scored."""
        return round(self.horizon / DT)

    @classmethod
    def of(cls, config: EvaluateConfig) -> Self:
        """Return the settings of the same simulation of all agents; ConfigError if it searches by the true flags."""
        return cls(**config.simulation, logged_goals=config.logged_goals)

    def config(self, rollouts: int, seed: int) -> EvaluateConfig:
        """Return the settings of some rollouts, each from a tree of its own where there is a search."""
        same = self.simulation | {"logged_goals": self.logged_goals, "seed": seed}
        return EvaluateConfig(**same, rollouts=rollouts, trees=rollouts)
