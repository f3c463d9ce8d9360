"""Readers: one module per log format, found by name and imported on first use."""

from __future__ import annotations

import difflib
import importlib
from typing import Any

from symphony.data.sources.base import Reader
from symphony.errors import ConfigError

__all__ = ["Reader", "get_reader", "readers"]

_READERS = {
    "argoverse2": "Argoverse2Reader",
    "commonroad": "CommonRoadReader",
    "interaction": "InteractionReader",
    "scenarionet": "ScenarioNetReader",
    "womd": "WomdReader",
}


def readers() -> tuple[str, ...]:
    """Return the names that :func:`get_reader` knows."""
    return tuple(_READERS)


def get_reader(name: str, **options: Any) -> Reader:
    """Return the reader of a format; ``options`` are the keyword arguments of its class. A :class:`ConfigError` says
    if the name or an option is unknown, or an option has a bad value.
    """
    if name not in _READERS:
        close = difflib.get_close_matches(name.lower(), _READERS, n=1, cutoff=0.4)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ConfigError(f"unknown data source {name!r} (known: {', '.join(_READERS)}){hint}")
    try:
        return getattr(importlib.import_module(f"{__name__}.{name}"), _READERS[name])(**options)
    except TypeError as error:
        raise ConfigError(f"data source {name!r}: {error}") from error
