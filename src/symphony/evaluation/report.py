"""What happened in saved rollouts: a row for each run, totals with errors over groups of segments.

A run is one rollout of one segment. Percent, metres, seconds; what each number means: ``docs/metrics.md``.
"""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import AgentType
from symphony.errors import DataError
from symphony.evaluation.contacts import contacts, time_to_collision
from symphony.evaluation.driving import (
    Lights,
    blocking,
    comfort,
    log_distance,
    progress,
    red_lights,
    wrong_way,
)
from symphony.evaluation.fault import at_fault
from symphony.evaluation.lanes import Lanes
from symphony.metrics import CollisionKind
from symphony.metrics.intervals import ratio, zero_bound
from symphony.render.viewer import Event
from symphony.saved.folder import RolloutFolder
from symphony.saved.rollouts import SavedRollouts, world_of

Evaluated = Literal["interactive", "ego"]
Row = dict[str, Any]

LOW_TTC = 1.0
"""Seconds to a collision below which time counts as spent too near to one."""
KIND_NAMES = {kind: kind.name.lower().replace("_", " ") for kind in CollisionKind}
_NUMBERS = (
    "collision",
    "collision_at_states",
    "at_fault_collision",
    "collisions",
    "red_lights",
    "offroad_time",
    "wrong_way_time",
    "blocking_time",
    "min_ttc",
    "low_ttc_time",
    "progress",
    "progress_ratio",
    "beyond_route",
    "no_route",
    "max_acceleration",
    "max_braking",
    "max_jerk",
    "max_lateral_acceleration",
    "log_distance",
    "first_event",
    "steps",
    "logged_steps",
)
"""Numbers of a run; None for one that is not defined."""
_WORST = (
    "at_fault_collision",
    "collision",
    "red_lights",
    "offroad_time",
    "wrong_way_time",
    "blocking_time",
    "low_ttc_time",
)
"""What makes a run that did not fail a bad one, worst first."""
_MEANS = {
    "collision_rate": ("collision", 100.0, None),
    "collision_rate_at_states": ("collision_at_states", 100.0, None),
    "at_fault_collision_rate": ("at_fault_collision", 100.0, None),
    "red_light_rate": ("red_lights", 100.0, None),
    "offroad_time": ("offroad_time", 1.0, "steps"),
    "wrong_way_time": ("wrong_way_time", 1.0, "steps"),
    "blocking_time": ("blocking_time", 1.0, "steps"),
    "low_ttc_time": ("low_ttc_time", 1.0, "steps"),
    "progress": ("progress", 1.0, None),
    "progress_ratio": ("progress_ratio", 1.0, None),
    "log_distance": ("log_distance", 1.0, "logged_steps"),
    "mean_max_jerk": ("max_jerk", 1.0, None),
    "mean_max_acceleration": ("max_acceleration", 1.0, None),
    "mean_max_braking": ("max_braking", 1.0, None),
    "mean_max_lateral_acceleration": ("max_lateral_acceleration", 1.0, None),
}
"""Means over runs: of which number, times what, weighted by what."""


@dataclass
class Report:
    """What was found in a folder of rollouts.

    Attributes:
        agent: name of what was evaluated.
        evaluated: which driven agents: all interactive ones, or the ego.
        rows: one for each run, in the order of segments and rollouts.
        collisions: how many there were, by kind, type of the other, fault, and whether the other played back the log.
        events: of each segment, to be marked in its replay.
    """

    agent: str
    evaluated: Evaluated
    rows: list[Row] = field(default_factory=list)
    collisions: Counter[tuple[str, str, bool, bool]] = field(default_factory=Counter)
    events: dict[str, list[Event]] = field(default_factory=dict)

    def worst(self) -> list[Row]:
        """The runs, worst first; equal ones in their order."""

        def badness(row: Row) -> list[float]:
            return [-float(bool(row["failed"])), *(-_known(row[name]) for name in _WORST)]

        return sorted(self.rows, key=badness)

    def breakdown(self) -> list[Row]:
        """Collisions by kind and so on, most frequent first."""
        names = ("kind", "other", "at_fault", "with_playback")
        return [
            dict(zip(names, key, strict=True)) | {"collisions": n} for key, n in self.collisions.most_common()
        ]

    def totals(self) -> Row:
        """Numbers of all runs, see :func:`total_numbers`."""
        return total_numbers(self.rows)

    def plain(self) -> Row:
        """All of it, as JSON can hold it."""
        units = {"rates and times": "percent", "lengths": "m", "durations": "s", "motion": "m/s^2, m/s^3"}
        about = {"agent": self.agent, "evaluated": self.evaluated, "units": units}
        return about | self.totals() | {"collisions": self.breakdown(), "per_run": self.worst()}

    def csv(self) -> str:
        """The rows, worst first; words that begin like a formula get an apostrophe, so no spreadsheet runs them."""
        out = io.StringIO()
        writer = csv.DictWriter(
            out, ("segment", "rollout", "group", "failed", *_NUMBERS), lineterminator="\n"
        )
        writer.writeheader()
        for row in self.worst():
            formulas = {
                name: f"'{value}"
                for name, value in row.items()
                if isinstance(value, str) and value.startswith(("=", "+", "-", "@"))
            }
            writer.writerow(row | formulas)
        return out.getvalue()


