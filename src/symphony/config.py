"""Every setting of training and evaluation, in one typed place; field docstrings are the command line's help.

Imports nothing heavy, so that ``--help`` answers at once.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from tyro.conf import Positional, arg

from symphony.errors import ConfigError

FORMAT = 2
"""Version of a saved configuration."""


def _positive(config: Any, *names: str) -> None:
    for name in names:
        if not getattr(config, name) > 0:
            raise ConfigError(f"{name.replace('_', '-')} must be positive, is {getattr(config, name)}")


def _not_negative(config: Any, *names: str) -> None:
    for name in names:
        if getattr(config, name) < 0:
            raise ConfigError(f"{name.replace('_', '-')} must not be negative, is {getattr(config, name)}")


def _one_of(config: Any, name: str, known: Any) -> None:
    if getattr(config, name) not in get_args(known):
        raise ConfigError(
            f"{name.replace('_', '-')} is one of {', '.join(get_args(known))}, not '{getattr(config, name)}'"
        )


Method = Literal["bc", "bc_h", "bc_ts", "bc_ts_h", "mgail", "mgail_h", "mgail_ts", "mgail_ts_h"]
"""Rows of the paper's tables: behavioural cloning or adversarial imitation through the model (MGAIL), with goals (H:
hierarchy), with tree search (TS), with both.
"""

Features = Literal["clearance", "paper", "foresight"]
Rule = Literal["best", "systematic"]
Survivors = Literal["all", "best"]
Cost = Literal["log_d", "non_saturating", "logit"]
Search = Literal["agent", "none", "tree", "oracle", "best"]
Setting = Literal["main", "long", "many"]
"""Of the paper's tables: 10 s with 2 interactive agents, 20 s with 2, 10 s with 8."""
PaperData = Literal["proprietary", "womd"]
"""Data sets whose figures the paper gives."""
TableFormat = Literal["text", "markdown", "latex", "json"]


@dataclass(frozen=True)
class AgentConfig:
    """What an agent sees and how large its networks are; saved with its weights."""

    interactive: Annotated[int, arg(aliases=("--interactive",))] = 2
    """Interactive agents per run segment (the paper uses 2 and 8)."""
    num_objects: int = 16
    """Nearest other agents it sees."""
    num_points: int = 200
    """Nearest map and light points it sees (the paper: 1 000)."""
    hidden: int = 64
    """Width of the element encoders."""
    head: int = 128
    """Width of the action head."""

    def __post_init__(self) -> None:
        _positive(self, "interactive", "num_objects", "num_points", "hidden", "head")


@dataclass(frozen=True)
class DiscriminatorConfig:
    """The network that judges realism, and how it learns."""

    features: Features = "clearance"
    """`paper`: objects and points around; `clearance`: also gaps between boxes and distances to the road's edge;
    `foresight`: also the gaps within the next 2 s, were everyone to keep speed and course."""
    radius: float = 20.0
    """Metres around an agent that it sees."""
    hidden: int = 32
    """Width of its encoders."""
    head: int = 64
    """Width of its head."""
    states: int = 256
    """States of either kind (simulated, logged) per update, each with all its interactive agents."""
    learning_rate: float = 1e-3
    """Of its Adam."""
    gradient_penalty: float = 0.0
    """Weight of the squared gradient at logged states (0: none)."""
    instance_noise: float = 0.0
    """Standard deviation of noise on what it sees in training (0: none)."""

    def __post_init__(self) -> None:
        _one_of(self, "features", Features)
        _positive(self, "radius", "hidden", "head", "states", "learning_rate")
        _not_negative(self, "gradient_penalty", "instance_noise")


