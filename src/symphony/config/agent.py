"""What an agent is: what it observes, how large its networks are, how it is simulated."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, get_args

from tyro.conf import Fixed, Suppress, arg

from symphony.config.checks import at_most, not_negative, one_of, positive
from symphony.errors import ConfigError

ActionSpace = Literal["bicycle", "displacement"]
Features = Literal["clearance", "paper", "foresight"]
Score = Literal["discriminator", "flags", "rule"]
RULES = ("best", "systematic", "replace")


@dataclass(frozen=True, kw_only=True)
class AgentConfig:
    """What an agent observes and how large its networks are."""

    interactive: Annotated[int, arg(aliases=("--interactive",))] = 2
    """Interactive agents per run segment (the paper uses 2 and 8)."""
    num_points: int = 200
    """Nearest map and light points that the agent observes (the paper: 1 000)."""
    num_lights: int = 0
    """Nearest lights that the agent observes beside the points, however far they are (the paper: none)."""
    features: Literal["paper", "gaps"] = "paper"
    """Inputs of the policy. `paper`: objects and points around; `gaps`: also how far the agent is from the boxes of
    objects, now and within the next 2 s, were everyone to keep speed and course, and with goals where they are along
    its route."""
    goal_features: Annotated[Literal["points", "turns"], Fixed, Suppress] = field(
        default="turns", metadata={"before": "points"}
    )
    """What the goal policy observes of each route. `points`, of agents from before it could see more: where it is
    every 12 m; `turns`: also where it begins and how much it turns every 3 m, which tells where it changes lanes."""
    accelerations: int = 7
    """Levels of acceleration, an odd number (methods bc*; the paper: 7)."""
    cells: int = 0
    """Cells along and across of a histogram that displacements are drawn from, an odd number (methods mgail*; 0: one
    Gaussian instead, as in the paper)."""
    persona: bool = False
    """Drive in styles: the policy is told how closely the vehicle follows and how fast it drives among those of the
    log; in simulations that is drawn for each rollout, or given."""
    hidden: int = 64
    """Width of the element encoders; the action head is twice as wide."""
    encoder: str = "paper"
    """Encoder of policy and goal policy. `paper`: element MLPs and max-pool; or the import path of your own, with the
    signature of `symphony.modules.SceneEncoder`."""
    policy: str = "paper"
    """Policy: `paper`, or the import path of a function from an `AgentSpec` to a policy module."""
    GONE: ClassVar[dict[str, Any]] = {"num_objects": 16, "head": lambda values: 2 * values.get("hidden", 64)}

    def __post_init__(self) -> None:
        positive(self, "interactive", "num_points", "hidden")
        not_negative(self, "num_lights", "cells")
        at_most(self, 10_000, "num_points", "num_lights")
        at_most(self, 1001, "accelerations", "cells")
        one_of(self, "features", ["paper", "gaps"])
        one_of(self, "goal_features", ["points", "turns"])
        if self.accelerations < 3 or self.accelerations % 2 == 0:
            raise ConfigError(f"accelerations must be odd and at least 3, is {self.accelerations}")
        if self.cells and (self.cells < 3 or self.cells % 2 == 0):
            raise ConfigError(f"cells must be odd and at least 3, or 0, is {self.cells}")
        one_of(self, "encoder", ["paper"], path=True)
        one_of(self, "policy", ["paper"], path=True)


@dataclass(frozen=True, kw_only=True)
class DiscriminatorConfig:
    """The network that scores realism, and how it learns."""

    features: Features = "clearance"
    """Inputs of the discriminator. `paper`: objects and points around; `clearance`: also gaps between boxes and
    distances to the road's edge; `foresight`: also the gaps within the next 2 s, were everyone to keep speed and
    course."""
    hidden: Annotated[int, Suppress] = 32
    """Width of the discriminator's encoders; its head is twice as wide."""
    network: str = "paper"
    """Discriminator: `paper`, or the import path of a function from an `AgentSpec` to a module that writes one logit
    per agent."""
    GONE: ClassVar[dict[str, Any]] = {
        "radius": 20.0,
        "head": lambda values: 2 * values.get("hidden", 32),
    } | dict.fromkeys(("states", "learning_rate", "gradient_penalty", "instance_noise"), ...)

    def __post_init__(self) -> None:
        one_of(self, "features", get_args(Features))
        one_of(self, "network", ["paper"], path=True)
        positive(self, "hidden")


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """The beam search and what is learned from it."""

    branches: int = 4
    """Branches per run segment in training (S)."""
    test_branches: int = 16
    """Branches per run segment in evaluation."""
    prune_every: int = 2
    """Steps between prunings (T_p; 10 in the paper)."""
    rule: str = "systematic"
    """Rule that prunes. `best`: the better half of the branches survives (the paper); `systematic`: every branch gets
    copies in proportion to exp(-score / temperature), as in a particle filter, which bears and wants more prunings;
    `replace`: only branches above `threshold` make room, for copies of others, of the same goals where there are any;
    or the import path of a pruning rule of your own."""
    temperature: float = 0.6
    """Temperature of rule `systematic`: the lower, the stricter."""
    threshold: float = 1.0
    """Highest total, in logits of the discriminator, that a branch goes on with under rule `replace`."""
    goals: Literal["tree", "branch"] = "tree"
    """Branches that draw goals together: all of a `tree` (the paper), or each `branch` alone."""
    way: Annotated[Literal["tree", "backtrack"], Fixed, Suppress] = "tree"
    """Search that the agent is simulated with unless something else is asked for: `tree` (the paper), `backtrack`."""
    score: Annotated[Score, Fixed, Suppress] = "discriminator"
    """Score that this search lowers."""
    updates: int = 10
    """Updates made from the results of one search before the next."""
    states: int = 256
    """States per update of the surviving rollouts for the policy, and of the simulated and the logged ones each for
    the discriminator; every state is of all its interactive agents."""
    GONE: ClassVar[dict[str, Any]] = {
        "keep": 0.5,
        "aggregate": "max_then_sum",
    } | dict.fromkeys(("segments", "weight", "survivors"), ...)

    def __post_init__(self) -> None:
        positive(self, "branches", "test_branches", "prune_every", "temperature", "updates", "states")
        at_most(self, 10_000, "branches", "test_branches")
        one_of(self, "goals", ["tree", "branch"])
        one_of(self, "rule", RULES, path=True)
        one_of(self, "way", ["tree", "backtrack"])
        one_of(self, "score", get_args(Score))


