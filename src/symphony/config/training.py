"""How agents are trained."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from tyro.conf import Positional, arg

from symphony.config.agent import ActionSpace, AgentConfig, AgentSpec, DiscriminatorConfig, SearchConfig
from symphony.config.checks import not_negative, one_of, positive
from symphony.config.evaluation import MOST
from symphony.errors import ConfigError
from symphony.keys import SEEN

Method = Literal["bc", "bc_h", "bc_ts", "bc_ts_h", "mgail", "mgail_h", "mgail_ts", "mgail_ts_h"]
"""Rows of the paper's tables, each with a recipe of its name: behavioural cloning or adversarial imitation through
the model (MGAIL), with goals (H: hierarchy), with tree search (TS), with both.
"""
METHODS: tuple[str, ...] = get_args(Method)
Cost = Literal["log_d", "non_saturating", "logit"]
MAX_SEED = (1 << 40) - 1
"""Of a training, which derives a number from it for every update."""


@dataclass(frozen=True, kw_only=True)
class MGAILConfig:
    """How a policy learns from the gradient of the discriminator (methods mgail*)."""

    regression: int = 2700
    """Updates of plain regression to the log before the adversarial ones, which need a start that stays on the road
    (0: none, as in the paper)."""
    head_start: int = 30
    """Updates of the discriminator alone after them."""
    rollouts: int = 16
    """Rollouts per update that the gradient goes through, drawn from those of the last search; all of them, if it has
    fewer.
    """
    learning_rate: float = 2e-4
    """Of the policy's Adam in the adversarial updates, falling to a tenth along a cosine."""
    cost: Cost = "non_saturating"
    """What the policy lowers, D the probability that a state is simulated: `log_d` (the paper; its gradient vanishes
    in the worst states), `non_saturating` -log(1 - D), or the `logit` of D."""
    expert_weight: float = 0.2
    """Weight of the regression to the log beside it (the paper: 0, which here ends in standing still)."""
    discriminator_updates: int = 2
    """Updates of the discriminator per update of the policy."""
    react: bool = False
    """Let the gradient also pass through the policy's reactions to what earlier actions changed."""
    truncate: int = 0
    """Steps after which the gradient is cut (0: never)."""
    checkpoint: int = 0
    """Steps simulated twice instead of being kept in memory for the gradient (0: all are kept)."""

    def __post_init__(self) -> None:
        one_of(self, "cost", get_args(Cost))
        positive(self, "rollouts", "learning_rate", "discriminator_updates")
        not_negative(self, "regression", "head_start", "expert_weight", "truncate", "checkpoint")

    @property
    def gradient(self) -> dict[str, Any]:
        """How the gradient reaches the policy, as :class:`symphony.objectives.MGAILLoss` takes it."""
        return {
            "cost": self.cost,
            "detach_keys": () if self.react else SEEN,
            "truncate": self.truncate,
            "checkpoint": self.checkpoint,
        }


@dataclass(frozen=True, kw_only=True)
class ValidationConfig:
    """How checkpoints are evaluated while training; the best of them is the agent."""

    data: Path | None = None
    """Store of run segments to evaluate them on; without one the last checkpoint is the agent."""
    every: int = 0
    """Updates between evaluations, a multiple of `checkpoint-every` (0: at every checkpoint)."""
    segments: int = 200
    """Run segments of it, evenly spaced (all, if there are fewer)."""
    rollouts: int = 4
    """Simulations of each."""

    def __post_init__(self) -> None:
        positive(self, "segments", "rollouts")
        not_negative(self, "every")


@dataclass(frozen=True, kw_only=True)
class PerturbConfig:
    """Logged states displaced, labelled with the action of a smooth return to the log."""

    share: float = 0.0
    """Of the expert states of an update (0: none, as in the paper)."""
    begin: int = 0
    """Updates before the first: a policy learns more from displaced states when it drives already."""
    along: float = 1.5
    """Standard deviation along the road, in metres, times a number between 0 and 1 drawn for each state."""
    across: float = 0.5
    """Likewise to the side, in metres; less below 4 m/s."""
    heading: float = 0.1
    """Likewise in radians; less below 4 m/s and above 8 m/s."""
    speed: float = 1.5
    """Likewise in m/s."""

    def __post_init__(self) -> None:
        not_negative(self, "share", "begin", "along", "across", "heading", "speed")
        if self.share > 1:
            raise ConfigError(f"share must not exceed 1, is {self.share}")

    def at(self, step: int) -> PerturbConfig | None:
        """What holds at an update; None where no state is displaced."""
        return self if self.share and step >= self.begin else None


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """What is learned from more often than the rest; all is drawn alike by default."""

    interactive: float = 1.0
    """How much more often states of interactive agents are drawn than those of other vehicles."""
    standing: float = 1.0
    """How often states below 0.5 m/s are drawn, relative to others."""
    hard: Path | None = None
    """Record of an evaluation on the store that is learned from (`symphony evaluate RUN --data STORE --json FILE`):
    run segments are drawn in proportion to the collision rate plus off-road time there."""
    even_sources: bool = False
    """Run segments of every source of logs (`sumo`, `womd`, ...; `symphony data info` counts them) are drawn as
    often as those of any other, however few there are."""
    share: float = 0.5
    """Of an update's run segments that are drawn so, with a record or even sources; the others are drawn evenly."""

    def __post_init__(self) -> None:
        positive(self, "interactive")
        not_negative(self, "standing", "share")
        if self.share > 1:
            raise ConfigError(f"share must not exceed 1, is {self.share}")

    @property
    def even(self) -> bool:
        """Whether all states count alike."""
        return self.interactive == self.standing == 1.0


