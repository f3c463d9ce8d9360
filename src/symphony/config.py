"""Every setting of training and evaluation, in one typed place; field docstrings are the command line's help.

Imports nothing heavy, so that ``--help`` answers at once.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from symphony.errors import ConfigError

FORMAT = 1
"""Version of a saved configuration."""


def _positive(config: Any, *names: str) -> None:
    for name in names:
        if not getattr(config, name) > 0:
            raise ConfigError(f"{name.replace('_', '-')} must be positive, is {getattr(config, name)}")


@dataclass(frozen=True)
class AgentConfig:
    """What an agent sees and how large its network is; saved with its weights."""

    interactive: int = 2
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
class BCConfig:
    """Train an agent by behavioural cloning."""

    data: Path
    """Store of run segments to learn from (see `symphony data convert`)."""
    out: Path
    """Folder of the run: configuration, metrics, checkpoints."""
    steps: int = 3000
    """Updates (the paper: 70 000)."""
    seed: int = 0
    """Of the weights and of the order of the data."""
    agent: AgentConfig = field(default_factory=AgentConfig)
    """The agent."""
    segments: int = 16
    """Run segments per update."""
    states: int = 1024
    """Expert states per update, drawn from those segments."""
    learning_rate: float = 1e-3
    """Of Adam, falling to a tenth along a cosine."""
    clip: float = 1.0
    """Largest norm of the gradient."""
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
        _positive(
            self, "steps", "segments", "states", "learning_rate", "clip", "checkpoint_every", "log_every"
        )


@dataclass(frozen=True)
class EvaluateConfig:
    """How agents are judged."""

    rollouts: int = 16
    """Simulations per run segment."""
    seed: int = 0
    """Of everything drawn at random in them."""
    interactive: int = 0
    """Interactive agents per run segment; 0 takes what the agent was trained with (2 for the baselines)."""
    batch: int = 16
    """Run segments simulated at a time (changes memory and speed, not results)."""
    device: str = "cpu"
    """`cpu`, `cuda` or `cuda:N`."""

    def __post_init__(self) -> None:
        _positive(self, "rollouts", "batch")
        if self.interactive < 0:
            raise ConfigError(f"interactive must not be negative, is {self.interactive}")


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
    nested = {"agent": AgentConfig}
    built = {}
    for name, value in values.items():
        if name in nested:
            built[name] = from_dict(nested[name], value, file=file)
        else:
            built[name] = Path(value) if fields[name].type == "Path" else value
    try:
        return kind(**built)
    except TypeError as error:
        raise ConfigError(f"{where}{error}") from error