@dataclass(frozen=True, kw_only=True)
class AgentSpec:
    """All that it takes to build an agent's networks anew and to simulate it as it was trained; kept in its folder.

    Attributes:
        action_space: `bicycle`, discrete actions; `displacement`, continuous ones that gradients pass (section V-A).
        dt: seconds per step it learned.
        duration: seconds of a segment it learned from; 0 for all.
        goals: whether it follows routes.
        agent: what it observes and how large it is.
        discriminator: of its discriminator; None without one.
        searches: whether it is meant to be simulated with search.
        search: how.
    """

    action_space: ActionSpace
    dt: float
    duration: int = 0
    goals: bool = False
    agent: AgentConfig = field(default_factory=AgentConfig)
    discriminator: DiscriminatorConfig | None = None
    searches: bool = False
    search: SearchConfig = field(default_factory=SearchConfig)

    def __post_init__(self) -> None:
        one_of(self, "action_space", get_args(ActionSpace))
        positive(self, "dt")
        not_negative(self, "duration")
        if self.searches and self.discriminator is None and self.search.score == "discriminator":
            raise ConfigError("an agent that searches needs a discriminator")
        if self.agent.cells and self.action_space != "displacement":
            raise ConfigError(
                f"cells are of displacements, and the actions are those of a {self.action_space}"
            )

    @property
    def code(self) -> dict[str, str]:
        """Import paths of code that is not this package's, by the settings that name them."""
        network = "" if self.discriminator is None else self.discriminator.network
        paths = {
            "agent.encoder": self.agent.encoder,
            "agent.policy": self.agent.policy,
            "discriminator.network": network,
            "search.rule": self.search.rule,
        }
        return {name: path for name, path in paths.items() if ":" in path}
