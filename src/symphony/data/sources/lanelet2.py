"""Lanelet2 maps: OpenStreetMap XML whose relations are lanelets and regulatory elements.

What is read, and what becomes of it:

- Every relation of type ``lanelet`` with one way on its left and one on its right, every relation of type
  ``regulatory_element`` with its lines, and areas (``multipolygon``) that vehicles may use. Elements that an editor
  marked as deleted do not count.
- Ways may be drawn in either direction: here both bounds of a lanelet run in its direction of travel, the left one
  on its left. One that is open in both directions counts in the one it is drawn in.
- A node lies where its file says in metres (attributes ``x``, ``y`` as in INTERACTION's ``.osm_xy`` files, else tags
  ``local_x``, ``local_y``), if that holds for every node; else its latitude and longitude are projected.
- Lanes are the lanelets for vehicles or bicycles; footways, stairs and rails are left out, crosswalks are marks. A
  centre line is halfway between points at equal shares of the bounds' lengths.
- A lane's successors begin with the two nodes its bounds end with. Its neighbour shares the whole bound between them,
  in the same direction, unless the bound may not be crossed there (a solid line, a kerb, the tag ``lane_change``).
- The boundary encloses the union of these lanelets and of the areas for vehicles (parking lots, exits, free space),
  and is open where no lane goes on (see :func:`.lines.cut_ends`).
- A stop sign that the map has is a mark; so are painted lines.
- What can't be read is left out, and noted.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely

from symphony.data.segment import LaneType, MarkType, RoadMap
from symphony.data.sources import lines
from symphony.data.sources.base import pairs, readable
from symphony.data.sources.lines import (
    Doubles,
    Lane,
    Links,
    cut_ends,
    drivable_rings,
    matched,
    median_width,
    opened,
)
from symphony.data.sources.xml_files import integer, load_xml, number
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

Projection = Callable[[Doubles], Doubles]
"""[N, 2] latitude and longitude in degrees to metres."""
Tags = dict[str, str]

MPH, KMH = 0.44704, 1 / 3.6
_NO_LANES = frozenset({"walkway", "shared_walkway", "crosswalk", "stairs", "rail"})
_TYPES = {
    "bicycle_lane": LaneType.BIKE_LANE,
    "bikelane": LaneType.BIKE_LANE,
    "highway": LaneType.FREEWAY,
}
_EDGES = frozenset({"road_border", "curbstone", "fence", "wall", "guard_rail", "jersey_barrier"})
_PAINT = frozenset({"line_thin", "line_thick", "stop_line"})
_STOP_SIGNS = re.compile(r"(de206|r1-1(?!\d)|\bstop\b)", re.IGNORECASE)
_SPEED = re.compile(r"(\d+(?:\.\d+)?)\s*(mph|km/h|kmh|m/s|mps)?\s*$", re.IGNORECASE)


@dataclass(frozen=True)
class Way:
    """A line: ids of its nodes, its points [P, 2] in metres, and its tags."""

    way_id: int
    nodes: tuple[int, ...]
    line: Doubles
    tags: Tags

    def turned(self) -> Way:
        """The same in the other direction."""
        return Way(self.way_id, self.nodes[::-1], self.line[::-1], self.tags)


@dataclass(frozen=True)
class Lanelet:
    """A stretch of lane between two bounds that run in its direction of travel.

    Attributes:
        lanelet_id: of the relation.
        left: left bound.
        right: right bound.
        turned: whether left and right run against their way's own direction.
        tags: of the relation.
        rules: ids of its regulatory elements.
    """

    lanelet_id: int
    left: Way
    right: Way
    turned: tuple[bool, bool]
    tags: Tags
    rules: tuple[int, ...]

    @property
    def subtype(self) -> str:
        """``road`` where the map does not say."""
        return self.tags.get("subtype", "road")

    @property
    def ring(self) -> Doubles:
        """[P, 2] closed outline."""
        return np.concatenate([self.left.line, self.right.line[::-1], self.left.line[:1]])

    @property
    def bounds(self) -> tuple[Doubles, Doubles]:
        """Both bounds with as many points."""
        return matched(self.left.line, self.right.line, f"lanelet {self.lanelet_id}")

    @property
    def center(self) -> Doubles:
        """[P, 2] the middle line."""
        left, right = self.bounds
        return (left + right) / 2


@dataclass(frozen=True)
class Rule:
    """A regulatory element: tags, of which ``subtype`` says what it is, and the stop lines it names."""

    rule_id: int
    tags: Tags
    stops: tuple[Way, ...]


@dataclass(frozen=True)
class LaneletMap:
    """Everything read from a file, in metres; lanelets, ways and areas in file order.

    ``odd`` says what was left out, as a map that was cut out of a larger one lacks some of it: kind -> example.
    """

    lanelets: tuple[Lanelet, ...]
    ways: dict[int, Way]
    rules: dict[int, Rule]
    areas: tuple[shapely.Polygon, ...] = ()
    odd: Mapping[str, str] = field(default_factory=dict)


def read_lanelet2(path: Path, projection: Projection) -> LaneletMap:
    """Read an ``.osm`` or ``.osm_xy`` file.

    Args:
        path: the file.
        projection: for files without metres, such as ``partial(utm, origin=...)``.

    Raises:
        DataError: it is no OSM XML, declares a document type, a node, way or rule can't be read, or it has no
            lanelets with both bounds; names the file and the element.
    """
    try:
        root = load_xml(path, "OSM")
        if root.tag != "osm":
            raise DataError(f"not an OSM file: its root is <{root.tag[:40]}>", field="osm")
        odd: dict[str, str] = {}
        ways = _ways(root, projection, odd)
        kinds: dict[str, list[tuple[ET.Element, Tags]]] = {}
        for node in _living(root, "relation"):
            tags = _tags(node)
            kinds.setdefault(tags.get("type", ""), []).append((node, tags))
        rules = [_rule(node, tags, ways) for node, tags in kinds.get("regulatory_element", ())]
        wanted = kinds.get("lanelet", ())
        lanelets = [
            each for relation in wanted for each in readable(NO_LANELET, odd, _lanelet, *relation, ways)
        ]
        if not lanelets:
            missing = f": {odd[NO_LANELET]}" if NO_LANELET in odd else ""
            raise DataError(f"has no lanelets{missing}", field="relation")
        wanted = [each for kind in ("multipolygon", "area") for each in kinds.get(kind, ())]
        areas = [each for relation in wanted for each in readable(NO_AREA, odd, _area, *relation, ways)]
        return LaneletMap(tuple(lanelets), ways, {rule.rule_id: rule for rule in rules}, tuple(areas), odd)
    except DataError as error:
        raise error.at(file=path) from error
    except OSError as error:
        raise DataError(f"can't be read: {error.strerror or error}", file=path) from error


def _living(root: ET.Element, tag: str) -> Iterator[ET.Element]:
    return (node for node in root.iter(tag) if node.get("action") != "delete")


def _tags(node: ET.Element) -> Tags:
    return {child.get("k", ""): child.get("v", "").strip() for child in node.findall("tag")}


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


def _lanelet(node: ET.Element, tags: Tags, ways: dict[int, Way]) -> Lanelet:
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


def _for_vehicles(tags: Tags) -> bool:
    """Whether vehicles may be on an area: as its participants say, else by its subtype."""
    named = {name: value for name, value in tags.items() if name.startswith("participant:")}
    if named:
        return any(name.startswith("participant:vehicle") and value == "yes" for name, value in named.items())
    return tags.get("subtype") in _DRIVABLE


def _area(node: ET.Element, tags: Tags, ways: dict[int, Way]) -> shapely.Polygon | None:
    """A place for vehicles that has no direction, such as a parking lot; None for others."""
    if not _for_vehicles(tags):
        return None
    field = f"area {integer(node.get('id'), 'relation id')}"
    members = _members(node, "way", field)
    outer, inner = (_closed(members.get(role, []), ways, f"{field}: {role}") for role in ("outer", "inner"))
    if len(outer) != 1:
        raise DataError(f"{len(outer)} outlines, expected one", field=f"{field}: outer")
    return shapely.Polygon(outer[0].exterior, [hole.exterior for hole in inner])


def _closed(refs: list[int], ways: dict[int, Way], field: str) -> list[shapely.Polygon]:
    """What ways that meet in their nodes enclose, drawn in either direction."""
    absent = [ref for ref in refs if ref not in ways or len(ways[ref].line) < 2]
    if absent:
        raise DataError(f"there is no way {absent[0]} of two points or more", field=field)
    found, *rest = shapely.polygonize_full([shapely.LineString(ways[ref].line) for ref in refs])
    if any(len(each.geoms) for each in rest):
        raise DataError("is not closed", field=field)
    return list(found.geoms)


def _rule(node: ET.Element, tags: Tags, ways: dict[int, Way]) -> Rule:
    rule_id = integer(node.get("id"), "relation id")
    refs = _members(node, "way", f"regulatory element {rule_id}").get("ref_line", [])
    # Lines outside the map's section are missing in it.
    return Rule(rule_id, tags, tuple(ways[ref] for ref in refs if ref in ways and len(ways[ref].line)))


def lane_lanelets(source: LaneletMap) -> tuple[Lanelet, ...]:
    """The lanelets that are lanes, at least one; lane k of :func:`road_map` is number k."""
    lanes = tuple(lanelet for lanelet in source.lanelets if lanelet.subtype not in _NO_LANES)
    if not lanes:
        raise DataError("has no lanes", field="lanelet")
    if len({lane.lanelet_id for lane in lanes}) < len(lanes):
        raise DataError("two lanelets of one id", field="lanelet")
    return lanes


def middle(source: LaneletMap) -> Doubles:
    """[2] the middle of the box around all lanes, rounded to metres: an origin for everything on the map."""
    points = np.concatenate([lane.ring for lane in lane_lanelets(source)])
    return np.round((points.min(axis=0) + points.max(axis=0)) / 2)


def road_map(source: LaneletMap, origin: Doubles) -> RoadMap:
    """The map relative to an origin [2]; z is 0. A :class:`DataError` says if no area can be formed of its lanes."""
    ways = lane_lanelets(source)
    lanes = [
        Lane(
            way.lanelet_id,
            way.center,
            _TYPES.get(way.subtype, LaneType.SURFACE_STREET),
            median_width(*way.bounds),
            _speed_limit(way, source.rules),
        )
        for way in ways
    ]
    links = successors(ways)
    rings = drivable_rings([*(way.ring for way in ways), *source.areas], field="lanelet, area")
    boundary = opened(rings, cut_ends([(way.left.line, way.right.line) for way in ways], links))
    beside = _beside(ways, left=True), _beside(ways, left=False)
    return lines.road_map(lanes, origin, boundary, list(_marks(source)), links=links, beside=beside)


def successors(lanes: Sequence[Lanelet]) -> Links:
    """[E, 2] lane indices (from, to)."""
    starts: dict[tuple[int, int], list[int]] = {}
    for k, lane in enumerate(lanes):
        starts.setdefault((lane.left.nodes[0], lane.right.nodes[0]), []).append(k)
    ends = [(lane.left.nodes[-1], lane.right.nodes[-1]) for lane in lanes]
    return pairs([(k, after) for k, end in enumerate(ends) for after in starts.get(end, []) if after != k])


def _beside(lanes: Sequence[Lanelet], left: bool) -> Links:
    """[E, 2] (lane, the one on that side that a lane change may reach)."""
    others: dict[tuple[int, ...], list[int]] = {}
    for k, lane in enumerate(lanes):
        others.setdefault((lane.right if left else lane.left).nodes, []).append(k)
    found = []
    for k, lane in enumerate(lanes):
        bound = lane.left if left else lane.right
        if _may_cross(bound, lane.turned[0 if left else 1], to_left=left):
            found += [(k, other) for other in others.get(bound.nodes, []) if other != k]
    return pairs(found)


def _may_cross(bound: Way, turned: bool, to_left: bool) -> bool:
    """Whether the line between two lanes may be crossed; of unknown and unmarked ones it is assumed."""
    explicit = bound.tags.get("lane_change")
    if explicit in {"yes", "no"}:
        return explicit == "yes"
    if bound.tags.get("type") in _EDGES:
        return False
    # The names give the left line first, seen along the way as it is drawn: the near one counts.
    first, _, second = bound.tags.get("subtype", "").partition("_")
    near = (second or first) if to_left != turned else first
    return near != "solid"


def _speed_limit(lane: Lanelet, rules: dict[int, Rule]) -> float:
    """m/s: the lowest of the lanelet's own tags and its rules; NaN where none can be understood."""
    texts = [lane.tags.get(name, "") for name in ("speed_limit", "maxspeed")]
    for rule in (rules[ref] for ref in lane.rules if ref in rules):
        if rule.tags.get("subtype") == "speed_limit":
            texts.append(rule.tags.get("limit") or rule.tags.get("sign_type", ""))
    return min((speed for speed in map(_speed, texts) if 0 < speed < 60), default=np.nan)


