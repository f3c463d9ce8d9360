"""A run segment without some of its agents, states, steps or lines: odd ones, which are noted, or far ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.data import segment as schema
from symphony.data.segment import STATES, Bools, Polylines, RunSegment, jumps, largest, validate

LATE = 1.0  # seconds after the first step within which an ego may come: then the segment begins there
PLACE = schema.MAX_COORDINATE, schema.MAX_COORDINATE, schema.MAX_HEIGHT
MOVING = 3.0  # m/s, covered or logged, above which speeds are compared
OFF_MAP = 100.0  # metres between an ego and the lanes from which on they may be of two places
MARGIN = 10.0  # metres beside the lanes that are kept within which the boundary is kept, too

NO_SIZE = "an agent left out: a box without a size"
THIN = f"a box with a side under {100 * schema.MIN_SIZE:g} cm made that wide"
WILD = "states left out: not finite, or beyond what is plausible"
UNSEEN = "an agent left out: no plausible state"
NO_LINE = "a line of the map left out: not finite, or beyond what is plausible"
LATE_EGO = "steps left out before the ego comes"


def noted(segment: RunSegment, found: Mapping[str, str]) -> RunSegment:
    """Return the segment with more oddities, kind -> example; the first example of a kind stays."""
    return segment.replace(odd={**found, **segment.odd}) if found else segment


def mended(segment: RunSegment) -> RunSegment:
    """Return a segment without the single agents, states and lines that break the schema.

    Left out are agents without a size, or of 100 m and more; states that are not finite or beyond
    :mod:`symphony.data.segment`, and of a track that jumps those a jump away from its longest piece; lines of the map
    with such points. The ego stays, so that the result may still break the schema.
    """
    return _agents(_states(_lines(segment)))


def oddities(segment: RunSegment) -> list[str]:
    """Return what is unusual about a valid segment: worth a look where it is frequent, no reason to leave it out."""
    s, seen = segment, segment.valid
    sides = s.size[seen.any(1), :2]
    points = (s.road.lanes.points, s.road.boundary.points, s.road.marks.points)
    lit, (covered, logged) = (s.signal_state != 0).mean(1), spans(s)
    wrong = np.hypot(*(covered - logged).T) / np.maximum(np.hypot(*covered.T), np.hypot(*logged.T))
    found = {
        "an agent faster than 70 m/s": largest(s.velocity[seen]) > 70,
        "an agent that jumps, at over 100 m/s": (jumps(s) > 100 * s.dt + 1).any(),
        "a box with a side under 0.2 m": (sides < 0.2).any(),
        "a box with a side over 30 m": (sides > 30).any(),
        "a time step outside 0.02 to 1 s": not 0.02 <= s.dt <= 1,
        "a heading that has turned more than 4 times": largest(s.heading[seen]) > 8 * np.pi,
        "a map that reaches beyond 5 km": max(map(largest, points)) > 5_000,
        "lights known for less than half of the time (see --hold-lights)": ((lit > 0) & (lit < 0.5)).any(),
        "velocities that are not those of the positions": len(wrong) and np.median(wrong) > 0.2,
        f"an ego over {OFF_MAP:g} m away from the lanes": _off_map(s) > OFF_MAP,
    }
    return [what for what, applies in found.items() if applies]


def spans(s: RunSegment) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean velocities [n, 2] over each second of tracks that move, by positions and as logged."""
    velocity, position = s.velocity.astype(np.float64), s.position[..., :2].astype(np.float64)
    lag = int(np.clip(round(1 / s.dt), 1, s.num_steps - 1))
    means = np.pad(np.cumsum((velocity[:, 1:] + velocity[:, :-1]) / 2, axis=1), ((0, 0), (1, 0), (0, 0)))
    seen = np.pad(np.cumsum(s.valid, axis=1), ((0, 0), (1, 0)))
    throughout: Bools = seen[:, lag + 1 :] - seen[:, : -lag - 1] == lag + 1
    covered = ((position[:, lag:] - position[:, :-lag]) / (lag * s.dt))[throughout]
    logged = ((means[:, lag:] - means[:, :-lag]) / lag)[throughout]
    fast = np.maximum(np.hypot(*covered.T), np.hypot(*logged.T)) > MOVING
    return covered[fast], logged[fast]


