"""The choice of a run's checkpoint: the best by validation, the last, or a named one; the included agents."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symphony.errors import ConfigError, DataError
from symphony.files import read_object

PREFIX = "pretrained:"  # names of agents that come with the package begin with it
FOLDER = Path(__file__).resolve().parents[1] / "pretrained"
CARD = "card.json"  # model card in an agent's folder


@dataclass(frozen=True)
class Best:
    """The best checkpoint so far: its step, and its collision rate plus its off-road time, percent."""

    step: int
    infractions: float

    @classmethod
    def of(cls, extra: Mapping[str, Any]) -> Best | None:
        """Read it from the extra values of a checkpoint; None if nothing was validated by then."""
        from symphony.agents.checkpoint import CheckpointError  # noqa: PLC0415 - torch, which names do without

        found = extra.get("best")
        if found is None:
            return None
        values: Any = [found.get(name) for name in ("step", "infractions")] if isinstance(found, dict) else []
        if [type(value) for value in values] != [int, float] or not min(values) >= 0:
            raise CheckpointError("no step with its infractions", field="extra.best")
        return cls(*values)


def split_name(name: str) -> tuple[Path, str]:
    """Split ``RUN[@WHICH]`` into the folder of a run and which of its checkpoints is meant ("" if it doesn't say);
    ``pretrained:NAME`` is the folder of an agent that comes with the package.
    """
    if name.startswith(PREFIX):
        known, _, which = name.partition("@")
        return pretrained_folder(known), which
    run, at, which = name.rpartition("@")
    # A folder's own name may hold the sign.
    return (Path(run), which) if at and not Path(name).is_dir() else (Path(name), "")


def best_of(last: Path) -> Best | None:
    """Return the best checkpoint of a run, as its last one records it; None if nothing was validated."""
    from symphony.agents.checkpoint import MANIFEST, CheckpointError, load_checkpoint  # noqa: PLC0415

    try:
        return Best.of(load_checkpoint(last, partial=True, restore_rng=False).extra)
    except CheckpointError as error:
        raise error.at(file=last / MANIFEST) from error


def choose(folder: Path, which: str = "") -> Path:
    """Return the checkpoint of a run that ``which`` names: the ``best``, the ``last``, or that of a step such as
    ``3000`` or ``step-3000``; by default the best, which the last one knows, if the run was validated, else the last.

    Raises a :class:`ConfigError` if there is no such checkpoint, a :class:`CheckpointError` if the last is damaged.
    """
    from symphony.agents.checkpoint import CheckpointError, checkpoints  # noqa: PLC0415

    found = {int(path.name[-12:]): path for path in checkpoints(folder / "checkpoints")}
    if not found:
        raise ConfigError(f"{folder}: {'the run has no checkpoint yet' if folder.is_dir() else 'no such folder'}")
    last, held = max(found), f"it has those of the steps {', '.join(map(str, found))}"
    if named := re.fullmatch(r"(?:step-)?(\d+)", which):
        if int(named[1]) not in found:
            raise ConfigError(f"{folder}: no checkpoint of step {int(named[1])}, {held}")
        return found[int(named[1])]
    if which not in ("", "best", "last"):
        raise ConfigError(f"{folder}: '{which}' is not a checkpoint; name best, last or a step, {held}")
    best = None if which == "last" else best_of(found[last])
    if best is None and which == "best":
        raise ConfigError(f"{folder}: the run was not validated, so that none is the best; {held}")
    step = last if best is None else best.step
    if step not in found:
        raise CheckpointError(f"the best checkpoint, of step {step}, is gone; {held}", file=folder)
    return found[step]


def pretrained_names() -> list[str]:
    """Return the names of all included agents, without prefix."""
    return sorted(path.parent.name for path in FOLDER.glob("*/agent.json"))


def pretrained_folder(name: str) -> Path:
    """Return the folder of ``pretrained:NAME``; a ConfigError lists the names if there is no such agent."""
    wanted, names = name.removeprefix(PREFIX), pretrained_names()
    if wanted not in names:
        close = difflib.get_close_matches(wanted, names, 1)
        hint = f"did you mean '{PREFIX}{close[0]}'? " if close else ""
        known = ", ".join(PREFIX + known for known in names) or "none"
        raise ConfigError(f"no agent '{name}' comes with this package; {hint}there are: {known}")
    return FOLDER / wanted


def read_card(folder: Path) -> dict[str, Any]:
    """Return the model card in the folder of an agent: ``name``, ``method``, ``about``, ``training``, ``settings``,
    ``scores`` (one for each data set it was evaluated on) and ``limits``.
    """
    file = folder / CARD
    if not file.exists():
        raise DataError("the agent has no model card", file=file)
    return read_object(file)
