"""Lanelet2 maps: OpenStreetMap XML whose relations are lanelets and regulatory elements; and their projections.

- Ways may be drawn in either direction: here both bounds of a lanelet run in its direction of travel, the left one
  on its left. One that is open in both directions counts in the one it is drawn in.
- A node lies where its file says in metres (attributes ``x``, ``y`` as in INTERACTION's ``.osm_xy`` files, else tags
  ``local_x``, ``local_y``), if that holds for every node; else its latitude and longitude are projected.
- Lanes are the lanelets for vehicles or bicycles, by their ``participant:`` tags or else their subtype; footways,
  stairs and rails are left out, crosswalks are marks, as are painted lines and stop signs.
- A lane's successors begin with the two nodes its bounds end with. Its neighbour shares the whole bound between them,
  in the same direction, unless the bound may not be crossed there (a solid line, a kerb, the tag ``lane_change``).
- The boundary encloses these lanelets and the areas for vehicles (``multipolygon``: parking lots, exits, free space),
  and is open where no lane goes on (see :func:`.lines.cut_ends`).
- What an editor marked as deleted does not count; what can't be read is left out, and noted.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely

from symphony.data.segment import LaneType, MarkType, RoadMap
from symphony.data.sources import base, lines
from symphony.data.sources.base import Doubles, located, pairs, readable, refuse
from symphony.data.sources.lines import Lane, Links
from symphony.errors import DataError

MAX_NODES = 2_000_000  # more than any map of a city district
NO_NODE = "a node left out that the map lacks"
NO_LANELET = "a lanelet left out that can't be read"
NO_AREA = "an area left out that can't be read"

Projection = Callable[[Doubles], Doubles]  # [N, 2] latitude and longitude in degrees to metres
Tags = dict[str, str]

MPH, KMH = 0.44704, 1 / 3.6
_DRIVABLE = ["road", "highway", "play_street", "bus_lane", "emergency_lane", "exit", "parking", "freespace"]
"""Subtypes of areas on which vehicles may be."""
_NO_LANES = frozenset({"walkway", "shared_walkway", "crosswalk", "stairs", "rail"})
_BIKE_LANES = frozenset({"bicycle_lane", "bikelane"})
_EDGES = frozenset({"road_border", "curbstone", "fence", "wall", "guard_rail", "jersey_barrier"})
_PAINT = frozenset({"line_thin", "line_thick", "stop_line"})
_STOP_SIGNS = re.compile(r"(de206|r1-1(?!\d)|\bstop\b)", re.IGNORECASE)
_SPEED = re.compile(r"(?i)(?:[a-z][\w.: -]*[-_: ](?=[5-9]|\d\d))?(\d+(?:\.\d+)?)\s*(mph|km/?h|m/s|mps)?")
_TRUTH = dict(zip(("yes", "true", "1", "no", "false", "0"), 3 * [True] + 3 * [False], strict=True))
_SIGNS = {"de274.1": "30", "de274_1": "30", "de310": "50"}  # km/h of zones and towns, whose signs do not say it

MAX_LATITUDE = 84.0  # degrees up to which UTM is defined
SEMI_MAJOR, FLATTENING = 6_378_137.0, 1 / 298.257223563  # of the WGS 84 ellipsoid, metres
_UTM_SCALE = 0.9996


@dataclass(frozen=True)
class Way:
    """A line: ids of its nodes, its points [P, 2] in metres, and its tags."""

    nodes: tuple[int, ...]
    line: Doubles
    tags: Tags

    def turned(self) -> Way:
        """Return the way in the other direction."""
        return Way(self.nodes[::-1], self.line[::-1], self.tags)


@dataclass(frozen=True)
class Lanelet:
    """A stretch of lane between two bounds that run in its direction of travel."""

    lanelet_id: int
    left: Way
    right: Way
    turned: tuple[bool, bool]  # whether left and right run against their way's own direction
    tags: Tags
    rules: Sequence[int]  # ids of its regulatory elements

    @property
    def subtype(self) -> str:
        """The subtype; ``road`` where the map does not name it."""
        return self.tags.get("subtype", "road")

    @property
    def lane_type(self) -> LaneType | None:
        """Which lane it is; None for footways, stairs and rails."""
        if _admits(self.tags, "vehicle", self.subtype not in _NO_LANES | _BIKE_LANES):
            return LaneType.FREEWAY if self.subtype == "highway" else LaneType.SURFACE_STREET
        bicycles = self.subtype != "crosswalk" and _admits(self.tags, "bicycle", self.subtype in _BIKE_LANES)
        return LaneType.BIKE_LANE if bicycles else None

    @property
    def ring(self) -> Doubles:
        """The closed outline of the lanelet [P, 2]."""
        return np.concatenate([self.left.line, self.right.line[::-1], self.left.line[:1]])

    @property
    def bounds(self) -> tuple[Doubles, Doubles]:
        """The left and the right bound, with the same number of points."""
        return lines.matched(self.left.line, self.right.line, f"lanelet {self.lanelet_id}")

    @property
    def center(self) -> Doubles:
        """The middle line [P, 2]."""
        left, right = self.bounds
        return (left + right) / 2


Rules = Mapping[int, tuple[Tags, Sequence[Way]]]
"""Id of a regulatory element -> its tags, of which ``subtype`` says what it is, and the stop lines it names."""


@dataclass(frozen=True)
class LaneletMap:
    """The content of a file, in metres; lanelets, ways and areas in file order. ``odd`` says what was left out, as a
    map that was cut out of a larger one lacks some of it: kind -> example.
    """

    lanelets: Sequence[Lanelet]
    ways: Mapping[int, Way]
    rules: Rules
    areas: Sequence[shapely.Polygon] = ()
    odd: Mapping[str, str] = field(default_factory=dict)


def read_lanelet2(path: Path, projection: Projection) -> LaneletMap:
    """Read an ``.osm`` or ``.osm_xy`` file; ``projection``, such as ``partial(utm, origin=...)``, is for degrees.

    A :class:`DataError` names file and element where it is not OSM XML, declares a document type, a node, way or rule
    can't be read, or it has no lanelets with both bounds.
    """
    with located(file=path):
        root = base.load_xml(path, "OSM")
        refuse(root.tag != "osm", f"not an OSM file: its root is <{root.tag[:40]}>", "osm")
        odd: dict[str, str] = {}
        ways = _ways(root, projection, odd)
        kinds: dict[str, list[tuple[ET.Element, Tags]]] = {}
        for node in _living(root, "relation"):
            tags = _tags(node)
            kinds.setdefault(tags.get("type", ""), []).append((node, tags))
        rules = dict(told := [_rule(node, tags, ways) for node, tags in kinds.get("regulatory_element", ())])
        refuse(len(rules) < len(told), "two of one id", "regulatory_element")
        wanted = kinds.get("lanelet", [])
        lanelets = [each for found in wanted for each in readable(NO_LANELET, odd, _lanelet, *found, ways)]
        refuse(not lanelets, f"has no lanelets {odd.get(NO_LANELET, '')}".strip(), "relation")
        wanted = kinds.get("multipolygon", []) + kinds.get("area", [])
        areas = [each for found in wanted for each in readable(NO_AREA, odd, _area, *found, ways)]
        return LaneletMap(lanelets, ways, rules, areas, odd)


def _living(root: ET.Element, tag: str) -> Iterator[ET.Element]:
    return (node for node in root.iter(tag) if node.get("action") != "delete")


def _tags(node: ET.Element) -> Tags:
    return {child.get("k", ""): child.get("v", "").strip() for child in node.findall("tag")}


def _ways(root: ET.Element, projection: Projection, odd: dict[str, str]) -> dict[int, Way]:
    places = _places(root, projection)
    ways = {}
    for node in _living(root, "way"):
        way_id = base.integer(node.get("id"), "way id")
        refuse(way_id in ways, "two of one id", f"way {way_id}")
        refs = [base.integer(child.get("ref"), f"way {way_id}: nd") for child in node.findall("nd")]
        missing = [ref for ref in refs if ref not in places]
        if missing:
            odd.setdefault(NO_NODE, f"way {way_id}: node {missing[0]}")
            refs = [ref for ref in refs if ref in places]
        # The same node twice in a row is a slip of the editor.
        refs = [ref for k, ref in enumerate(refs) if k == 0 or ref != refs[k - 1]]
        line = np.array([places[ref] for ref in refs], np.float64).reshape(-1, 2)
        ways[way_id] = Way(tuple(refs), line, _tags(node))
    return ways


def _places(root: ET.Element, projection: Projection) -> dict[int, Doubles]:
    """Return node id -> [2] metres."""
    nodes = list(_living(root, "node"))
    refuse(len(nodes) > MAX_NODES, f"{len(nodes)} nodes, at most {MAX_NODES} can be read", "node")
    ids = [base.integer(node.get("id"), "node id") for node in nodes]
    refuse(len(set(ids)) < len(ids), "two of one id", "node")

    def numbers(texts: Sequence[tuple[str | None, str | None]], what: str) -> Doubles:
        both = zip(ids, texts, strict=True)
        found = [[base.number(text, f"node {name}: {what}") for text in pair] for name, pair in both]
        return np.array(found, np.float64).reshape(-1, 2)

    local = [(node.get("x"), node.get("y")) for node in nodes]
    if any(None in pair for pair in local):
        local = [(tags.get("local_x"), tags.get("local_y")) for tags in map(_tags, nodes)]
    if any(None in pair for pair in local):
        metres = projection(numbers([(node.get("lat"), node.get("lon")) for node in nodes], "lat, lon"))
    else:
        metres = numbers(local, "x, y")
    return dict(zip(ids, metres, strict=True))


def _members(node: ET.Element, kind: str, field: str) -> dict[str, list[int]]:
    """Return role -> references of a relation's members of a kind."""
    found: dict[str, list[int]] = {}
    for child in node.findall("member"):
        if child.get("type") == kind:
            found.setdefault(child.get("role", ""), []).append(base.integer(child.get("ref"), field))
    return found


