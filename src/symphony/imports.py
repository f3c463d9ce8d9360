"""Objects by import path, such as ``my.module:Name``: how users bring parts of their own."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from symphony.errors import ConfigError


def load_object(path: str, *, here: bool = True) -> Any:
    """Import ``module:name``. A file will do, too: ``path/to/file.py:name``, with what lies beside it to import.

    Args:
        path: the import path.
        here: find modules in the current folder, too, as ``python -m`` does. Not for paths that the user did not
            type: whatever lies in the folder would run.

    Raises:
        ConfigError: if there is no such module, file or name.
    """
    module, _, name = path.rpartition(":")
    file, paths = module.endswith(".py"), {os.getcwd(), ""}
    try:
        try:
            found: Any = _file(Path(module).resolve()) if file else importlib.import_module(module)
        except ModuleNotFoundError:
            if file or not here or not paths.isdisjoint(sys.path):
                raise
            sys.path.append(os.getcwd())
            found = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"can't import '{path}': {error}") from error
    except (Exception, SystemExit) as error:  # whatever a user's module raises
        raise ConfigError(f"can't import '{path}': {type(error).__name__}: {error}") from error
    return found


def _file(path: Path) -> ModuleType:
    """A file as a module, run once."""
    if str(path) in sys.modules:
        return sys.modules[str(path)]
    spec = importlib.util.spec_from_file_location(str(path), path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise ImportError(f"{path}: no such file")
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    module = sys.modules[str(path)] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[str(path)]
        raise
    return module


def lazily(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package whose names are imported when they are asked for.

    Where they are from is what its ``if TYPE_CHECKING`` block says, so that nothing is written twice. A name that is
    also that of a module of the package does not work: Python would give the module to whoever imported that before.
    """
    source = Path(str(sys.modules[package].__file__)).read_text(encoding="utf-8")
    blocks = [block for block in ast.parse(source).body if isinstance(block, ast.If)]
    imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(importlib.import_module(homes[name]), name)

    return get, lambda: sorted(homes)
