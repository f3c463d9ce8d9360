"""A suite: which planners drive among which crowds, through which segments, and what must be true of them.

The format is TOML; ``docs/test-bench.md`` describes it. Everything in it is checked before anything is simulated.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from symphony.agents.agent import load_agent
from symphony.bench.criticality import hardest
from symphony.bench.measures import MEASURES, needed_groups
from symphony.config import EvaluateConfig
from symphony.config.evaluation import check_planner_seconds
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, SymphonyError
from symphony.learning.demonstrations import evenly_spaced
from symphony.planners.interface import planner_maker

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")
"""The names that planners and crowds may have: folders are named after them."""
BUILTIN = "builtin:"
"""The prefix before the split of the run segments that come with the package."""
_NUMBER = (int, float)
_CROWD = {"interactive": (int, str), "others": str, "search": str, "score": str, "branches": int}
_CROWD |= {"radius": _NUMBER, "duration": int}
"""Settings of :class:`symphony.config.EvaluateConfig` that a crowd may have."""
_SUITE = {"name": str, "data": str, "segments": (int, list), "hardest": int, "rollouts": int, "seed": int}
_LIMIT = {"metric": str, "at_most": _NUMBER, "at_least": _NUMBER, "planners": list, "crowds": list}
_KEYS: dict[str, dict[str, Any]] = {
    "suite": {**_SUITE, "confidence": float, "baseline": str},
    "planner": {"planner": str, "name": str, "seconds": _NUMBER},
    "crowd": {"agent": str, "name": str, **_CROWD},
    "threshold": {**_LIMIT, "confidence": (float, bool), "compared": bool},
}
"""Tables of a suite, their keys and the types of these."""
_NEEDED = {"suite": "data", "planner": "planner", "crowd": "agent", "threshold": "metric"}
"""The key that each table must have."""


class SuitePlanner(NamedTuple):
    """A planner under test."""

    name: str
    planner: str
    seconds: float


class Crowd(NamedTuple):
    """The agents that drive around a planner."""

    name: str
    agent: str
    config: EvaluateConfig


N = TypeVar("N", SuitePlanner, Crowd)


@dataclass(frozen=True)
class Threshold:
    """A threshold that some planners must keep in some crowds.

    Attributes:
        metric: a name of :data:`symphony.bench.measures.MEASURES`.
        limit: in the unit of the metric.
        side: on which side of it the mean must be.
        confidence: with which the mean must be known to be on that side; None: the mean itself decides.
        compared: whether the metric is the difference from the baseline, run by run.
    """

    metric: str
    limit: float
    side: Literal["at_most", "at_least"]
    confidence: float | None
    planners: tuple[str, ...]
    crowds: tuple[str, ...]
    compared: bool = False

    def __str__(self) -> str:
        measure = MEASURES[self.metric]
        what = f"{measure.text}, less the baseline's," if self.compared else measure.text
        sign = "≤" if self.side == "at_most" else "≥"
        sure = "" if self.confidence is None else f" at {100 * self.confidence:g} %"
        return f"{what} {sign} {self.limit:g} {measure.unit}".rstrip() + sure


@dataclass(frozen=True)
class Suite:
    """A suite, read and checked.

    Attributes:
        items: the rows of the store that are driven, in the order in which they are.
        baseline: a planner of the suite that others are compared with, or an earlier ``result.json`` of it; or empty.
    """

    name: str
    path: Path
    store: SegmentStore
    items: tuple[int, ...]
    planners: tuple[SuitePlanner, ...]
    crowds: tuple[Crowd, ...]
    thresholds: tuple[Threshold, ...]
    baseline: str | Path = ""


def read_suite(path: Path, **shared: Any) -> Suite:
    """Read a suite and check all of it; ``shared`` are settings of the machine, such as ``workers``.

    Raises:
        ConfigError: something can't be used; names file, line and field.
        DataError: the store can't be read.
    """
    try:
        text = path.read_text(encoding="utf-8")
        plain = tomllib.loads(text)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from error
    file = _File(path, text.splitlines())
    for name in plain:
        if name not in _KEYS:
            raise file.wrong(name, None, "", f"unknown table (known: {', '.join(_KEYS)})")
    top = _Table(file, "suite", None, plain.get("suite", {}))
    tables: dict[str, list[_Table]] = {}
    for name in ("planner", "crowd", "threshold"):
        found = plain.get(name, [])
        if not isinstance(found, list):
            raise file.wrong(name, None, "", f"is a list of tables: [[{name}]]")
        if not found:
            raise ConfigError(f"{path}: there is no [[{name}]]")
        tables[name] = [_Table(file, name, k, given) for k, given in enumerate(found)]
    with top.at("data"):
        store = SegmentStore(_store(file.beside(top.given["data"])))
    sure, rollouts = top.given.get("confidence", 0.95), top.given.get("rollouts", 1)
    if rollouts < 1:
        raise top.wrong("rollouts", f"must be at least 1, is {rollouts}")
    top.check_confidence(sure)
    shared |= {"rollouts": rollouts, "seed": top.given.get("seed", 0)}
    planners = _distinct(tables["planner"], map(_planner, tables["planner"]))
    crowds = _distinct(tables["crowd"], (_crowd(one, shared) for one in tables["crowd"]))
    names = {"planners": [one.name for one in planners], "crowds": [one.name for one in crowds]}
    with top.at("segments"):
        items = _items(store, top.given.get("segments", 0))
    if (count := top.given.get("hardest")) is not None:
        if not 0 < count <= len(items):
            raise top.wrong("hardest", f"is of {len(items)} segments, not {count}")
        items = tuple(row for row, _ in hardest(store, count, items))
    baseline: str | Path = top.given.get("baseline", "")
    if baseline and baseline not in names["planners"]:
        baseline = Path(file.beside(str(baseline)))
        if not baseline.is_file():
            raise top.wrong("baseline", "is neither a planner of the suite nor a file")
    groups = len({str(store.groups[i]) for i in items})
    limits = tuple(_threshold(one, names, sure, groups, baseline) for one in tables["threshold"])
    name = top.given.get("name", path.stem)
    return Suite(name, path, store, items, planners, crowds, limits, baseline)


@dataclass(frozen=True)
class _File:
    """A file and its lines, to locate errors in it."""

    path: Path
    lines: list[str]

    def wrong(self, table: str, k: int | None, key: str, why: str) -> ConfigError:
        field = table if k is None else f"{table} {k + 1}"
        where = f"{self.path}, line {self._line(table, k or 0, key)}, {field}"
        return ConfigError(f"{where}, {key}: {why}" if key else f"{where}: {why}")

    def _line(self, table: str, k: int, key: str) -> int:
        """Return the line of a key in the k-th such table, else of its head, else the first that begins like it."""
        head = re.compile(rf"\s*\[+\s*{re.escape(table)}\s*\]+\s*(#.*)?$")
        heads = [number for number, line in enumerate(self.lines, 1) if head.match(line)]
        if k >= len(heads):
            begins = re.compile(rf"\s*\[*\s*{re.escape(table)}\b")
            return next((n for n, line in enumerate(self.lines, 1) if begins.match(line)), 1)
        for number, line in enumerate(self.lines[heads[k] :], heads[k] + 1):
            if line.lstrip().startswith("["):
                break
            if key and re.match(rf"\s*{re.escape(key)}\s*=", line):
                return number
        return heads[k]

    def beside(self, given: str) -> str:
        """Return a path beside the file if it exists; other names as they are."""
        beside = self.path.parent / given
        return str(beside) if beside.exists() else given


class _Table:
    """The k-th table of a name, or the only one, with its keys and types checked."""

    def __init__(self, file: _File, name: str, k: int | None, given: Any) -> None:
        self.file, self.name, self.k, self.given = file, name, k, given
        if not isinstance(given, dict):
            raise self.wrong("", "is not a table")
        keys = _KEYS[name]
        for key, value in given.items():
            if key not in keys:
                raise self.wrong(key, f"unknown (known: {', '.join(keys)})")
            kinds = keys[key] if isinstance(keys[key], tuple) else (keys[key],)
            if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
                raise self.wrong(key, f"can't be {value!r}")
        if _NEEDED[name] not in given:
            raise self.wrong(_NEEDED[name], "is missing")

    def wrong(self, key: str, why: str) -> ConfigError:
        return self.file.wrong(self.name, self.k, key, why)

    @contextmanager
    def at(self, key: str) -> Iterator[None]:
        """Attribute errors raised inside to a key of the table."""
        try:
            yield
        except (SymphonyError, OSError) as error:
            raise self.wrong(key, str(error)) from error

    def named(self) -> str:
        name = str(self.given.get("name", self.given[_NEEDED[self.name]].removeprefix("pretrained:")))
        if not NAME.fullmatch(name):
            raise self.wrong("name", f"{name!r} is not a valid name: use letters, digits and _.+-")
        return name

    def check_confidence(self, value: Any) -> None:
        if not isinstance(value, float) or not 0.5 < value < 1:
            raise self.wrong("confidence", f"is between 0.5 and 1, or false, not {value!r}")


def _distinct(tables: list[_Table], given: Iterable[N]) -> tuple[N, ...]:
    """Return the objects read from the tables; raise an error if two have the same name."""
    found: list[N] = []
    for table, one in zip(tables, given, strict=True):
        if one.name in [other.name for other in found]:
            raise table.wrong("name", f"{one.name!r} is given twice")
        found.append(one)
    return tuple(found)


def _planner(table: _Table) -> SuitePlanner:
    planner, seconds = table.given["planner"], float(table.given.get("seconds", 60.0))
    name = table.named()
    file, colon, part = planner.rpartition(":")
    if file.endswith(".py"):
        planner = f"{table.file.beside(file)}{colon}{part}"
    with table.at("planner"):
        planner_maker(planner)
    with table.at("seconds"):
        check_planner_seconds(seconds)
    return SuitePlanner(name, planner, seconds)


def _crowd(table: _Table, shared: dict[str, Any]) -> Crowd:
    settings = {key: value for key, value in table.given.items() if key in _CROWD}
    if isinstance(settings.get("interactive"), str) and settings["interactive"] != "all":
        raise table.wrong("interactive", f"can't be {settings['interactive']!r}")
    with table.at(next(iter(settings), "agent")):
        config = EvaluateConfig(**settings, **shared)
    agent = table.file.beside(table.given["agent"])
    with table.at("agent"):
        load_agent(agent)
    return Crowd(table.named(), agent, config)


def _threshold(
    table: _Table, names: dict[str, list[str]], sure: float, groups: int, baseline: str | Path
) -> Threshold:
    """Read a threshold, and check that a planner could keep it with so few or many groups of segments."""
    given, confidence = table.given, table.given.get("confidence", sure)
    if given["metric"] not in MEASURES:
        raise table.wrong("metric", f"unknown (known: {', '.join(MEASURES)})")
    if ("at_most" in given) == ("at_least" in given):
        raise table.wrong("metric", "has one of at_most and at_least")
    side: Literal["at_most", "at_least"] = "at_most" if "at_most" in given else "at_least"
    if not math.isfinite(given[side]):
        raise table.wrong(side, f"is a number, not {given[side]}")
    for key, known in names.items():
        if given.get(key) == []:
            raise table.wrong(key, "names none; leave it out for all")
        for name in given.get(key, ()):
            if name not in known:
                raise table.wrong(key, f"there is no {name!r} among {known}")
    compared = given.get("compared", False)
    itself = {str(baseline)} == {*given.get("planners", names["planners"])}
    if compared and (itself or not baseline):
        why = f"{baseline} is the baseline, and not compared with itself" if itself else "the suite has no baseline"
        raise table.wrong("compared", why)
    if confidence is not False:
        table.check_confidence(confidence)
        needed = 2
        if MEASURES[given["metric"]].kind != "mean" and not compared:
            room = given[side] if side == "at_most" else 100.0 - given[side]
            if room <= 0:
                shown = "0 %" if side == "at_most" else "at least 100 %"
                raise table.wrong(side, f"no number of runs shows {shown}; set confidence = false")
            needed = needed_groups(room, confidence)
        if groups < needed:
            what = f"needs at least {needed} independent groups of segments"
            raise table.wrong(side, f"{what}; these segments are of {groups}")
    planners, crowds = (tuple(given.get(key, known)) for key, known in names.items())
    limit = float(given[side])
    return Threshold(given["metric"], limit, side, confidence or None, planners, crowds, compared)


def _items(store: SegmentStore, given: int | list[Any]) -> tuple[int, ...]:
    if isinstance(given, list):
        places = {name: i for i, name in enumerate(store.ids)}
        if not given or not all(isinstance(name, str) for name in given):
            raise ConfigError("segments are a number, or a list of ids")
        for name in given:
            if name not in places:
                raise ConfigError(f"the store has no segment {name!r}")
        return tuple(dict.fromkeys(places[name] for name in given))
    if not 0 <= given <= len(store):
        raise ConfigError(f"the store has {len(store)} segments, not {given}")
    return tuple(evenly_spaced(len(store), given or len(store)))


def _store(given: str) -> Path:
    split = given.removeprefix(BUILTIN)
    if split == given:
        return Path(given)
    if split not in ("train", "test"):
        raise ConfigError(f"built in are {BUILTIN}train and {BUILTIN}test, not {given!r}")
    return builtin_store(split)  # type: ignore[arg-type]