@dataclass(frozen=True)
class SearchConfig:
    """The beam search and what is learned from it (methods with TS)."""

    branches: int = 4
    """Branches per run segment in training (S)."""
    test_branches: int = 16
    """Branches per run segment in evaluation."""
    prune_every: int = 2
    """Steps between prunings (T_p; 10 in the paper)."""
    rule: Rule = "systematic"
    """`best`: the better share of the branches survives (the paper); `systematic`: every branch gets copies in
    proportion to exp(-score / temperature), as in a particle filter, which bears and wants more prunings."""
    keep: float = 0.5
    """Share of the branches that survives a pruning with rule `best`."""
    temperature: float = 0.6
    """Of rule `systematic`: the lower, the stricter."""
    segments: int = 16
    """Run segments searched at a time."""
    updates: int = 10
    """Updates made from the results of one search before the next."""
    states: int = 256
    """States of surviving rollouts per update, each with all its interactive agents."""
    weight: float = 1.0
    """Of the surviving rollouts beside the expert data in the policy's loss."""
    survivors: Survivors = "all"
    """Learn from every surviving branch or only from the best of each tree."""

    def __post_init__(self) -> None:
        _positive(
            self,
            "branches",
            "test_branches",
            "prune_every",
            "keep",
            "temperature",
            "segments",
            "updates",
            "states",
        )
        _one_of(self, "survivors", Survivors)
        _one_of(self, "rule", Rule)
        if self.keep > 1:
            raise ConfigError(f"keep must not exceed 1, is {self.keep}")
        _not_negative(self, "weight")


@dataclass(frozen=True)
class MGAILConfig:
    """How a policy learns from the gradient of the discriminator (methods mgail*)."""

    regression: int = 2000
    """Updates of plain regression to the log before the adversarial ones (0: none, as in the paper)."""
    head_start: int = 50
    """Updates of the discriminator alone after them."""
    rollouts: int = 16
    """Rollouts per update that the gradient goes through, drawn from those of the last search."""
    learning_rate: float = 2e-4
    """Of the policy's Adam in the adversarial updates, falling to a tenth along a cosine."""
    cost: Cost = "non_saturating"
    """What the policy lowers, D the probability that a state is simulated: `log_d` (the paper; its gradient vanishes
    in the worst states), `non_saturating` -log(1 - D), or the `logit` of D."""
    expert_weight: float = 0.0
    """Weight of the regression to the log beside it."""
    discriminator_updates: int = 1
    """Updates of the discriminator per update of the policy."""
    react: bool = False
    """Let the gradient also pass through the policy's reactions to what earlier actions changed."""
    truncate: int = 0
    """Steps after which the gradient is cut (0: never)."""
    checkpoint: int = 0
    """Steps simulated twice instead of being kept in memory for the gradient (0: all are kept)."""

    def __post_init__(self) -> None:
        _one_of(self, "cost", Cost)
        _positive(self, "rollouts", "learning_rate", "discriminator_updates")
        _not_negative(self, "regression", "head_start", "expert_weight", "truncate", "checkpoint")


@dataclass(frozen=True)
class ValidationConfig:
    """How checkpoints are judged while training; the best of them is the agent."""

    data: Path | None = None
    """Store of run segments to judge them on; without one the last checkpoint is the agent."""
    every: int = 0
    """Updates between judgements, a multiple of `checkpoint-every` (0: at every checkpoint)."""
    segments: int = 200
    """Run segments of it, evenly spaced (all, if there are fewer)."""
    rollouts: int = 4
    """Simulations of each."""

    def __post_init__(self) -> None:
        _positive(self, "segments", "rollouts")
        _not_negative(self, "every")


@dataclass(frozen=True)
class ShowConfig:
    """What a run lets see of its agent while it trains: animated rollouts, and distributions of what it does."""

    every: int = 2000
    """Updates after which it is shown, and once more at the end of a run that has so many (0: never); by default this
    takes about a hundredth of the time on a CPU, or less."""
    segments: int = 8
    """Run segments simulated for it, evenly spaced over those that are validated on, or else learned from; the
    animation has the first two."""

    def __post_init__(self) -> None:
        _positive(self, "segments")
        _not_negative(self, "every")


