"""Lanelet networks and traffic lights of CommonRoad files."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import LaneType, MarkType, SignalState, check_signals
from symphony.data.sources.base import readable
from symphony.data.sources.lines import (
    Lane,
    cut_ends,
    drivable_rings,
    evenly,
    flow,
    lights,
    median_width,
    opened,
    painted,
    road_map,
)
from symphony.data.sources.xml_files import Doubles, integer, number, points, references
from symphony.errors import DataError

MAX_CYCLE = 10**8
"""Steps in one cycle of a traffic light: more would not fit the arithmetic."""

NO_LANELET = "a lanelet left out that can't be read"
NO_LIGHT = "a traffic light left out that can't be read"
NO_SIGN = "a traffic sign left out that can't be read"

_LANE_TYPES = (
    (LaneType.BIKE_LANE, {"bicycleLane"}),
    (LaneType.FREEWAY, {"highway", "interstate", "mainCarriageWay", "accessRamp", "exitRamp"}),
    (LaneType.SURFACE_STREET, {"urban", "country", "intersection", "driveWay", "busLane"}),
)
_WALKWAYS = frozenset({"sidewalk", "crosswalk"})
_BESIDE = frozenset({"shoulder", "border", "parking", "restricted"})
"""Places of the road that are no way to anywhere."""
_SPEED_SIGNS = frozenset({"274", "R2-1", "r301", "R301"})
_COLORS = {
    "red": SignalState.STOP,
    "redYellow": SignalState.STOP,
    "yellow": SignalState.CAUTION,
    "green": SignalState.GO,
    "inactive": SignalState.UNKNOWN,
}


@dataclass(frozen=True)
class _Lanelet:
    """A lanelet: its lane, halfway between its bounds [P, 2], and what else it says.

    Attributes:
        lane: the lane; its type is UNDEFINED where the lanelet does not say.
        left: left bound in the direction of travel.
        right: right bound with as many points.
        kinds: its types.
        marked: the bounds that are painted.
        lights: ids of traffic lights.
        stop: [2] where its stop line is, or where it ends.
    """

    lane: Lane
    left: Doubles
    right: Doubles
    kinds: frozenset[str]
    marked: list[Doubles]
    lights: tuple[int, ...]
    stop: Doubles

    @property
    def ring(self) -> Doubles:
        """[2 P + 1, 2] closed outline."""
        return np.concatenate([self.left, self.right[::-1], self.left[:1]])


def read_map(
    root: ET.Element, steps: NDArray[np.int64], origin: Doubles, odd: dict[str, str]
) -> dict[str, Any]:
    """The map and the lights of either version of the format, as fields of a run segment.

    Sidewalks are left out; so are lanelets with a bound of fewer than two points. Shoulders, parking places and what
    is restricted belong to the drivable area, but are no lanes.

    Args:
        root: of the file.
        steps: [T] the format's time steps.
        origin: [2] what is subtracted.
        odd: where it is noted what can't be read.

    Raises:
        DataError: there are no lanelets.
    """
    limits: dict[int, float] = {}
    for node in root.findall("trafficSign"):
        for limit in readable(NO_SIGN, odd, _speed_limits, node):
            limits |= limit
    nodes = root.findall("lanelet")
    found = [each for node in nodes for each in readable(NO_LANELET, odd, _lanelet, node, limits)]
    lanelets = [lanelet for lanelet in found if len(lanelet.left)]
    surface = [lanelet for lanelet in lanelets if not lanelet.kinds & _WALKWAYS]
    ways = [lanelet for lanelet in surface if not lanelet.kinds & _BESIDE]
    if not ways:
        missing = f": {odd[NO_LANELET]}" if NO_LANELET in odd else ""
        raise DataError(f"has no lanes{missing}", field="lanelet")
    tags = set((root.get("tags") or "").split()) | {child.tag for child in root.findall("scenarioTags/*")}
    lanes = [replace(each.lane, kind=each.lane.kind or _lane_type(tags)) for each in ways]
    links = flow(lanes)
    rings = drivable_rings([lanelet.ring for lanelet in surface])
    ends = cut_ends([(each.left, each.right) for each in surface], flow([each.lane for each in surface]))
    marks = [(line, MarkType.ROAD_LINE) for line in painted(line for each in ways for line in each.marked)]
    marks += [(each.ring, MarkType.CROSSWALK) for each in lanelets if "crosswalk" in each.kinds]
    return {
        "road": road_map(lanes, origin, opened(rings, ends), marks, links=links),
        **lights(_signals(root, ways, steps, odd), len(steps), origin),
    }


def _speed_limits(sign: ET.Element) -> dict[int, float]:
    """Sign id -> speed limit in m/s; empty for other signs."""
    limits = {}
    for element in sign.findall("trafficSignElement"):
        value = element.findtext("additionalValue")
        if (element.findtext("trafficSignID") or "").strip() in _SPEED_SIGNS and value is not None:
            limits[integer(sign.get("id"), "trafficSign id")] = number(value, "trafficSign additionalValue")
    return limits


def _lanelet(node: ET.Element, limits: dict[int, float]) -> _Lanelet:
    lanelet_id = integer(node.get("id"), "lanelet id")
    field = f"lanelet {lanelet_id}"
    bounds = {side: node.find(f"{side}Bound") for side in ("left", "right")}
    left, right = (points(bound, f"{field}: {side}Bound") for side, bound in bounds.items())
    if min(len(left), len(right)) < 2:
        left = right = np.zeros((0, 2))
    elif len(left) != len(right):
        count = max(len(left), len(right))
        left, right = evenly(left, count), evenly(right, count)
    center = (left + right) / 2
    speeds = [number(child.text, f"{field}: speedLimit") for child in node.findall("speedLimit")]
    speeds += [limits[ref] for ref in references(node, "trafficSignRef", field) if ref in limits]
    line = points(node.find("stopLine"), f"{field}: stopLine")
    kinds = frozenset(
        (kind.text or "").strip() for tag in ("laneletType", "type") for kind in node.findall(tag)
    )
    lane = Lane(
        lanelet_id,
        center,
        _lane_type(kinds),
        median_width(left, right) if len(left) else np.nan,
        min((speed for speed in speeds if speed > 0), default=np.nan),
        references(node, "successor", field),
        references(node, "predecessor", field),
        _same_direction(node, "adjacentLeft", field),
        _same_direction(node, "adjacentRight", field),
    )
    marked = [side for side, bound in zip((left, right), bounds.values(), strict=True) if _is_marked(bound)]
    stop = line.mean(axis=0) if len(line) else center[-1] if len(center) else np.zeros(2)
    return _Lanelet(lane, left, right, kinds, marked, references(node, "trafficLightRef", field), stop)


def _same_direction(node: ET.Element, tag: str, field: str) -> list[int]:
    same = [child for child in node.findall(tag) if child.get("drivingDir") == "same"]
    return [integer(child.get("ref"), f"{field}: {tag}") for child in same]


def _is_marked(bound: ET.Element | None) -> bool:
    marking = None if bound is None else bound.findtext("lineMarking")
    return marking is not None and marking.strip() not in {"", "no_marking", "unknown"}


def _lane_type(kinds: set[str] | frozenset[str]) -> LaneType:
    return next((lane_type for lane_type, names in _LANE_TYPES if kinds & names), LaneType.UNDEFINED)


def _signals(
    root: ET.Element, ways: Sequence[_Lanelet], steps: NDArray[np.int64], odd: dict[str, str]
) -> dict[int, tuple[Doubles, NDArray[np.uint8]]]:
    """Lane -> (stop point [2], state [T]) of the traffic lights.

    As in WOMD, a light belongs to the lane behind it: to each successor of a lanelet that refers to the light,
    in the light's direction where an intersection tells the successors' directions apart, or to the lanelet
    itself where it has no successor. The first light of a lane counts. The stop point is the middle of the
    stop line, or the end of the referring lanelet.
    """
    turns = _turns(root)
    index = {way.lane.name: k for k, way in enumerate(ways)}
    known: dict[int, tuple[str, NDArray[np.uint8]]] = {}
    wanted = {ref for way in ways for ref in way.lights}
    for node in root.findall("trafficLight"):
        for name, direction, states in readable(NO_LIGHT, odd, _light, node, steps, wanted):
            known[name] = direction, states
            check_signals(len(known), len(steps), "trafficLight")
    found: dict[int, tuple[Doubles, NDArray[np.uint8]]] = {}
    for k, way in enumerate(ways):
        after = [index[ref] for ref in way.lane.successors if ref in index]
        for direction, states in (known[ref] for ref in way.lights if ref in known):
            for target in after or [k]:
                turn = turns.get(ways[target].lane.name)
                if direction == "all" or turn is None or turn in direction:
                    found.setdefault(target, (way.stop, states))
        check_signals(len(found), len(steps), "trafficLight")
    return found


def _turns(root: ET.Element) -> dict[int, str]:
    """Lanelet id -> left, straight or right, as the intersections tell."""
    turns: dict[int, str] = {}
    for incoming in root.findall("intersection/incoming"):
        for turn in ("Left", "Straight", "Right"):
            turns |= dict.fromkeys(references(incoming, f"successors{turn}", "intersection"), turn.lower())
    return turns


def _light(
    node: ET.Element, steps: NDArray[np.int64], wanted: set[int]
) -> tuple[int, str, NDArray[np.uint8]] | None:
    """(id, direction, state at each time step) of a light that some lanelet refers to.

    Its cycle repeats, its first element beginning at the time offset.
    """
    name = integer(node.get("id"), "trafficLight id")
    if name not in wanted:
        return None
    field = f"trafficLight {name}"
    direction = (node.findtext("direction") or "all").strip().lower()
    cycle = node.find("cycle")
    if cycle is None or node.findtext("active", "true").strip() not in {"true", "1"}:
        return name, direction, np.full(len(steps), SignalState.UNKNOWN, np.uint8)
    elements = cycle.findall("cycleElement")
    colors = [(element.findtext("color") or "").strip() for element in elements]
    for color in colors:
        if color not in _COLORS:
            raise DataError(f"unknown color {color!r}", field=f"{field}: color")
    durations = [integer(element.findtext("duration"), f"{field}: duration") for element in elements]
    if not durations or min(durations) < 1 or sum(durations) > MAX_CYCLE:
        raise DataError("needs elements that last at least one step", field=f"{field}: cycle")
    offset = integer(cycle.findtext("timeOffset", "0"), f"{field}: timeOffset") % sum(durations)
    phase = (steps - offset) % sum(durations)
    which = np.searchsorted(np.cumsum(durations), phase, side="right")
    return name, direction, np.array([_COLORS[color] for color in colors], np.uint8)[which]
