"""Lanelet2 maps: OpenStreetMap XML whose relations are lanelets and regulatory elements.

What is read, and what is not:

- Every relation of type ``lanelet`` with one way on its left and one on its right, every relation of type
  ``regulatory_element`` with its lines, and areas (``multipolygon``) that vehicles may use. Other areas are not read.
  Elements that an editor marked as deleted do not count.
- Ways may be drawn in either direction: here both bounds of a lanelet run in its direction of travel, the left one
  on its left.
- A node lies where its file says in metres (attributes ``x``, ``y`` as in INTERACTION's ``.osm_xy`` files, else tags
  ``local_x``, ``local_y``), if that holds for every node; else its latitude and longitude are projected.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from symphony.data.sources.commonroad_xml import integer, load_xml, number
from symphony.data.sources.lines import Doubles
from symphony.errors import DataError

MAX_NODES = 2_000_000
"""More than any map of a city district."""

_DRIVABLE = frozenset(
    {"road", "highway", "play_street", "bus_lane", "emergency_lane", "exit", "parking", "freespace"}
)
"""Subtypes of areas on which vehicles may be."""

NO_NODE = "a node left out that the map lacks"
NO_LANELET = "a lanelet left out that can't be read"
NO_AREA = "an area left out that can't be read"

T = TypeVar("T")

Projection = Callable[[Doubles], Doubles]
"""[N, 2] latitude and longitude in degrees to metres."""


@dataclass(frozen=True)
class Way:
    """A line: ids of its nodes, its points [P, 2] in metres, and its tags."""

    way_id: int
    nodes: tuple[int, ...]
    line: Doubles
    tags: dict[str, str]

    def turned(self) -> Way:
        """The same in the other direction."""
        return Way(self.way_id, self.nodes[::-1], self.line[::-1], self.tags)


@dataclass(frozen=True)
class Lanelet:
    """A stretch of lane between two bounds that run in its direction of travel.

    Attributes:
        lanelet_id: of the relation.
        left, right: bounds.
        turned: whether left and right run against their way's own direction.
        tags: of the relation.
        rules: ids of its regulatory elements.
    """

    lanelet_id: int
    left: Way
    right: Way
    turned: tuple[bool, bool]
    tags: dict[str, str]
    rules: tuple[int, ...]

    @property
    def subtype(self) -> str:
        """``road`` where the map does not say."""
        return self.tags.get("subtype", "road")

    @property
    def ring(self) -> Doubles:
        """[P, 2] closed outline."""
        return np.concatenate([self.left.line, self.right.line[::-1], self.left.line[:1]])


@dataclass(frozen=True)
class Rule:
    """A regulatory element.

    Attributes:
        rule_id: of the relation.
        tags: its ``subtype`` says what it is: traffic_light, traffic_sign, speed_limit, right_of_way …
        lines: role (``refers``, ``ref_line`` …) -> its ways.
        lanelets: role (``yield``, ``right_of_way`` …) -> ids of lanelets.
    """

    rule_id: int
    tags: dict[str, str]
    lines: dict[str, tuple[Way, ...]]
    lanelets: dict[str, tuple[int, ...]]


@dataclass(frozen=True)
class Area:
    """A place for vehicles that has no direction, such as a parking lot.

    Attributes:
        area_id: of the relation.
        outer: [P, 2] closed outline.
        inner: likewise of each hole.
        tags: of the relation.
    """

    area_id: int
    outer: Doubles
    inner: tuple[Doubles, ...]
    tags: dict[str, str]


@dataclass(frozen=True)
class LaneletMap:
    """Everything read from a file, in metres; lanelets, ways and areas in file order.

    ``odd`` says what was left out, as a map that was cut out of a larger one lacks some of it: kind -> example.
    """

    lanelets: tuple[Lanelet, ...]
    ways: dict[int, Way]
    rules: dict[int, Rule]
    areas: tuple[Area, ...] = ()
    odd: Mapping[str, str] = field(default_factory=dict)


def read_lanelet2(path: Path, projection: Projection) -> LaneletMap:
    """Read a map.

    Args:
        path: an ``.osm`` or ``.osm_xy`` file.
        projection: for files without metres, such as ``partial(utm, origin=...)``.

    Raises:
        DataError: it is no OSM XML, declares a document type, an element can't be read, or it has no lanelets with
            both bounds; names the file and the element.
    """
    try:
        root = load_xml(path, "OSM")
        if root.tag != "osm":
            raise DataError(f"not an OSM file: its root is <{root.tag[:40]}>", field="osm")
        odd: dict[str, str] = {}
        ways = _ways(root, projection, odd)
        relations = [(node, _tags(node)) for node in _living(root, "relation")]
        rules = [_rule(n, tags, ways) for n, tags in relations if tags.get("type") == "regulatory_element"]
        wanted = [(n, tags) for n, tags in relations if tags.get("type") == "lanelet"]
        lanelets = tuple(_all_but(_lanelet, wanted, ways, NO_LANELET, odd))
        if not lanelets:
            missing = f": {odd[NO_LANELET]}" if NO_LANELET in odd else ""
            raise DataError(f"has no lanelets{missing}", field="relation")
        wanted = [
            (n, tags)
            for n, tags in relations
            if tags.get("type") in ("multipolygon", "area") and _for_vehicles(tags)
        ]
        areas = tuple(_all_but(_area, wanted, ways, NO_AREA, odd))
        return LaneletMap(lanelets, ways, {rule.rule_id: rule for rule in rules}, areas, odd)
    except DataError as error:
        raise error.at(file=path) from error
    except OSError as error:
        raise DataError(f"can't be read: {error.strerror or error}", file=path) from error


def _living(root: ET.Element, tag: str) -> Iterator[ET.Element]:
    return (node for node in root.iter(tag) if node.get("action") != "delete")


def _tags(node: ET.Element) -> dict[str, str]:
    return {child.get("k", ""): child.get("v", "").strip() for child in node.findall("tag")}


def _all_but(
    read: Callable[[ET.Element, dict[str, str], dict[int, Way]], T],
    relations: list[tuple[ET.Element, dict[str, str]]],
    ways: dict[int, Way],
    kind: str,
    odd: dict[str, str],
) -> Iterator[T]:
    """The relations that are whole; the first of the others is noted."""
    for node, tags in relations:
        try:
            yield read(node, tags, ways)
        except DataError as error:
            odd.setdefault(kind, f"{error.field}: {error.message}")


def _ways(root: ET.Element, projection: Projection, odd: dict[str, str]) -> dict[int, Way]:
    places = _places(root, projection)
    ways = {}
    for node in _living(root, "way"):
        way_id = integer(node.get("id"), "way id")
        refs = [integer(child.get("ref"), f"way {way_id}: nd") for child in node.findall("nd")]
        missing = [ref for ref in refs if ref not in places]
        if missing:
            odd.setdefault(NO_NODE, f"way {way_id}: node {missing[0]}")
            refs = [ref for ref in refs if ref in places]
        # The same node twice in a row is a slip of the editor.
        refs = [ref for k, ref in enumerate(refs) if k == 0 or ref != refs[k - 1]]
        line = np.array([places[ref] for ref in refs], np.float64).reshape(-1, 2)
        ways[way_id] = Way(way_id, tuple(refs), line, _tags(node))
    return ways


def _places(root: ET.Element, projection: Projection) -> dict[int, Doubles]:
    """Node id -> [2] metres."""
    nodes = list(_living(root, "node"))
    if len(nodes) > MAX_NODES:
        raise DataError(f"{len(nodes)} nodes, at most {MAX_NODES} can be read", field="node")
    ids = [integer(node.get("id"), "node id") for node in nodes]
    local = [(node.get("x"), node.get("y")) for node in nodes]
    if not all(x is not None and y is not None for x, y in local):
        tags = [_tags(node) for node in nodes]
        local = [(tag.get("local_x"), tag.get("local_y")) for tag in tags]
    if all(x is not None and y is not None for x, y in local):
        metres = _pairs(ids, local, "x, y")
    else:
        degrees = _pairs(ids, [(node.get("lat"), node.get("lon")) for node in nodes], "lat, lon")
        metres = projection(degrees)
    return dict(zip(ids, metres, strict=True))


def _pairs(ids: list[int], texts: list[tuple[str | None, str | None]], what: str) -> Doubles:
    found = [
        [number(text, f"node {name}: {what}") for text in pair] for name, pair in zip(ids, texts, strict=True)
    ]
    return np.array(found, np.float64).reshape(-1, 2)


def _members(node: ET.Element, kind: str, field: str) -> dict[str, list[int]]:
    """Role -> references of a relation's members of a kind."""
    found: dict[str, list[int]] = {}
    for child in node.findall("member"):
        if child.get("type") == kind:
            found.setdefault(child.get("role", ""), []).append(integer(child.get("ref"), field))
    return found


