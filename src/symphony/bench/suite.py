"""A suite: which planners drive among which crowds, through which segments, and what must be true of them.

The format is TOML; ``docs/test-bench.md`` describes it. Everything in it is checked before anything is simulated.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from symphony.agents.agent import load_agent
from symphony.bench.criticality import hardest
from symphony.bench.measures import MEASURES, needed_groups
from symphony.config import EvaluateConfig
from symphony.config.evaluation import check_planner_seconds
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, SymphonyError
from symphony.learning.demonstrations import evenly_spaced
from symphony.planners.interface import NAMES, PIPE, planner_maker

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")
"""What planners and crowds may be called: these are folders, too."""
BUILTIN = "builtin:"
"""Before the split of the run segments that come with the package."""
CROWD_SETTINGS = ("interactive", "others", "search", "score", "branches", "radius", "persona", "duration")
"""Settings of :class:`symphony.config.EvaluateConfig` that a crowd may have."""
_SUITE = {
    "name": str,
    "data": str,
    "segments": (int, list),
    "hardest": int,
    "rollouts": int,
    "seed": int,
    "confidence": float,
    "baseline": str,
}
_PLANNER = {"name": str, "planner": str, "seconds": (int, float)}
_THRESHOLD = {
    "metric": str,
    "at_most": (int, float),
    "at_least": (int, float),
    "confidence": (float, bool),
    "planners": list,
    "crowds": list,
    "compared": bool,
}
_TABLES = ("planner", "crowd", "threshold")


@dataclass(frozen=True)
class SuitePlanner:
    """A planner under test."""

    name: str
    planner: str
    seconds: float


@dataclass(frozen=True)
class Crowd:
    """Who drives around it."""

    name: str
    agent: str
    config: EvaluateConfig


@dataclass(frozen=True)
class Threshold:
    """What must be true of a planner in a crowd.

    Attributes:
        metric: a name of :data:`symphony.bench.measures.MEASURES`.
        limit: in the unit of the metric.
        side: on which side of it the mean must be.
        confidence: with which it must be known to be there; None: the mean itself decides.
        planners: that it holds for.
        crowds: in which it holds.
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
    """All of a suite.

    Attributes:
        name: of the suite.
        path: the file.
        store: the run segments.
        items: rows of the store that are driven, in the order in which they are.
        planners: under test.
        crowds: they drive in.
        thresholds: that they must keep.
        baseline: a planner of the suite that others are compared with, or the ``result.json`` of an earlier run of
            it; empty for none.
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
    """Read a suite and check all of it.

    Args:
        path: the file.
        shared: settings of :class:`symphony.config.EvaluateConfig` that are the machine's, such as ``workers``.

    Raises:
        ConfigError: something can't be used; names file, line and field.
        DataError: the store can't be read.
    """
    try:
        text = path.read_text(encoding="utf-8")
        plain = tomllib.loads(text)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"{path}: no TOML: {error}") from error
    return _Reader(path, text, plain).suite(shared)


class _Reader:
    """The parts of a file, and where in it they are."""

    def __init__(self, path: Path, text: str, plain: Mapping[str, Any]) -> None:
        self.path, self.lines, self.plain = path, text.splitlines(), plain

    def suite(self, shared: dict[str, Any]) -> Suite:
        for key in self.plain:
            if key not in ("suite", *_TABLES):
                raise self._wrong(key, None, "", f"unknown table (known: suite, {', '.join(_TABLES)})")
        top = self._table("suite", None, self.plain.get("suite", {}), _SUITE, ("data",))
        with self._at("suite", None, "data"):
            store = SegmentStore(self._store(top["data"]))
        rollouts, seed = top.get("rollouts", 1), top.get("seed", 0)
        if rollouts < 1:
            raise self._wrong("suite", None, "rollouts", f"must be at least 1, is {rollouts}")
        sure = top.get("confidence", 0.95)
        self._confidence(sure, "suite", None)
        planners, crowds = self._planners(), self._crowds(shared | {"rollouts": rollouts, "seed": seed})
        with self._at("suite", None, "segments"):
            items = self._items(store, top.get("segments", 0))
        if "hardest" in top:
            if not 0 < top["hardest"] <= len(items):
                raise self._wrong(
                    "suite", None, "hardest", f"is of {len(items)} segments, not {top['hardest']}"
                )
            items = tuple(row for row, _ in hardest(store, top["hardest"], items))
        thresholds = self._thresholds(planners, crowds, sure)
        baseline = self._baseline(top.get("baseline", ""), planners)
        known = store.groups
        self._enough(thresholds, len({str(known[i]) for i in items}), bool(baseline))
        name = top.get("name", self.path.stem)
        return Suite(name, self.path, store, items, planners, crowds, thresholds, baseline)

    def _planners(self) -> tuple[SuitePlanner, ...]:
        found: list[SuitePlanner] = []
        for k, given in self._entries("planner"):
            entry = self._table("planner", k, given, _PLANNER, ("planner",))
            name = self._name("planner", k, entry, entry["planner"], [one.name for one in found])
            planner, seconds = self._planner(entry["planner"]), float(entry.get("seconds", 60.0))
            with self._at("planner", k, "planner"):
                planner_maker(planner)
            with self._at("planner", k, "seconds"):
                check_planner_seconds(seconds)
            found.append(SuitePlanner(name, planner, seconds))
        return tuple(found)

    def _crowds(self, shared: Mapping[str, Any]) -> tuple[Crowd, ...]:
        fields = {"name": str, "agent": str} | dict.fromkeys(CROWD_SETTINGS, object)
        found: list[Crowd] = []
        for k, given in self._entries("crowd"):
            entry = self._table("crowd", k, given, fields, ("agent",))
            name = self._name("crowd", k, entry, entry["agent"], [one.name for one in found])
            settings = {key: entry[key] for key in CROWD_SETTINGS if key in entry}
            for key, value in settings.items():
                default = getattr(EvaluateConfig, key)
                # Whole numbers are numbers, and `interactive` may be "all".
                whole = isinstance(default, float) and type(value) is int
                everyone = key == "interactive" and value == "all"
                if not (type(value) is type(default) or whole or everyone):
                    raise self._wrong("crowd", k, key, f"can't be {value!r}")
            with self._at("crowd", k, next(iter(settings), "agent")):
                config = EvaluateConfig(**settings, **shared)
            agent = self._beside(entry["agent"])
            with self._at("crowd", k, "agent"):
                load_agent(agent)
            found.append(Crowd(name, agent, config))
        return tuple(found)

    def _thresholds(
        self, planners: tuple[SuitePlanner, ...], crowds: tuple[Crowd, ...], sure: float
    ) -> tuple[Threshold, ...]:
        found = []
        for k, given in self._entries("threshold"):
            entry = self._table("threshold", k, given, _THRESHOLD, ("metric",))
            if entry["metric"] not in MEASURES:
                raise self._wrong("threshold", k, "metric", f"unknown (known: {', '.join(MEASURES)})")
            sides = [side for side in ("at_most", "at_least") if side in entry]
            if len(sides) != 1:
                raise self._wrong("threshold", k, "metric", "has one of at_most and at_least")
            if not math.isfinite(entry[sides[0]]):
                raise self._wrong("threshold", k, sides[0], f"is a number, not {entry[sides[0]]}")
            confidence = entry.get("confidence", sure)
            if confidence is not False:
                self._confidence(confidence, "threshold", k)
            chosen = {}
            for key, names in (
                ("planners", [one.name for one in planners]),
                ("crowds", [one.name for one in crowds]),
            ):
                for name in entry.get(key, ()):
                    if name not in names:
                        raise self._wrong("threshold", k, key, f"there is no {name!r} among {names}")
                chosen[key] = tuple(entry.get(key, names))
            found.append(
                Threshold(
                    entry["metric"],
                    float(entry[sides[0]]),
                    "at_most" if sides[0] == "at_most" else "at_least",
                    None if confidence is False else float(confidence),
                    chosen["planners"],
                    chosen["crowds"],
                    compared=entry.get("compared", False),
                )
            )
        return tuple(found)

    def _enough(self, thresholds: tuple[Threshold, ...], groups: int, baseline: bool) -> None:
        """Refuse thresholds that no planner could keep with so few segments."""
        for k, one in enumerate(thresholds):
            if one.compared and not baseline:
                raise self._wrong("threshold", k, "compared", "the suite has no baseline")
            if one.confidence is None:
                continue
            needed = 2
            if MEASURES[one.metric].kind == "rate" and not one.compared:
                room = one.limit if one.side == "at_most" else 100.0 - one.limit
                if room <= 0:
                    side = "at least 100 %" if one.side == "at_least" else "0 %"
                    raise self._wrong(
                        "threshold", k, one.side, f"no number of runs shows {side}; set confidence = false"
                    )
                needed = needed_groups(room, one.confidence)
            if groups < needed:
                raise self._wrong(
                    "threshold",
                    k,
                    one.side,
                    f"needs at least {needed} independent groups of segments; these segments are of {groups}",
                )

    def _baseline(self, given: str, planners: tuple[SuitePlanner, ...]) -> str | Path:
        if not given or given in [one.name for one in planners]:
            return given
        path = Path(self._beside(given))
        if not path.is_file():
            raise self._wrong("suite", None, "baseline", "is no planner of the suite and no file")
        return path

    def _items(self, store: SegmentStore, given: int | list[Any]) -> tuple[int, ...]:
        if isinstance(given, list):
            if not given or not all(isinstance(name, str) for name in given):
                raise ConfigError("segments are a number, or a list of ids")
            places = {name: i for i, name in enumerate(store.ids)}
            missing = [name for name in given if name not in places]
            if missing:
                raise ConfigError(f"the store has no segment {missing[0]!r}")
            return tuple(dict.fromkeys(places[name] for name in given))
        if given < 0 or given > len(store):
            raise ConfigError(f"the store has {len(store)} segments, not {given}")
        return tuple(evenly_spaced(len(store), given or len(store)))

    def _entries(self, table: str) -> Iterator[tuple[int, Any]]:
        found = self.plain.get(table, [])
        if not isinstance(found, list):
            raise self._wrong(table, None, "", f"is a list of tables: [[{table}]]")
        if not found:
            raise ConfigError(f"{self.path}: there is no [[{table}]]")
        yield from enumerate(found)

    def _table(
        self, table: str, k: int | None, given: Any, fields: Mapping[str, Any], needed: tuple[str, ...]
    ) -> dict[str, Any]:
        if not isinstance(given, dict):
            raise self._wrong(table, k, "", "is no table")
        for key, value in given.items():
            if key not in fields:
                raise self._wrong(table, k, key, f"unknown (known: {', '.join(fields)})")
            kinds = fields[key] if isinstance(fields[key], tuple) else (fields[key],)
            if not isinstance(value, kinds) or (isinstance(value, bool) and not {bool, object} & set(kinds)):
                raise self._wrong(table, k, key, f"can't be {value!r}")
        for key in needed:
            if key not in given:
                raise self._wrong(table, k, key, "is missing")
        return given

    def _name(self, table: str, k: int, entry: Mapping[str, Any], given: str, taken: list[str]) -> str:
        name = entry.get("name", given.removeprefix("pretrained:"))
        if not NAME.fullmatch(name):
            raise self._wrong(table, k, "name", f"{name!r} is no name: give one of letters, digits and _.+-")
        if name in taken:
            raise self._wrong(table, k, "name", f"{name!r} is there twice")
        return str(name)

    def _confidence(self, value: Any, table: str, k: int | None) -> None:
        if not isinstance(value, float) or not 0.5 < value < 1:
            raise self._wrong(table, k, "confidence", f"is between 0.5 and 1, or false, not {value!r}")

    def _store(self, given: str) -> Path:
        if not given.startswith(BUILTIN):
            return Path(self._beside(given))
        split = given.removeprefix(BUILTIN)
        if split not in ("train", "test"):
            raise ConfigError(f"built in are {BUILTIN}train and {BUILTIN}test, not {given!r}")
        return builtin_store(split)  # type: ignore[arg-type]

    def _planner(self, given: str) -> str:
        file, colon, name = given.rpartition(":")
        if given in NAMES or given.startswith(PIPE) or not file.endswith(".py"):
            return given
        return f"{self._beside(file)}{colon}{name}"

    def _beside(self, given: str) -> str:
        """A path relative to the suite's file; other names as they are."""
        beside = self.path.parent / given
        return str(beside) if beside.exists() else given

    @contextmanager
    def _at(self, table: str, k: int | None, key: str) -> Iterator[None]:
        try:
            yield
        except (SymphonyError, OSError) as error:
            raise self._wrong(table, k, key, str(error)) from error

    def _wrong(self, table: str, k: int | None, key: str, why: str) -> ConfigError:
        field = table if k is None else f"{table} {k + 1}"
        where = f"{self.path}, line {self._line(table, k or 0, key)}, {field}"
        return ConfigError(f"{where}, {key}: {why}" if key else f"{where}: {why}")

    def _line(self, table: str, k: int, key: str) -> int:
        """Where a key of the k-th such table is, else its head, else the first line."""
        head = re.compile(rf"\s*\[+\s*{re.escape(table)}\s*\]+\s*(#.*)?$")
        heads = [number for number, line in enumerate(self.lines, 1) if head.match(line)]
        if k >= len(heads):
            return next(
                (
                    n
                    for n, line in enumerate(self.lines, 1)
                    if re.match(rf"\s*\[*\s*{re.escape(table)}\b", line)
                ),
                1,
            )
        for number, line in enumerate(self.lines[heads[k] :], heads[k] + 1):
            if line.lstrip().startswith("["):
                break
            if key and re.match(rf"\s*{re.escape(key)}\s*=", line):
                return number
        return heads[k]
