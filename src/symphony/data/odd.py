"""What is odd in a record is left out, and noted by kind with an example; the rest of the record goes on."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import (
    MAX_COORDINATE,
    MAX_HEADING,
    MAX_HEIGHT,
    MAX_JUMP,
    MAX_SIZE,
    MAX_SPEED,
    MIN_SIZE,
    STATES,
    Bools,
    Polylines,
    RunSegment,
    jumps,
    largest,
)
from symphony.data.subset import lines_of, with_agents, with_lanes

LATE = 1.0
"""Seconds after the first step of a log within which an ego may come: then the segment begins there."""

NO_SIZE = "an agent left out: a box without a size"
THIN = f"a box with a side under {100 * MIN_SIZE:g} cm made that wide"
WILD = "states left out: not finite, or beyond what is plausible"
UNSEEN = "an agent left out: no plausible state"
NO_LINE = "a line of the map left out: not finite, or beyond what is plausible"
LATE_EGO = "steps left out before the ego comes"


def noted(segment: RunSegment, found: Mapping[str, str]) -> RunSegment:
    """The segment with more oddities, kind -> example; the first example of a kind stays."""
    return segment.replace(odd={**found, **segment.odd}) if found else segment


def mended(segment: RunSegment) -> RunSegment:
    """What remains of a segment that breaks the schema once single agents, states and lines are left out.

    Left out are agents without a size, or of 100 m and more; states that are not finite or beyond
    :mod:`symphony.data.segment`, and of a track that jumps those a jump away from its longest piece; lines of the map
    with such points. The ego stays, so that the result may still break the schema.
    """
    return _agents(_states(_lines(segment)))


def oddities(segment: RunSegment) -> list[str]:
    """What is unusual about a valid segment: worth a look where it is frequent, no reason to leave it out."""
    s, seen = segment, segment.valid
    sides = s.size[seen.any(1), :2]
    points = (s.road.lanes.points, s.road.boundary.points, s.road.marks.points)
    lit = (s.signal_state != 0).mean(1)
    found = {
        "an agent faster than 70 m/s": largest(s.velocity[seen]) > 70,
        "an agent that jumps, at over 100 m/s": (jumps(s) > 100 * s.dt + 1).any(),
        "a box with a side under 0.2 m": (sides < 0.2).any(),
        "a box with a side over 30 m": (sides > 30).any(),
        "a time step outside 0.02 to 1 s": not 0.02 <= s.dt <= 1,
        "a heading that has turned more than 4 times": largest(s.heading[seen]) > 8 * np.pi,
        "a map that reaches beyond 5 km": max(map(largest, points)) > 5_000,
        "lights known for less than half of the time (see --hold-lights)": ((lit > 0) & (lit < 0.5)).any(),
    }
    return [what for what, applies in found.items() if applies]


def _lines(segment: RunSegment) -> RunSegment:
    road = segment.road
    fine = {name: _plausible(getattr(road, name)) for name in ("lanes", "boundary", "marks")}
    wrong = [f"{name} {np.argmin(kept)}" for name, kept in fine.items() if not kept.all()]
    if not wrong:
        return segment
    road = dataclasses.replace(
        road,
        boundary=lines_of(road.boundary, fine["boundary"]),
        marks=lines_of(road.marks, fine["marks"]),
        mark_type=road.mark_type[fine["marks"]],
    )
    return noted(with_lanes(segment.replace(road=road), fine["lanes"]), {NO_LINE: wrong[0]})


def _plausible(lines: Polylines) -> Bools:
    """[K] whether all points of a line are."""
    limits = MAX_COORDINATE, MAX_COORDINATE, MAX_HEIGHT
    bad = ~(np.abs(lines.points) <= limits).all(axis=1)
    return np.bincount(lines.line_index[bad], minlength=len(lines)) == 0


def _states(segment: RunSegment) -> RunSegment:
    s = segment
    numbers = np.concatenate([s.position, s.velocity, s.heading[..., None]], axis=-1)
    limits = MAX_COORDINATE, MAX_COORDINATE, MAX_HEIGHT, MAX_SPEED, MAX_SPEED, MAX_HEADING
    valid = s.valid & (np.abs(numbers) <= limits).all(axis=-1)
    place = np.where(valid[..., None], s.position[..., :2].astype(np.float64), 0.0)
    far = np.hypot(*np.moveaxis(np.diff(place, axis=1), -1, 0)) > MAX_JUMP
    for agent in np.flatnonzero((far & valid[:, 1:] & valid[:, :-1]).any(axis=1)):
        valid[agent] = _without_jumps(place[agent], valid[agent])
    if (valid == s.valid).all():
        return s
    agent, step = np.argwhere(valid != s.valid)[0].tolist()
    masked = {name: getattr(s, name).copy() for name in STATES[:3]}
    for array in masked.values():
        array[~valid] = 0
    return noted(s.replace(valid=valid, **masked), {WILD: f"agent {s.agent_id[agent]}, step {step}"})


def _without_jumps(place: NDArray[np.float64], valid: Bools) -> Bools:
    """[T] the valid steps of a track [T, 2] that are no jump away from its longest piece without one."""
    steps = np.flatnonzero(valid)
    piece = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(place[steps], axis=0).T) > MAX_JUMP)])
    longest = steps[piece == np.bincount(piece).argmax()]
    nearest = np.clip(np.arange(len(valid)), longest[0], longest[-1])
    return valid & (np.hypot(*(place - place[nearest]).T) <= MAX_JUMP)


def _agents(segment: RunSegment) -> RunSegment:
    s = segment
    size, found = s.size.copy(), dict[str, str]()
    unknown = ~((size[:, 2] >= 0) & (size[:, 2] < MAX_SIZE))
    size[unknown, 2] = 0  # a height that is not known is none
    thin = (size[:, :2] > 0) & (size[:, :2] < MIN_SIZE)
    sized = ((size[:, :2] > 0) & (size[:, :2] < MAX_SIZE)).all(axis=1)
    kinds: dict[str, Any] = {NO_SIZE: ~sized, UNSEEN: ~s.valid.any(axis=1), THIN: thin.any(axis=1)}
    for kind, which in kinds.items():
        which[s.ego] &= kind == THIN
        if which.any():
            found[kind] = f"agent {s.agent_id[np.argmax(which)]}"
    size[:, :2][thin] = MIN_SIZE
    left = kinds[NO_SIZE] | kinds[UNSEEN]
    return noted(with_agents(s.replace(size=size), ~left), found)


def from_ego(segment: RunSegment) -> RunSegment:
    """A segment whose ego comes up to :data:`LATE` seconds after its first step, from the step at which it does."""
    first = int(segment.valid[segment.ego].argmax())
    if not 0 < first * segment.dt <= LATE + 1e-6 or segment.num_steps - first < 2:
        return segment
    there = np.asarray(segment.valid[:, first:].any(axis=1))
    timed = {name: getattr(segment, name)[:, first:].copy() for name in (*STATES, "signal_state")}
    later = segment.replace(current_step=max(segment.current_step - first, 0), **timed)
    return noted(with_agents(later, there), {LATE_EGO: f"{first} of {segment.num_steps}"})
