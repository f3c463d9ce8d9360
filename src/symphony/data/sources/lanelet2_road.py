"""From a Lanelet2 map to lanes, links, boundary and markings.

- Lanes are the lanelets for vehicles or bicycles; footways, stairs and rails are left out, crosswalks are marks. A
  centre line is halfway between points at equal shares of the bounds' lengths.
- A lane's successors begin with the two nodes its bounds end with. Its neighbour shares the whole bound between them,
  in the same direction, unless the bound may not be crossed there (a solid line, a kerb, the tag ``lane_change``).
- The boundary encloses the union of these lanelets and of the areas for vehicles (parking lots, exits, free space),
  and is open where no lane goes on (see :func:`.lines.cut_ends`).
- A stop sign that the map has, as a sign or as a stop line of a rule with one, is a mark; so are painted lines.
- A lanelet that is open in both directions counts in the one it is drawn in.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from symphony.data.segment import LaneType, MarkType, RoadMap
from symphony.data.sources.base import pairs, to_float32
from symphony.data.sources.lanelet2 import Area, Lanelet, LaneletMap, Rule, Way
from symphony.data.sources.lines import Doubles, cut_ends, drivable_rings, evenly, opened, polylines
from symphony.errors import DataError

MPH, KMH = 0.44704, 1 / 3.6
SPACING = 2.0
"""Metres between the points of a centre line, at most."""

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


def lane_lanelets(source: LaneletMap) -> tuple[Lanelet, ...]:
    """The lanelets that are lanes; lane k of :func:`road_map` is number k.

    Raises:
        DataError: there are none.
    """
    lanes = tuple(lanelet for lanelet in source.lanelets if lanelet.subtype not in _NO_LANES)
    if not lanes:
        raise DataError("has no lanes", field="lanelet")
    ids = [lane.lanelet_id for lane in lanes]
    if len(set(ids)) < len(ids):
        raise DataError("two lanelets of one id", field="lanelet")
    return lanes


def center(lane: Lanelet) -> Doubles:
    """[P, 2] the middle of a lanelet, points at most :data:`SPACING` apart."""
    return (_matched(lane)[0] + _matched(lane)[1]) / 2


def _matched(lane: Lanelet) -> tuple[Doubles, Doubles]:
    bounds = lane.left.line, lane.right.line
    longest = max(np.hypot(*np.diff(line, axis=0).T).sum() for line in bounds)
    if not longest <= 1e6:
        raise DataError("longer than 1000 km", field=f"lanelet {lane.lanelet_id}")
    count = max(int(np.ceil(longest / SPACING)) + 1, 2)
    return evenly(bounds[0], count), evenly(bounds[1], count)


def middle(source: LaneletMap) -> Doubles:
    """[2] the middle of the box around all lanes, rounded to metres: an origin for everything on the map."""
    points = np.concatenate([lane.ring for lane in lane_lanelets(source)])
    return np.round((points.min(axis=0) + points.max(axis=0)) / 2)


def road_map(source: LaneletMap, origin: Doubles) -> RoadMap:
    """The map relative to an origin [2]; z is 0.

    Raises:
        DataError: it has no lanes, or no area can be formed of them.
    """
    lanes = lane_lanelets(source)
    links = successors(lanes)
    widths = [np.median(np.hypot(*(left - right).T)) for left, right in map(_matched, lanes)]
    rings = opened(
        drivable_rings([*(lane.ring for lane in lanes), *map(_polygon, source.areas)], field="lanelet, area"),
        cut_ends([(lane.left.line, lane.right.line) for lane in lanes], links),
    )
    marks = list(_marks(source))
    return RoadMap(
        lanes=polylines([center(lane) for lane in lanes], origin),
        lane_id=np.array([lane.lanelet_id for lane in lanes], np.int64),
        lane_type=np.array([_TYPES.get(lane.subtype, LaneType.SURFACE_STREET) for lane in lanes], np.uint8),
        speed_limit=to_float32(np.array([_speed_limit(lane, source.rules) for lane in lanes])),
        lane_width=to_float32(np.where(np.array(widths) > 0, widths, np.nan)),
        successors=links,
        left_neighbors=_beside(lanes, left=True),
        right_neighbors=_beside(lanes, left=False),
        boundary=polylines(rings, origin),
        marks=polylines([line for line, _ in marks], origin),
        mark_type=np.array([kind for _, kind in marks], np.uint8),
    )


def _polygon(area: Area) -> shapely.Polygon:
    return shapely.Polygon(area.outer, area.inner)


def successors(lanes: Sequence[Lanelet]) -> NDArray[np.int32]:
    """[E, 2] lane indices (from, to)."""
    starts: dict[tuple[int, int], list[int]] = {}
    for k, lane in enumerate(lanes):
        starts.setdefault((lane.left.nodes[0], lane.right.nodes[0]), []).append(k)
    return pairs(
        [
            (k, after)
            for k, lane in enumerate(lanes)
            for after in starts.get((lane.left.nodes[-1], lane.right.nodes[-1]), [])
            if after != k
        ]
    )


def _beside(lanes: Sequence[Lanelet], left: bool) -> NDArray[np.int32]:
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
        elif kind == "traffic_sign" and _is_stop(way) and len(way.line):
            yield way.line.mean(axis=0, keepdims=True), MarkType.STOP_SIGN
    for lanelet in source.lanelets:
        if lanelet.subtype == "crosswalk":
            yield lanelet.ring, MarkType.CROSSWALK


def _is_stop(sign: Way) -> bool:
    return any(_STOP_SIGNS.search(sign.tags.get(name, "")) for name in ("subtype", "sign_type"))


def stop_line(lane: Lanelet, rules: dict[int, Rule]) -> Doubles | None:
    """[2] the middle of the stop line that a traffic light of the lanelet names; None where none does."""
    for rule in (rules[ref] for ref in lane.rules if ref in rules):
        if rule.tags.get("subtype") == "traffic_light":
            for line in rule.lines.get("ref_line", ()):
                return line.line.mean(axis=0)
    return None
