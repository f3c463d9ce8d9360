"""Hand-made lane graphs: crossing, roundabout, fork, merge, pocket, tree."""

from __future__ import annotations

import dataclasses

import numpy as np

import helpers_segments as segments
from symphony.data.segment import Polylines
from symphony.roadgraph import LaneGraph


def make_road(lines, edges=(), left=(), right=(), types=None):
    """A RoadMap of named lanes; returns it and the index of each name."""
    index = {name: k for k, name in enumerate(lines)}

    def pairs(names):
        return np.array([(index[a], index[b]) for a, b in names], np.int32).reshape(-1, 2)

    road, unknown = segments.make_road(list(lines.values())), np.full(len(lines), np.nan, np.float32)
    road = dataclasses.replace(
        road, lane_id=np.arange(len(lines)), speed_limit=unknown, lane_width=unknown,
        lane_type=np.array([(types or {}).get(name, 2) for name in lines], np.uint8),
        successors=pairs(edges), left_neighbors=pairs(left), right_neighbors=pairs(right),
    )  # fmt: skip
    return road, index


def graph_of(made):
    """The lane graph of a made road, and the index of each name."""
    road, name = made
    return LaneGraph(road), name


def straight(a, b, spacing=1.0):
    a, b = np.asarray(a, float), np.asarray(b, float)
    count = max(2, int(np.ceil(np.linalg.norm(b - a) / spacing)) + 1)
    return a + np.linspace(0, 1, count)[:, None] * (b - a)


def arc(center, radius, begin, end, spacing=0.5):
    """Circle arc between two angles in degrees; counter-clockwise if end > begin."""
    begin, end = np.radians(begin), np.radians(end)
    count = max(3, int(np.ceil(abs(end - begin) * radius / spacing)) + 1)
    angle = np.linspace(begin, end, count)
    return np.asarray(center, float) + radius * np.stack((np.cos(angle), np.sin(angle)), -1)


def turned(points, degrees):
    angle = np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[c, s], [-s, c]])


def moved_road(road, degrees, shift):
    """Return the same map, turned and shifted."""
    xy = turned(road.lanes.points[:, :2].astype(float), degrees) + shift
    points = np.concatenate((xy, road.lanes.points[:, 2:]), axis=1).astype(np.float32)
    return dataclasses.replace(road, lanes=Polylines(points, road.lanes.offsets))


def crossing():
    """Four-way crossing, traffic on the right. Arm k lies at k * 90 degrees from south, counter-clockwise. Lanes in0
    ... in3 lead in, out0 ... out3 lead out, left/ahead/right k are the connectors of in k. Lanes lie 2 m right of the
    middle of the road, arms are 60 m long, and the connectors begin 10 m from the centre.
    """
    lines, edges = {}, []
    # Seen from the south arm, driving north along x = 2.
    shapes = {"in": straight((2, -70), (2, -10)), "out": straight((-2, -10), (-2, -70))}
    shapes |= {"ahead": straight((2, -10), (2, 10)), "left": arc((-10, -10), 12, 0, 90)}
    shapes["right"] = arc((10, -10), 8, 180, 90)
    for k in range(4):
        for name, shape in shapes.items():
            lines[f"{name}{k}"] = turned(shape, 90 * k)
        for name, to in (("left", 3), ("ahead", 2), ("right", 1)):
            edges += [(f"in{k}", f"{name}{k}"), (f"{name}{k}", f"out{(k + to) % 4}")]
    return make_road(lines, edges)


