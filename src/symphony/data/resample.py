"""Changing a run segment's time step, smoothing noisy logs, filling in lights, and mirroring.

These are choices of the one who prepares the data; readers keep to the log.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data import segment as schema
from symphony.data.odd import noted
from symphony.data.segment import STATES, Bools, Ints, Polylines, RunSegment, SignalState, validate, wrap
from symphony.errors import ConfigError

Doubles = NDArray[np.float64]

MAX_SIGMA = 10.0  # seconds of smoothing; a window that is much longer leaves nothing of the motion
BLOCK = 1_000_000  # numbers that are held at a time
EVEN = 0.1  # share of a time step by which a frame may come early or late without being moved
MAX_GAP = 1.0  # seconds between two frames of a log that are filled in between; a longer gap stays open
SLOW, FAST = 1.0, 2.0  # m/s between which the heading goes over from the logged one to that of the motion

LOST = "frames lost in the recording, up to 1 s of them filled in between"
UNEVEN = "frames at uneven times, brought to even ones"
REPEATED = "frames left out: not after those before them"
MIRRORED = "-mirrored"  # what follows the id of a segment that is mirrored


def resample(segment: RunSegment, dt: float) -> RunSegment:
    """Return a valid segment with steps of ``dt`` seconds, beginning at the same moment.

    Where ``dt`` is a whole multiple of the segment's own step (10 Hz to 5 Hz), steps are picked and nothing is
    computed. Otherwise positions and velocities are interpolated linearly, and headings along the shorter arc,
    between two neighbouring valid steps; an agent is valid where both are. A light has the latest state known since
    the new step before (some WOMD records show lights at one), and ``current_step`` is the latest new step not after
    the old one. A :class:`DataError` says if too few or too many steps would remain, or the ego would be at none.
    """
    if not schema.MIN_DT <= dt <= schema.MAX_DT:
        raise ConfigError(f"dt must be between {schema.MIN_DT:g} and {schema.MAX_DT:g} s, is {dt}")
    ratio = dt / segment.dt
    every = round(ratio)
    if every >= 1 and abs(ratio - every) < 1e-6 * every:
        lights = _lights(segment.signal_state, np.arange(0, segment.num_steps, every))
        picked = {name: getattr(segment, name)[:, ::every].copy() for name in STATES}
        step = segment.current_step // every
        return validate(segment.replace(dt=dt, signal_state=lights, current_step=step, **picked))
    return validate(_interpolate(segment, ratio, dt))


def _lights(state: Ints, steps: Ints) -> Ints:
    """Return [Q, U] the states at steps [U]; where none is known, the latest one known since the step before."""
    known = np.where(state != SignalState.UNKNOWN, np.arange(state.shape[1]), -1)
    last = np.maximum.accumulate(known, axis=1)[:, steps]
    since = np.minimum(np.append(steps[:1], steps[:-1]), steps - 1)  # the first one has none before it
    return np.where(last > since, np.take_along_axis(state, last, axis=1), np.uint8(SignalState.UNKNOWN))


def hold_lights(segment: RunSegment) -> RunSegment:
    """Give lights the last state that the log knows, where it knows none, and the first one before that. For logs
    that show lights at a single step: an agent that has never met an unknown light may wait at it for ever.
    """
    state = segment.signal_state
    known = state != SignalState.UNKNOWN
    last = np.maximum.accumulate(np.where(known, np.arange(state.shape[1]), -1), axis=1)
    source = np.where(last < 0, known.argmax(1)[:, None], last)
    return segment.replace(signal_state=np.take_along_axis(state, source, axis=1))


def mirrored(segment: RunSegment) -> RunSegment:
    """Return the segment mirrored at the x axis, where who kept right keeps left: another one of its recording."""

    def flipped(points: NDArray[Any]) -> NDArray[Any]:
        return points * np.array([1, -1, 1], points.dtype)[: points.shape[-1]]

    road = segment.road
    lanes, marks = (replace(lines, points=flipped(lines.points)) for lines in (road.lanes, road.marks))
    edges = Polylines.of([flipped(road.boundary[k])[::-1] for k in range(len(road.boundary))])
    road = replace(road, lanes=lanes, marks=marks, boundary=edges)
    road = replace(road, left_neighbors=road.right_neighbors, right_neighbors=road.left_neighbors)
    changed = {name: flipped(getattr(segment, name)) for name in ("position", "velocity", "signal_point", "origin")}
    goal = segment.goal and flipped(np.array(segment.goal)).tolist()
    name, group = f"{segment.segment_id}{MIRRORED}", segment.group or segment.segment_id
    return segment.replace(segment_id=name, group=group, road=road, heading=-segment.heading, goal=goal, **changed)


def _interpolate(segment: RunSegment, ratio: float, dt: float) -> RunSegment:
    last = segment.num_steps - 1
    steps = int(np.floor(last / ratio + 1e-6)) + 1
    schema.check_counts(segment.num_agents, steps, "valid")
    where = np.arange(steps) * ratio
    before = np.minimum(np.floor(where + 1e-6).astype(np.int64), last)
    share = np.clip(where - before, 0, 1)
    share[share < 1e-6] = 0
    # A moment that coincides with a logged step needs no second neighbour.
    after = np.where(share > 0, np.minimum(before + 1, last), before)
    current = max(int(np.searchsorted(where, segment.current_step + 1e-6, side="right")) - 1, 0)
    return _between(segment.replace(dt=dt, current_step=current), before, after, share)


def evened(segment: RunSegment, times: Doubles) -> RunSegment:
    """Return a segment logged at uneven times with even steps of its ``dt``, from the first on.

    Frames within a tenth of a step are taken as they are. What lies between two frames is interpolated as in
    :func:`resample`; inside a gap of more than :data:`MAX_GAP` seconds no agent is valid. Frames that do not come
    after those before them are left out. What was done is noted (see :mod:`symphony.data.odd`). Times [T] are those
    of its steps in seconds; its ``dt`` is the usual time between two frames.
    """
    dt = segment.dt
    if (np.abs(np.diff(times) - dt) <= EVEN * dt).all():
        return segment
    frames = np.flatnonzero(np.diff(np.maximum.accumulate(times), prepend=-np.inf) > 0)
    logged = times[frames]
    steps = int(np.floor((logged[-1] - logged[0]) / dt + EVEN)) + 1
    schema.check_counts(segment.num_agents, steps, "valid")
    where = logged[0] + dt * np.arange(steps)
    last = np.clip(np.searchsorted(logged, where + EVEN * dt, side="right") - 1, 0, None)
    near = where - logged[last] <= EVEN * dt
    following = np.where(near, last, np.minimum(last + 1, len(logged) - 1))
    gap = logged[following] - logged[last]
    share = np.where(near, 0.0, (where - logged[last]) / np.where(near, 1.0, gap))
    current = max(int(np.searchsorted(where, times[segment.current_step] + EVEN * dt, side="right")) - 1, 0)
    found = _between(segment.replace(current_step=current), frames[last], frames[following], share)
    open_ = gap > MAX_GAP + 1e-6
    found.valid[:, open_] = False
    found.signal_state[:, open_] = SignalState.UNKNOWN
    lost, uneven = gap > 1.5 * dt, (gap > 0) & (gap <= 1.5 * dt)
    repeated = len(times) - len(frames)
    kinds = ((LOST, lost.sum(), steps), (UNEVEN, uneven.sum(), steps), (REPEATED, repeated, len(times)))
    masked = {name: _masked(getattr(found, name), found.valid) for name in STATES[:3]}
    return noted(found.replace(**masked), {kind: f"{count} of {of}" for kind, count, of in kinds if count})


def _between(segment: RunSegment, before: Ints, after: Ints, share: Doubles) -> RunSegment:
    """Return the states and lights at moments [U] between two steps each; an agent is valid where it is at both."""
    valid = segment.valid[:, before] & segment.valid[:, after]

    def between(array: NDArray[Any]) -> Doubles:
        first, second = array[:, before].astype(np.float64), array[:, after].astype(np.float64)
        return first + share[:, None] * (second - first)

    heading = segment.heading.astype(np.float64)
    turn = wrap(heading[:, after] - heading[:, before])
    return segment.replace(
        position=_masked(between(segment.position), valid),
        heading=_masked(heading[:, before] + share * turn, valid),
        velocity=_masked(between(segment.velocity), valid),
        valid=valid,
        signal_state=_lights(segment.signal_state, before),
    )


def smooth(segment: RunSegment, sigma: float) -> RunSegment:
    """Remove position noise with a Gaussian window (NGSIM: 0.3 to 0.5 s before actions are fitted).

    Each position becomes the value, and each velocity the slope, of a straight line fitted to the agent's valid
    positions with Gaussian weights in time (standard deviation ``sigma`` seconds), out to 4 sigma. Inside a track it
    is a Gaussian filter; unlike one it does not pull a moving agent inwards at the ends of its track or beside gaps.
    Above 2 m/s the heading becomes the direction of motion (or its opposite, for an agent that reverses), below 1 m/s
    it is the logged one, smoothed, in between a mixture of both. A track of one valid step stays as it is.
    """
    if not 0 < sigma <= MAX_SIGMA:
        raise ConfigError(f"sigma must be positive and at most {MAX_SIGMA:g} s, is {sigma}")
    valid = segment.valid
    position, slope, fitted = local_line(segment.position.astype(np.float64), valid, segment.dt, sigma)
    velocity = np.where(fitted[..., None], slope[..., :2], segment.velocity)
    logged = segment.heading.astype(np.float64)
    steady, _, _ = local_line(_unwrapped(logged, valid)[..., None], valid, segment.dt, sigma)
    steady = steady[..., 0]
    speed = np.hypot(velocity[..., 0], velocity[..., 1])
    turn = wrap(np.arctan2(velocity[..., 1], velocity[..., 0]) - steady)
    turn = np.where(np.abs(turn) > np.pi / 2, wrap(turn + np.pi), turn)
    share = np.clip((speed - SLOW) / (FAST - SLOW), 0, 1)
    # Unwrapping must not show: the result stays on the logged heading's branch.
    heading = logged + wrap(steady + share * turn - logged)
    states = {"position": position, "velocity": velocity, "heading": np.where(fitted, heading, logged)}
    return segment.replace(**{name: _masked(array, valid) for name, array in states.items()})


def local_line(values: Doubles, valid: Bools, dt: float, sigma: float) -> tuple[Doubles, Doubles, Bools]:
    """Return (value, slope, whether a line could be fitted) at each step of values [A, T, D]; else the values."""
    there = valid.astype(np.float64)
    # Offsets from the agent's mean keep the sums small, so that nothing is lost to cancellation.
    total = np.maximum(there.sum(axis=1), 1)[:, None, None]
    mean = (values * there[..., None]).sum(axis=1, keepdims=True) / total
    masked = (values - mean) * there[..., None]
    steps = valid.shape[1]
    rows = max(BLOCK // steps, 1)  # steps at a time: their lags to all others stay below BLOCK numbers
    parts = (slice(k, min(k + rows, steps)) for k in range(0, steps, rows))
    blocks = [_moments(there, masked, part, dt, sigma) for part in parts]
    s0, s1, s2, y0, y1 = (np.concatenate(part, axis=1) for part in zip(*blocks, strict=True))
    spread = s0 * s2 - s1**2
    fitted = valid & (spread > 1e-9 * s0**2 * sigma**2)
    safe = np.where(fitted, spread, 1.0)[..., None]
    value = (s2[..., None] * y0 - s1[..., None] * y1) / safe + mean
    slope = (s0[..., None] * y1 - s1[..., None] * y0) / safe
    return np.where(fitted[..., None], value, values), np.where(fitted[..., None], slope, 0.0), fitted


def _moments(there: Doubles, masked: Doubles, rows: slice, dt: float, sigma: float) -> tuple[Doubles, ...]:
    """Return weighted sums about some steps: of 1, lag, lag squared [A, rows]; of values, and by lag [A, rows, D]."""
    steps, columns = np.arange(there.shape[1]), slice(None)
    if rows != slice(0, len(steps)):  # a long log: what is out of the window's reach is left out
        reach = int(min(4 * sigma / dt + 1, len(steps)))
        columns = slice(max(rows.start - reach, 0), rows.stop + reach)
    lag = (steps[None, columns] - steps[rows, None]) * dt
    weight = np.where(np.abs(lag) <= 4 * sigma, np.exp(-0.5 * (lag / sigma) ** 2), 0.0)
    there, masked = there[:, columns], masked[:, columns]
    sums = (there @ (weight * lag**k).T for k in range(3))
    return *sums, *((weight * lag**k) @ masked for k in range(2))


def _unwrapped(heading: Doubles, valid: Bools) -> Doubles:
    """Return [A, T] headings without jumps of 2π between an agent's successive valid steps."""
    result = heading.copy()
    for agent in np.flatnonzero(valid.any(axis=1)):
        result[agent, valid[agent]] = np.unwrap(heading[agent, valid[agent]])
    return result


def _masked(array: Doubles, valid: Bools) -> NDArray[np.float32]:
    mask = valid.reshape(*valid.shape, *[1] * (array.ndim - 2))
    return np.where(mask, array, 0).astype(np.float32)
