"""Configurations as JSON, and back with every type and range checked."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import json
import types
from collections.abc import Hashable, Iterable
from pathlib import Path
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from symphony.errors import ConfigError

FORMAT = 3
"""Version of a saved configuration."""


def to_json(config: Any) -> str:
    """A configuration as text that :func:`read_json` reads back."""
    return json.dumps({"format": FORMAT, **dataclasses.asdict(config)}, indent=2, default=str) + "\n"


def read_json(kind: type[Any], file: Path) -> Any:
    """Read a configuration that :func:`to_json` wrote.

    Raises:
        ConfigError: if it is no such file; names it and the setting.
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
    _adapt(kind, values, f"{file}: ")
    return from_dict(kind, values, where=f"{file}: ")


def _adapt(kind: Any, values: dict[str, Any], where: str) -> None:
    """Make of an older agent's settings today's.

    Settings that the file is too old to have, and that meant something else then than by default now, are added.
    Settings that are gone are left out where they said what always holds now: ``GONE`` of a class has these values
    by name, ``...`` for what mattered to the training only, and a function where the value follows from the others.

    Raises:
        ConfigError: a setting that is gone said something else.
    """
    for name, held in getattr(kind, "GONE", {}).items():
        meant = held(values) if callable(held) else held
        found = values.pop(name, meant)
        if meant is not ... and found != meant:
            raise ConfigError(f"{where}setting '{name}' is gone: this version reads only {meant!r}")
    for field in dataclasses.fields(kind):
        hint, value = _hints(kind)[field.name], values.get(field.name)
        if "before" in field.metadata:
            values.setdefault(field.name, field.metadata["before"])
        for nested in (hint, *get_args(hint)):
            if isinstance(nested, type) and dataclasses.is_dataclass(nested) and isinstance(value, dict):
                _adapt(nested, value, f"{where}{field.name}.")


def from_dict(kind: type[Any], values: dict[str, Any], *, where: str = "") -> Any:
    """Build a configuration from plain values.

    Args:
        kind: the dataclass.
        values: by the names of its fields, nested ones as dicts.
        where: put before what is told of an error.

    Raises:
        ConfigError: for an unknown name (with the nearest known one), a missing one, another type or a value out of
            range.
    """
    hints = _hints(cast("Hashable", kind))
    fields = {f.name: f for f in dataclasses.fields(kind)}
    for name in values:
        if name not in fields:
            raise ConfigError(f"{where}unknown setting '{name}'{_nearest(str(name), fields)}")
    for name, field in fields.items():
        needed = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if needed and name not in values:
            raise ConfigError(f"{where}setting '{name}' is missing")
    built = {name: _typed(hints[name], value, where, name) for name, value in values.items()}
    try:
        return kind(**built)
    except ConfigError as error:
        raise ConfigError(f"{where}{error}") from error


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind)  # compiles every annotation anew


def _nearest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, known, 1)
    return f", did you mean '{close[0]}'?" if close else ""


def _typed(hint: Any, value: Any, where: str, name: str) -> Any:
    """A value as its annotation wants it."""
    origin, options = get_origin(hint), get_args(hint)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return from_dict(hint, value, where=f"{where}{name}.")
    if origin in (Union, types.UnionType):
        if value is None and type(None) in options:
            return None
        return _typed(next(o for o in options if o is not type(None)), value, where, name)
    if origin is tuple and isinstance(value, list):
        return tuple(_typed(options[0], item, where, name) for item in value)
    if origin is Literal and isinstance(value, str):
        if value not in options:
            known = f"{', '.join(options)}, not '{value}'{_nearest(value, options)}"
            raise ConfigError(f"{where}{name} is one of {known}")
        return value
    return _plain(hint, value, where, name)


def _plain(hint: Any, value: Any, where: str, name: str) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint is float and number:
        return float(value)
    if isinstance(hint, type) and isinstance(value, hint) and (number or hint is not int):
        return value
    wanted = getattr(hint, "__name__", str(hint))
    raise ConfigError(f"{where}{name} must be {wanted}, is {type(value).__name__} {str(value)[:40]!r}")
