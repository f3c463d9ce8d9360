"""Reading a compiled SUMO network and cutting the map of a run segment out of it."""

from __future__ import annotations

import xml.etree.ElementTree as ET  # files are our own
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import MultiPolygon, Point, Polygon
from shapely.geometry.polygon import orient

from symphony.data.levels import divided
from symphony.data.segment import Bools, Floats, LaneType, MarkType, Polylines, RoadMap
from symphony.data.sources.base import Doubles
from symphony.data.sources.lines import stretches

_DEFAULT_WIDTH = 3.2
_FREEWAY_SPEED = 22.0
_APPROACH = 15.0
_LANE_SPACING, _CONNECTOR_SPACING, _BOUNDARY_SPACING = 2.0, 1.5, 3.0
_BOUNDARY_TOLERANCE = 0.04
_SLIT, _SLIVER = 0.3, 1.0
BOUNDARY_MARGIN = 25.0
"""Metres by which the road boundary reaches beyond the lanes that are cut: connectors may reach beyond."""


@dataclass(frozen=True)
class Network:
    """A compiled network; of its L lanes, those of one edge follow each other from right to left."""

    lanes: list[Doubles]  # centre lines in the direction of travel, connectors inside junctions included
    width: Doubles  # [L] metres
    speed: Doubles  # [L] m/s
    internal: Bools  # [L] whether the lane is a connector inside a junction
    edge: NDArray[np.int64]  # [L] index of the lane's edge
    edge_names: list[str]
    successors: NDArray[np.int64]  # [E, 2] lanes (from, to)
    beside: list[NDArray[np.int64]]  # [E', 2] (lane, one to its left that cars may change to), then to the right
    connectors: dict[str, list[tuple[int, int, int]]]  # per light (link, connector it controls, lane before)
    stop_lanes: list[int]  # the lane at the kerb of each edge that ends at a stop sign
    side: int  # of the kerb: 1 right, -1 left
    junction_shapes: list[Doubles]  # the paved area of each junction, with its corners where people walk
    walked: list[Doubles]  # the areas at junctions where people walk, but for crosswalks
    crosswalks: list[Doubles]  # the four corners [4, 2] of each
    centers: Doubles  # [J, 2] junctions where at least three streets meet or lanes split or join, or middles of roads

    def sources(self) -> list[int]:
        """Return the edges for traffic that nothing leads into."""
        following, _, lanes = self.edge_graph()
        entered = {edge for edges in following for edge in edges}
        return [edge for edge in range(len(lanes)) if lanes[edge] > 0 and edge not in entered]

    def edge_graph(self) -> tuple[list[list[int]], Doubles, NDArray[np.int64]]:
        """Return for each edge outside junctions the edges that follow, its length and its number of lanes. Edges
        inside junctions have no followers, length 0 and 0 lanes.
        """
        count = len(self.edge_names)
        following: list[set[int]] = [set() for _ in range(count)]
        after = {a: b for a, b in self.successors.tolist() if self.internal[a]}
        for a, b in self.successors[~self.internal[self.successors[:, 0]]].tolist():
            target = b
            while self.internal[target]:
                target = after[target]
            following[self.edge[a]].add(int(self.edge[target]))
        length, lanes = np.zeros(count), np.zeros(count, np.int64)
        for k in np.flatnonzero(~self.internal):
            length[self.edge[k]] = np.linalg.norm(np.diff(self.lanes[k], axis=0), axis=-1).sum()
            lanes[self.edge[k]] += 1
        return [sorted(f) for f in following], length, lanes

    def edge_headings(self) -> tuple[Doubles, Doubles]:
        """Return the radians in which each edge begins and ends, over :data:`_APPROACH` metres."""
        first, last = np.zeros(len(self.edge_names)), np.zeros(len(self.edge_names))
        for k, line in enumerate(self.lanes):
            for out, piece, sign in ((first, line, 1), (last, line[::-1], -1)):
                away = np.linalg.norm(piece - piece[0], axis=-1)
                far = int(np.argmax(away > _APPROACH)) or len(piece) - 1
                step = sign * (piece[far] - piece[0])
                out[self.edge[k]] = np.arctan2(step[1], step[0])
        return first, last


