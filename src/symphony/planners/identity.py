"""Digests of planners: another planner of the same name makes another simulation."""

from __future__ import annotations

import hashlib
import inspect
import re
import shlex
from collections.abc import Callable, Mapping, Set
from functools import partial
from modulefinder import ModuleFinder
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor, nn

from symphony.planners.interface import PIPE, Planners, planner_maker, planner_name
from symphony.planners.view import FunctionPlanner

_PLACE = re.compile(" at 0x[0-9A-Fa-f]+")
"""The place of an object in memory, in what Python prints of it."""


def source_of(planner: str | Callable[..., Any]) -> str:
    """Return a digest of the file that a planner is written in, of modules beside it that it imports, and of values
    bound to it: by ``functools.partial``, as attributes of an object, or as variables of an enclosing function.

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
    code = _code_of(given)
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


def _code_of(given: Any) -> str:
    module = inspect.getmodule(given)
    if module is None or module.__name__.partition(".")[0] == "symphony":
        return ""
    if getattr(module, "__file__", None) is not None:
        return _sources(str(module.__file__))
    try:  # of a notebook, say
        return _short(inspect.getsource(given).encode())
    except (OSError, TypeError):
        return ""


def _sources(file: str) -> str:
    """Return the digest of a module and of those beside it that it imports, without running them."""
    finder = ModuleFinder([str(Path(file).parent)])
    try:
        finder.run_script(file)
    except (OSError, SyntaxError):
        return _digest(file)
    found = sorted(filter(None, (getattr(each, "__file__", None) for each in finder.modules.values())))
    return _digest(file) if len(found) < 2 else _short("".join(map(_digest, found)).encode())


def _short(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:12]


def _digest(file: str) -> str:
    try:
        return _short(Path(file).read_bytes())
    except OSError:
        return ""
