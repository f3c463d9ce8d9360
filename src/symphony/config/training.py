"""How agents are trained."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from tyro.conf import Positional, Suppress, arg

from symphony.config.agent import ActionSpace, AgentConfig, AgentSpec, DiscriminatorConfig, SearchConfig
from symphony.config.checks import not_negative, one_of, positive
from symphony.errors import ConfigError
from symphony.keys import SEEN

Method = Literal["bc", "bc_h", "bc_ts", "bc_ts_h", "mgail", "mgail_h", "mgail_ts", "mgail_ts_h"]
"""Rows of the paper's tables, each with a recipe of its name: behavioural cloning or adversarial imitation through
the model (MGAIL), with goals (H: hierarchy), with tree search (TS), with both.
"""
METHODS: tuple[str, ...] = get_args(Method)
Cost = Literal["log_d", "non_saturating", "logit"]
GOALS = 128
"""Expert routes per update of the goal policy."""
DISCRIMINATOR_RATE = 1e-3
"""Learning rate of the discriminator's Adam, falling to a tenth along a cosine."""
MAX_SEED = (1 << 40) - 1
"""Largest seed of a training, which derives a number from it for every update."""


@dataclass(frozen=True, kw_only=True)
class MGAILConfig:
    """How a policy learns from the gradient of the discriminator (methods mgail*)."""

    regression: int = 2700
    """Updates of plain regression to the log before the adversarial ones, which need a start that stays on the road
    (0: none, as in the paper)."""
    head_start: int = 30
    """Updates of the discriminator alone after those of regression."""
    rollouts: int = 16
    """Rollouts per update that the gradient goes through, drawn from those of the last search; all of them, if it has
    fewer."""
    learning_rate: float = 2e-4
    """Learning rate of the policy's Adam in the adversarial updates, falling to a tenth along a cosine."""
    cost: Cost = "non_saturating"
    """Cost that the policy lowers, D the probability that a state is simulated: `log_d` (the paper; its gradient
    vanishes in the worst states), `non_saturating` -log(1 - D), or the `logit` of D."""
    expert_weight: float = 0.2
    """Weight of the regression to the log beside that cost (the paper: 0, which here ends in standing still)."""
    discriminator_updates: int = 2
    """Updates of the discriminator per update of the policy."""
    react: bool = False
    """Let the gradient also pass through the policy's reactions to what earlier actions changed."""
    truncate: int = 0
    """Steps after which the gradient is cut (0: never)."""

    def __post_init__(self) -> None:
        one_of(self, "cost", get_args(Cost))
        positive(self, "rollouts", "learning_rate", "discriminator_updates")
        not_negative(self, "regression", "head_start", "expert_weight", "truncate")

    @property
    def gradient(self) -> dict[str, Any]:
        """How the gradient reaches the policy, as :class:`symphony.objectives.MGAILLoss` takes it."""
        return {
            "cost": self.cost,
            "detach_keys": () if self.react else SEEN,
            "truncate": self.truncate,
        }


@dataclass(frozen=True, kw_only=True)
class ValidationConfig:
    """How checkpoints are evaluated while training; the best of them is the agent."""

    data: Path | None = None
    """Store of run segments to evaluate checkpoints on; without one the last checkpoint is the agent."""
    segments: int = 200
    """Run segments of that store, evenly spaced (all, if there are fewer)."""
    rollouts: int = 4
    """Rollouts of each run segment."""

    def __post_init__(self) -> None:
        positive(self, "segments", "rollouts")


@dataclass(frozen=True, kw_only=True)
class PerturbConfig:
    """Logged states displaced, labelled with the action of a smooth return to the log."""

    share: float = 0.0
    """Share of the expert states of an update that are displaced (0: none, as in the paper)."""
    begin: int = 0
    """Updates before the first with displaced states, from which a policy learns more when it drives already."""

    def __post_init__(self) -> None:
        not_negative(self, "share", "begin")
        if self.share > 1:
            raise ConfigError(f"share must not exceed 1, is {self.share}")

    def at(self, step: int) -> PerturbConfig | None:
        """What holds at an update; None where no state is displaced."""
        return self if self.share and step >= self.begin else None


