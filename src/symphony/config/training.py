"""Settings of a training."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from tyro.conf import Positional, Suppress, arg

from symphony.config.agent import ActionSpace, AgentConfig, AgentSpec, DiscriminatorConfig, SearchConfig
from symphony.config.checks import Bounds, Count, Natural, NotNegative, Positive, Settings
from symphony.config.evaluation import Compile, compiles
from symphony.keys import SEEN

Row = Literal["bc", "bc_h", "bc_ts", "bc_ts_h", "mgail", "mgail_h", "mgail_ts", "mgail_ts_h"]
"""Rows of the paper's tables: behavioural cloning or MGAIL, with goals (H: hierarchy), tree search (TS), or both."""
METHODS: tuple[str, ...] = get_args(Row)
Method = Literal[Row, "bc_rl", "bc_rl_h"]
"""Methods that have a recipe: also BC and BC+H with a policy gradient (RL), which is not in the paper."""
Cost = Literal["log_d", "non_saturating", "logit"]
DISCRIMINATOR_RATE = 1e-3
"""Learning rate of the discriminator's Adam, falling to a tenth along a cosine."""
ROWS, AGE = 256, 32
"""Run segments that a card searches in the time of 16, and the greatest age, in updates, of states to learn from."""
MAX_SEED = (1 << 40) - 1
"""Largest seed of a training, which derives a number from it for every update."""


@dataclass(frozen=True, kw_only=True)
class MGAILConfig(Settings):
    """Settings of learning from the gradient of the discriminator (methods mgail*)."""

    #: Updates of plain regression to the log before the adversarial ones, which need a start that stays on the
    #: road (0: none, as in the paper).
    regression: Natural = 2700
    head_start: Natural = 30  # Updates of the discriminator alone after those of regression.
    #: Rollouts per update that the gradient goes through, drawn from those of the last search (at most all of them).
    rollouts: Count = 16
    #: Learning rate of the policy's Adam in the adversarial updates, falling to a tenth along a cosine.
    learning_rate: Positive = 2e-4
    #: Cost that the policy lowers, D the probability that a state is simulated: `log_d` (the paper; its gradient
    #: vanishes in the worst states), `non_saturating` -log(1 - D), or the `logit` of D.
    cost: Cost = "non_saturating"
    #: Weight of the regression to the log beside that cost (the paper: 0, which here ends in standing still).
    expert_weight: NotNegative = 0.2
    discriminator_updates: Count = 2  # Updates of the discriminator per update of the policy.
    #: Let the gradient also pass through the policy's reactions to what earlier actions changed.
    react: bool = False
    truncate: Natural = 0  # Steps after which the gradient is cut (0: never).

    @property
    def gradient(self) -> dict[str, Any]:
        """The settings of the gradient to the policy, as :class:`symphony.objectives.MGAILLoss` takes them."""
        return {"cost": self.cost, "detach_keys": () if self.react else SEEN, "truncate": self.truncate}


@dataclass(frozen=True, kw_only=True)
class ValidationConfig(Settings):
    """Settings of the evaluation of checkpoints during training; the best of them is the agent."""

    #: Store of run segments to evaluate checkpoints on; without one the last checkpoint is the agent.
    data: Path | None = None
    segments: Count = 200  # Run segments of that store, evenly spaced (all, if there are fewer).
    rollouts: Count = 4  # Rollouts of each run segment.


@dataclass(frozen=True, kw_only=True)
class PerturbConfig(Settings):
    """Settings of logged states that are displaced and labelled with the action of a smooth return to the log."""

    #: Share of the expert states of an update that are displaced (0: none, as in the paper).
    share: Annotated[float, Bounds(0, 1)] = 0.0
    #: Updates before the first with displaced states, from which a policy learns more when it drives already.
    begin: Natural = 0

    def at(self, step: int) -> PerturbConfig | None:
        """Return the settings at an update; None where no state is displaced."""
        return self if self.share and step >= self.begin else None


@dataclass(frozen=True, kw_only=True)
class PreviewConfig(Settings):
    """Settings of previews of an agent in training: animated rollouts."""

    #: Updates between previews, and one at the end of a run of that length (0: never); by default this takes about a
    #: hundredth of the time on a CPU, or less.
    every: Natural = 2000