@dataclass(frozen=True)
class TrainConfig:
    """Train agents."""

    method: Positional[Method]
    """What to train: behavioural cloning or MGAIL, with goals (h), with tree search (ts), with both."""
    data: Path
    """Store of run segments to learn from (see `symphony data convert`)."""
    out: Path
    """Folder of the run: configuration, metrics, checkpoints."""
    steps: int = 3000
    """Updates (the paper: 70 000)."""
    seed: int = 0
    """Of the weights and of the order of the data."""
    duration: int = 0
    """Seconds of each run segment that are used (the paper: 10 and 20; 0: all there are)."""
    agent: AgentConfig = field(default_factory=AgentConfig)
    """The agent."""
    segments: int = 16
    """Run segments per update."""
    states: int = 1024
    """Expert states per update, drawn from those segments."""
    goals: int = 128
    """Expert routes per update of the goal policy (methods with H)."""
    learning_rate: float = 1e-3
    """Of Adam, falling to a tenth along a cosine."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    search: SearchConfig = field(default_factory=SearchConfig)
    """The beam search (methods with TS; MGAIL without TS simulates as many rollouts and keeps all)."""
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    """The discriminator (methods with TS, and MGAIL)."""
    mgail: MGAILConfig = field(default_factory=MGAILConfig)
    """Adversarial learning (methods mgail*)."""
    warm_start: Path | None = None
    """Folder of a run whose networks training starts from, its best checkpoint if it was validated, else its last
    (`RUN@last` or `RUN@3000` names another), or `pretrained:NAME`; new ones where that run has none."""
    validation: ValidationConfig = field(default_factory=ValidationConfig)
    """Choice of the best checkpoint: that with the lowest collision rate plus off-road time (the paper)."""
    show: ShowConfig = field(default_factory=ShowConfig)
    """Rollouts to look at, in `media` of the run's folder."""
    checkpoint_every: int = 1000
    """Updates between checkpoints."""
    log_every: int = 20
    """Updates between records of the metrics."""
    resume: bool = False
    """Go on from the last checkpoint in `out`; without it a folder that holds a run is refused."""
    wandb: Literal["offline", "online", "disabled"] = "offline"
    """Where Weights & Biases keeps the curves; a plain file has them in any case."""
    device: str = "cpu"
    """`cpu`, `cuda` or `cuda:N`."""

    def __post_init__(self) -> None:
        _one_of(self, "method", Method)
        _positive(self, "steps", "segments", "states", "goals", "learning_rate", "clip")
        _positive(self, "checkpoint_every", "log_every")
        _not_negative(self, "duration")
        if self.judged and self.checkpoint_every % self.search.updates:
            raise ConfigError(
                f"checkpoint-every ({self.checkpoint_every}) must be a multiple of search.updates "
                f"({self.search.updates}), so that a resumed run repeats no search"
            )
        if self.validation.every % self.checkpoint_every:
            raise ConfigError(
                f"validation.every ({self.validation.every}) must be a multiple of checkpoint-every "
                f"({self.checkpoint_every}): only checkpoints are judged"
            )
        too_many = self.validation.rollouts > self.search.test_branches
        if self.validation.data is not None and self.searches and too_many:
            raise ConfigError(
                f"validation.rollouts ({self.validation.rollouts}) must not exceed search.test-branches "
                f"({self.search.test_branches}), the branches of one tree"
            )

    @property
    def hierarchical(self) -> bool:
        """Whether agents follow goals."""
        return self.method.endswith("_h")

    @property
    def searches(self) -> bool:
        """Whether rollouts are refined by the search."""
        return "_ts" in self.method

    @property
    def adversarial(self) -> bool:
        """Whether the policy learns from the gradient of the discriminator."""
        return self.method.startswith("mgail")

    @property
    def judged(self) -> bool:
        """Whether there is a discriminator."""
        return self.searches or self.adversarial


