"""Planners among crowds: a record for each pair, and one table of all."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from symphony.errors import ConfigError, DataError
from symphony.evaluation.report import report, total_numbers
from symphony.evaluation.table import markdown
from symphony.metrics.intervals import effective_groups, grouped_mean, t_quantile
from symphony.saved.folder import RolloutFolder
from symphony.saved.rollouts import PLAYBACK

COLUMNS = {
    "score": ("score", 1),
    "score_runs": ("scored", 0),
    "collision_rate": ("collisions %", 1),
    "at_fault_collision_rate": ("at fault %", 1),
    "red_light_rate": ("red lights %", 1),
    "offroad_time": ("off-road %", 1),
    "progress_ratio": ("progress", 2),
    "failed_runs": ("failed", 0),
}
"""Numbers of the table, their headings and digits."""
_ABOUT = ("segment", "rollout", "group", "failed", "progress_ratio", "beyond_route", "no_route", "logged_steps")
_RUN = (*_ABOUT, "collision", "at_fault_collision", "red_lights", "offroad_time")  # of each run, in a record
_FREE = ("planner", "planner_seconds", "rollouts")
"""Settings of the planner itself, and of how often it is tried."""
_LATER: dict[str, Any] = {"lights": [], "after_collision": "go-on"}
_BESIDE_LOG = ("interactive", "others", "open_traffic", "radius", "duration", "seed", "inflow", *_LATER, "drives")
"""Settings that mean something where all others play back their log."""

Record = dict[str, Any]


def run_score(run: Mapping[str, Any]) -> float | None:
    """Return the score of a run: its progress in percent of the log's, from 0 to 100. It is 0 if the run failed or
    has a collision at fault, a red light or time off the road, and 100 where the log stays in place, with no progress
    to make. None where progress is undefined: beyond a route that ends inside the map, without a route or a log.
    """
    if run["failed"] or run["at_fault_collision"] or run["red_lights"] or run["offroad_time"]:
        return 0.0
    if run["progress_ratio"] is None:
        unknown = run["beyond_route"] or run["no_route"] or not run.get("logged_steps", 1)
        return None if unknown else 100.0
    return 100.0 * min(max(float(run["progress_ratio"]), 0.0), 1.0)


def planner_record(folder: RolloutFolder) -> Record:
    """Return how the planner in a folder of rollouts drove.

    That is ``planner``, ``crowd`` (who drove the other interactive agents; ``playback`` for the log), ``settings``
    and ``store`` of the simulation; the totals of :func:`symphony.evaluation.report.total_numbers` with the ego
    evaluated, progress relative to the log's along routes only; ``score``, the mean of :func:`run_score`,
    ``score_se``, and ``score_runs`` that have one; ``per_run``. Raises a :class:`DataError` where there is no planner
    in it, or a file of it can't be read.
    """
    about = folder.about
    if "ego" not in about.drivers:
        raise DataError("no planner drove here: simulate with --planner", file=folder.path, field="drivers")
    rows = report(folder, "ego").rows
    member = np.unique([row["group"] for row in rows], return_inverse=True)[1]
    scores = np.array([run_score(row) for row in rows], np.float64)
    known = ~np.isnan(scores)
    score, error = grouped_mean(np.where(known, scores, 0.0), known.astype(np.float64), member)
    name = "/".join(Path(str(about.store["path"])).parts[-2:])  # the path is of no use elsewhere
    record: Record = {"planner": about.drivers["ego"], "crowd": about.drivers["interactive"]}
    record |= {"settings": dict(about.settings), "store": {"name": name, "checksum": about.store["checksum"]}}
    record |= total_numbers(rows) | {"score": score, "score_se": error, "score_runs": int(known.sum())}
    return record | {"per_run": [{name: row[name] for name in _RUN} for row in rows]}


def crowd_name(record: Record) -> str:
    """Return a short name of the crowd: its agent, how many were driven and searched how, who drove the rest."""
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
    """Return the planner's name without its folder."""
    return str(record["planner"]).rpartition("/")[2]


def planners_text(records: Sequence[Record]) -> str:
    """Return the table of some records, planners of a crowd beside each other, and which is first in each crowd."""
    grid = [["crowd", "planner", *(heading for heading, _ in COLUMNS.values())]]
    for crowd, members in _crowds(records).items():
        for one in members:
            grid.append([crowd, planner_title(one)])
            for name, (_, digits) in COLUMNS.items():
                value, error, bound = one[name], one.get(f"{name}_se"), one.get(f"{name}_bound")
                text = "–" if value is None else f"{value:.{digits}f}"
                if bound is not None:
                    text += f" (≤ {bound:.{digits}f})"
                elif value is not None and error is not None:
                    text += f" ± {error:.{digits}f}"
                grid[-1].append(text)
    return "\n".join([markdown(grid), *winners(records)]).rstrip() + "\n"