def report(
    folder: RolloutFolder,
    evaluated: Evaluated = "interactive",
    progress_bar: Callable[[int, int], None] | None = None,
) -> Report:
    """Evaluate all rollouts of a folder.

    Args:
        folder: the rollouts.
        evaluated: which of the driven agents.
        progress_bar: called with the segments done and their total.

    Raises:
        DataError: a segment can't be read, or its ego was not driven but is to be evaluated.
    """
    found = Report(folder.about.agent, evaluated)
    for number, saved in enumerate(folder):
        add_segment(found, saved)
        if progress_bar is not None:
            progress_bar(number + 1, len(folder))
    for lost in folder.failures:
        name, group, reason = lost.segment, lost.group or lost.segment, lost.failed or "failed"
        for k in range(lost.rollouts):
            run = {"segment": name, "rollout": k, "group": group, "failed": reason}
            found.rows.append(run | dict.fromkeys(_NUMBERS))
    return found


def add_segment(found: Report, saved: SavedRollouts) -> None:
    """Evaluate the rollouts of one segment and add them to a report."""
    segment, who = saved.segment, saved.evaluated
    name = segment.segment_id
    if found.evaluated == "ego":
        who = np.flatnonzero(saved.agents == segment.ego)
        if not len(who):
            raise DataError("the ego was not driven", segment=name, field="agents")
    numbers, events = _numbers(saved, who)
    for k, values in enumerate(numbers):
        run = {
            "segment": name,
            "rollout": k,
            "group": segment.group or name,
            "failed": saved.failed.get(k, ""),
        }
        found.rows.append(run | values)
    for hit in (event for event in events if event.kind == "collision" and event.rollout not in saved.failed):
        other = AgentType(segment.agent_type[hit.other]).name.lower()
        found.collisions[hit.text, other, bool(hit.fault), hit.other not in saved.agents] += 1
    found.events[name] = events


def _numbers(saved: SavedRollouts, who: NDArray[np.int64]) -> tuple[list[Row], list[Event]]:
    """Numbers of every rollout, and what is to be marked in them."""
    segment, rows, lanes = saved.segment, saved.agents[who], Lanes(saved.segment)
    moved, motion = progress(saved, who, lanes), comfort(saved, who)
    distance, logged = log_distance(saved, who)
    out, events = [], []
    worlds = [world_of(saved, k) for k in range(saved.rollouts)]
    for k, (world, hits) in enumerate(zip(worlds, contacts(worlds, rows), strict=True)):
        counted = saved.counted[k][:, who].T
        off, stands = np.zeros((2, *world.valid.shape), bool)
        off[saved.agents, 1:] = (saved.offroad[k] & saved.counted[k]).T
        lights = red_lights(world, np.union1d(rows, hits.other), lanes, saved.start)
        fault = at_fault(world, hits, lanes, off, lights)
        # Those of others only say whose fault a collision is.
        lights = Lights(*(part[np.isin(lights.agent, rows)] for part in lights))
        stands[rows] = blocking(world, rows, lanes, saved.start)
        found = [
            Event(k, step, agent, "collision", KIND_NAMES[CollisionKind(kind)], other, mine, "collision")
            for agent, other, step, kind, mine in _each(hits.agent, hits.other, hits.step, hits.kind, fault)
        ]
        found += [
            Event(k, step, agent, "redlight", "runs a red light", label="red light")
            for agent, step in _each(lights.agent, lights.step)
        ]
        for flags, kind, text, label in (
            (off, "offroad", "leaves the road", "off road"),
            (stands, "blocking", "blocks traffic", "blocks traffic"),
        ):
            begins = flags[rows] & ~np.pad(flags[rows][:, :-1], ((0, 0), (1, 0)))
            found += [
                Event(k, step, int(rows[m]), kind, text, label=label) for m, step in _each(*begins.nonzero())
            ]
        found.sort(key=lambda event: event.step)
        events += found
        ttc = np.where(counted, time_to_collision(world, rows)[:, 1:], math.inf)
        steps = int(counted.sum())
        lane_steps = steps * (len(lanes.graph.usable_lanes) > 0)
        # Of an agent whose progress is not defined, the log's does not count either.
        known = np.isfinite(moved.driven[k])
        of_log = float(moved.logged[k][known].sum())
        out.append(
            {
                "collision": len(hits.agent) > 0,
                "collision_at_states": bool(hits.at_state.any()),
                "at_fault_collision": bool(fault.any()),
                "collisions": len(hits.agent),
                "red_lights": len(lights.agent) if len(segment.signal_lane) else None,
                "offroad_time": _percent(off[rows], steps * (len(segment.road.boundary) > 0)),
                "wrong_way_time": _percent(wrong_way(world, rows, lanes)[:, 1:] & counted, lane_steps),
                "blocking_time": _percent(stands[rows, 1:] & counted, lane_steps),
                "min_ttc": _most(-ttc, -1.0),
                "low_ttc_time": _percent(ttc < LOW_TTC, steps),
                "progress": float(moved.driven[k][known].mean()) if known.any() else None,
                "progress_ratio": float(moved.compared[k][known].sum()) / of_log if of_log > 1 else None,
                "beyond_route": int((~known).sum()),
                "no_route": int((saved.goal[k, who] < 0).sum()),
                "max_acceleration": _most(motion.acceleration[k]),
                "max_braking": _most(-motion.acceleration[k]),
                "max_jerk": _most(np.abs(motion.jerk[k])),
                "max_lateral_acceleration": _most(np.abs(motion.lateral[k])),
                "log_distance": float(distance[k] / logged[k]) if logged[k] else None,
                "first_event": round(found[0].step * segment.dt, 3) if found else None,
                "steps": steps,
                "logged_steps": int(logged[k]),
            }
        )
    return out, events


