"""Ranges of settings."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from symphony.errors import ConfigError


def positive(config: Any, *names: str) -> None:
    """Raise ConfigError for a setting that is not positive and finite."""
    for name in names:
        value = getattr(config, name)
        if not (value > 0 and math.isfinite(value)):
            raise ConfigError(f"{option(name)} must be positive, is {value}")


def not_negative(config: Any, *names: str) -> None:
    """Raise ConfigError for a setting that is negative or not finite."""
    for name in names:
        value = getattr(config, name)
        if not (value >= 0 and math.isfinite(value)):
            raise ConfigError(f"{option(name)} must not be negative, is {value}")


def at_most(config: Any, limit: int, *names: str) -> None:
    """Raise ConfigError for a count beyond what any machine could hold, say in the file of an agent."""
    for name in names:
        value = getattr(config, name)
        if value > limit:
            raise ConfigError(f"{option(name)} must be at most {limit}, is {value}")


def one_of(config: Any, name: str, known: Iterable[str], *, path: bool = False) -> None:
    """Raise ConfigError for a setting that is no known name, nor, with `path`, an import path."""
    value, known = getattr(config, name), list(known)
    if value not in known and not (path and ":" in value):
        more = " or an import path such as my.module:Name" if path else ""
        raise ConfigError(f"{option(name)} is one of {', '.join(known)}{more}, not '{value}'")


def option(name: str) -> str:
    """A setting as the command line spells it."""
    return name.replace("_", "-")
