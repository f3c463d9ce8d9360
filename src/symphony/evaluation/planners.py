"""Planners among crowds: a record for each pair, and one table of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from symphony.errors import ConfigError, DataError
from symphony.evaluation.records import read_object
from symphony.evaluation.report import grouped_mean, report, total_numbers
from symphony.metrics.intervals import t_quantile
from symphony.saved.folder import LATER, RolloutFolder
from symphony.saved.rollouts import PLAYBACK

FORMAT = 1
"""Version of a record."""
COLUMNS = (
    ("score", "score", 1),
    ("collision_rate", "collisions %", 1),
    ("at_fault_collision_rate", "at fault %", 1),
    ("red_light_rate", "red lights %", 1),
    ("offroad_time", "off-road %", 1),
    ("progress_ratio", "progress", 2),
    ("failed_runs", "failed", 0),
)
"""Numbers of the table, their headings and digits."""
_RUN = (
    "segment",
    "rollout",
    "group",
    "failed",
    "collision",
    "at_fault_collision",
    "red_lights",
    "offroad_time",
    "progress_ratio",
)
"""Of each run, in a record."""
_LATER = ("beyond_route", "no_route")
"""Of each run, too, but in older records there are none; they count as 0."""
_FREE = ("planner", "planner_seconds", "rollouts")
"""Settings that are the planner's own, and how often it is tried."""
_BESIDE_LOG = ("interactive", "others", "open_traffic", "radius", "duration", "seed")
"""Settings that mean something where all others play back their log."""

Record = dict[str, Any]


def run_score(run: Mapping[str, Any]) -> float | None:
    """0 to 100 of one run: the progress relative to the log's, at most all of it; 0 for a run that failed, with a
    collision at fault, a red light, or time off the road. 100 where the log stays in place, as there is no progress
    to make; None where progress is not defined: beyond a route that ends inside the map, or without a route.
    """
    if run["failed"] or run["at_fault_collision"] or run["red_lights"] or run["offroad_time"]:
        return 0.0
    if run["progress_ratio"] is None:
        return None if any(run.get(name) for name in _LATER) else 100.0
    return 100.0 * min(max(float(run["progress_ratio"]), 0.0), 1.0)


def planner_record(folder: RolloutFolder) -> Record:
    """How the planner in a folder of rollouts drove.

    Returns:
        ``planner``, ``crowd`` (who drove the other interactive agents; ``playback`` for the log), ``settings`` and
        ``store`` of the simulation; the totals of :func:`symphony.evaluation.report.total_numbers` with the ego
        evaluated, progress relative to the log's along routes only; ``score``, the mean of :func:`run_score`,
        ``score_se``, and ``score_runs`` that have one; ``per_run``.

    Raises:
        DataError: there is no planner in it, or a file of it can't be read.
    """
    about = folder.about
    if "ego" not in about.drivers:
        raise DataError("no planner drove here: simulate with --planner", file=folder.path, field="drivers")
    rows = report(folder, "ego").rows
    for row in rows:
        # Metres of a planner without a route are no progress: it may have gone anywhere.
        lost = bool(row["no_route"]) and row["progress_ratio"] is not None
        row |= {"no_route": int(lost), "progress_ratio": None if lost else row["progress_ratio"]}
    member = np.unique([row["group"] for row in rows], return_inverse=True)[1]
    scores = np.array([run_score(row) for row in rows], np.float64)
    known = ~np.isnan(scores)
    score, error = grouped_mean(np.where(known, scores, 0.0), known.astype(np.float64), member)
    return {
        "format": FORMAT,
        "planner": about.drivers["ego"],
        "crowd": about.drivers["interactive"],
        "settings": dict(about.settings),
        # The path is of no use elsewhere.
        "store": {
            "name": "/".join(Path(str(about.store["path"])).parts[-2:]),
            "checksum": about.store["checksum"],
        },
        **total_numbers(rows),
        "score": score,
        "score_se": error,
        "score_runs": int(known.sum()),
        "per_run": [{name: row[name] for name in (*_RUN, *_LATER)} for row in rows],
    }


def read_planner_record(path: Path) -> Record:
    """A record from a file.

    Raises:
        DataError: it can't be read, or is no such record.
    """
    found = read_object(path)
    if found.get("format") != FORMAT or "planner" not in found:
        raise DataError("no record of a planner (format 1)", file=path, field="format")
    kinds: dict[str, Any] = {"crowd": str, "settings": dict, "store": dict, "per_run": list}
    kinds |= {name: (int, float, type(None)) for name, _, _ in COLUMNS}
    wrong = [name for name, kind in kinds.items() if name not in found or not isinstance(found[name], kind)]
    if not wrong and "checksum" not in found["store"]:
        wrong = ["store"]
    if wrong:
        raise DataError("is not what a record of a planner has", file=path, field=wrong[0])
    if not all(isinstance(run, dict) and run.keys() >= set(_RUN) for run in found["per_run"]):
        raise DataError("has a run without one of its numbers", file=path, field="per_run")
    return found


def crowd_name(record: Record) -> str:
    """The crowd in few words: its agent, how many were driven, whether they were searched, and who drove the rest."""
    name = str(record["crowd"]).rpartition("/")[2].removeprefix("pretrained:")
    settings = record["settings"]
    others = settings.get("others", "log")
    if name == PLAYBACK:
        return "log" if others == "log" else f"{others}, all driven"
    many = settings["interactive"]
    driven = "all" if many == "all" else int(many) - 1
    search = "" if settings.get("search", "agent") == "agent" else f", search {settings['search']}"
    return f"{name}, {driven} driven{search}" + ("" if others == "log" else f", others {others}")