@dataclass(frozen=True, kw_only=True)
class RunConfig(Settings):
    """Settings of a run that the trainer needs, whatever is trained."""

    data: Path  # Store of run segments to learn from (see `symphony data convert`).
    out: Path  # Folder of the run: configuration, metrics, checkpoints.
    steps: Count = 3000  # Updates of the networks (the paper: 70 000).
    seed: Annotated[int, Bounds(-MAX_SEED, MAX_SEED)] = 0  # Seed of the weights and of the order of the data.
    #: Run whose networks training starts from, or `pretrained:NAME`: its best checkpoint if it was validated, else
    #: its last (`RUN@last` or `RUN@3000` names another). A network that this run lacks starts anew.
    warm_start: Path | None = None
    #: Choice of the best checkpoint: that with the lowest collision rate plus off-road time (the paper).
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    #: Rollouts to look at, in `media` of the run's folder.
    preview: PreviewConfig = field(default_factory=PreviewConfig)
    checkpoint_every: Count = 1000  # Updates between checkpoints.
    log_every: Annotated[Count, Suppress] = 20  # Updates between records of the metrics.
    #: Go on from the last checkpoint in `out`; without it a folder that holds a run is refused.
    resume: bool = False
    #: Mode of Weights & Biases; a plain file has the curves in any case. The variables WANDB_PROJECT, WANDB_RUN_GROUP
    #: and WANDB_TAGS name project, group and tags.
    wandb: Literal["offline", "online", "disabled"] = "offline"
    device: str = "cpu"  # Device to train on: `cpu`, `cuda` or `cuda:N`.
    #: Compile the steps of searches and of MGAIL, which takes minutes; `auto`: only on a GPU, if a run is long.
    compile: Compile = "auto"


@dataclass(frozen=True, kw_only=True)
class TrainConfig(RunConfig):
    """All settings of a training."""

    #: Method to train: behavioural cloning (bc) or MGAIL, with goals (h), tree search (ts) or both; `rl` adds to
    #: cloning a policy gradient against collisions in closed loop, for an agent that already drives (--warm-start).
    method: Positional[Method]
    #: Seconds of each run segment that are used (the paper: 10 and 20; 0: all there are).
    duration: Natural = 0
    agent: AgentConfig = field(default_factory=AgentConfig)  # What the agent observes, its networks.
    segments: Annotated[Count, arg(name="batch")] = 16  # Run segments per update, and per search.
    #: Searches made together, for this many times `search.updates` to come; 0: one, on a device more (see `rows`).
    together: Annotated[Natural, Suppress] = 0
    states: Count = 1024  # Expert states per update, drawn from those segments.
    perturb: PerturbConfig = field(default_factory=PerturbConfig)  # Displaced expert states.
    learning_rate: Positive = 1e-2  # Learning rate of Adam (the discriminator's is 0.001), which falls to a tenth.
    #: The beam search (methods with TS; MGAIL without TS simulates as many rollouts and keeps all).
    search: SearchConfig = field(default_factory=SearchConfig)
    #: The discriminator (methods with TS, and MGAIL).
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    mgail: MGAILConfig = field(default_factory=MGAILConfig)  # Adversarial learning (methods mgail*).

    def spec(self, action_space: ActionSpace, dt: float, *, discriminator: bool = False, **more: Any) -> AgentSpec:
        """Return the specification of the agent that a recipe trains.

        Args:
            action_space: that of the agent.
            dt: seconds per step of the training data.
            discriminator: whether it has one.
            more: ``goals``, whether it follows routes; ``searches``, whether it is simulated with search.
        """
        parts: dict[str, Any] = {"agent": self.agent, "search": self.search, "duration": self.duration}
        parts["discriminator"] = self.discriminator if discriminator else None
        return AgentSpec(action_space=action_space, dt=dt, **parts, **more)

    @property
    def scenes(self) -> dict[str, Any]:
        """The choice of run segments to learn from and how they are drawn, as :class:`SceneDataset` takes it."""
        together = self.rows(1 << 30) // self.segments
        few_shapes = compiles(self.compile, self.device, self.steps // (self.search.updates * together))
        how = {"interactive": self.agent.interactive, "duration": self.duration}
        return how | {"few_shapes": few_shapes}

    def rows(self, segments: int) -> int:
        """Return how many of ``segments`` run segments are searched together: on a device up to :data:`ROWS`, as long
        as no update learns from states :data:`AGE` updates old, and checkpoints come between searches.
        """
        each, every = min(self.segments, segments), self.search.updates
        most = 1 if self.device.startswith("cpu") else min(ROWS // each, AGE // every, segments // each)
        fits = (k for k in range(most, 1, -1) if self.checkpoint_every % (k * every) == 0)
        return each * (min(self.together, segments // each) or next(fits, 1))

    def rates(self, optimizers: Iterable[str]) -> dict[str, float]:
        """Return the learning rates by network, before they fall."""
        own = {"discriminator": DISCRIMINATOR_RATE}
        return {name: own.get(name, self.learning_rate) for name in optimizers}
