"""The line that a vehicle follows along lanes: forward only, without the jumps of maps where lanes meet.

Arrays of points are [P, 2] in metres, in the map's frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from symphony.roadgraph.graph import LaneGraph, Reals, arc_lengths, turn_between

CHORD = 3.0
"""Metres of a piece of a line that has a direction, and over which a change of direction is measured."""
SPACING = 0.5  # metres between the points at which such a piece may begin
GENTLE = 0.09  # radians that a lane turns from one such piece to the next where its radius is 34 m
_STEP = 1.0  # metres between the points of a blend
_SMOOTH = 1.5
"""Metres to either side over which the direction of a line is taken when something is moved beside it."""
CLOSE = 1e-6  # metres between points that are one
_JOINED = 0.02  # metres between two lanes that meet
_JOIN = 6.0
"""Metres along for a metre to the side, where a lane does not begin exactly where the one before it ends."""


def blend(line: Reals, point: Reals, length: float) -> Reals:
    """Return the way from a point beside a line onto it.

    The way runs beside the line, from where the point is along it, and comes nearer like 1 - 3 u² + 2 u³, with u from
    0 to 1 over the length: it begins and ends in the direction of the line. Beyond that it is the line itself. Where
    the point is before the beginning of the line, the line is taken to come straight from there.

    Neighbouring points of the line differ. The length is metres along it until the way is on it, or less, where it
    ends before. The first point [Q, 2] of the way is ``point``; the point alone, if the line ends behind it.
    """
    begin, _ = beside(line, point)
    if begin < 0.0:
        first = line[1] - line[0]
        line = np.concatenate([line[:1] + begin * (first / np.hypot(*first)), line])
        begin = 0.0
    arc = arc_lengths(line)
    if begin >= arc[-1]:
        return point[None]
    end = min(begin + max(length, _STEP), arc[-1])
    places = np.append(np.arange(begin, end - CLOSE, _STEP), end)
    ahead, behind = (at(line, arc, places + shift) for shift in (_SMOOTH, -_SMOOTH))
    way = ahead - behind
    normal = np.stack([-way[:, 1], way[:, 0]], -1) / np.hypot(*way.T)[:, None]
    on = at(line, arc, places)
    aside = float((point - on[0]) @ normal[0])
    share = (places - begin) / (end - begin)
    fades = 1.0 - share * share * (3.0 - 2.0 * share)
    moved = on + (aside * fades)[:, None] * normal
    moved[0] = point
    return np.concatenate([moved, line[arc > end + CLOSE]])


def beside(line: Reals, point: Reals) -> tuple[float, float]:
    """Return the metres along a line of its place nearest to a point, and from there to the point.

    A point before the beginning has a negative place, on the line as it would come straight from there; one past the
    end has the length of the line.
    """
    start, way = line[:-1], np.diff(line, axis=0)
    length = np.maximum(np.hypot(*way.T), np.finfo(np.float64).tiny)
    away = point - start
    share = (away * way).sum(-1) / length
    before = float(share[0])
    share = share.clip(0.0, length)
    distance = np.hypot(*(away - (share / length)[:, None] * way).T)
    piece = int(distance.argmin())
    if piece == 0 and before < 0.0:
        return before, float(distance[0])
    return float(length[:piece].sum() + share[piece]), float(distance[piece])


def at(line: Reals, arc: Reals, places: Reals) -> Reals:
    """Return points [Q, 2] at ``places`` metres along a line [P, 2] with arc lengths [P]; past its ends, those."""
    found = np.empty((len(places), 2))
    found[:, 0], found[:, 1] = np.interp(places, arc, line[:, 0]), np.interp(places, arc, line[:, 1])
    return found


def followed(graph: LaneGraph, before: int, lane: int) -> Reals:
    """Return the centre line of a lane as followed from the end of the lane before, without that end itself. It is
    the lane's own line where the two meet. Else overlap is left out, and a short blend makes up for the rest.
    """
    known = graph.followed.get((before, lane))
    if known is None:
        line, end = graph.lines[lane], graph.lines[before][-1]
        gap = float(np.hypot(*(line[0] - end)))
        if gap > _JOINED:
            near = int(np.searchsorted(graph.arc[lane], 20.0 + 7.0 * gap)) + 1  # a circuit comes by here again
            aside = min(beside(line[:near], end)[1], gap)
            line = np.concatenate([blend(line[:near], end, _JOIN * aside), line[near:]])
        known = graph.followed[before, lane] = distinct(np.concatenate([end[None], line]))[1:]
    return known


def centre_line(graph: LaneGraph, lanes: Sequence[int], start: float = 0.0) -> Reals:
    """Return the line [P, 2] along lanes, each the successor of the last, from ``start`` metres on the first."""
    first, arc = graph.lines[lanes[0]], graph.arc[lanes[0]]
    start = min(max(start, 0.0), float(arc[-1]))
    parts = [at(first, arc, np.array([start])), first[arc > start + CLOSE]] if start > 0.0 else [first]
    return np.concatenate([*parts, *(followed(graph, before, lane) for before, lane in pairwise(lanes))])


def distinct(line: Reals) -> Reals:
    """Return a line without points that lie on the one before."""
    return line[np.concatenate(([True], np.hypot(*np.diff(line, axis=0).T) > CLOSE))]


def sharpest(line: Reals) -> float:
    """Return the largest change of direction, in radians, between pieces of :data:`CHORD` metres of a line. Pieces
    may begin anywhere. It is 0 for a line that is shorter than two of them.
    """
    arc = arc_lengths(line)
    points = at(line, arc, np.arange(0.0, arc[-1], SPACING))
    apart = round(CHORD / SPACING)
    way = points[apart:] - points[:-apart]
    if len(way) <= apart:
        return 0.0
    angle = np.arctan2(way[:, 1], way[:, 0])
    return float(turn_between(angle[apart:], angle[:-apart]).max())


def gentle(graph: LaneGraph, lane: int) -> bool:
    """Return whether a lane never turns by more than :data:`GENTLE`: a change beside it can't be too sharp."""
    if lane not in graph.gentle:
        graph.gentle[lane] = sharpest(graph.lines[lane]) < GENTLE
    return graph.gentle[lane]