def planner_title(record: Record) -> str:
    """The planner's name without its folder."""
    return str(record["planner"]).rpartition("/")[2]


def _crowds(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Records by their crowd, the best score first, those without any last."""
    crowds: dict[str, list[Record]] = {}
    for one in records:
        crowds.setdefault(crowd_name(one), []).append(one)
    return {
        name: sorted(members, key=lambda one: (one["score"] is None, -(one["score"] or 0.0)))
        for name, members in crowds.items()
    }


def planner_grid(records: Sequence[Record]) -> list[list[str]]:
    """A line for each record, its heading first; planners of a crowd beside each other, the best score first."""
    grid = [["crowd", "planner", *(heading for _, heading, _ in COLUMNS)]]
    for crowd, members in _crowds(records).items():
        for one in members:
            cells = []
            for name, _, digits in COLUMNS:
                value, error, bound = one[name], one.get(f"{name}_se"), one.get(f"{name}_bound")
                text = "–" if value is None else f"{value:.{digits}f}"
                spread = "" if value is None or error is None else f" ± {error:.{digits}f}"
                cells.append(text + (spread if bound is None else f" (≤ {bound:.{digits}f})"))
            grid.append([crowd, planner_title(one), *cells])
    return grid


def without_score(records: Sequence[Record]) -> list[str]:
    """Which runs have no score, in a sentence, where some have none."""
    lost = [(one, sum(run_score(run) is None for run in one["per_run"])) for one in records]
    found = [
        f"{planner_title(one)} among {crowd_name(one)} {count} of {len(one['per_run'])} runs"
        for one, count in lost
        if count
    ]
    return [f"without a score, as progress is not defined: {', '.join(found)}"] if found else []


def counted_at_states(records: Sequence[Record]) -> list[str]:
    """How collisions were counted, in a sentence, where some were only between states."""
    name = "collision_rate_at_states"
    found = [
        f"{planner_title(one)} among {crowd_name(one)} {one[name]:.1f} %"
        for one in records
        if one.get(name) is not None and one[name] != one["collision_rate"]
    ]
    return [f"collisions are found between states, too; at states only: {', '.join(found)}"] if found else []


def check_crowds(records: Sequence[Record]) -> None:
    """Refuse to put planners beside each other that did not meet the same.

    Raises:
        ConfigError: of two records of one crowd the store, the settings or all segments differ; names what does.
    """
    first: dict[str, Record] = {}
    for one in records:
        other = first.setdefault(crowd_name(one), one)
        here, there = one["settings"], other["settings"]
        names = [name for name in dict.fromkeys([*there, *here]) if name not in _FREE]
        if one["crowd"] == other["crowd"] == PLAYBACK:
            names = [name for name in names if name in _BESIDE_LOG]
        # Records from before these were kept lack them.
        names = [n for n in names if n not in LATER or None not in (here.get(n), there.get(n))]
        differing = [name for name in names if here.get(name) != there.get(name)]
        # The same agent may go by several names.
        same_weights = here.get("weights") is not None and here.get("weights") == there.get("weights")
        if one["crowd"] != other["crowd"] and not same_weights:
            differing.append("the agent")
        if one["store"].get("checksum") != other["store"].get("checksum"):
            differing.append("the store")
        if not _segments(one) & _segments(other):
            differing.append("all segments")
        if differing:
            raise ConfigError(
                f"{planner_title(other)} and {planner_title(one)} did not meet the same crowd: "
                f"{', '.join(differing)} differ; compare them apart"
            )


def _segments(record: Record) -> set[str]:
    return {run["segment"] for run in record["per_run"]}


def winners(records: Sequence[Record]) -> list[str]:
    """For each crowd a sentence: which planner scores best, and by how much over the next one.

    The difference is paired over the runs of the segments that both drove (± standard error over groups); whether 0
    is outside of its 95 % interval is by Student's t. Of two that drove different segments the better is who was
    better where both did.
    """
    found = []
    for crowd, members in _crowds(records).items():
        if len(members) < 2:
            continue
        first, second = members[:2]
        difference, error, groups = paired_difference(first, second)
        if difference is not None and difference < 0:
            first, second, difference = second, first, -difference
        apart = 0.0 if difference is None else difference
        clear = error is not None and apart > t_quantile(0.975, groups - 1) * error
        by = "–" if difference is None else f"{difference:.1f}"
        by += "" if error is None else f" ± {error:.1f}"
        verb = "wins" if clear else "is first, within the error"
        shared = len(_segments(first) & _segments(second))
        where = "" if _segments(first) == _segments(second) else f", in the {shared} segments that both drove"
        found.append(f"{crowd}: {planner_title(first)} {verb}, {by} above {planner_title(second)}{where}")
    return found


def paired_difference(one: Record, other: Record) -> tuple[float | None, float | None, int]:
    """Mean score of the first less that of the second, paired over segments in which both have one, its standard
    error over groups, and how many of these there are.
    """
    means = []
    for record in (one, other):
        by_segment: dict[str, list[float]] = {}
        for run in record["per_run"]:
            if (score := run_score(run)) is not None:
                by_segment.setdefault(run["segment"], []).append(score)
        means.append({segment: float(np.mean(scores)) for segment, scores in by_segment.items()})
    both = sorted(means[0].keys() & means[1].keys())
    group = {run["segment"]: run["group"] or run["segment"] for run in one["per_run"]}
    names, member = np.unique([group[segment] for segment in both], return_inverse=True)
    apart = np.array([means[0][segment] - means[1][segment] for segment in both], np.float64)
    return *grouped_mean(apart, np.ones_like(apart), member), len(names)
