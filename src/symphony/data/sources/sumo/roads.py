"""Reading a compiled SUMO network and cutting the map of a run segment out of it."""

from __future__ import annotations

import xml.etree.ElementTree as ET  # files are our own
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, MultiPolygon, Point, Polygon
from shapely.geometry.polygon import orient

from symphony.data.levels import shares
from symphony.data.segment import LaneType, MarkType, Polylines, RoadMap

Line = NDArray[np.float64]
_DEFAULT_WIDTH = 3.2
_FREEWAY_SPEED = 22.0
_APPROACH = 15.0
_LANE_SPACING, _CONNECTOR_SPACING, _BOUNDARY_SPACING = 2.0, 1.5, 3.0
_BOUNDARY_TOLERANCE = 0.04
_SLIT = 0.3
BOUNDARY_MARGIN = 25.0
"""Metres by which the road boundary reaches beyond the lanes that are cut: connectors may reach beyond."""


@dataclass(frozen=True)
class Network:
    """A compiled network.

    Attributes:
        lanes: centre lines in the direction of travel, connectors inside junctions included.
        width: [L] metres.
        speed: [L] m/s.
        internal: [L] bool, the lane is a connector inside a junction.
        edge: [L] index of the lane's edge; lanes of one edge follow each other from right to left.
        edge_names: SUMO's names of the edges.
        successors: [E, 2] lanes (from, to).
        connectors: per traffic light, its (link index, the connector it controls, the lane that leads there).
        stop_lanes: the rightmost lane of each edge that ends at a stop sign.
        junction_shapes: the paved area of each junction.
        centers: [J, 2] junctions where at least three streets meet or lanes split or join.
    """

    lanes: list[Line]
    width: NDArray[np.float64]
    speed: NDArray[np.float64]
    internal: NDArray[np.bool_]
    edge: NDArray[np.int64]
    edge_names: list[str]
    successors: NDArray[np.int64]
    connectors: dict[str, list[tuple[int, int, int]]]
    stop_lanes: list[int]
    junction_shapes: list[Line]
    centers: Line

    def sources(self) -> list[int]:
        """Edges for traffic that nothing leads into."""
        following, _, lanes = self.edge_graph()
        entered = {edge for edges in following for edge in edges}
        return [edge for edge in range(len(lanes)) if lanes[edge] > 0 and edge not in entered]

    def edge_graph(self) -> tuple[list[list[int]], NDArray[np.float64], NDArray[np.int64]]:
        """Of the edges outside junctions: those that follow each, its length and its number of lanes.

        Edges inside junctions have no followers, length 0 and 0 lanes.
        """
        count = len(self.edge_names)
        following: list[set[int]] = [set() for _ in range(count)]
        after = {}
        for a, b in self.successors[self.internal[self.successors[:, 0]]]:
            after[int(a)] = int(b)
        for a, b in self.successors[~self.internal[self.successors[:, 0]]]:
            target = int(b)
            while self.internal[target]:
                target = after[target]
            following[self.edge[a]].add(int(self.edge[target]))
        length, lanes = np.zeros(count), np.zeros(count, np.int64)
        for k in np.flatnonzero(~self.internal):
            length[self.edge[k]] = np.linalg.norm(np.diff(self.lanes[k], axis=0), axis=-1).sum()
            lanes[self.edge[k]] += 1
        return [sorted(f) for f in following], length, lanes

    def edge_headings(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Directions in radians in which each edge begins and ends, over :data:`_APPROACH` metres."""
        first, last = np.zeros(len(self.edge_names)), np.zeros(len(self.edge_names))
        for k, line in enumerate(self.lanes):
            for out, piece in ((first, line), (last, line[::-1])):
                away = np.linalg.norm(piece - piece[0], axis=-1)
                far = int(np.argmax(away > _APPROACH)) or len(piece) - 1
                step = piece[far] - piece[0] if out is first else piece[0] - piece[far]
                out[self.edge[k]] = np.arctan2(step[1], step[0])
        return first, last

    def edge_speed(self) -> NDArray[np.float64]:
        """Speed limit per edge."""
        speed = np.zeros(len(self.edge_names))
        np.maximum.at(speed, self.edge, self.speed)
        return speed


def _shape(text: str) -> Line:
    return np.array([[float(c) for c in p.split(",")[:2]] for p in text.split()])


def read_network(file: Path) -> Network:
    """Read a compiled network (``.net.xml``)."""
    root = ET.parse(file).getroot()  # noqa: S314
    lanes: list[Line] = []
    width, speed, internal, edge, names = [], [], [], [], []
    index: dict[str, int] = {}
    for element in root.iter("edge"):
        if element.get("function") in {"crossing", "walkingarea"}:
            continue
        names.append(element.attrib["id"])
        for lane in element.iter("lane"):
            index[lane.attrib["id"]] = len(lanes)
            lanes.append(_shape(lane.attrib["shape"]))
            width.append(float(lane.get("width", _DEFAULT_WIDTH)))
            speed.append(float(lane.attrib["speed"]))
            internal.append(element.get("function") == "internal")
            edge.append(len(names) - 1)
    successors, stops = [], []
    connectors: dict[str, list[tuple[int, int, int]]] = {}
    for link in root.iter("connection"):
        start = index[f"{link.attrib['from']}_{link.attrib['fromLane']}"]
        end = index[f"{link.attrib['to']}_{link.attrib['toLane']}"]
        via = index[link.attrib["via"]] if "via" in link.attrib else end
        successors.append((start, via))
        if "tl" in link.attrib:
            connectors.setdefault(link.attrib["tl"], []).append((int(link.attrib["linkIndex"]), via, start))
        if link.get("state") in {"s", "w"}:
            stops.append(edge.index(edge[start]))
    shapes, centers, meeting = [], [], _meeting_points(root)
    for junction in root.iter("junction"):
        if junction.get("type") == "internal" or len(_shape(junction.get("shape", ""))) < 3:
            continue
        shapes.append(_shape(junction.attrib["shape"]))
        if junction.attrib["id"] in meeting:
            centers.append(shapes[-1].mean(0))
    return Network(
        lanes,
        np.array(width),
        np.array(speed),
        np.array(internal),
        np.array(edge),
        names,
        np.array(sorted(set(successors)), dtype=np.int64).reshape(-1, 2),
        connectors,
        sorted(set(stops)),
        shapes,
        np.array(centers).reshape(-1, 2),
    )


def _meeting_points(root: ET.Element) -> set[str]:
    """Ids of the junctions where streams of traffic cross, split or join."""
    balance: dict[str, int] = {}
    for edge in root.iter("edge"):
        if edge.get("function") is None:
            for end, sign in (("from", -1), ("to", 1)):
                balance[edge.attrib[end]] = balance.get(edge.attrib[end], 0) + sign
    crossing = {
        junction.attrib["id"]
        for junction in root.iter("junction")
        if any("1" in request.attrib["foes"] for request in junction.iter("request"))
    }
    # Sources and sinks have an imbalance too, but no junction shape of at least three points.
    return crossing | {name for name, count in balance.items() if count != 0}


@dataclass(frozen=True)
class Crop:
    """The map around a point, and the traffic lights on it.

    Attributes:
        road: the map, with ``center`` as its origin.
        center: [2] in the network's frame.
        signals: per light on the map, (traffic light, link index).
        signal_lane: [Q] the connector it controls.
        signal_point: [Q, 3] the stop point: end of the lane that leads to the connector.
        drivable: the drivable area, in the map's frame.
    """

    road: RoadMap
    center: Line
    signals: list[tuple[str, int]]
    signal_lane: NDArray[np.int32]
    signal_point: NDArray[np.float32]
    drivable: Polygon | MultiPolygon


def crop_network(network: Network, center: Line, radius: float) -> Crop:
    """Cut the map within ``radius`` metres of a point.

    Lanes are cut where they first enter and last leave the circle; connectors that touch it may reach beyond, as
    far as the road boundary does. A lane keeps its successors only if its end is kept.
    """
    kept, lines, whole_end, whole_start = [], [], [], []
    for k, shape in enumerate(network.lanes):
        local = _densify(shape - center, _CONNECTOR_SPACING if network.internal[k] else _LANE_SPACING)
        away = np.linalg.norm(local, axis=-1)
        reach = radius
        if network.internal[k] and away.min() <= radius:
            reach = radius + BOUNDARY_MARGIN - 2 * _BOUNDARY_SPACING
        inside = np.flatnonzero(away <= reach)
        first, last = (inside[0], inside[-1]) if len(inside) else (0, -1)
        if last - first < 1:
            continue
        kept.append(k)
        lines.append(local[first : last + 1])
        whole_start.append(first == 0)
        whole_end.append(last == len(local) - 1)
    place = np.full(len(network.lanes), -1)
    place[kept] = np.arange(len(kept))
    pairs = place[network.successors]
    pairs = pairs[(pairs >= 0).all(1)]
    pairs = pairs[np.array(whole_end)[pairs[:, 0]] & np.array(whole_start)[pairs[:, 1]]]
    drivable = _drivable(network, center, radius + BOUNDARY_MARGIN)
    left = _left_neighbors(network, np.array(kept))
    ends = {k: lines[i][-1] for i, k in enumerate(kept) if whole_end[i]}
    marks = [_beside(lines[place[k]], network.width[k]) for k in network.stop_lanes if k in ends]
    road = RoadMap(
        lanes=Polylines.of(lines),
        lane_id=np.array(kept, np.int64),
        lane_type=np.where(
            network.speed[kept] > _FREEWAY_SPEED, LaneType.FREEWAY, LaneType.SURFACE_STREET
        ).astype(np.uint8),
        speed_limit=network.speed[kept].astype(np.float32),
        lane_width=network.width[kept].astype(np.float32),
        successors=pairs.astype(np.int32),
        left_neighbors=left.astype(np.int32),
        right_neighbors=left[:, ::-1].astype(np.int32),
        boundary=Polylines.of(_boundary(drivable, radius + BOUNDARY_MARGIN)),
        marks=Polylines.of(marks),
        mark_type=np.full(len(marks), MarkType.STOP_SIGN, np.uint8),
    )
    controlled = [
        (light, number, place[via], network.lanes[start][-1] - center)
        for light, links in sorted(network.connectors.items())
        for number, via, start in sorted(links)
        if place[via] >= 0 and start in ends
    ]
    return Crop(
        road,
        center,
        [(light, number) for light, number, _, _ in controlled],
        np.array([lane for _, _, lane, _ in controlled], np.int32),
        np.array([[*point, 0] for *_, point in controlled], np.float32).reshape(-1, 3),
        drivable,
    )


def _densify(line: Line, spacing: float) -> Line:
    """Points at most ``spacing`` apart at equal arc lengths; the ends stay."""
    step = np.linalg.norm(np.diff(line, axis=0), axis=-1)
    keep = np.concatenate([[True], step > 1e-6])
    line, at = line[keep], np.concatenate([[0.0], np.cumsum(step[keep[1:]])])
    if len(line) < 2:
        return line
    s = np.linspace(0, at[-1], int(np.ceil(at[-1] / spacing - 1e-9)) + 1)
    return np.stack([np.interp(s, at, line[:, 0]), np.interp(s, at, line[:, 1])], -1)


def _left_neighbors(network: Network, kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """[E, 2] pairs (lane, lane on its left) outside junctions, as positions in ``kept``."""
    same = (network.edge[kept[:-1]] == network.edge[kept[1:]]) & (np.diff(kept) == 1)
    right = np.flatnonzero(same & ~network.internal[kept[:-1]])
    return np.stack([right, right + 1], -1)


def _beside(line: Line, width: float) -> Line:
    """[1, 2] where a sign stands: right of the end of a lane."""
    along = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    return (line[-1] + np.array([along[1], -along[0]]) * (width / 2 + 0.5))[None]


def _drivable(network: Network, center: Line, radius: float) -> Polygon | MultiPolygon:
    """Union of lanes and junctions that reach into the circle; correct inside it, ragged beyond."""
    circle = Point(0, 0).buffer(radius + 20)
    lines = np.array([LineString(line - center) for line in network.lanes], dtype=object)
    near = shapely.intersects(lines, circle)
    strips = shapely.buffer(
        lines[near], network.width[near] / 2, cap_style="flat", join_style="mitre", mitre_limit=2.0
    )
    shapes = np.array([Polygon(s - center) for s in network.junction_shapes], dtype=object)
    shapes = shapely.make_valid(shapes[shapely.intersects(shapes, circle)])
    union = shapely.union_all(np.concatenate([strips, shapes]))
    return union.buffer(_SLIT, join_style="mitre").buffer(-_SLIT, join_style="mitre")


def _boundary(area: Polygon | MultiPolygon, radius: float) -> list[Line]:
    """Rings of the area inside the circle, drivable side on the left; rings that leave it become open lines."""
    lines: list[Line] = []
    parts = area.geoms if isinstance(area, MultiPolygon) else [area]
    for part in parts:
        simple = orient(part.simplify(_BOUNDARY_TOLERANCE))
        for ring in (simple.exterior, *simple.interiors):
            if ring.is_empty or Polygon(ring).area < 1.0:
                continue
            points = _subdivide(np.asarray(ring.coords)[:, :2], _BOUNDARY_SPACING)
            lines += _runs(points, np.linalg.norm(points, axis=-1) <= radius)
    return lines


def _subdivide(line: Line, spacing: float) -> Line:
    """The same line with points added so that none are further apart than ``spacing``; vertices stay."""
    step = np.linalg.norm(np.diff(line, axis=0), axis=-1)
    count = np.maximum(1, np.ceil(step / spacing)).astype(int)
    start = np.repeat(np.arange(len(step)), count)
    return np.concatenate([line[start] + shares(count)[:, None] * np.diff(line, axis=0)[start], line[-1:]])


def _runs(ring: Line, inside: NDArray[np.bool_]) -> list[Line]:
    """Stretches of a closed ring of at least two points that are inside."""
    if inside.all():
        return [ring]
    shift = int(np.argmin(inside))
    ring, inside = np.roll(ring[:-1], -shift, axis=0), np.roll(inside[:-1], -shift)
    change = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8)))
    return [ring[a:b] for a, b in zip(change[::2], change[1::2], strict=True) if b - a >= 2]
