"""Digests of planners: another planner of the same name makes another simulation."""

from __future__ import annotations

import ast
import hashlib
import inspect
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Set
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn

from symphony.planners.interface import PIPE, Planners, planner_maker, planner_name
from symphony.planners.view import FunctionPlanner

_PLACE = re.compile(" at 0x[0-9A-Fa-f]+")
"""The place of an object in memory, in what Python prints of it."""


def source_of(planner: str | Callable[..., Any]) -> str:
    """Return a digest of the files that a planner is written in and named by, of modules beside them that these
    import, and of values bound to it: by ``functools.partial``, as attributes, or as variables around a function.

    For a command, it covers the program that is started, if that is a file, and the first other word that is a file.
    It is empty for planners that come with the package, and where no source is known.
    """
    if isinstance(planner, str) and planner.startswith(PIPE):
        words = shlex.split(planner.removeprefix(PIPE))
        found = [_digest(words[0]), next(filter(None, map(_digest, words[1:])), "")]
        return _short("".join(found).encode()) if all(found) else "".join(found)
    given, bound = planner_maker(planner), ""
    if isinstance(given, partial) and given.func is FunctionPlanner:
        given = given.args[0]
    while isinstance(given, partial):
        bound += _content((given.args, given.keywords))
        given = given.func
    if inspect.isfunction(given):
        held = inspect.getclosurevars(given).nonlocals
    elif inspect.isclass(given):
        held = {}
    else:
        held = getattr(getattr(given, "__self__", given), "__dict__", {})
    bound += _content(held) if held else ""
    code = _code_of(given, planner.rpartition(":")[0] if isinstance(planner, str) else "")
    return _short((code + bound).encode()) if bound else code


def planner_settings(planners: Planners, seconds: float) -> dict[str, Any]:
    """Return the settings that distinguish a simulation with planners, given their seconds for an answer.

    Raises:
        ConfigError: there is no such planner, or it can't be made.
    """
    for one in planners.values():
        planner_maker(one)
    others = {str(k): [planner_name(one), source_of(one)] for k, one in planners.items() if k is not None}
    found = {"planner": source_of(planners[None]), "planner_seconds": seconds} if planners else {}
    return found | ({"drives": others} if others else {})


def _content(value: Any, inside: tuple[int, ...] = ()) -> str:
    """Return a value in words that are the same in every process, and differ where any part of it differs. What
    Python prints of an array leaves out its middle, of a set is in any order, and of an object may be its name.
    """
    if id(value) in inside:
        return "itself"
    inside = (*inside, id(value))
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return f"{value.dtype}{value.shape}{_short(np.ascontiguousarray(value).tobytes())}"
    if isinstance(value, nn.Module):
        value = {"": type(value).__qualname__, **value.state_dict()}
    if isinstance(value, Mapping):
        parts = [f"{_content(name, inside)}: {_content(held, inside)}" for name, held in value.items()]
    elif isinstance(value, Set):
        parts = sorted(_content(held, inside) for held in value)
    elif isinstance(value, (list, tuple, np.ndarray)):
        parts = [_content(held, inside) for held in value]
    elif type(value).__repr__ is object.__repr__ and getattr(value, "__dict__", None):
        parts = [_content(vars(value), inside)]
    else:
        return _PLACE.sub("", repr(value))
    return f"{type(value).__qualname__}({', '.join(parts)})"


def _code_of(given: Any, named: str) -> str:
    """Return the digest of the code of an object and of the module by whose name it was asked for."""
    module = inspect.getmodule(given)
    if module is None or module.__name__.partition(".")[0] == "symphony":
        return ""
    modules = module, sys.modules.get(named), sys.modules.get(str(Path(named).resolve()))
    if files := {Path(file).resolve() for each in modules if (file := getattr(each, "__file__", None))}:
        parts = sorted(_sources(files))
        return parts[0] if len(parts) == 1 else _short("".join(parts).encode())
    try:  # of a notebook, say
        return _short(inspect.getsource(given).encode())
    except (OSError, TypeError):
        return ""


def _sources(files: set[Path]) -> set[str]:
    """Return digests of files and, without running them, of what they import from their folder or package."""
    found, todo = dict[Path, str](), [*files]
    while todo:
        file = todo.pop()
        found[file] = _digest(str(file))
        top = next((folder for folder in file.parents if not (folder / "__init__.py").is_file()), file.parent)
        own = file.parent if top == file.parent else top / file.relative_to(top).parts[0]
        try:
            nodes = [*ast.walk(ast.parse(file.read_bytes()))]
        except (OSError, SyntaxError, ValueError):
            continue
        for node in (one for one in nodes if isinstance(one, ast.Import | ast.ImportFrom)):
            module, level = getattr(node, "module", None) or "", getattr(node, "level", 0)
            places = [file.parents[level - 1]] if level else [file.parent, top]
            for place, name in product(places, [module, *(f"{module}.{alias.name}" for alias in node.names)]):
                stem = place.joinpath(*name.strip(".").split("."))
                each = [one for one in (stem.parent / f"{stem.name}.py", stem / "__init__.py") if one.is_file()]
                todo += [one for one in each if own in one.parents and one not in found]
    return {*found.values()}


def _short(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:12]


def _digest(file: str) -> str:
    try:
        return _short(Path(file).read_bytes())
    except OSError:
        return ""
