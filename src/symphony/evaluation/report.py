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
from symphony.evaluation.blocking import blocking
from symphony.evaluation.contacts import Contacts, contacts, time_to_collision
from symphony.evaluation.driving import comfort, log_distance, progress, red_lights, wrong_way
from symphony.evaluation.fault import Lights, at_fault
from symphony.metrics import CollisionKind
from symphony.metrics.intervals import zero_bound
from symphony.render.viewer import Event
from symphony.roadgraph import LaneGraph
from symphony.saved.folder import RolloutFolder
from symphony.saved.rollouts import SavedRollouts
from symphony.saved.world import world_of

Evaluated = Literal["interactive", "ego"]
Row = dict[str, Any]

LOW_TTC = 1.0
"""Seconds to a collision below which time counts as spent too near to one."""
KIND_NAMES = {kind: kind.name.lower().replace("_", " ") for kind in CollisionKind}
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


@dataclass
class Report:
    """What was found in a folder of rollouts.

    Attributes:
        rows: one for each run, in the order of segments and rollouts.
        collisions: how many there were, by kind, type of the other, fault, and whether the other played back the log.
        events: of each segment, to be marked in its replay.
        evaluated: which driven agents: all interactive ones, or the ego.
        agent: name of what was evaluated.
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
        """Over all runs that did not fail, standard errors over groups beside them as ``*_se``.

        Rates and times in percent; see :func:`total_numbers`.
        """
        return total_numbers(self.rows)

    def plain(self) -> Row:
        """All of it, as JSON can hold it."""
        units = {"rates and times": "percent", "lengths": "m", "durations": "s", "motion": "m/s^2, m/s^3"}
        return {
            "agent": self.agent,
            "evaluated": self.evaluated,
            "units": units,
            **self.totals(),
            "collisions": self.breakdown(),
            "per_run": self.worst(),
        }

    def csv(self) -> str:
        """The rows, worst first."""
        out = io.StringIO()
        rows = self.worst()
        names = ("segment", "rollout", "group", "failed", *_NUMBERS)
        writer = csv.DictWriter(out, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
        return out.getvalue()


def _cell(value: Any) -> Any:
    """A value as a cell that no spreadsheet takes for a formula: words that begin like one get an apostrophe."""
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@")):
        return f"'{value}"
    return "" if value is None else value


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
    for failure in folder.failures:
        empty = dict.fromkeys(_NUMBERS)
        for k in range(failure.rollouts):
            found.rows.append(_row(failure.segment, k, failure.group, failure.failed or "failed", empty))
    return found


def add_segment(found: Report, saved: SavedRollouts) -> None:
    """Evaluate the rollouts of one segment and add them to a report."""
    segment = saved.segment
    who = saved.evaluated
    if found.evaluated == "ego":
        who = np.flatnonzero(saved.agents == segment.ego)
        if not len(who):
            raise DataError("the ego was not driven", segment=segment.segment_id, field="agents")
    graph = LaneGraph(segment.road)
    numbers, events = _numbers(saved, who, graph)
    group = segment.group or segment.segment_id
    for k, values in enumerate(numbers):
        found.rows.append(_row(segment.segment_id, k, group, saved.failed.get(k, ""), values))
    for hit in (event for event in events if event.kind == "collision" and event.rollout not in saved.failed):
        other = AgentType(segment.agent_type[hit.other]).name.lower()
        found.collisions[hit.text, other, bool(hit.fault), hit.other not in saved.agents] += 1
    found.events[segment.segment_id] = events


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


def _row(segment: str, rollout: int, group: str, failed: str, values: Row) -> Row:
    return {"segment": segment, "rollout": rollout, "group": group or segment, "failed": failed, **values}


def _numbers(saved: SavedRollouts, who: NDArray[np.int64], graph: LaneGraph) -> tuple[list[Row], list[Event]]:
    """Numbers of every rollout, and what is to be marked in them."""
    segment, rows = saved.segment, saved.agents[who]
    has_road, has_lanes = len(segment.road.boundary) > 0, len(graph.usable_lanes) > 0
    has_lights = len(segment.signal_lane) > 0
    moved, motion = progress(saved, who), comfort(saved, who)
    distance, logged = log_distance(saved, who)
    out, events = [], []
    worlds = [world_of(saved, k) for k in range(saved.rollouts)]
    met = contacts(worlds, rows)
    for k, (world, hits) in enumerate(zip(worlds, met, strict=True)):
        counted = saved.counted[k][:, who]
        off = np.zeros(world.valid.shape, bool)
        off[saved.agents, 1:] = (saved.offroad[k] & saved.counted[k]).T
        lights = red_lights(world, np.union1d(rows, hits.other), segment, saved.start)
        fault = at_fault(world, hits, graph, segment, off, lights)
        # Those of others only say whose fault a collision is.
        lights = Lights(*(part[np.isin(lights.agent, rows)] for part in lights))
        stands = np.zeros_like(off)
        stands[rows] = blocking(world, rows, segment, graph, saved.start)
        found = [
            *_collision_events(k, hits, fault),
            *_light_events(k, lights),
            *_begin_events(k, rows, off, "offroad", "leaves the road", "off road"),
            *_begin_events(k, rows, stands, "blocking", "blocks traffic", "blocks traffic"),
        ]
        found.sort(key=lambda event: event.step)
        events += found
        ttc = np.where(counted.T, time_to_collision(world, rows)[:, 1:], math.inf)
        steps = int(counted.sum())
        # Of an agent whose progress is not defined, the log's does not count either.
        known = np.isfinite(moved.driven[k])
        logged_progress = float(moved.logged[k][known].sum())
        out.append(
            {
                "collision": len(hits.agent) > 0,
                "collision_at_states": bool(hits.at_state.any()),
                "at_fault_collision": bool(fault.any()),
                "collisions": len(hits.agent),
                "red_lights": len(lights.agent) if has_lights else None,
                "offroad_time": _percent(off[rows].sum(), steps * has_road),
                "wrong_way_time": _percent(
                    (wrong_way(world, rows, graph)[:, 1:] & counted.T).sum(), steps * has_lanes
                ),
                "blocking_time": _percent((stands[rows, 1:] & counted.T).sum(), steps * has_lanes),
                "min_ttc": _finite(ttc.min(initial=math.inf)),
                "low_ttc_time": _percent((ttc < LOW_TTC).sum(), steps),
                "progress": float(moved.driven[k][known].mean()) if known.any() else None,
                "progress_ratio": float(moved.compared[k][known].sum()) / logged_progress
                if logged_progress > 1
                else None,
                "beyond_route": int((~known).sum()),
                "no_route": int((saved.goal[k, who] < 0).sum()),
                "max_acceleration": _peak(motion.acceleration[k]),
                "max_braking": _peak(-motion.acceleration[k]),
                "max_jerk": _peak(np.abs(motion.jerk[k])),
                "max_lateral_acceleration": _peak(np.abs(motion.lateral[k])),
                "log_distance": float(distance[k] / logged[k]) if logged[k] else None,
                "first_event": round(found[0].step * segment.dt, 3) if found else None,
                "steps": steps,
                "logged_steps": int(logged[k]),
            }
        )
    return out, events


def _percent(part: Any, whole: int) -> float | None:
    return 100.0 * float(part) / whole if whole else None


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None


def _peak(values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.max()) + 0.0 if len(known) else None


def _known(value: Any) -> float:
    return 0.0 if value is None else float(value)


def _collision_events(rollout: int, hits: Contacts, fault: NDArray[np.bool_]) -> list[Event]:
    label = "collision"
    parts = hits.agent, hits.other, hits.step, hits.kind, fault
    return [
        Event(rollout, step, agent, label, KIND_NAMES[CollisionKind(kind)], other, mine, label)
        for agent, other, step, kind, mine in zip(*(part.tolist() for part in parts), strict=True)
    ]


def _light_events(rollout: int, lights: Any) -> list[Event]:
    found = zip(lights.agent.tolist(), lights.step.tolist(), strict=True)
    return [
        Event(rollout, step, agent, "redlight", "runs a red light", label="red light")
        for agent, step in found
    ]


def _begin_events(
    rollout: int, rows: NDArray[np.int64], flags: NDArray[np.bool_], kind: str, text: str, label: str
) -> list[Event]:
    """Where something begins that lasts, of flags [A, U]."""
    begins = flags[rows] & ~np.pad(flags[rows][:, :-1], ((0, 0), (1, 0)))
    found = zip(*(part.tolist() for part in begins.nonzero()), strict=True)
    return [Event(rollout, step, int(rows[m]), kind, text, label=label) for m, step in found]


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
_SHARES = [name for name in _MEANS if name.endswith(("_rate", "_time", "_states"))]
"""Those in percent, of runs or of time: of one that is zero an upper bound is known."""
_PEAKS = ("max_acceleration", "max_braking", "max_jerk", "max_lateral_acceleration")


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
    out: Row = {
        "runs": len(rows),
        "failed_runs": len(rows) - len(good),
        "segments": len({row["segment"] for row in rows}),
        "groups": len({row["group"] for row in good}),
    }
    names = sorted({row["group"] for row in good})
    group = np.array([names.index(row["group"]) for row in good], np.int64)
    for name, (of, scale, by) in _MEANS.items():
        known = np.array([row[of] is not None for row in good], bool)
        value = np.array([_known(row[of]) for row in good], np.float64)
        if of == "red_lights":
            value = (value > 0).astype(np.float64)
        weight = known * np.array([1.0 if by is None else row[by] for row in good], np.float64)
        out[name], out[f"{name}_se"] = grouped_mean(scale * value, weight, group)
        out[f"{name}_segments"] = len(
            {row["segment"] for row, some in zip(good, weight > 0, strict=True) if some}
        )
        if name in _SHARES:
            out[f"{name}_bound"] = zero_bound(len(np.unique(group[weight > 0]))) if out[name] == 0 else None
    for name in _PEAKS:
        out[name] = max((row[name] for row in good if row[name] is not None), default=None)
    out["min_ttc"] = min((row["min_ttc"] for row in good if row["min_ttc"] is not None), default=None)
    return out


def grouped_mean(
    value: NDArray[np.float64], weight: NDArray[np.float64], group: NDArray[np.int64]
) -> tuple[float | None, float | None]:
    """Weighted mean and its standard error over groups (linearised: groups are what was drawn independently).

    Groups without weight are none.
    """
    total, share = np.bincount(group, value * weight), np.bincount(group, weight)
    total, share = total[share > 0], share[share > 0]
    if not len(share):
        return None, None
    mean = float(total.sum() / share.sum())
    count = len(total)
    if count < 2:
        return mean, None
    residual = (total - mean * share) / share.mean()
    return mean, float(np.sqrt((residual**2).sum() / (count - 1) / count))
