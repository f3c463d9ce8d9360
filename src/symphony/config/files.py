"""Configurations written as JSON, and read back with every type and range checked."""

from __future__ import annotations

import dataclasses
import json
import sys
import types
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from symphony.config.checks import type_hints
from symphony.errors import ConfigError

FORMAT = 3
"""Version of a saved configuration."""


def to_json(config: Any) -> str:
    """Return a configuration as text that :func:`read_json` reads back."""
    return json.dumps({"format": FORMAT, **dataclasses.asdict(config)}, indent=2, default=str) + "\n"


def read_json(kind: type[Any], file: Path) -> Any:
    """Read a configuration that :func:`to_json` wrote.

    Raises:
        ConfigError: if it is not such a file; names it and the setting.
    """
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{file}: not valid JSON ({error})") from error
    except OSError as error:
        raise ConfigError(f"{file}: can't be read: {error.strerror}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{file}: not a JSON object")
    if values.pop("format", None) != FORMAT:
        raise ConfigError(f"{file}: configuration of another version, expected format {FORMAT}")
    return from_dict(kind, values, where=f"{file}: ")


def from_dict(kind: Any, values: dict[str, Any], *, where: str = "") -> Any:
    """Build a configuration from plain values.

    Args:
        kind: the dataclass.
        values: by the names of its fields, nested ones as dicts.
        where: put before the message of an error.

    Raises:
        ConfigError: for an unknown name, a missing one, another type or a value out of range.
    """
    hints, fields = type_hints(kind), {f.name: f for f in dataclasses.fields(kind)}
    for name in values:
        if name not in fields:
            raise ConfigError(f"{where}unknown setting '{name}'")
    for name, field in fields.items():
        needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if needed and name not in values:
            raise ConfigError(f"{where}setting '{name}' is missing")
    built = {name: _typed(hints[name], value, where, name) for name, value in values.items()}
    try:
        return kind(**built)
    except ConfigError as error:
        raise ConfigError(f"{where}{error}") from error


def _typed(hint: Any, value: Any, where: str, name: str) -> Any:
    """Return a value as its annotation wants it."""
    if get_origin(hint) is Annotated:
        hint = hint.__origin__
    origin, options = get_origin(hint), get_args(hint)
    if dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return from_dict(hint, value, where=f"{where}{name}.")
    if origin in (Union, types.UnionType):
        if value is None and type(None) in options:
            return None
        return _typed(next(o for o in options if o is not type(None)), value, where, name)
    if origin is tuple and isinstance(value, list):
        return tuple(_typed(options[0], item, where, name) for item in value)
    if origin is Literal and isinstance(value, str):
        if value not in options:
            raise ConfigError(f"{where}{name} is one of {', '.join(options)}, not '{value}'")
        return value
    return _plain(hint, value, where, name)


def _plain(hint: Any, value: Any, where: str, name: str) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint is float and number and abs(value) <= sys.float_info.max:
        return float(value)
    if isinstance(hint, type) and isinstance(value, hint) and (number or hint is not int):
        return value
    wanted = getattr(hint, "__name__", str(hint))
    raise ConfigError(f"{where}{name} must be {wanted}, is {type(value).__name__} {str(value)[:40]!r}")
