"""Traffic lights past the end of the log: their own cycle where the log shows one, else a plan by phases.

Legend: Q lights, T logged steps, U steps in all. Seconds, radians.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.data.segment import AMBER, GREEN, RunSegment, SignalState
from symphony.roadgraph import LaneGraph
from symphony.roadgraph.graph import turn_between

States = NDArray[np.uint8]
Rows = NDArray[np.intp]

USUAL = (25.0, 3.0, 2.0)  # seconds of green, amber and all red of a phase
JUNCTION = 40.0  # metres between stop points, from one to the next, within which lights are of one junction
ARROW = (SignalState.ARROW_STOP, SignalState.ARROW_CAUTION, SignalState.ARROW_GO)
_ALWAYS = (SignalState.UNKNOWN, SignalState.FLASHING_STOP, SignalState.FLASHING_CAUTION)


def continued(segment: RunSegment, graph: LaneGraph, steps: int, timing: tuple[float, ...] = ()) -> States:
    """Return the states [Q, U] of the lights of a segment, the first T as logged.

    The lights of a junction go on with their cycle where the log shows a whole one: some change of them twice, and
    equal states that far apart. Otherwise, and where a timing (seconds of green, amber and all red) is given, phases
    take turns, each with the timing or :data:`USUAL`: first those that are green, as long as they are; then those of
    one direction after the other, the longest red first. Flashing and unknown lights stay so.
    """
    state = segment.signal_state
    latest = np.maximum.accumulate(np.where(state != SignalState.UNKNOWN, np.arange(state.shape[1]), 0), 1)
    state = np.take_along_axis(state, latest, 1) if state.size else state
    out = np.concatenate([segment.signal_state, np.repeat(state[:, -1:], steps - state.shape[1], 1)], 1)
    logged, later = state.shape[1], steps - state.shape[1]
    for junction in _junctions(segment.signal_point[:, :2]):
        period = None if timing else cycle(state[junction])
        if period is not None:
            past = logged - period + np.arange(later) % period
            out[junction, logged:] = state[junction][:, past]
        elif len(rows := junction[~np.isin(state[junction, -1], _ALWAYS)]):
            axis = np.array([_heading(segment, graph, light) for light in rows])
            out[rows, logged:] = _planned(state[rows], axis, later, segment.dt, timing or USUAL)
    return out


def cycle(state: NDArray[Any]) -> int | None:
    """Return the steps of the cycle of lights [Q, T] of one junction; None where no whole one is seen."""
    code = np.unique(state, axis=1, return_inverse=True)[1].ravel()
    begins = np.flatnonzero(code[1:] != code[:-1]) + 1
    change = np.stack([code[begins - 1], code[begins]], -1)
    alike = (change[:, None] == change).all(-1)
    spans = np.unique((begins - begins[:, None])[alike])
    for span in spans[spans > 0].tolist():
        if (code[span:] == code[:-span]).all():
            return int(span)
    return None


def _junctions(points: NDArray[Any]) -> list[Rows]:
    """Return the rows of lights by junction."""
    if not len(points):
        return []
    around = shapely.union_all(shapely.buffer(shapely.points(points), 0.5 * JUNCTION))
    parts, which = shapely.get_parts(around), shapely.points(points)
    return [np.flatnonzero(shapely.intersects(part, which)) for part in parts]


def _heading(segment: RunSegment, graph: LaneGraph, light: int) -> float:
    """Return the direction of a light's lane at its stop point."""
    lane = int(segment.signal_lane[light])
    line = graph.lines[lane]
    if len(line) < 2:
        return 0.0
    near = np.linalg.norm(line - segment.signal_point[light, :2], axis=-1).argmin()
    step = line[min(near + 1, len(line) - 1)] - line[min(near, len(line) - 2)]
    return float(np.arctan2(step[1], step[0]))


def _planned(
    state: NDArray[Any], axis: NDArray[np.float64], steps: int, dt: float, timing: tuple[float, ...]
) -> States:
    """Return states [Q, steps] after those of the lights of one junction, which are as known [Q, T]."""
    green, amber, red = timing
    shows, ambers = (np.asarray(np.isin(state, kinds)) for kinds in (GREEN, AMBER))
    logged = state.shape[1]
    last = np.where((shows | ambers).any(1), logged - 1 - (shows | ambers)[:, ::-1].argmax(1), -1)
    now = shows[:, -1] if shows[:, -1].any() else ambers[:, -1]
    rest, waiting = list[Rows](), np.logical_not(now)
    while waiting.any():  # streams that cross each other share no phase
        turn = turn_between(axis, np.full_like(axis, axis[waiting.argmax()]))
        along = waiting & (np.minimum(turn, math.pi - turn) <= math.pi / 6)
        rest, waiting = [*rest, np.flatnonzero(along)], waiting & ~along
    phases = [np.flatnonzero(now)] * bool(now.any()) + sorted(rest, key=lambda part: last[part].max())
    # One that has its junction for itself is red for the time of another phase.
    phases += [np.zeros(0, np.int64)] * (len(phases) == 1)
    each = green + amber + red
    since = _since(np.where(now[:, None], shows, False), now) if now.any() else _since(~(shows | ambers), ~now)
    if not now.any():  # all red: as the last phase ends
        begin = len(phases) * each - red + min(since * dt, red)
    elif shows[now, -1].any():
        begin = min(since * dt, green)
    else:
        begin = green + min(_since(ambers, now) * dt, amber)
    place = (begin + np.arange(steps) * dt + 1e-6) % (len(phases) * each)
    within, turns = place % each, (place // each).astype(np.int64)
    light = np.zeros(len(state), np.int64)
    for number, part in enumerate(phases):
        light[part] = number
    own = np.equal(light[:, None], turns)
    goes, slows = own & (within < green), own & (within >= green) & (within < green + amber)
    # A light that is amber while others are green turns red first.
    ends = np.array([amber - _since(row[None], np.ones(1, bool)) * dt for row in ambers])
    slows |= (ambers[:, -1] & ~now)[:, None] & (np.arange(steps) * dt < ends[:, None] - 1e-6)
    arrow = np.isin(state, ARROW).any(1, keepdims=True)
    shown = np.where(goes, SignalState.GO, np.where(slows, SignalState.CAUTION, SignalState.STOP))
    # Arrows are numbered like plain ones.
    return (shown - np.where(arrow, SignalState.STOP - SignalState.ARROW_STOP, 0)).astype(np.uint8)


def _since(flags: NDArray[np.bool_], who: NDArray[np.bool_]) -> int:
    """Return the number of steps up to the end for which all of some rows [Q, T] are set."""
    broken = np.flatnonzero(~flags[who].all(axis=0))
    return flags.shape[1] - 1 - int(broken[-1]) if len(broken) else flags.shape[1]