def _speed(text: str) -> float:
    """Of ``50``, ``50 km/h``, ``25 mph``, ``de274-50``, ``us_r2-1-25``; km/h where there is no unit; else 0."""
    found = _SPEED.search(text)
    if found is None:
        return 0.0
    unit = (found[2] or ("mph" if text.lower().startswith("us") else "km/h")).lower()
    return float(found[1]) * {"mph": MPH, "m/s": 1.0, "mps": 1.0}.get(unit, KMH)


def _marks(source: LaneletMap) -> Iterable[tuple[Doubles, MarkType]]:
    for way in source.ways.values():
        kind = way.tags.get("type")
        if kind in _PAINT and len(way.line) > 1:
            yield way.line, MarkType.ROAD_LINE
        elif kind == "traffic_sign" and len(way.line) and _is_stop(way.tags):
            yield way.line.mean(axis=0, keepdims=True), MarkType.STOP_SIGN
    for lanelet in source.lanelets:
        if lanelet.subtype == "crosswalk":
            yield lanelet.ring, MarkType.CROSSWALK


def stop_line(lane: Lanelet, rules: dict[int, Rule]) -> Doubles | None:
    """[2] the middle of the stop line that a traffic light of the lanelet names; None where none does."""
    for rule in (rules[ref] for ref in lane.rules if ref in rules):
        if rule.tags.get("subtype") == "traffic_light":
            for way in rule.stops:
                return way.line.mean(axis=0)
    return None


def _is_stop(tags: Tags) -> bool:
    return any(_STOP_SIGNS.search(tags.get(name, "")) for name in ("subtype", "sign_type"))