def _lanelet(node: ET.Element, tags: dict[str, str], ways: dict[int, Way]) -> Lanelet:
    lanelet_id = integer(node.get("id"), "relation id")
    field = f"lanelet {lanelet_id}"
    members = _members(node, "way", field)
    bounds = []
    for side in ("left", "right"):
        refs = members.get(side, [])
        if len(refs) != 1:
            raise DataError(f"{len(refs)} ways, expected one", field=f"{field}: {side}")
        if refs[0] not in ways:
            raise DataError(f"there is no way {refs[0]}", field=f"{field}: {side}")
        if len(ways[refs[0]].line) < 2:
            raise DataError("a bound of fewer than 2 points", field=f"{field}: {side}")
        bounds.append(ways[refs[0]])
    left, right, turned = _aligned(*bounds)
    rules = _members(node, "relation", field).get("regulatory_element", [])
    return Lanelet(lanelet_id, left, right, turned, tags, tuple(rules))


def _aligned(left: Way, right: Way) -> tuple[Way, Way, tuple[bool, bool]]:
    """Both bounds in the direction in which the left one is on the left."""
    ends = left.line[[0, -1]]
    apart, crossed = (np.hypot(*(ends - right.line[rows]).T).sum() for rows in ([0, -1], [-1, 0]))
    twist = bool(crossed < apart)
    along = right.turned() if twist else right
    ring = np.concatenate([left.line, along.line[::-1]])
    ring = ring - ring[0]
    x, y = ring.T
    # Forth on the left and back on the right goes round clockwise.
    backwards = bool((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() > 0)
    if backwards:
        return left.turned(), along.turned(), (True, not twist)
    return left, along, (False, twist)


def _for_vehicles(tags: dict[str, str]) -> bool:
    """Whether vehicles may be on an area: as its participants say, else by its subtype."""
    named = {name: value for name, value in tags.items() if name.startswith("participant:")}
    if named:
        return any(name.startswith("participant:vehicle") and value == "yes" for name, value in named.items())
    return tags.get("subtype") in _DRIVABLE


def _area(node: ET.Element, tags: dict[str, str], ways: dict[int, Way]) -> Area:
    area_id = integer(node.get("id"), "relation id")
    field = f"area {area_id}"
    members = _members(node, "way", field)
    found = {role: _closed(members.get(role, []), ways, f"{field}: {role}") for role in ("outer", "inner")}
    if len(found["outer"]) != 1:
        raise DataError(f"{len(found['outer'])} outlines, expected one", field=f"{field}: outer")
    return Area(area_id, found["outer"][0], tuple(found["inner"]), tags)


def _closed(refs: list[int], ways: dict[int, Way], field: str) -> list[Doubles]:
    """Rings [P, 2] of ways that follow one another, drawn in either direction."""
    absent = [ref for ref in refs if ref not in ways or len(ways[ref].line) < 2]
    if absent:
        raise DataError(f"there is no way {absent[0]} of two points or more", field=field)
    if len(set(refs)) < len(refs):
        raise DataError("one way twice", field=field)
    rings: list[Doubles] = []
    ring: list[Way] = []
    for k, way in enumerate(ways[ref] for ref in refs):
        # What a way must begin with; the first of a ring may turn to where the next one is.
        onward = ways[refs[k + 1]].nodes if k + 1 < len(refs) else ()
        turns = (
            ring[-1].nodes[-1] != way.nodes[0] if ring else way.nodes[-1] not in (onward[:1] + onward[-1:])
        )
        closed = not ring and way.nodes[0] == way.nodes[-1]
        ring.append(way.turned() if turns and not closed else way)
        if len(ring) > 1 and ring[-2].nodes[-1] != ring[-1].nodes[0]:
            raise DataError(f"way {way.way_id} does not go on where the one before it ends", field=field)
        if ring[0].nodes[0] == ring[-1].nodes[-1]:
            line = np.concatenate([part.line[:-1] for part in ring] + [ring[0].line[:1]])
            if len(line) < 4:
                raise DataError("a ring of fewer than 3 points", field=field)
            rings.append(line)
            ring = []
    if ring:
        raise DataError("is not closed", field=field)
    return rings


def _rule(node: ET.Element, tags: dict[str, str], ways: dict[int, Way]) -> Rule:
    rule_id = integer(node.get("id"), "relation id")
    field = f"regulatory element {rule_id}"
    lines = {
        # Lines outside the map's section are missing in it.
        role: tuple(ways[ref] for ref in refs if ref in ways and len(ways[ref].line))
        for role, refs in _members(node, "way", field).items()
    }
    lanelets = {role: tuple(refs) for role, refs in _members(node, "relation", field).items()}
    return Rule(rule_id, tags, lines, lanelets)
