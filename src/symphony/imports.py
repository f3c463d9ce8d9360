"""Objects by import path, such as ``my.module:Name``: the way in which users bring their own parts."""

from __future__ import annotations

import ast
import importlib
import os
import sys
from collections.abc import Callable
from importlib.util import module_from_spec, spec_from_file_location
from operator import attrgetter
from pathlib import Path
from typing import Any

from symphony.errors import ConfigError


def load_object(path: str, *, here: bool = True) -> Any:
    """Import ``module:name``, or ``path/to/file.py:name``, with what lies beside the file to import.

    Unless ``here`` is False, modules are also sought in the current folder, as ``python -m`` does. Not for paths that
    the user did not type: whatever lies in the folder would run. A :class:`ConfigError` says what is missing, or why.
    """
    module, _, name = path.rpartition(":")
    load = _file if module.endswith(".py") else importlib.import_module
    try:
        try:
            found: Any = load(module)
        except ModuleNotFoundError:
            if load is _file or not here or not {os.getcwd(), ""}.isdisjoint(sys.path):
                raise
            sys.path.append(os.getcwd())
            found = load(module)
        return attrgetter(name)(found)
    except (Exception, SystemExit) as error:  # whatever a user's module raises
        usual = isinstance(error, ImportError | AttributeError | ValueError)
        kind = "" if usual else f"{type(error).__name__}: "
        raise ConfigError(f"can't import '{path}': {kind}{error}") from error


def build_object(path: str, *arguments: Any, **named: Any) -> Any:
    """Call the object of an import path; a :class:`ConfigError` if it can't be imported or called like this."""
    found = load_object(path)
    try:
        return found(*arguments, **named)
    except TypeError as error:
        raise ConfigError(f"'{path}' can't be called as needed: {error}") from error


def _file(name: str) -> Any:
    """Return a file as a module, run once."""
    path = Path(name).resolve()
    if str(path) in sys.modules:
        return sys.modules[str(path)]
    if not path.is_file():
        raise ImportError(f"{path}: no such file")
    sys.path += [str(path.parent)] if str(path.parent) not in sys.path else []
    spec: Any = spec_from_file_location(str(path), path)
    module = sys.modules[str(path)] = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[str(path)]
        raise
    return module


def lazily(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package whose names are imported when they are asked for. Its ``if
    TYPE_CHECKING`` block says where they are from. A name must not also be that of a module of the package.
    """
    source = Path(str(sys.modules[package].__file__)).read_text(encoding="utf-8")
    nodes = [node for block in ast.parse(source).body if isinstance(block, ast.If) for node in block.body]
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(importlib.import_module(homes[name]), name)

    return get, lambda: sorted(homes)