def _each(*parts: NDArray[Any]) -> Any:
    return zip(*(part.tolist() for part in parts), strict=True)


def _percent(flags: NDArray[np.bool_], whole: int) -> float | None:
    return 100.0 * float(flags.sum()) / whole if whole else None


def _most(values: NDArray[np.float64], sign: float = 1.0) -> float | None:
    """The largest finite value, times a sign; None without any."""
    known = values[np.isfinite(values)]
    return sign * float(known.max()) + 0.0 if len(known) else None


def _known(value: Any) -> float:
    return 0.0 if value is None else float(value)


def total_numbers(rows: Sequence[Row]) -> Row:
    """Totals of some runs.

    Returns:
        ``runs`` (failed ones included), ``failed_runs``, ``segments`` and ``groups``; over the runs that did not fail
        the means, each with its standard error over groups under ``*_se`` (None for a single group) and the segments
        that have such a number under ``*_segments``; the largest ``max_*`` and the smallest ``min_ttc``. ``*_rate``
        are percent of runs (``collision_rate_at_states``: at states only), ``*_time`` percent of the evaluated
        agents' time, ``log_distance`` is a mean over steps. ``*_bound`` is of a percentage that is zero the exact
        bound over groups with 95 % confidence (:func:`symphony.metrics.intervals.zero_bound`), else None.
    """
    good = [row for row in rows if not row["failed"]]
    names, member = np.unique([row["group"] for row in good], return_inverse=True)
    out: Row = {
        "runs": len(rows),
        "failed_runs": len(rows) - len(good),
        "segments": len({row["segment"] for row in rows}),
        "groups": len(names),
    }
    for name, (of, scale, by) in _MEANS.items():
        value = np.array([_known(row[of]) for row in good], np.float64)
        if of == "red_lights":
            value = (value > 0).astype(np.float64)
        weight = np.array(
            [0.0 if row[of] is None else 1.0 if by is None else row[by] for row in good], np.float64
        )
        out[name], out[f"{name}_se"] = grouped_mean(scale * value, weight, member)
        has = weight > 0
        out[f"{name}_segments"] = len({row["segment"] for row, some in zip(good, has, strict=True) if some})
        if name.endswith(("_rate", "_time", "_states")):
            out[f"{name}_bound"] = zero_bound(len(np.unique(member[has]))) if out[name] == 0 else None
    for name in ("max_acceleration", "max_braking", "max_jerk", "max_lateral_acceleration"):
        out[name] = max((row[name] for row in good if row[name] is not None), default=None)
    out["min_ttc"] = min((row["min_ttc"] for row in good if row["min_ttc"] is not None), default=None)
    return out


def grouped_mean(
    value: NDArray[np.float64], weight: NDArray[np.float64], member: NDArray[np.int64]
) -> tuple[float | None, float | None]:
    """Weighted mean and standard error over groups (:func:`symphony.metrics.intervals.ratio`); None for NaN."""
    mean, error = ratio(value * weight, weight, member)
    return None if math.isnan(mean) else mean, None if math.isnan(error) else error
