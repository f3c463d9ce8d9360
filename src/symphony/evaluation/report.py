"""The events in saved rollouts: a row for each run, totals with errors over groups of segments.

A run is one rollout of one segment. ``docs/metrics.md`` says what each number means.
"""

from __future__ import annotations

import csv
import io
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import AgentType
from symphony.errors import DataError
from symphony.evaluation import driving
from symphony.evaluation.contacts import Contacts, at_fault, contacts, time_to_collision
from symphony.metrics import CollisionKind
from symphony.metrics.intervals import grouped_mean, zero_bound
from symphony.render.viewer import Event, Replay
from symphony.saved.folder import RolloutFolder
from symphony.saved.rollouts import SavedRollouts, world_of

Evaluated = Literal["interactive", "ego"]
Row = dict[str, Any]
Array = NDArray[Any]
UNITS = {"rates and times": "percent", "lengths": "m", "durations": "s", "motion": "m/s^2, m/s^3"}
LOW_TTC = 1.0  # seconds to a collision below which time counts as spent too near to one
KIND_NAMES = {kind: kind.name.lower().replace("_", " ") for kind in CollisionKind}
_MOTION = ("max_acceleration", "max_braking", "max_jerk", "max_lateral_acceleration")
_TIMES = ("offroad_time", "wrong_way_time", "blocking_time", "low_ttc_time")
_WORST = ("at_fault_collision", "collision", "red_lights", *_TIMES)
"""Events that make a run that did not fail a bad one, worst first."""
_OTHERS = ("min_ttc", "progress", "progress_ratio", "beyond_route", "no_route", "log_distance", "first_event")
NUMBERS = (*_WORST, *_MOTION, *_OTHERS, "collision_at_states", "collisions", "steps", "logged_steps")
"""Numbers of a run; None for one that is not defined."""
# What is marked where a flag of an agent is raised: text and label.
_MARKS = {"offroad": ("leaves the road", "off road"), "blocking": ("blocks traffic", "blocks traffic")}
_MEANS: dict[str, tuple[str, float, str | None]] = {
    "collision_rate": ("collision", 100.0, None),
    "collision_rate_at_states": ("collision_at_states", 100.0, None),
    "at_fault_collision_rate": ("at_fault_collision", 100.0, None),
    "red_light_rate": ("red_lights", 100.0, None),
    **{name: (name, 1.0, "steps") for name in _TIMES},
    "progress": ("progress", 1.0, None),
    "progress_ratio": ("progress_ratio", 1.0, None),
    "log_distance": ("log_distance", 1.0, "logged_steps"),
    **{f"mean_{name}": (name, 1.0, None) for name in _MOTION},
}
"""Means over runs: the number, its factor and its weight."""


@dataclass
class Report:
    """The findings in a folder of rollouts."""

    agent: str
    evaluated: Evaluated  # which driven agents: all interactive ones, or the ego
    rows: list[Row] = field(default_factory=list)  # of each run, in the order of segments and rollouts
    # By kind, type of the other, fault, and whether the other played back the log.
    collisions: Counter[tuple[str, str, bool, bool]] = field(default_factory=Counter)
    events: dict[str, list[Event]] = field(default_factory=dict)  # of each segment, marked in its replay
    collision_in: dict[str, Array] = field(default_factory=dict)  # of each segment, seconds [K, T, N]
    # Sums over runs that did not fail, in the log and past its end: seconds of agents (on
    # maps with edges, with lights), and what happened in them.
    parts: tuple[dict[str, float], ...] = field(default_factory=lambda: tuple(map(defaultdict, [float, float])))

    def replay(self, saved: SavedRollouts) -> Replay:
        """Return what a viewer shows of a segment; nothing is marked in one that was not evaluated."""
        name = saved.segment.segment_id
        return Replay(saved, self.events.get(name, ()), self.collision_in.get(name))

    def past_log(self) -> Row:
        """Return what happened past the end of the log, and within it (``log``); empty if all is logged."""
        if not self.parts[1]["seconds"]:
            return {}
        found = {}
        for name, part in zip(("log", "past_log"), self.parts, strict=True):
            share = _percent(np.array(part["offroad"]), part["edged"])
            numbers = {"agent_minutes": part["seconds"] / 60, "offroad_time": share}
            for kind, where in (("collisions", "seconds"), ("red_lights", "lit")):
                minutes = part[where] / 60
                numbers[kind] = int(part[kind]) if minutes else None
                numbers[f"{kind}_per_minute"] = part[kind] / minutes if minutes else None
            found[name] = numbers
        return found

    def worst(self) -> list[Row]:
        """Return the runs, worst first; equal ones in their order."""
        return sorted(self.rows, key=lambda r: [-bool(r["failed"]), *(-(r[name] or 0.0) for name in _WORST)])

    def totals(self) -> Row:
        """Return the numbers of all runs."""
        return total_numbers(self.rows)

    def plain(self) -> Row:
        """Return all of it, as JSON can hold it; collisions by kind and so on, most frequent first."""
        names = ("kind", "other", "at_fault", "with_playback", "collisions")
        kinds = [dict(zip(names, (*key, count), strict=True)) for key, count in self.collisions.most_common()]
        about = {"agent": self.agent, "evaluated": self.evaluated, "units": UNITS} | self.totals()
        past = {"parts": parts} if (parts := self.past_log()) else {}
        return about | past | {"collisions": kinds, "per_run": self.worst()}

    def csv(self) -> str:
        """Return the runs, worst first; an apostrophe before what looks like a formula, so that none is run."""
        names = ("segment", "rollout", "group", "failed", *NUMBERS)
        rows = [[row.get(name) for name in names] for row in self.worst()]
        risky = tuple("=+-@")
        safe = [[f"'{c}" if isinstance(c, str) and c.startswith(risky) else c for c in row] for row in rows]
        csv.writer(out := io.StringIO(), lineterminator="\n").writerows([names, *safe])
        return out.getvalue()