def speed_ratios(covered: NDArray[np.float64], logged: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how many times the logged speed was covered [n], see :func:`spans`."""
    return np.asarray(np.hypot(*covered.T) / np.maximum(np.hypot(*logged.T), 1e-6))


def _off_map(s: RunSegment) -> float:
    """Return the metres, in the median, between the ego and the rectangle around the lanes; 0 without lanes."""
    place, lanes = s.position[s.ego, s.valid[s.ego], :2], s.road.lanes.points[:, :2]
    if not len(lanes) or not len(place):
        return 0.0
    return float(np.median(np.linalg.norm(place - np.clip(place, lanes.min(0), lanes.max(0)), axis=-1)))


def _lines(segment: RunSegment) -> RunSegment:
    road = segment.road
    fine: dict[str, Bools] = {}
    for name in ("lanes", "boundary", "marks"):
        lines: Polylines = getattr(road, name)
        bad = ~(np.abs(lines.points) <= PLACE).all(axis=1)
        fine[name] = np.bincount(lines.line_index[bad], minlength=len(lines)) == 0
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


def _states(segment: RunSegment) -> RunSegment:
    s = segment
    numbers = np.concatenate([s.position, s.velocity, s.heading[..., None]], axis=-1)
    limits = (*PLACE, schema.MAX_SPEED, schema.MAX_SPEED, schema.MAX_HEADING)
    valid = s.valid & (np.abs(numbers) <= limits).all(axis=-1)
    place = np.where(valid[..., None], s.position[..., :2].astype(np.float64), 0.0)
    far = np.hypot(*np.moveaxis(np.diff(place, axis=1), -1, 0)) > schema.MAX_JUMP
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
    """Return [T] the valid steps of a track [T, 2] that are not a jump away from its longest piece without one."""
    steps = np.flatnonzero(valid)
    piece = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(place[steps], axis=0).T) > schema.MAX_JUMP)])
    longest = steps[piece == np.bincount(piece).argmax()]
    nearest = np.clip(np.arange(len(valid)), longest[0], longest[-1])
    return valid & (np.hypot(*(place - place[nearest]).T) <= schema.MAX_JUMP)


def _agents(segment: RunSegment) -> RunSegment:
    s = segment
    size, found = s.size.copy(), dict[str, str]()
    unknown = ~((size[:, 2] >= 0) & (size[:, 2] < schema.MAX_SIZE))
    size[unknown, 2] = 0  # a height that is not known is none
    thin = (size[:, :2] > 0) & (size[:, :2] < schema.MIN_SIZE)
    sized = ((size[:, :2] > 0) & (size[:, :2] < schema.MAX_SIZE)).all(axis=1)
    kinds: dict[str, Any] = {NO_SIZE: ~sized, UNSEEN: ~s.valid.any(axis=1), THIN: thin.any(axis=1)}
    for kind, which in kinds.items():
        which[s.ego] &= kind == THIN
        if which.any():
            found[kind] = f"agent {s.agent_id[np.argmax(which)]}"
    size[:, :2][thin] = schema.MIN_SIZE
    return noted(with_agents(s.replace(size=size), ~(kinds[NO_SIZE] | kinds[UNSEEN])), found)


def from_ego(segment: RunSegment) -> RunSegment:
    """Return a segment from the step at which its ego appears, if that is at most :data:`LATE` seconds in."""
    first = int(segment.valid[segment.ego].argmax())
    if not 0 < first * segment.dt <= LATE + 1e-6 or segment.num_steps - first < 2:
        return segment
    there = np.asarray(segment.valid[:, first:].any(axis=1))
    later = segment.during(slice(first, None), current_step=max(segment.current_step - first, 0))
    return noted(with_agents(later, there), {LATE_EGO: f"{first} of {segment.num_steps}"})


def with_agents(segment: RunSegment, kept: Bools) -> RunSegment:
    """Return a segment with the agents of a mask [A], the ego among them, and all references to them renumbered."""
    return segment.replace(
        ego=int(kept[: segment.ego].sum()),
        **{name: getattr(segment, name)[kept] for name in ("agent_id", "agent_type", "size", *STATES)},
        interest=_renumbered(segment.interest[kept[segment.interest]], kept),
        predict=_renumbered(segment.predict[kept[segment.predict]], kept),
    )


def with_lanes(segment: RunSegment, kept: Bools) -> RunSegment:
    """Return a segment with the lanes of a mask [L], the links between them and their lights."""
    road, lights = segment.road, kept[segment.signal_lane]
    joined = road.successors[len(road.successors) - segment.joined_gaps :]  # they are the last
    pairs = {name: getattr(road, name) for name in ("successors", "left_neighbors", "right_neighbors")}
    names = ("lane_id", "lane_type", "speed_limit", "lane_width")
    fields: dict[str, Any] = {name: getattr(road, name)[kept] for name in names}
    fields |= {name: _renumbered(pair[kept[pair].all(axis=1)], kept) for name, pair in pairs.items()}
    return segment.replace(
        road=dataclasses.replace(road, lanes=lines_of(road.lanes, kept), **fields),
        signal_lane=_renumbered(segment.signal_lane[lights], kept),
        signal_point=segment.signal_point[lights],
        signal_state=segment.signal_state[lights],
        joined_gaps=int(kept[joined].all(axis=1).sum()),
    )


def lines_of(lines: Polylines, kept: Bools) -> Polylines:
    """Return the lines of a mask [K]."""
    return Polylines.of([lines[k] for k in np.flatnonzero(kept).tolist()])


def _renumbered(index: NDArray[Any], kept: Bools) -> NDArray[np.int32]:
    return (np.cumsum(kept) - 1).astype(np.int32)[index]


def crop(segment: RunSegment, radius: float) -> RunSegment:
    """Keep what comes within a radius in metres of the ego's logged path: some sources give a whole district.

    Lanes are kept whole, with their links and lights, and so are agents that are near enough at some step; of the
    boundary and the marks the pieces that are near enough, or beside a lane that is kept.
    """
    road = segment.road
    near = _shape(segment.position[segment.ego, segment.valid[segment.ego]]).buffer(radius)
    shapely.prepare(near)
    spots = segment.position[..., :2].astype(np.float64)
    agents = (shapely.contains_xy(near, spots[..., 0], spots[..., 1]) & segment.valid).any(axis=1)
    agents[segment.ego] = True
    shapes = [_shape(road.lanes[k]) for k in range(len(road.lanes))]
    kept = shapely.intersects(near, np.array(shapes, object))
    lanes = [shape.buffer(MARGIN) for shape, keep in zip(shapes, kept, strict=True) if keep]
    beside = shapely.union_all([near, *lanes])
    shapely.prepare(beside)
    edges, marks = ([_pieces(ls[k], beside) for k in range(len(ls))] for ls in (road.boundary, road.marks))
    road = dataclasses.replace(
        road,
        boundary=Polylines.of([piece for pieces in edges for piece in pieces]),
        marks=Polylines.of([piece for pieces in marks for piece in pieces]),
        mark_type=np.repeat(road.mark_type, [len(pieces) for pieces in marks]),
    )
    return validate(with_agents(with_lanes(segment.replace(road=road), kept), agents))


def _shape(points: NDArray[Any]) -> Any:
    flat = points[:, :2].astype(np.float64)
    return shapely.LineString(flat) if len(flat) > 1 else shapely.Point(flat[0])


def _pieces(line: NDArray[np.float32], area: Any) -> list[NDArray[np.float32]]:
    """Return the stretches of a line [P, 3] of edges that touch an area, each uncut, in their order."""
    points = line[:, :2].astype(np.float64)
    if len(line) == 1:
        return [line] if shapely.intersects_xy(area, *points[0]) else []
    keep = shapely.intersects(area, shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1)))
    change = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(np.int8)))
    return [line[a : b + 1] for a, b in pairwise(change.tolist()) if keep[a]]