def roundabout(radius=15.0):
    """A counter-clockwise ring of four arcs; at each quarter an exit leaves and 20 degrees later an entry joins."""
    lines, edges = {}, []
    for k in range(4):
        at = 90 * k
        lines[f"between{k}"] = arc((0, 0), radius, at + 20, at + 90)
        lines[f"stay{k}"] = arc((0, 0), radius, at, at + 20, spacing=0.25)
        tangent = turned([[0, 1]], at)[0]
        leave, join = lines[f"stay{k}"][0], lines[f"stay{k}"][-1]
        lines[f"exit{k}"] = straight(leave, leave + 40 * tangent + 10 * turned([[1, 0]], at)[0])
        lines[f"entry{k}"] = straight(join + 40 * turned([[1, -0.6]], at)[0], join)
    for k in range(4):
        n = (k + 1) % 4
        edges += [(f"between{k}", f"stay{n}"), (f"between{k}", f"exit{n}")]
        edges += [(f"stay{k}", f"between{k}"), (f"entry{k}", f"between{k}")]
    return make_road(lines, edges)


def fork():
    """One lane that splits in two, both of which end."""
    lines = {"stem": straight((0, 0), (50, 0)), "on": straight((50, 0), (120, 0))}
    return make_road(lines | {"up": arc((50, 40), 40, -90, -30)}, [("stem", "up"), ("stem", "on")])


def merge():
    """Two lanes that become one."""
    lines = {"a": straight((0, 0), (50, 0)), "b": straight((10, -20), (50, 0))}
    return make_road(lines | {"c": straight((50, 0), (150, 0))}, [("a", "c"), ("b", "c")])


def pocket():
    """A road of three lanes in a row; beside the last one a turn pocket begins on the left, which alone turns."""
    lines = {
        "first": straight((0, 0), (50, 0)), "second": straight((50, 0), (100, 0)),
        "third": straight((100, 0), (150, 0)), "pocket": straight((100, 3.5), (150, 3.5)),
        "turn": arc((150, 13.5), 10, -90, 0), "on": straight((150, 0), (300, 0)),
    }  # fmt: skip
    edges = [("first", "second"), ("second", "third"), ("third", "on"), ("pocket", "turn")]
    return make_road(lines, edges, left=[("third", "pocket")], right=[("pocket", "third")])


def parallel():
    """Two lanes side by side, three pieces long."""
    lines, edges, left, right = {}, [], [], []
    for k in range(3):
        lines[f"a{k}"] = straight((50 * k, 0), (50 * k + 50, 0))
        lines[f"b{k}"] = straight((50 * k, 3.5), (50 * k + 50, 3.5))
        left.append((f"a{k}", f"b{k}"))
        right.append((f"b{k}", f"a{k}"))
        if k:
            edges += [(f"a{k - 1}", f"a{k}"), (f"b{k - 1}", f"b{k}")]
    return make_road(lines, edges, left, right)


def tree(depth, piece=10.0):
    """A lane that forks in two at every end."""
    lines, edges = {"r": straight((0, 0), (piece, 0))}, []

    def grow(name, at, angle, level):
        for side, turn in (("0", 0.9 / 2**level), ("1", -0.8 / 2**level)):
            after = angle + turn
            end = at + piece * np.array([np.cos(after), np.sin(after)])
            lines[name + side] = straight(at, end)
            edges.append((name, name + side))
            if level < depth:
                grow(name + side, end, after, level + 1)

    grow("r", np.array([piece, 0.0]), 0.0, 1)
    return make_road(lines, edges)


def drive(*lines, step=1.5, offset=0.0):
    """Positions and headings of a vehicle that follows the lines at constant speed, ``offset`` m to their left."""
    points = np.concatenate(lines)
    keep = np.concatenate(([True], np.hypot(*np.diff(points, axis=0).T) > 1e-6))
    points = points[keep]
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    places = np.arange(0, length[-1], step)
    position = np.stack([np.interp(places, length, points[:, k]) for k in (0, 1)], -1)
    segment = np.clip(np.searchsorted(length, places, side="right") - 1, 0, len(points) - 2)
    along = (points[1:] - points[:-1])[segment]
    heading = np.arctan2(along[:, 1], along[:, 0])
    position = position + offset * np.stack((-np.sin(heading), np.cos(heading)), -1)
    return position, heading