@dataclass(frozen=True, kw_only=True)
class PreviewConfig:
    """What a run lets see of its agent while it trains: animated rollouts, and distributions of what it does."""

    every: int = 2000
    """Updates between previews, and one at the end of a run that has so many (0: never); by default this takes about
    a hundredth of the time on a CPU, or less."""

    def __post_init__(self) -> None:
        not_negative(self, "every")


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """What the trainer needs to know of a run, whatever is trained."""

    data: Path
    """Store of run segments to learn from (see `symphony data convert`)."""
    out: Path
    """Folder of the run: configuration, metrics, checkpoints."""
    steps: int = 3000
    """Updates (the paper: 70 000)."""
    seed: int = 0
    """Seed of the weights and of the order of the data."""
    warm_start: Path | None = None
    """Folder of a run whose networks training starts from, its best checkpoint if it was validated, else its last
    (`RUN@last` or `RUN@3000` names another), or `pretrained:NAME`; new ones where that run has none."""
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    """Choice of the best checkpoint: that with the lowest collision rate plus off-road time (the paper)."""
    preview: PreviewConfig = field(default_factory=PreviewConfig)
    """Rollouts to look at, in `media` of the run's folder."""
    checkpoint_every: int = 1000
    """Updates between checkpoints."""
    log_every: Annotated[int, Suppress] = 20
    """Updates between records of the metrics."""
    resume: bool = False
    """Go on from the last checkpoint in `out`; without it a folder that holds a run is refused."""
    wandb: Literal["offline", "online", "disabled"] = "offline"
    """Mode of Weights & Biases; a plain file has the curves in any case. The variables WANDB_PROJECT, WANDB_RUN_GROUP
    and WANDB_TAGS name project, group and tags."""
    device: str = "cpu"
    """Device that learns: `cpu`, `cuda` or `cuda:N`."""

    def __post_init__(self) -> None:
        positive(self, "steps", "checkpoint_every", "log_every")
        if abs(self.seed) > MAX_SEED:
            raise ConfigError(f"seed must be within ±{MAX_SEED}, is {self.seed}")


@dataclass(frozen=True, kw_only=True)
class TrainConfig(RunConfig):
    """Train agents."""

    method: Positional[Method]
    """Method to train: behavioural cloning or MGAIL, with goals (h), with tree search (ts), with both."""
    duration: int = 0
    """Seconds of each run segment that are used (the paper: 10 and 20; 0: all there are)."""
    agent: AgentConfig = field(default_factory=AgentConfig)
    """The agent."""
    segments: Annotated[int, arg(name="batch")] = 16
    """Run segments per update, and per search."""
    states: int = 1024
    """Expert states per update, drawn from those segments."""
    perturb: PerturbConfig = field(default_factory=PerturbConfig)
    """Displaced expert states."""
    learning_rate: float = 1e-2
    """Learning rate of Adam, falling to a tenth along a cosine."""
    search: SearchConfig = field(default_factory=SearchConfig)
    """The beam search (methods with TS; MGAIL without TS simulates as many rollouts and keeps all)."""
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    """The discriminator (methods with TS, and MGAIL)."""
    mgail: MGAILConfig = field(default_factory=MGAILConfig)
    """Adversarial learning (methods mgail*)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of(self, "method", METHODS)
        if self.segments < 1:  # by its name on the command line
            raise ConfigError(f"batch must be positive, is {self.segments}")
        positive(self, "states", "learning_rate")
        not_negative(self, "duration")

    def spec(
        self,
        action_space: ActionSpace,
        dt: float,
        *,
        goals: bool = False,
        discriminator: bool = False,
        searches: bool = False,
    ) -> AgentSpec:
        """What the agent is that a recipe trains.

        Args:
            action_space: its own.
            dt: seconds per step of what it learns from.
            goals: whether it follows routes.
            discriminator: whether it has one.
            searches: whether it is simulated with search.
        """
        return AgentSpec(
            action_space=action_space,
            dt=dt,
            duration=self.duration,
            goals=goals,
            agent=self.agent,
            discriminator=self.discriminator if discriminator else None,
            searches=searches,
            search=self.search,
        )

    @property
    def scenes(self) -> dict[str, Any]:
        """Which run segments are learned from and how they are drawn, as :class:`SceneDataset` takes it."""
        return {
            "interactive": self.agent.interactive,
            "duration": self.duration,
            "persona": self.agent.persona,
        }

    def rates(self, optimizers: Iterable[str]) -> dict[str, float]:
        """Learning rates by network, before they fall."""
        return {
            name: DISCRIMINATOR_RATE if name == "discriminator" else self.learning_rate for name in optimizers
        }
