"""Ranges of settings."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from symphony.errors import ConfigError


def positive(config: Any, *names: str) -> None:
    """Raise ConfigError for a setting that is not positive and finite."""
    _check(config, names, "be positive", lambda value: value > 0 and math.isfinite(value))


def not_negative(config: Any, *names: str) -> None:
    """Raise ConfigError for a setting that is negative or not finite."""
    _check(config, names, "not be negative", lambda value: value >= 0 and math.isfinite(value))


def at_most(config: Any, limit: int, *names: str) -> None:
    """Raise ConfigError for a count beyond what any machine could hold, say in the file of an agent."""
    _check(config, names, f"be at most {limit}", lambda value: value <= limit)


def _check(config: Any, names: Iterable[str], rule: str, holds: Any) -> None:
    for name in names:
        if not holds(value := getattr(config, name)):
            raise ConfigError(f"{name.replace('_', '-')} must {rule}, is {value}")


def one_of(config: Any, name: str, known: Iterable[str], *, path: bool = False) -> None:
    """Raise ConfigError for a setting that is no known name, nor, with `path`, an import path."""
    value, known = getattr(config, name), list(known)
    if value not in known and not (path and ":" in value):
        more = " or an import path such as my.module:Name" if path else ""
        raise ConfigError(f"{name.replace('_', '-')} is one of {', '.join(known)}{more}, not '{value}'")