def report(
    folder: RolloutFolder,
    evaluated: Evaluated = "interactive",
    progress_bar: Callable[[int, int], None] = lambda done, total: None,
    *,
    picked: bool = False,
) -> Report:
    """Evaluate all rollouts of a folder, of all interactive agents or of the ego: a DataError if it was not driven,
    or, unless that is allowed, if runs were picked for what they show, so that totals mean nothing. ``progress_bar``
    is called with the segments done and their total.
    """
    if not picked and "hunt" in folder.about.settings:
        raise DataError("`symphony hunt` picked runs that fail: view them, they give no rates", file=folder.path)
    found = Report(folder.about.agent, evaluated)
    for number, saved in enumerate(folder):
        add_segment(found, saved)
        progress_bar(number + 1, len(folder))
    for row in found.rows if evaluated == "ego" else ():
        # Metres of a planner without a route are no progress: it may have gone anywhere.
        none = bool(row["no_route"]) and row["progress_ratio"] is not None
        row |= {"no_route": int(none), "progress_ratio": None if none else row["progress_ratio"]}
    for lost in folder.failures:
        about = {"segment": lost.segment, "group": lost.group or lost.segment, "failed": lost.failed}
        found.rows += [dict.fromkeys(NUMBERS) | about | {"rollout": k} for k in range(lost.rollouts)]
    return found


def add_segment(found: Report, saved: SavedRollouts) -> None:
    """Evaluate the rollouts of one segment and add them to a report."""
    segment, who, name = saved.segment, saved.evaluated, saved.segment.segment_id
    if found.evaluated == "ego":
        who = np.flatnonzero(saved.agents == segment.ego)
        if not len(who):
            raise DataError("the ego was not driven", segment=name, field="agents")
    rows, lanes = saved.agents[who], driving.Lanes(segment)
    found.events[name], found.collision_in[name] = [], np.full(saved.counted.shape, math.inf)
    driven, compared, of_log = driving.progress(saved, who, lanes)
    acceleration, jerk, lateral = driving.comfort(saved, who)
    distance, logged = driving.log_distance(saved, who)
    worlds = [world_of(saved, k) for k in range(saved.rollouts)]
    for k, (world, hits) in enumerate(zip(worlds, contacts(worlds, rows), strict=True)):
        counted = saved.counted[k][:, who].T
        off, stands = np.zeros((2, *world.valid.shape), bool)
        off[saved.agents, 1:] = (saved.offroad[k] & saved.counted[k]).T
        stands[rows] = driving.blocking(world, rows, lanes, saved.start)
        lights = driving.red_lights(world, np.union1d(rows, hits.other), lanes, saved.start)
        fault = at_fault(world, hits, lanes, off, lights)
        # Those of others only say whose fault a collision is.
        lights = driving.Lights(*(part[np.isin(lights.agent, rows)] for part in lights))
        marked = _events(k, hits, fault, lights, rows, {"offroad": off, "blocking": stands})
        ttc = np.where(counted, time_to_collision(world, rows)[:, 1:], math.inf)
        found.collision_in[name][k][:, who] = ttc.T
        steps = int(counted.sum())
        lane_steps = steps * (len(lanes.graph.usable_lanes) > 0)
        # Of an agent whose progress is not defined, the log's does not count either.
        known, came = np.isfinite(driven[k]), counted.any(1)
        whole = float(of_log[k][known].sum())
        numbers: Row = {
            "segment": name,
            "rollout": k,
            "group": segment.group or name,
            "failed": saved.failed.get(k, ""),
            "collision": len(hits.agent) > 0,
            "collision_at_states": bool(hits.at_state.any()),
            "at_fault_collision": bool(fault.any()),
            "collisions": len(hits.agent),
            "red_lights": len(lights.agent) if lanes.lit else None,
            "offroad_time": _percent(off[rows], steps * (len(segment.road.boundary) > 0)),
            "wrong_way_time": _percent(driving.wrong_way(world, rows, lanes)[:, 1:] & counted, lane_steps),
            "blocking_time": _percent(stands[rows, 1:] & counted, lane_steps),
            "min_ttc": _most(-ttc, -1.0),
            "low_ttc_time": _percent(ttc < LOW_TTC, steps),
            "progress": float(driven[k][known & came].mean()) if (known & came).any() else None,
            "log_progress": whole,
            "progress_ratio": float(compared[k][known].sum()) / whole if whole > 1 else None,
            "beyond_route": int((~known).sum()),
            "no_route": int((saved.goal[k, who] < 0).sum()),
            "max_acceleration": _most(np.maximum(acceleration[k], 0)),
            "max_braking": _most(np.maximum(-acceleration[k], 0)),
            "max_jerk": _most(np.abs(jerk[k])),
            "max_lateral_acceleration": _most(np.abs(lateral[k])),
            "log_distance": float(distance[k] / logged[k]) if logged[k] else None,
            "first_event": round(marked[0].step * segment.dt, 3) if marked else None,
            "steps": steps,
            "logged_steps": int(logged[k]),
        }
        found.rows.append(numbers)
        end = segment.log_steps - 1 - saved.start
        if k not in saved.failed:
            for part, within in zip(found.parts, (slice(1, end + 1), slice(end + 1, None)), strict=True):
                begin, stop, _ = within.indices(world.valid.shape[1])
                seconds = segment.dt * int(counted[:, begin - 1 : max(stop - 1, 0)].sum())
                part["seconds"] += seconds
                part["edged"] += seconds * (len(segment.road.boundary) > 0)
                part["lit"] += seconds * lanes.lit
                part["offroad"] += segment.dt * int(off[rows, within].sum())
                for kind, step in (("collisions", hits.step), ("red_lights", lights.step)):
                    part[kind] += int(((step >= begin) & (step < stop)).sum())
        found.events[name] += marked
        for hit in (event for event in marked if event.kind == "collision" and k not in saved.failed):
            other = AgentType(segment.agent_type[hit.other]).name.lower()
            found.collisions[hit.text, other, bool(hit.fault), hit.other not in saved.agents] += 1


