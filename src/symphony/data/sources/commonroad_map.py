"""Lanelet networks and traffic lights of CommonRoad files."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from symphony.data.bounds import check_signals
from symphony.data.segment import Floats, LaneType, MarkType, RoadMap, SignalState
from symphony.data.sources.base import pairs, to_float32
from symphony.data.sources.commonroad_xml import (
    Doubles,
    integer,
    is_true,
    number,
    points,
    references,
)
from symphony.data.sources.lines import cut_ends, drivable_rings, evenly, opened, polylines
from symphony.errors import DataError

MAX_CYCLE = 10**8
"""Steps in one cycle of a traffic light: more would not fit the arithmetic."""

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
class Lanelet:
    """One lanelet; bounds [P, 2] with equal P in the direction of travel, ``stop`` the middle of its stop line."""

    lanelet_id: int
    left: Doubles
    right: Doubles
    kinds: frozenset[str]
    marked: tuple[bool, bool]
    successors: tuple[int, ...]
    predecessors: tuple[int, ...]
    left_neighbors: tuple[int, ...]
    right_neighbors: tuple[int, ...]
    speed_limit: float
    lights: tuple[int, ...]
    stop: Doubles | None

    @property
    def center(self) -> Doubles:
        """[P, 2] halfway between the bounds."""
        return (self.left + self.right) / 2

    @property
    def ring(self) -> Doubles:
        """[2 P + 1, 2] closed outline."""
        return np.concatenate([self.left, self.right[::-1], self.left[:1]])


@dataclass(frozen=True)
class Network:
    """All lanelets of a file in logged coordinates (float64).

    Attributes:
        lanes: those by which vehicles or cyclists get on; a road's lane k is ``lanes[k]``.
        crosswalks: those for crossing on foot.
        boundary: edge of the drivable area, drivable side on the left, open where the network was cut.
        kind: lane type where a lanelet does not say.
        index: lanelet id -> lane index.
        links: [E, 2] successors, lane indices (from, to).
    """

    lanes: tuple[Lanelet, ...]
    crosswalks: tuple[Lanelet, ...]
    boundary: tuple[Doubles, ...]
    kind: LaneType
    index: dict[int, int]
    links: NDArray[np.int32]


def read_network(root: ET.Element) -> Network:
    """Read the lanelets of either version of the format.

    Sidewalks are left out; so are lanelets with a bound of fewer than two points. Shoulders, parking places and what
    is restricted belong to the drivable area, but are no lanes.

    Raises:
        DataError: there are no lanelets, or one can't be read.
    """
    limits = _speed_signs(root)
    found = [_lanelet(node, limits) for node in root.findall("lanelet")]
    lanelets = [lanelet for lanelet in found if len(lanelet.left)]
    surface = tuple(lanelet for lanelet in lanelets if not lanelet.kinds & _WALKWAYS)
    lanes = tuple(lanelet for lanelet in surface if not lanelet.kinds & _BESIDE)
    if not lanes:
        raise DataError("has no lanes", field="lanelet")
    tags = set((root.get("tags") or "").split()) | {child.tag for child in root.findall("scenarioTags/*")}
    rings = drivable_rings([lanelet.ring for lanelet in surface])
    ends = cut_ends([(lanelet.left, lanelet.right) for lanelet in surface], _links(surface))
    return Network(
        lanes=lanes,
        crosswalks=tuple(lanelet for lanelet in lanelets if "crosswalk" in lanelet.kinds),
        boundary=opened(rings, ends),
        kind=_lane_type(tags, LaneType.UNDEFINED),
        index=_places(lanes),
        links=_links(lanes),
    )


def _places(lanelets: Sequence[Lanelet]) -> dict[int, int]:
    return {lanelet.lanelet_id: k for k, lanelet in enumerate(lanelets)}


def _links(lanelets: Sequence[Lanelet]) -> NDArray[np.int32]:
    """[E, 2] which of some lanelets lead to which of them, told by either."""
    index = _places(lanelets)
    flow = [(k, index[ref]) for k, lane in enumerate(lanelets) for ref in lane.successors if ref in index]
    flow += [(index[ref], k) for k, lane in enumerate(lanelets) for ref in lane.predecessors if ref in index]
    return pairs(flow)


def _speed_signs(root: ET.Element) -> dict[int, float]:
    """Sign id -> speed limit in m/s."""
    limits = {}
    for sign in root.findall("trafficSign"):
        for element in sign.findall("trafficSignElement"):
            value = element.findtext("additionalValue")
            if (element.findtext("trafficSignID") or "").strip() in _SPEED_SIGNS and value is not None:
                limits[integer(sign.get("id"), "trafficSign id")] = number(
                    value, "trafficSign additionalValue"
                )
    return limits


def _lanelet(node: ET.Element, limits: dict[int, float]) -> Lanelet:
    lanelet_id = integer(node.get("id"), "lanelet id")
    field = f"lanelet {lanelet_id}"
    left, right = (points(node.find(f"{side}Bound"), f"{field}: {side}Bound") for side in ("left", "right"))
    if min(len(left), len(right)) < 2:
        left = right = np.zeros((0, 2))
    elif len(left) != len(right):
        count = max(len(left), len(right))
        left, right = evenly(left, count), evenly(right, count)

    speeds = [number(child.text, f"{field}: speedLimit") for child in node.findall("speedLimit")]
    speeds += [
        limits[ref] for ref in references(node, "trafficSignRef", f"{field}: trafficSignRef") if ref in limits
    ]
    line = points(node.find("stopLine"), f"{field}: stopLine")
    kinds = [*node.findall("laneletType"), *node.findall("type")]
    return Lanelet(
        lanelet_id=lanelet_id,
        left=left,
        right=right,
        kinds=frozenset((kind.text or "").strip() for kind in kinds),
        marked=(_is_marked(node.find("leftBound")), _is_marked(node.find("rightBound"))),
        successors=tuple(references(node, "successor", f"{field}: successor")),
        predecessors=tuple(references(node, "predecessor", f"{field}: predecessor")),
        left_neighbors=_same_direction(node, "adjacentLeft", field),
        right_neighbors=_same_direction(node, "adjacentRight", field),
        speed_limit=min((speed for speed in speeds if speed > 0), default=np.nan),
        lights=tuple(references(node, "trafficLightRef", f"{field}: trafficLightRef")),
        stop=line.mean(axis=0) if len(line) else None,
    )


def _same_direction(node: ET.Element, tag: str, field: str) -> tuple[int, ...]:
    return tuple(
        integer(child.get("ref"), f"{field}: {tag}")
        for child in node.findall(tag)
        if child.get("drivingDir") == "same"
    )


def _is_marked(bound: ET.Element | None) -> bool:
    marking = None if bound is None else bound.findtext("lineMarking")
    return marking is not None and marking.strip() not in {"", "no_marking", "unknown"}


def _lane_type(kinds: set[str] | frozenset[str], default: LaneType) -> LaneType:
    return next((lane_type for lane_type, names in _LANE_TYPES if kinds & names), default)


def road_map(network: Network, origin: Doubles) -> RoadMap:
    """The network relative to an origin [2]; z is 0, as trajectories have none."""
    lanes, index = network.lanes, network.index
    left = [(k, index[ref]) for k, lane in enumerate(lanes) for ref in lane.left_neighbors if ref in index]
    right = [(k, index[ref]) for k, lane in enumerate(lanes) for ref in lane.right_neighbors if ref in index]
    widths = np.array([np.median(np.hypot(*(lane.left - lane.right).T)) for lane in lanes])
    marks = _markings(network)
    types = [_lane_type(lane.kinds, network.kind) for lane in lanes]
    return RoadMap(
        lanes=polylines([lane.center for lane in lanes], origin),
        lane_id=np.array([lane.lanelet_id for lane in lanes], np.int64),
        lane_type=np.array(types, np.uint8),
        speed_limit=to_float32(np.array([lane.speed_limit for lane in lanes])),
        lane_width=to_float32(np.where(widths > 0, widths, np.nan)),
        successors=network.links,
        left_neighbors=pairs(left),
        right_neighbors=pairs(right),
        boundary=polylines(network.boundary, origin),
        marks=polylines(marks + [lanelet.ring for lanelet in network.crosswalks], origin),
        mark_type=np.array(
            [MarkType.ROAD_LINE] * len(marks) + [MarkType.CROSSWALK] * len(network.crosswalks), np.uint8
        ),
    )


def _markings(network: Network) -> list[Doubles]:
    """Painted bounds; one that two neighbours share counts once."""
    found: dict[bytes, Doubles] = {}
    for lane in network.lanes:
        for bound, marked in zip((lane.left, lane.right), lane.marked, strict=True):
            if marked and bound[::-1].tobytes() not in found:
                found.setdefault(bound.tobytes(), bound)
    return list(found.values())


def read_signals(
    root: ET.Element, network: Network, first_step: int, steps: int, origin: Doubles
) -> tuple[NDArray[np.int32], Floats, NDArray[np.uint8]]:
    """(lane [Q], stop point [Q, 3], state [Q, T]) of the traffic lights, one row per lane.

    As in WOMD, a light belongs to the lane behind it: to each successor of a lanelet that refers to the light,
    in the light's direction where an intersection tells the successors' directions apart, or to the lanelet
    itself where it has no successor. The first light of a lane counts. The stop point is the middle of the
    stop line, or the end of the referring lanelet.
    """
    turns = _turns(root)
    lights = {integer(node.get("id"), "trafficLight id"): node for node in root.findall("trafficLight")}
    found: dict[int, tuple[Doubles, NDArray[np.uint8]]] = {}
    when = np.arange(first_step, first_step + steps)
    cycles: dict[int, NDArray[np.uint8]] = {}
    for k, lane in enumerate(network.lanes):
        after = [network.index[ref] for ref in lane.successors if ref in network.index]
        stop = lane.center[-1] if lane.stop is None else lane.stop
        for ref in lane.lights:
            node = lights.get(ref)
            if node is None:
                continue
            field = f"trafficLight {ref}"
            direction = (node.findtext("direction") or "all").strip().lower()
            if ref not in cycles:
                cycles[ref] = _cycle(node, when, field)
            states = cycles[ref]
            for target in after or [k]:
                turn = turns.get(network.lanes[target].lanelet_id)
                if direction == "all" or turn is None or turn in direction:
                    found.setdefault(target, (stop, states))
        check_signals(len(cycles), steps, "trafficLight")
        check_signals(len(found), steps, "trafficLight")
    stops = np.array([stop - origin for stop, _ in found.values()]).reshape(-1, 2)
    return (
        np.array(list(found), np.int32),
        to_float32(np.pad(stops, ((0, 0), (0, 1)))),
        np.array([states for _, states in found.values()], np.uint8).reshape(-1, steps),
    )


def _turns(root: ET.Element) -> dict[int, str]:
    """Lanelet id -> left, straight or right, as the intersections tell."""
    turns = {}
    for incoming in root.findall("intersection/incoming"):
        for turn in ("Left", "Straight", "Right"):
            for ref in references(incoming, f"successors{turn}", f"intersection: successors{turn}"):
                turns[ref] = turn.lower()
    return turns


def _cycle(node: ET.Element, steps: NDArray[np.int64], field: str) -> NDArray[np.uint8]:
    """State at each time step: the cycle repeats, its first element beginning at the time offset."""
    cycle = node.find("cycle")
    if cycle is None or not is_true(node.findtext("active"), default=True):
        return np.full(len(steps), SignalState.UNKNOWN, np.uint8)
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
    return np.array([_COLORS[color] for color in colors], np.uint8)[which]
