"""The evaluations that stand for runs: which of those a run keeps count, and their numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, get_args

from symphony.config import Method, Setting
from symphony.errors import ConfigError, DataError
from symphony.evaluation.records import (
    find_runs,
    kept_evaluations,
    read_run,
    run_interactive,
    simulation_way,
)

BASELINES = {"playback": "Playback", "constant_velocity": "Constant velocity"}
"""Rows that every table begins with."""
ROWS: tuple[str, ...] = (*BASELINES, *get_args(Method))
SETTINGS: dict[Setting, tuple[int, int]] = {"main": (2, 10), "long": (2, 20), "many": (8, 10)}
"""Interactive agents and seconds."""
AT_STATES = "collision_rate_at_states"
"""The paper's reading of collisions; records from before it had a name have no other."""
WHOLE_LOG = 10
"""Seconds that the whole of the segments counts as, where nothing says how many they are."""


@dataclass(frozen=True)
class Entry:
    """A run and the evaluation that stands for it, or one of several by the way it was simulated."""

    folder: Path
    config: Mapping[str, Any]
    name: str
    record: Mapping[str, Any]
    way: str = ""

    @property
    def method(self) -> str:
        """Row it belongs to."""
        return self.config["method"]

    @property
    def seed(self) -> int:
        """Of its training."""
        return self.config.get("seed", 0)


def method_name(method: str) -> str:
    """A method as the paper writes it, such as BC+TS+H."""
    return BASELINES.get(method) or method.upper().replace("_", "+")


def family(method: str) -> str:
    """Methods that compete for the best value: ``bc`` or ``mgail``."""
    return method.partition("_")[0]


def collect(
    folders: Sequence[Path], setting: Setting, patterns: Sequence[str] = (), *, each: bool = False
) -> tuple[list[Entry], dict[str, list[Path]]]:
    """The evaluated runs of a setting.

    Args:
        folders: runs, or folders of runs.
        setting: of the runs that are wanted.
        patterns: names of evaluations (``*`` and ``?`` stand for anything); of those of a run, the ones that the
            first fitting pattern fits count. Without patterns all do.
        each: take every evaluation that any pattern fits, as a row for each way of simulation.

    Returns:
        The runs, each with its one evaluation (or with each), and those that are left out by the reason.

    Raises:
        ConfigError: no runs, a run with several evaluations, or two runs of the same method and seed.
        DataError: a file that can't be read.
    """
    entries: list[Entry] = []
    left_out: dict[str, list[Path]] = {}
    for folder in find_runs(folders):
        config = read_run(folder)
        reason = _unfit(config, setting)
        if reason:
            left_out.setdefault(reason, []).append(folder)
            continue
        interactive, seconds = SETTINGS[setting]
        kept = {
            name: record
            for name, record in kept_evaluations(folder).items()
            if record["config"]["interactive"] == interactive
            and setting_seconds(record) == seconds
            and record["config"]["duration"] in (0, config.get("duration") or WHOLE_LOG)
        }
        if not fitting(kept, patterns):
            reason = (
                "only evaluated in other ways" if kept else "not evaluated (symphony evaluate RUN --data DIR)"
            )
            left_out.setdefault(reason, []).append(folder)
            continue
        if each:
            names = [name for name in kept if any(fitting([name], [p]) for p in patterns or "*")]
            entries += [Entry(folder, config, n, kept[n], simulation_way(kept[n]["config"])) for n in names]
        else:
            entries.append(Entry(folder, config, *choose_evaluation(folder, kept, patterns)))
    _check_distinct(entries)
    return entries, left_out


def setting_seconds(record: Mapping[str, Any]) -> float:
    """Seconds of the setting that an evaluation belongs to.

    Those asked for; of one over the whole of the segments those of the setting that is nearest to its horizon: logs
    of 9.1 s belong to the one of 10.
    """
    asked: float = record["config"]["duration"]
    horizon: float = record.get("horizon", WHOLE_LOG)
    return asked or min((seconds for _, seconds in SETTINGS.values()), key=lambda each: abs(each - horizon))


def _unfit(config: Mapping[str, Any], setting: Setting) -> str:
    if config["method"] not in ROWS[1:]:
        return f"unknown method {config['method']}"
    interactive, seconds = SETTINGS[setting]
    acting, lasting = run_interactive(dict(config)), config.get("duration", 0)
    if acting != interactive or lasting not in (0, seconds):
        return f"trained with {acting} interactive agents for {lasting or WHOLE_LOG:g} s"
    return ""


def fitting(kept: Iterable[str], patterns: Sequence[str]) -> list[str]:
    """Names of the evaluations that the first fitting pattern fits; all without patterns."""
    if not patterns:
        return list(kept)
    found = ([name for name in kept if fnmatchcase(name, pattern)] for pattern in patterns)
    return next((names for names in found if names), [])


def choose_evaluation(
    run: Path, kept: Mapping[str, dict[str, Any]], patterns: Sequence[str] = ()
) -> tuple[str, dict[str, Any]]:
    """Name and record of the one evaluation of a run that fits (see :func:`collect`).

    Raises:
        ConfigError: none or several do; names them.
    """
    names = fitting(kept, patterns)
    if not kept:
        raise ConfigError(f"{run} keeps no evaluation: symphony evaluate {run} --data DIR")
    if len(names) != 1:
        state = "was evaluated in several ways" if names else "was not evaluated in that way"
        raise ConfigError(f"{run} {state}, choose one with --evaluation: {', '.join(names or kept)}")
    return names[0], kept[names[0]]


def _check_distinct(entries: Sequence[Entry]) -> None:
    seen: dict[tuple[str, int, str], Entry] = {}
    for entry in entries:
        other = seen.setdefault((entry.method, entry.seed, entry.way), entry)
        if other is entry:
            continue
        if other.folder == entry.folder:
            names = f"{other.name}, {entry.name}"
            raise ConfigError(
                f"{entry.folder} was simulated twice as {entry.way}, choose with --evaluation: {names}"
            )
        raise ConfigError(
            f"two runs of {method_name(entry.method)} with seed {entry.seed}: {other.folder}, {entry.folder}"
        )


def number(entry: Entry, where: Mapping[str, Any], key: str) -> float:
    """A number of an evaluation, from its record or a part of it; NaN for a mean over nothing.

    Collisions are those at states only, as the paper and all evaluations of before count them.

    Raises:
        DataError: it is none.
    """
    value = where.get(key, "")
    if key == "collision_rate":
        value = where.get(AT_STATES, value)
    # JSON has no NaN, which stands for a mean over nothing.
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DataError("is no number", file=f"{entry.folder}: {entry.name}", field=key)
    return float(value)