@dataclass(frozen=True)
class EvaluateConfig:
    """How agents are judged."""

    rollouts: int = 16
    """Simulations per run segment that are judged."""
    search: Search = "agent"
    """`agent`: as it was trained; `none`; `tree`: beam search by its discriminator; `oracle`: by the true collision
    and off-road flags; `best`: independent rollouts, of which the one with the best score is judged."""
    trees: int = 1
    """Search trees per run segment, each with goals of its own; each gives its share of the rollouts."""
    branches: int = 0
    """Branches of each tree; 0: as many as the agent's `search.test-branches`."""
    rule: Literal["agent"] | Rule = "agent"
    """How trees are pruned: `agent` as it was trained, else see `search.rule` of training."""
    prune_every: int = 0
    """Steps between prunings; 0: as the agent was trained."""
    temperature: float = 0.0
    """Of rule `systematic`; 0: as the agent was trained."""
    retries: int = 0
    """How often the steps between two prunings are simulated again for branches that end them with a score above
    `retry-above` (each time costs as much as the whole search)."""
    retry_above: float = 0.0
    """Of a branch: the highest logit of the discriminator within those steps, summed over its agents."""
    logged_goals: bool = False
    """Give agents the routes of the log instead of sampled ones."""
    seed: int = 0
    """Of everything drawn at random in them."""
    duration: int = 0
    """Seconds of each run segment that are simulated; 0 takes what the agent was trained with."""
    interactive: int = 0
    """Interactive agents per run segment; 0 takes what the agent was trained with (2 for the baselines)."""
    batch: int = 16
    """Run segments simulated at a time (changes memory and speed, not results)."""
    device: str = "cpu"
    """`cpu`, `cuda` or `cuda:N`."""

    def __post_init__(self) -> None:
        _one_of(self, "search", Search)
        if self.rule != "agent":
            _one_of(self, "rule", Rule)
        _positive(self, "rollouts", "batch", "trees")
        if self.rollouts % self.trees:
            raise ConfigError(f"rollouts ({self.rollouts}) must be a multiple of trees ({self.trees})")
        _not_negative(self, "interactive", "branches", "duration", "prune_every", "temperature", "retries")

    def pruning(self, trained: SearchConfig) -> SearchConfig:
        """How branches are pruned: as in training, but for what is set here."""
        return dataclasses.replace(
            trained,
            rule=trained.rule if self.rule == "agent" else self.rule,
            prune_every=self.prune_every or trained.prune_every,
            temperature=self.temperature or trained.temperature,
        )


def to_json(config: Any) -> str:
    """A configuration as text that :func:`from_dict` reads back."""
    return json.dumps({"format": FORMAT, **_plain(config)}, indent=2) + "\n"


def _plain(config: Any) -> dict[str, Any]:
    def value(item: Any) -> Any:
        if dataclasses.is_dataclass(item):
            return _plain(item)
        return str(item) if isinstance(item, Path) else item

    return {f.name: value(getattr(config, f.name)) for f in dataclasses.fields(config)}


def from_dict(kind: type[Any], values: dict[str, Any], *, file: Path | None = None) -> Any:
    """Build a configuration from what :func:`to_json` wrote.

    Raises:
        ConfigError: for an unknown format or name (with the nearest known one), or a missing field.
    """
    where = f"{file}: " if file is not None else ""
    values = dict(values)
    if values.pop("format", FORMAT) != FORMAT:
        raise ConfigError(f"{where}configuration of an unknown format, expected {FORMAT}")
    fields = {f.name: f for f in dataclasses.fields(kind)}
    for name in values:
        if name not in fields:
            close = difflib.get_close_matches(name, fields, 1)
            hint = f", did you mean '{close[0]}'?" if close else ""
            raise ConfigError(f"{where}unknown setting '{name}'{hint}")
    nested = {
        "agent": AgentConfig,
        "search": SearchConfig,
        "discriminator": DiscriminatorConfig,
        "mgail": MGAILConfig,
        "validation": ValidationConfig,
        "show": ShowConfig,
    }
    built = {}
    for name, value in values.items():
        if name in nested and isinstance(value, dict):
            built[name] = from_dict(nested[name], value, file=file)
        else:
            is_path = "Path" in str(fields[name].type) and value is not None
            built[name] = Path(value) if is_path else value
    try:
        return kind(**built)
    except TypeError as error:
        raise ConfigError(f"{where}{error}") from error