@dataclass(frozen=True, kw_only=True)
class PreviewConfig:
    """What a run lets see of its agent while it trains: animated rollouts, and distributions of what it does."""

    every: int = 2000
    """Updates between previews, and one at the end of a run that has so many (0: never); by default this takes about
    a hundredth of the time on a CPU, or less."""
    segments: int = 8
    """Run segments simulated for it, evenly spaced over those that are validated on, or else learned from; the
    animation has the first two."""

    def __post_init__(self) -> None:
        positive(self, "segments")
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
    """Of the weights and of the order of the data."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    warm_start: Path | None = None
    """Folder of a run whose networks training starts from, its best checkpoint if it was validated, else its last
    (`RUN@last` or `RUN@3000` names another), or `pretrained:NAME`; new ones where that run has none."""
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    """Choice of the best checkpoint: that with the lowest collision rate plus off-road time (the paper)."""
    preview: PreviewConfig = field(default_factory=PreviewConfig)
    """Rollouts to look at, in `media` of the run's folder."""
    checkpoint_every: int = 1000
    """Updates between checkpoints."""
    log_every: int = 20
    """Updates between records of the metrics."""
    resume: bool = False
    """Go on from the last checkpoint in `out`; without it a folder that holds a run is refused."""
    wandb: Literal["offline", "online", "disabled"] = "offline"
    """Where Weights & Biases keeps the curves; a plain file has them in any case."""
    wandb_project: str = "symphony"
    """Its project."""
    wandb_group: str = ""
    """Its group of runs, such as the seeds of one experiment; empty for none."""
    wandb_tags: tuple[str, ...] = ()
    """Its tags."""
    device: str = "cpu"
    """`cpu`, `cuda` or `cuda:N`."""

    def __post_init__(self) -> None:
        positive(self, "steps", "clip", "checkpoint_every", "log_every")
        if abs(self.seed) > MAX_SEED:
            raise ConfigError(f"seed must be within ±{MAX_SEED}, is {self.seed}")
        if self.validation.every % self.checkpoint_every:
            raise ConfigError(
                f"validation.every ({self.validation.every}) must be a multiple of checkpoint-every "
                f"({self.checkpoint_every}): only checkpoints are evaluated"
            )


@dataclass(frozen=True, kw_only=True)
class TrainConfig(RunConfig):
    """Train agents."""

    method: Positional[Method]
    """What to train: behavioural cloning or MGAIL, with goals (h), with tree search (ts), with both."""
    duration: int = 0
    """Seconds of each run segment that are used (the paper: 10 and 20; 0: all there are)."""
    agent: AgentConfig = field(default_factory=AgentConfig)
    """The agent."""
    most_interactive: int = 0
    """Simulate more agents in some run segments: their number is drawn for each between `agent.interactive` and this
    one (methods that simulate; 0: always `agent.interactive`, as in the paper)."""
    segments: Annotated[int, arg(name="batch")] = 16
    """Run segments per update."""
    states: int = 1024
    """Expert states per update, drawn from those segments."""
    perturb: PerturbConfig = field(default_factory=PerturbConfig)
    """Displaced expert states."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    """Run segments and expert states drawn more often than others."""
    goals: int = 128
    """Expert routes per update of the goal policy (methods with H)."""
    learning_rate: float = 1e-2
    """Of Adam, falling to a tenth along a cosine."""
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
        positive(self, "states", "goals", "learning_rate")
        not_negative(self, "duration")
        if self.most_interactive and not self.agent.interactive <= self.most_interactive <= MOST:
            raise ConfigError(
                f"most-interactive is 0 or from agent.interactive ({self.agent.interactive}) to {MOST}, "
                f"is {self.most_interactive}"
            )

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
            "sampling": self.sampling,
            "most": self.most_interactive,
            "persona": self.agent.persona,
            # Lists of near points are for the CPU; a device compares all points and would only be sent them.
            "num_points": self.agent.num_points if self.device == "cpu" else 0,
        }

    def rates(self, optimizers: Iterable[str]) -> dict[str, float]:
        """Learning rates by network, before they fall."""
        own = {"discriminator": self.discriminator.learning_rate}
        return {name: own.get(name, self.learning_rate) for name in optimizers}
