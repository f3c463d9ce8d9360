"""The configuration of an agent: what it observes, how large its networks are, how it is simulated."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from tyro.conf import Fixed, Suppress, arg

from symphony.config.checks import Bounds, Count, Names, Natural, Positive, Settings
from symphony.errors import ConfigError

ActionSpace = Literal["bicycle", "displacement"]
Features = Literal["clearance", "paper", "foresight"]
Score = Literal["discriminator", "flags", "rule"]
Rule = Annotated[str, Names(("best", "systematic", "replace"))]
Own = Annotated[str, Names(["paper"])]
MOST = 10_000
"""The most that the file of an agent may ask for: agents, points of each kind, branches, the width of a network."""
Size = Annotated[int, Bounds(1, MOST)]


@dataclass(frozen=True, kw_only=True)
class AgentConfig(Settings):
    """The observation of an agent and the sizes of its networks."""

    #: Interactive agents per run segment (the paper uses 2 and 8).
    interactive: Annotated[Size, arg(aliases=("--interactive",))] = 2
    #: Nearest map and light points that the agent observes (the paper: 1 000).
    num_points: Size = 200
    #: Nearest lights that the agent observes beside the points, however far they are (the paper: none).
    num_lights: Annotated[int, Bounds(0, MOST)] = 0
    #: Inputs of the policy. `paper`: objects and points around; `gaps`: also how far the agent is from the boxes of
    #: objects, now and within 2 s if all keep speed and course, and with goals where they are along its route.
    features: Literal["paper", "gaps"] = "paper"
    #: Levels of acceleration, an odd number (methods bc*; the paper: 7).
    accelerations: Annotated[int, Bounds(1, 1001)] = 7
    #: Cells along and across of a histogram that displacements are drawn from, an odd number (methods mgail*; 0: one
    #: Gaussian instead, as in the paper).
    cells: Annotated[int, Bounds(0, 1001)] = 0
    hidden: Size = 64  # Width of the element encoders; the action head is twice as wide.
    #: Encoder of policy and goal policy. `paper`: element MLPs and max-pool; or the import path of your own, with the
    #: signature of `symphony.modules.SceneEncoder`.
    encoder: Own = "paper"
    #: Policy: `paper`, or the import path of a function from an `AgentSpec` to a policy module.
    policy: Own = "paper"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("accelerations", "cells"):
            if (value := getattr(self, name)) and (value < 3 or value % 2 == 0):
                raise ConfigError(f"{name} must be odd and at least 3, is {value}")


@dataclass(frozen=True, kw_only=True)
class DiscriminatorConfig(Settings):
    """The network that scores realism, and how it learns."""

    #: Inputs of the discriminator. `paper`: objects and points around; `clearance`: also gaps between boxes and
    #: distances to the road's edge; `foresight`: also the gaps within the next 2 s if all keep speed and course.
    features: Features = "clearance"
    #: Width of the discriminator's encoders; its head is twice as wide.
    hidden: Annotated[Size, Suppress] = 32
    #: Discriminator: `paper`, or the import path of a function from an `AgentSpec` to a module that writes logits.
    network: Own = "paper"


@dataclass(frozen=True, kw_only=True)
class SearchConfig(Settings):
    """The beam search and what is learned from it."""

    branches: Size = 4  # Branches per run segment in training (S).
    test_branches: Size = 16  # Branches per run segment in evaluation.
    prune_every: Count = 2  # Steps between prunings (T_p; 10 in the paper).
    #: Rule that prunes. `best`: the better half of the branches survives (the paper); `systematic`: a branch gets
    #: copies in proportion to exp(-score / temperature), as in a particle filter, and should be pruned more often;
    #: with `replace`, a branch whose score is above `threshold` makes room for a copy of another, with the same goals
    #: if there is one; or the import path of a pruning rule of your own.
    rule: Rule = "systematic"
    temperature: Positive = 0.6  # Temperature of rule `systematic`: the lower, the stricter.
    #: Highest score, in logits of the discriminator, with which rule `replace` lets a branch go on.
    threshold: float = 1.0
    #: Whether branches share goals. `tree`: all branches of a tree do (the paper); `branch`: each draws its own.
    goals: Literal["tree", "branch"] = "tree"
    #: Search that the agent is simulated with by default: `tree` (the paper), `backtrack`.
    way: Annotated[Literal["tree", "backtrack"], Fixed, Suppress] = "tree"
    score: Annotated[Score, Fixed, Suppress] = "discriminator"  # Score that this search lowers.
    updates: Count = 10  # Updates made from the results of one search before the next.
    #: States per update: the policy learns from this many states of the surviving rollouts, the discriminator from
    #: this many of all rollouts and as many of the log; a state is that of all interactive agents of its run segment.
    states: Count = 256


@dataclass(frozen=True, kw_only=True)
class AgentSpec(Settings):
    """All that is needed to build an agent's networks again and to simulate it as trained; kept in its folder."""

    #: Kind of actions: `bicycle`, discrete ones; `displacement`, continuous ones that gradients pass (section III-C).
    action_space: ActionSpace
    dt: Positive  # Seconds per step it learned.
    duration: Natural = 0  # Seconds of a segment it learned from; 0 for all.
    goals: bool = False  # Whether it follows routes.
    agent: AgentConfig = field(default_factory=AgentConfig)
    discriminator: DiscriminatorConfig | None = None
    searches: bool = False  # Whether it is meant to be simulated with search.
    search: SearchConfig = field(default_factory=SearchConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.searches and self.discriminator is None and self.search.score == "discriminator":
            raise ConfigError("an agent that searches needs a discriminator")
        if self.agent.cells and self.action_space != "displacement":
            raise ConfigError(f"cells are of displacements, and the actions those of a {self.action_space}")

    @property
    def code(self) -> dict[str, str]:
        """The import paths of code that is not this package's, by the settings that name them."""
        paths = {"agent.encoder": self.agent.encoder, "agent.policy": self.agent.policy}
        paths |= {} if self.discriminator is None else {"discriminator.network": self.discriminator.network}
        paths["search.rule"] = self.search.rule
        return {name: path for name, path in paths.items() if ":" in path}