def _way(ref: int, ways: dict[int, Way], field: str) -> Way:
    fine = ref in ways and len(ways[ref].line) > 1
    refuse(not fine, f"there is no way {ref} of two points or more", field)
    return ways[ref]


def _lanelet(node: ET.Element, tags: Tags, ways: dict[int, Way]) -> Lanelet:
    lanelet_id = base.integer(node.get("id"), "relation id")
    field = f"lanelet {lanelet_id}"
    members = _members(node, "way", field)
    bounds = []
    for side in ("left", "right"):
        refs = members.get(side, [])
        refuse(len(refs) != 1, f"{len(refs)} ways, expected one", f"{field}: {side}")
        bounds.append(_way(refs[0], ways, f"{field}: {side}"))
    left, right, turned = _aligned(*bounds)
    rules = _members(node, "relation", field).get("regulatory_element", [])
    return Lanelet(lanelet_id, left, right, turned, tags, rules)


def _aligned(left: Way, right: Way) -> tuple[Way, Way, tuple[bool, bool]]:
    """Return both bounds in the direction in which the left one is on the left."""
    ends = left.line[[0, -1]]
    apart, crossed = (np.hypot(*(ends - right.line[rows]).T).sum() for rows in ([0, -1], [-1, 0]))
    twist = bool(crossed < apart)
    along = right.turned() if twist else right
    ring = np.concatenate([left.line, along.line[::-1]])
    x, y = (ring - ring[0]).T
    # Forth on the left and back on the right goes round clockwise.
    if (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() > 0:
        return left.turned(), along.turned(), (True, not twist)
    return left, along, (False, twist)


def _area(node: ET.Element, tags: Tags, ways: dict[int, Way]) -> shapely.Polygon | None:
    """Return a place for vehicles without a direction (a parking lot) by its participants or subtype, or None."""
    if not _admits(tags, "vehicle", tags.get("subtype") in _DRIVABLE):
        return None
    field = f"area {base.integer(node.get('id'), 'relation id')}"
    members = _members(node, "way", field)
    outer, inner = (_closed(members.get(role, []), ways, f"{field}: {role}") for role in ("outer", "inner"))
    refuse(len(outer) != 1, f"{len(outer)} outlines, expected one", f"{field}: outer")
    return shapely.Polygon(outer[0].exterior, [hole.exterior for hole in inner])


def _admits(tags: Tags, who: str, by_subtype: bool) -> bool:
    """Return whether somebody may be there: as soon as a tag admits one participant, the subtype counts no more."""
    told = {name: _TRUTH.get(value.lower()) for name, value in tags.items() if name.startswith("participant:")}
    if any(told.values()):
        return any(yes and name.startswith(f"participant:{who}") for name, yes in told.items())
    return by_subtype and told.get(f"participant:{who}") is not False


def _closed(refs: list[int], ways: dict[int, Way], field: str) -> list[shapely.Polygon]:
    """Return what ways that meet in their nodes enclose, drawn in either direction."""
    found, *rest = shapely.polygonize_full([shapely.LineString(_way(ref, ways, field).line) for ref in refs])
    refuse(any(len(each.geoms) for each in rest), "is not closed", field)
    return list(found.geoms)


def _rule(node: ET.Element, tags: Tags, ways: dict[int, Way]) -> tuple[int, tuple[Tags, list[Way]]]:
    rule_id = base.integer(node.get("id"), "relation id")
    members = _members(node, "way", f"regulatory element {rule_id}")
    # Lines outside the map's section are missing in it.
    found = {role: [ways[r] for r in refs if r in ways and len(ways[r].line)] for role, refs in members.items()}
    signs = [sign.tags.get("subtype", "") for sign in found.get("refers", ())]
    return rule_id, ({"sign_type": "".join(signs[:1])} | tags, found.get("ref_line", []))


def lane_lanelets(source: LaneletMap) -> list[Lanelet]:
    """Return the lanelets that are lanes, at least one; lane k of :func:`road_map` is number k."""
    lanes = [lanelet for lanelet in source.lanelets if lanelet.lane_type is not None]
    refuse(not lanes, "has no lanes", "lanelet")
    refuse(len({lane.lanelet_id for lane in lanes}) < len(lanes), "two lanelets of one id", "lanelet")
    return lanes


def middle(source: LaneletMap) -> Doubles:
    """Return the middle [2] of the box around all lanes, rounded to metres: an origin for everything on the map."""
    points = np.concatenate([lane.ring for lane in lane_lanelets(source)])
    return np.round((points.min(axis=0) + points.max(axis=0)) / 2)


def road_map(source: LaneletMap, origin: Doubles) -> RoadMap:
    """Return the map relative to an origin [2]; z is 0. A :class:`DataError` says if its lanes form no area."""
    ways = lane_lanelets(source)
    lanes = [
        Lane(
            way.lanelet_id,
            way.center,
            way.lane_type or LaneType.SURFACE_STREET,
            lines.median_width(*way.bounds),
            _speed_limit(way, source.rules),
        )
        for way in ways
    ]
    links = successors(ways)
    rings = lines.drivable_rings([*(way.ring for way in ways), *source.areas], field="lanelet, area")
    boundary = lines.opened(rings, lines.cut_ends([(way.left.line, way.right.line) for way in ways], links))
    beside = _beside(ways, left=True), _beside(ways, left=False)
    return lines.road_map(lanes, origin, boundary, list(_marks(source)), links=links, beside=beside)


def successors(lanes: Sequence[Lanelet]) -> Links:
    """Return [E, 2] lane indices (from, to)."""
    starts: dict[tuple[int, int], list[int]] = {}
    for k, lane in enumerate(lanes):
        starts.setdefault((lane.left.nodes[0], lane.right.nodes[0]), []).append(k)
    ends = [(lane.left.nodes[-1], lane.right.nodes[-1]) for lane in lanes]
    return pairs([(k, after) for k, end in enumerate(ends) for after in starts.get(end, []) if after != k])


def _beside(lanes: Sequence[Lanelet], left: bool) -> Links:
    """Return [E, 2] (lane, the one on that side that a lane change may reach)."""
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
    """Return whether the line between two lanes may be crossed; of unknown and unmarked ones it is assumed."""
    side = "left" if to_left != turned else "right"
    explicit = _TRUTH.get(bound.tags.get(f"lane_change:{side}", bound.tags.get("lane_change", "")).lower())
    if explicit is not None:
        return explicit
    if bound.tags.get("type") in _EDGES:
        return False
    # The names give the left line first, seen along the way as it is drawn: the near one counts.
    first, _, second = bound.tags.get("subtype", "").partition("_")
    near = (second or first) if side == "left" else first
    return near != "solid"


def _speed_limit(lane: Lanelet, rules: Rules) -> float:
    """Return m/s: the lowest of the lanelet's own tags and its rules; NaN where none can be understood."""
    texts = [lane.tags.get(name, "") for name in ("speed_limit", "maxspeed")]
    for tags, _ in (rules[ref] for ref in lane.rules if ref in rules):
        if tags.get("subtype") == "speed_limit":
            texts.append(tags.get("limit") or tags.get("sign_type", ""))
    return min((speed for speed in map(_speed, texts) if 0 < speed < 60), default=np.nan)


def _speed(text: str) -> float:
    """Return m/s of ``50``, ``50 km/h``, ``25 mph``, ``de274-50``, ``us_r2-1-25``; without a unit km/h; else 0."""
    found = _SPEED.fullmatch(_SIGNS.get(text.lower(), text))
    if found is None:
        return 0.0
    unit = (found[2] or ("mph" if text.lower().startswith("us") else "km/h")).lower()
    return float(found[1]) * {"mph": MPH, "m/s": 1.0, "mps": 1.0}.get(unit, KMH)


def _marks(source: LaneletMap) -> Iterator[tuple[Doubles, MarkType]]:
    for way in source.ways.values():
        kind = way.tags.get("type")
        if kind in _PAINT and len(way.line) > 1:
            yield way.line, MarkType.ROAD_LINE
        names = [way.tags.get(name, "") for name in ("subtype", "sign_type")]
        if kind == "traffic_sign" and len(way.line) and any(map(_STOP_SIGNS.search, names)):
            yield way.line.mean(axis=0, keepdims=True), MarkType.STOP_SIGN
    for lanelet in source.lanelets:
        if lanelet.subtype == "crosswalk":
            yield lanelet.ring, MarkType.CROSSWALK


def stop_line(lane: Lanelet, rules: Rules) -> Doubles | None:
    """Return the middle [2] of the stop line that a traffic light of the lanelet names; None where none does."""
    for tags, ways in (rules[ref] for ref in lane.rules if ref in rules):
        if tags.get("subtype") == "traffic_light" and ways:
            return ways[0].line.mean(axis=0)
    return None


def utm(places: Doubles, origin: Doubles) -> Doubles:
    """Project by Universal Transverse Mercator on WGS 84, in the zone of the origin, relative to the origin.

    Lanelet2's and INTERACTION's usual projection (there about latitude and longitude 0). Krüger's series to the
    fourth order in the third flattening (Karney, 2011, arXiv:1002.1417, eq. 35): well below 1 mm inside a zone.

    Takes places [N, 2] and an origin [2] of latitude and longitude in degrees, and gives [N, 2] metres, x towards the
    grid's east, y towards its north. Latitudes beyond 84 degrees are a :class:`DataError`.
    """
    both = _degrees(places, origin)
    zone = np.clip(np.floor((origin[1] + 180) / 6), 0, 59)
    n = FLATTENING / (2 - FLATTENING)
    radius = SEMI_MAJOR / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    series = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16 + 41 * n**4 / 180,
        13 * n**2 / 48 - 3 * n**3 / 5 + 557 * n**4 / 1440,
        61 * n**3 / 240 - 103 * n**4 / 140,
        49561 * n**4 / 161280,
    )
    latitude, longitude = np.radians(both - (0, 6 * zone - 177)).T
    eccentricity = np.sqrt(FLATTENING * (2 - FLATTENING))
    sine = np.sin(latitude)
    # Tangent of the conformal latitude.
    tangent = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    xi = np.arctan2(tangent, np.cos(longitude))
    eta = np.arcsinh(np.sin(longitude) / np.hypot(tangent, np.cos(longitude)))
    x, y = eta.copy(), xi.copy()
    for k, factor in enumerate(series, start=1):
        x += factor * np.cos(2 * k * xi) * np.sinh(2 * k * eta)
        y += factor * np.sin(2 * k * xi) * np.cosh(2 * k * eta)
    metres = _UTM_SCALE * radius * np.stack([x, y], axis=-1)
    return metres[:-1] - metres[-1]


def mercator(places: Doubles, origin: Doubles) -> Doubles:
    """Project by the spherical Mercator, scaled to be true to length at the origin, relative to the origin.

    The projection of the Test Area Autonomous Driving Baden-Württemberg recordings, and of Lanelet2's
    ``SphericalMercatorProjector``. Arguments, result and errors are those of :func:`utm`.
    """
    latitude, longitude = np.radians(_degrees(places, origin)).T
    scale = SEMI_MAJOR * np.cos(np.radians(origin[0]))
    metres = scale * np.stack([longitude, np.arctanh(np.sin(latitude))], axis=-1)
    return metres[:-1] - metres[-1]


def _degrees(places: Doubles, origin: Doubles) -> Doubles:
    """Return [N + 1, 2] degrees, the origin last."""
    both = np.concatenate([places.reshape(-1, 2), origin[None]])
    if not (np.abs(both) <= (MAX_LATITUDE, 180)).all():  # comparisons with NaN are false
        message = f"a place outside latitudes ±{MAX_LATITUDE:g} and longitudes ±180 degrees"
        raise DataError(message, field="lat, lon")
    return both