def _events(
    k: int, hits: Contacts, fault: Array, lights: driving.Lights, rows: Array, flags: Mapping[str, Array]
) -> list[Event]:
    """Return the events to mark in the replay of a rollout, by time."""
    found = [
        Event(k, step, agent, "collision", KIND_NAMES[CollisionKind(kind)], other, mine, "collision")
        for agent, other, step, kind, mine in _each(hits.agent, hits.other, hits.step, hits.kind, fault)
    ]
    for agent, step in _each(lights.agent, lights.step):
        found.append(Event(k, step, agent, "redlight", "runs a red light", label="red light"))
    for kind, flag in flags.items():
        begins = flag[rows] & ~np.pad(flag[rows][:, :-1], ((0, 0), (1, 0)))
        for m, step in _each(*begins.nonzero()):
            found.append(Event(k, step, int(rows[m]), kind, _MARKS[kind][0], label=_MARKS[kind][1]))
    return sorted(found, key=lambda event: event.step)


def _each(*parts: Array) -> Any:
    return zip(*(part.tolist() for part in parts), strict=True)


def _percent(flags: Array, whole: float) -> float | None:
    return 100.0 * float(flags.sum()) / whole if whole else None


def _most(values: Array, sign: float = 1.0) -> float | None:
    known = values[np.isfinite(values)]
    return sign * float(known.max()) + 0.0 if len(known) else None


def total_numbers(rows: Sequence[Row]) -> Row:
    """Return the totals of some runs: ``runs`` (failed ones included), ``failed_runs``, ``segments`` and ``groups``.

    Over the runs that did not fail the means (``*_rate`` in percent of runs, ``*_time`` in percent of the evaluated
    agents' time), each with its standard error over groups under ``*_se`` (None for a single group), the segments
    that have such a number under ``*_segments`` and, of a percentage that is zero, its exact bound over groups under
    ``*_bound`` (:func:`symphony.metrics.intervals.zero_bound`); the largest ``max_*`` and the least ``min_ttc``.
    """
    good = [row for row in rows if not row["failed"]]
    names, member = np.unique([row["group"] for row in good], return_inverse=True)
    out: Row = {"runs": len(rows), "failed_runs": len(rows) - len(good)}
    out |= {"segments": len({row["segment"] for row in rows}), "groups": len(names)}
    for name, (of, scale, by) in _MEANS.items():
        value = np.array([bool(row[of]) if of == "red_lights" else row[of] or 0.0 for row in good], float)
        weight = np.array([(1.0 if by is None else row[by]) * (row[of] is not None) for row in good], float)
        out[name], out[f"{name}_se"] = grouped_mean(scale * value, weight, member)
        has = weight > 0
        out[f"{name}_segments"] = len({row["segment"] for row, some in zip(good, has, strict=True) if some})
        if name.endswith(("_rate", "_time", "_states")):
            out[f"{name}_bound"] = zero_bound(len(np.unique(member[has]))) if out[name] == 0 else None
    for name, most in {**dict.fromkeys(_MOTION, max), "min_ttc": min}.items():
        out[name] = most((row[name] for row in good if row[name] is not None), default=None)
    return out