def shape(text: str) -> Doubles:
    """Return the points [P, 2] of a shape in SUMO's notation."""
    return np.array([[float(c) for c in p.split(",")[:2]] for p in text.split()])


def for_cars(lane: ET.Element) -> bool:
    """Return whether cars may use a lane."""
    return _has_cars(lane.get("allow", "all")) and not _has_cars(lane.get("disallow", ""))


def _has_cars(classes: str) -> bool:
    return not {"all", "passenger"}.isdisjoint(classes.split())


def read_network(file: Path) -> Network:
    """Read a compiled network (``.net.xml``): its lanes for cars."""
    root = ET.parse(file).getroot()  # noqa: S314
    side = -1 if root.get("lefthand") == "true" else 1
    lanes, walked, crosswalks = list[Doubles](), list[Doubles](), list[Doubles]()
    width, speed, internal, edge, names = [], [], [], [], []
    index, connectors = dict[str, int](), dict[str, list[tuple[int, int, int]]]()
    beside: tuple[list[tuple[int, int]], ...] = [], []
    balance, crossed = Counter[str](), Counter[str]()
    for element in root.iter("edge"):
        if element.get("function") is None:
            balance.update({element.attrib["from"]: -1})
            balance.update({element.attrib["to"]: 1})
        names.append(element.attrib["id"])
        if element.get("function") == "walkingarea":
            walked += [area for lane in element.iter("lane") if len(area := shape(lane.attrib["shape"])) > 2]
        if element.get("function") == "crossing":
            lines = ((shape(lane.attrib["shape"]), float(lane.attrib["width"])) for lane in element.iter("lane"))
            crosswalks += [_across(line, width) for line, width in lines if (line[0] != line[-1]).any()]
            crossed[element.attrib["id"][1:].rpartition("_")[0]] += 1
        # From right to left, which is the other way round where people drive on the left.
        own = list(filter(for_cars, element.iter("lane")))[::side]
        for lane in own:
            index[lane.attrib["id"]] = len(lanes)
            lanes.append(shape(lane.attrib["shape"]))
            width.append(float(lane.get("width", _DEFAULT_WIDTH)))
            speed.append(float(lane.attrib["speed"]))
            internal.append(element.get("function") == "internal")
            edge.append(len(names) - 1)
        for one, other in pairwise(own if element.get("function") != "internal" else ()):
            way = index[one.attrib["id"]], index[other.attrib["id"]]
            # Else a lane for others is between the two.
            near = abs(int(one.attrib["index"]) - int(other.attrib["index"])) == 1
            beside[0].extend([way] * (near and _has_cars(one.get("changeLeft", "all"))))
            beside[1].extend([way[::-1]] * (near and _has_cars(other.get("changeRight", "all"))))
    successors, stops = set(), set()
    for link in root.iter("connection"):
        start, end = (index.get(f"{link.attrib[which]}_{link.attrib[f'{which}Lane']}") for which in ("from", "to"))
        via = index.get(link.attrib["via"]) if "via" in link.attrib else end
        if start is None or end is None or via is None:  # crossings, or lanes and turns for others than cars
            continue
        successors.add((start, via))
        if "tl" in link.attrib:
            connectors.setdefault(link.attrib["tl"], []).append((int(link.attrib["linkIndex"]), via, start))
        if link.get("state") in {"s", "w"}:
            stops.add([k for k, own in enumerate(edge) if own == edge[start]][::side][0])
    shapes, centers = _junctions(root, balance, crossed)
    # Roads without a junction are seen from their middles.
    middles = (densify(line, _LANE_SPACING) for line, inner in zip(lanes, internal, strict=True) if not inner)
    centers = centers or [line[len(line) // 2] for line in middles]
    return Network(
        lanes,
        np.array(width),
        np.array(speed),
        np.array(internal),
        np.array(edge),
        names,
        np.array(sorted(successors), dtype=np.int64).reshape(-1, 2),
        [np.array(ways, dtype=np.int64).reshape(-1, 2) for ways in beside],
        connectors,
        sorted(stops),
        side,
        shapes,
        walked,
        crosswalks,
        np.array(centers).reshape(-1, 2),
    )


def _junctions(
    root: ET.Element, balance: Counter[str], crossed: Counter[str]
) -> tuple[list[Doubles], list[NDArray[Any]]]:
    """Return the outlines of junctions, and where streams of traffic meet at them: ``balance`` counts the streets
    that enter a junction less those that leave it, ``crossed`` its crosswalks.
    """
    shapes, centers = list[Doubles](), list[NDArray[Any]]()
    for junction in root.iter("junction"):
        outline = shape(junction.get("shape", ""))
        if junction.get("type") == "internal" or len(outline) < 3:
            continue
        shapes.append(outline)
        # Where streams of traffic cross, split or join. Sources and sinks are out of balance, but have no shape.
        foes = [request.attrib["foes"] for request in junction.iter("request")]
        cars = len(foes) - crossed[junction.attrib["id"]]  # crosswalks come last, and first in the names of foes
        crossing = any("1" in those[-cars:] for those in foes[:cars])
        if crossing or balance[junction.attrib["id"]] != 0:
            centers.append(outline.mean(0))
    return shapes, centers


@dataclass(frozen=True)
class Crop:
    """The map around a point, which is its origin, and the Q traffic lights on it."""

    road: RoadMap
    center: Doubles  # [2] in the network's frame
    signals: list[tuple[str, int]]  # per light on the map, (traffic light, link index)
    signal_lane: NDArray[np.int32]  # [Q] the connector it controls
    signal_point: Floats  # [Q, 3] the stop point: end of the lane that leads to the connector
    drivable: Polygon | MultiPolygon  # in the map's frame
    unwalked: Polygon | MultiPolygon  # the road, but for crosswalks and its edge


def _across(line: Doubles, width: float) -> Doubles:
    """Return the corners [4, 2] of a crosswalk."""
    along = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    aside = np.array([-along[1], along[0]]) * width / 2
    return np.stack([line[0] + aside, line[0] - aside, line[-1] - aside, line[-1] + aside])


def crop_network(network: Network, center: Doubles, radius: float) -> Crop:
    """Cut the map within ``radius`` metres of a point.

    Lanes are cut where they first enter and last leave the circle; connectors that touch it may reach beyond, as
    far as the road boundary does. A lane keeps its successors only if its end is kept.
    """
    kept, lines, whole_end, whole_start = [], [], [], []
    for k, shape in enumerate(network.lanes):
        local = densify(shape - center, _CONNECTOR_SPACING if network.internal[k] else _LANE_SPACING)
        away = np.linalg.norm(local, axis=-1)
        reach = radius
        if network.internal[k] and away.min() <= radius:
            reach = radius + BOUNDARY_MARGIN - 2 * _BOUNDARY_SPACING
        inside = np.flatnonzero(away <= reach)
        if len(inside) == 0 or inside[-1] == inside[0]:
            continue
        kept.append(k)
        lines.append(local[inside[0] : inside[-1] + 1])
        whole_start.append(inside[0] == 0)
        whole_end.append(inside[-1] == len(local) - 1)
    place = np.full(len(network.lanes), -1)
    place[kept] = np.arange(len(kept))
    linked = (place[ways].astype(np.int32) for ways in (network.successors, *network.beside))
    pairs, left, right = (ways[(ways >= 0).all(1)] for ways in linked)
    pairs = pairs[np.array(whole_end)[pairs[:, 0]] & np.array(whole_start)[pairs[:, 1]]]
    drivable = _drivable(network, center, radius + BOUNDARY_MARGIN)
    ends = {k: lines[i][-1] for i, k in enumerate(kept) if whole_end[i]}
    signs = [_beside(lines[place[k]], network.width[k], network.side) for k in network.stop_lanes if k in ends]
    walks = [ring - center for ring in network.crosswalks if np.linalg.norm(ring.mean(0) - center) <= radius]
    kinds = np.where(network.speed[kept] > _FREEWAY_SPEED, LaneType.FREEWAY, LaneType.SURFACE_STREET)
    road = RoadMap(
        lanes=Polylines.of(lines),
        lane_id=np.array(kept, np.int64),
        lane_type=kinds.astype(np.uint8),
        speed_limit=network.speed[kept].astype(np.float32),
        lane_width=network.width[kept].astype(np.float32),
        successors=pairs,
        left_neighbors=left,
        right_neighbors=right,
        boundary=Polylines.of(_boundary(drivable, radius + BOUNDARY_MARGIN)),
        marks=Polylines.of(signs + walks),
        mark_type=np.array([MarkType.STOP_SIGN] * len(signs) + [MarkType.CROSSWALK] * len(walks), np.uint8),
    )
    controlled = [
        ((light, number), place[via], network.lanes[start][-1] - center)
        for light, links in sorted(network.connectors.items())
        for number, via, start in sorted(links)
        if place[via] >= 0 and start in ends
    ]
    return Crop(
        road,
        center,
        [signal for signal, _, _ in controlled],
        np.array([lane for _, lane, _ in controlled], np.int32),
        np.array([[*point, 0] for *_, point in controlled], np.float32).reshape(-1, 3),
        drivable,
        drivable.buffer(-_SLIVER / 2).difference(
            shapely.union_all([Polygon(ring) for ring in walks]).buffer(_SLIVER)
        ),
    )


def densify(line: Doubles, spacing: float) -> Doubles:
    """Return points at most ``spacing`` apart at equal arc lengths; the ends stay."""
    step = np.linalg.norm(np.diff(line, axis=0), axis=-1)
    keep = np.concatenate([[True], step > 1e-6])
    line, at = line[keep], np.concatenate([[0.0], np.cumsum(step[keep[1:]])])
    if len(line) < 2:
        return line
    s = np.linspace(0, at[-1], int(np.ceil(at[-1] / spacing - 1e-9)) + 1)
    return np.stack([np.interp(s, at, line[:, 0]), np.interp(s, at, line[:, 1])], -1)


def _beside(line: Doubles, width: float, side: int) -> Doubles:
    """Return [1, 2] where a sign stands: right of the end of a lane, or left for a side of -1."""
    along = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    return (line[-1] + side * np.array([along[1], -along[0]]) * (width / 2 + 0.5))[None]


def _drivable(network: Network, center: Doubles, radius: float) -> Polygon | MultiPolygon:
    """Return the union of lanes and junctions that reach into the circle; correct inside it, ragged beyond."""
    circle = Point(0, 0).buffer(radius + 20)
    lines = np.array([shapely.LineString(line - center) for line in network.lanes], dtype=object)
    near = shapely.intersects(lines, circle)
    flat: dict[str, Any] = {"cap_style": "flat", "join_style": "mitre", "mitre_limit": 2.0}
    strips = shapely.buffer(lines[near], network.width[near] / 2, **flat)
    shapes = np.array([Polygon(s - center) for s in network.junction_shapes], dtype=object)
    shapes = shapely.make_valid(shapes[shapely.intersects(shapes, circle)])
    if network.walked:
        corners = [shapely.make_valid(Polygon(area - center)) for area in network.walked]
        paved = shapely.get_parts(shapely.difference(shapes, shapely.union_all(corners)))
        # At sharp bends people walk inside the outline, of which what lies beyond them is no road.
        driven = shapely.intersects(paved, shapely.union_all(lines[near]))
        shapes = shapely.buffer(shapely.buffer(paved[driven], -_SLIVER), _SLIVER, join_style="mitre")
    union = shapely.union_all(np.concatenate([strips, shapes]))
    with np.errstate(divide="ignore", invalid="ignore"):  # of slivers
        return union.buffer(_SLIT, join_style="mitre").buffer(-_SLIT, join_style="mitre")


def _boundary(area: Polygon | MultiPolygon, radius: float) -> list[Doubles]:
    """Return rings of the area inside the circle, drivable side on the left; what leaves it is open."""
    lines: list[Doubles] = []
    for part in shapely.get_parts(area):
        simple = orient(part.simplify(_BOUNDARY_TOLERANCE))
        for ring in (simple.exterior, *simple.interiors):
            if not ring.is_empty and Polygon(ring).area >= 1.0:
                line = np.asarray(ring.coords)[:, :2]
                points = divided(line, np.diff(line, axis=0, append=line[-1:]), _BOUNDARY_SPACING)
                inside = np.linalg.norm(points, axis=-1) <= radius
                lines += stretches(points, inside[:-1] & inside[1:])
    return lines
