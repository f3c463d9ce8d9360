"""Objects by import path, such as ``my.module:Name``: how users bring parts of their own."""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

from symphony.errors import ConfigError


def load_object(path: str) -> Any:
    """Import ``module:name``; modules in the current folder are found, as with ``python -m``.

    Raises:
        ConfigError: if there is no such module or name.
    """
    module, _, name = path.partition(":")
    if os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.append(os.getcwd())
    try:
        found = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"can't import '{path}': {error}") from error
    return found


def build_object(path: str, *args: Any, **kwargs: Any) -> Any:
    """Call what an import path names.

    Raises:
        ConfigError: if it can't be imported or called so.
    """
    found = load_object(path)
    try:
        return found(*args, **kwargs)
    except TypeError as error:
        raise ConfigError(f"'{path}' can't be called as needed: {error}") from error
