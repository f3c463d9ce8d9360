"""Trained agents that come with the package, each the folder of a run with one checkpoint and a model card."""

from __future__ import annotations

import difflib
import json
from pathlib import Path
from typing import Any

from symphony.errors import ConfigError, DataError

PREFIX = "pretrained:"
"""Names of these agents begin with it."""
FOLDER = Path(__file__).resolve().parents[1] / "pretrained"
CARD = "card.json"
"""Model card in an agent's folder."""
CARD_FORMAT = 1
"""Version of such a card."""


def is_pretrained(name: str) -> bool:
    """Whether a name is meant to be that of an agent that comes with the package."""
    return name.startswith(PREFIX)


def pretrained_names() -> list[str]:
    """All there are, without prefix."""
    return sorted(path.parent.name for path in FOLDER.glob("*/agent.json"))


def pretrained_folder(name: str) -> Path:
    """The folder of ``pretrained:NAME``.

    Raises:
        ConfigError: if there is none of that name; says which there are.
    """
    wanted, names = name.removeprefix(PREFIX), pretrained_names()
    if wanted not in names:
        close = difflib.get_close_matches(wanted, names, 1)
        hint = f"did you mean '{PREFIX}{close[0]}'? " if close else ""
        known = ", ".join(PREFIX + known for known in names) or "none"
        raise ConfigError(f"no agent '{name}' comes with this package; {hint}there are: {known}")
    return FOLDER / wanted


def run_folder(run: Path) -> Path:
    """The folder that is meant where one of a run is asked for: itself, or that of ``pretrained:NAME``.

    Raises:
        ConfigError: if there is no such agent.
    """
    return pretrained_folder(str(run)) if is_pretrained(str(run)) else run


def read_card(folder: Path) -> dict[str, Any]:
    """The model card in the folder of an agent: ``name``, ``method``, ``about``, ``training``, ``settings``,
    ``scores`` (one for each data set it was evaluated on) and ``limits``.

    Raises:
        DataError: there is none.
    """
    file = folder / CARD
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError("the agent has no model card", file=file) from error