def _crowds(records: Sequence[Record]) -> dict[str, list[Record]]:
    crowds: dict[str, list[Record]] = {name: [] for name in map(crowd_name, records)}
    for one in sorted(records, key=lambda one: (one["score"] is None, -(one["score"] or 0.0))):
        crowds[crowd_name(one)].append(one)
    return crowds


def check_crowds(records: Sequence[Record]) -> None:
    """Refuse to compare planners that did not meet the same traffic, with a :class:`ConfigError` that names what
    differs between two records of one crowd: the store, the settings or all segments.
    """
    first: dict[str, Record] = {}
    for one in records:
        other = first.setdefault(crowd_name(one), one)
        if differing := crowd_differences(one, other):
            both = f"{planner_title(other)} and {planner_title(one)} did not meet the same crowd"
            raise ConfigError(f"{both}: {', '.join(differing)} differ; compare them separately")


def crowd_differences(one: Record, other: Record) -> list[str]:
    """Return what differs between the traffic of two records: settings, the agent, the store, all segments."""
    here, there = (_LATER | record["settings"] for record in (one, other))  # suites do not save them
    beside_log = one["crowd"] == other["crowd"] == PLAYBACK
    names = _BESIDE_LOG if beside_log else [name for name in there | here if name not in _FREE]
    differing = [name for name in names if here.get(name) != there.get(name)]
    # The same agent may go by several names.
    same_weights = here.get("weights") is not None and here.get("weights") == there.get("weights")
    differing += ["the agent"] if one["crowd"] != other["crowd"] and not same_weights else []
    differing += ["the store"] if one["store"]["checksum"] != other["store"]["checksum"] else []
    return differing + ([] if _scores(one).keys() & _scores(other).keys() else ["all segments"])


def _scores(record: Record) -> dict[str, float | None]:
    """Return the mean score of each segment, None where no run has one."""
    scores = defaultdict[str, list[float]](list)
    for run in record["per_run"]:
        scores[run["segment"]] += [] if (score := run_score(run)) is None else [score]
    return {segment: float(np.mean(each)) if each else None for segment, each in scores.items()}


def winners(records: Sequence[Record]) -> list[str]:
    """Say for each crowd which planner scores best, and by how much over the next one.

    The difference is paired over the segments that both drove (± standard error over groups), and decides which of
    the two is better. It is a win if its 95 % interval, by Student's t, does not include 0.
    """
    found = []
    for crowd, members in _crowds(records).items():
        if len(members) < 2:
            continue
        first, second = members[:2]
        difference, error, groups = paired_difference(first, second)
        if difference is not None and difference < 0:
            first, second, difference = second, first, -difference
        error = error if error and error > 1e-9 else None  # groups that happen to agree say nothing of it
        clear = error is not None and (difference or 0.0) > t_quantile(0.975, groups - 1) * error
        by = "–" if difference is None else f"{difference:.1f}"
        by += "" if error is None else f" ± {error:.1f}"
        unsure = "is first, within the error" if error is not None else "is first, its error unknown"
        verb = "is level with" if difference == 0 else f"{'wins' if clear else unsure}, {by} above"
        one, two = _scores(first).keys(), _scores(second).keys()
        where = "" if one == two else f", in the {len(one & two)} segments that both drove"
        found.append(f"{crowd}: {planner_title(first)} {verb} {planner_title(second)}{where}")
    return found


def paired_difference(one: Record, other: Record) -> tuple[float | None, float | None, float]:
    """Return the mean score of the first less that of the second, paired over segments in which both have one, its
    standard error over groups, and the effective number of equal ones.
    """
    mine, theirs = _scores(one), _scores(other)
    group = {run["segment"]: run["group"] or run["segment"] for run in one["per_run"]}
    apart = {k: a - b for k, a in mine.items() if a is not None and (b := theirs.get(k)) is not None}
    _, member = np.unique([group[segment] for segment in apart], return_inverse=True)
    return *grouped_mean(np.array(list(apart.values())), np.ones(len(apart)), member), effective_groups(member)
