"""The allowed values of settings: their types state them, and every new configuration is checked."""

from __future__ import annotations

import functools
import math
import sys
from collections import Counter
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from symphony.errors import ConfigError


class Bounds(NamedTuple):
    """Marks a setting with its least and its greatest value, or with the least number of values it has."""

    least: float = 0.0
    most: float = sys.float_info.max
    distinct: bool = False


class Names(tuple[str, ...]):
    """Marks a setting that is one of some names, or an import path."""


LEAST = {0: "not be negative", 1: "be positive", sys.float_info.min: "be positive"}
Count = Annotated[int, Bounds(1)]
Natural = Annotated[int, Bounds()]
Positive = Annotated[float, Bounds(sys.float_info.min)]
NotNegative = Annotated[float, Bounds()]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Base of configurations; raises a ConfigError for a setting that its type does not allow."""

    def __post_init__(self) -> None:
        kind: Any = type(self)
        for name, hint in type_hints(kind).items():
            named = (mark.name for mark in getattr(hint, "__metadata__", ()) if getattr(mark, "name", None))
            check(next(named, name).replace("_", "-"), getattr(self, name), hint)


def check(told: str, value: Any, hint: Any) -> None:
    """Raise a ConfigError that calls a value ``told`` if an annotation does not allow it."""
    if isinstance(value, float) and math.isnan(value):
        raise ConfigError(f"{told} must be a number, is nan")
    for mark in getattr(hint, "__metadata__", ()):
        if isinstance(mark, Bounds) and isinstance(value, tuple):
            if len(value) < mark.least:
                raise ConfigError(f"give at least {mark.least} {told}")
            if mark.distinct and len(set(value)) < len(value):
                raise ConfigError(f"{told}: {Counter(value).most_common(1)[0][0]} is given twice")
        elif isinstance(mark, Bounds) and value is not None and not mark.least <= value <= mark.most:
            least = LEAST.get(mark.least, f"be at least {mark.least}")
            raise ConfigError(f"{told} must {f'be at most {mark.most}' if value > mark.most else least}, is {value}")
        elif isinstance(mark, Names) and value not in mark and ":" not in value:
            more = "or an import path such as my.module:Name"
            raise ConfigError(f"{told} is one of {', '.join(mark)} {more}, not '{value}'")
    plain = hint.__origin__ if get_origin(hint) is Annotated else hint
    if get_origin(plain) is Literal and value not in get_args(plain):
        raise ConfigError(f"{told} is one of {', '.join(get_args(plain))}, not '{value}'")


@functools.cache
def type_hints(kind: Any) -> dict[str, Any]:
    """Return the annotations of a class by field, with their marks; compiles them once."""
    return get_type_hints(kind, include_extras=True)
