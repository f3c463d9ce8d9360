"""Reader of CommonRoad scenarios: XML files of version 2018b or 2020a.

This is our own reader, since every release of ``commonroad-io`` since 2023 pins protobuf 3.20, which conflicts with
all else here, and the last that installs (2022.1) brings scipy and does not refuse XML entities.

- ``segment_id`` and ``group`` are the benchmark id. Steps run from the first to the last at which any dynamic
  obstacle exists. Coordinates are relative to the first position, in whole metres, of the ego ``egos="one"`` picks.
- With ``egos="problem"`` the ego is that of a planning problem: it begins as the problem says, with the size of a
  BMW 320i (vehicle 2 of CommonRoad's models), has no log but this state, and is to come past the middle of the goal.
- States are exact: predicted ones (intervals, regions, occupancies) are not logged motion. The velocity is the logged
  speed along the logged orientation, or a difference of positions where none is logged. Static obstacles are at rest;
  scenery (buildings, pillars, road boundaries, median strips) is left out.
- A lane is halfway between a lanelet's bounds. Sidewalks are left out, crosswalks are marks; shoulders, parking
  places and what is restricted belong to the drivable area, but are no lanes. The boundary is open at lanelets
  without successor or predecessor.
- As in WOMD, a light belongs to the lane behind it: to each successor of a lanelet that refers to the light, in the
  light's direction where an intersection tells the successors' directions apart, or to the lanelet itself where it
  has no successor. The first light of a lane counts. It stands at the stop line, or where the lanelet ends.
- Obstacles, lanelets, signs and lights that can't be read are left out, and noted.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from symphony.data import segment as schema
from symphony.data.segment import AgentType, Bools, LaneType, MarkType, RunSegment, SignalState
from symphony.data.sources import base, lines
from symphony.data.sources.base import Doubles, Item, Odd, Reader, by_ego, located, motion, readable, refuse
from symphony.data.sources.lines import Codes, Lane, Lights
from symphony.errors import DataError

VERSIONS = ("2018b", "2020a")
NO_OBSTACLE = "an obstacle left out that can't be read"
NO_LANELET = "a lanelet left out that can't be read"
NO_LIGHT = "a traffic light left out that can't be read"
NO_SIGN = "a traffic sign left out that can't be read"
STANDARD = (4.508, 1.610)  # metres of the ego of a planning problem
MAX_REFERENCES = 200  # references of one kind in a lanelet; junctions have a handful
MAX_CYCLE = 10**8  # steps in one cycle of a traffic light: more would not fit the arithmetic

Box = tuple[Sequence[float], Doubles, float]
"""(length, width) of the box around an obstacle's shape, its centre in the obstacle's frame [2], its turn."""
_CARS = ("car", "truck", "bus", "priorityVehicle", "parkedVehicle", "train", "motorcycle", "taxi")
_TYPES = dict.fromkeys(_CARS, AgentType.VEHICLE) | {"pedestrian": AgentType.PEDESTRIAN, "bicycle": AgentType.CYCLIST}
_SCENERY = frozenset({"roadBoundary", "building", "pillar", "median_strip"})
_LANE_TYPES = (
    (LaneType.BIKE_LANE, {"bicycleLane"}),
    (LaneType.FREEWAY, {"highway", "interstate", "mainCarriageWay", "accessRamp", "exitRamp"}),
    (LaneType.SURFACE_STREET, {"urban", "country", "intersection", "driveWay", "busLane"}),
)
_WALKWAYS = frozenset({"sidewalk", "crosswalk"})
_BESIDE = frozenset({"shoulder", "border", "parking", "restricted"})
"""Parts of the road that lead nowhere."""
_SPEED_SIGNS = frozenset({"274", "274.1", "R2-1", "r301", "R301", "3.24", "R15", "C43", "B14", "Ρ-32", "B31"})
_COLORS = dict.fromkeys(("red", "redYellow"), SignalState.STOP) | {
    "yellow": SignalState.CAUTION,
    "green": SignalState.GO,
    "inactive": SignalState.UNKNOWN,
}


class CommonRoadReader(Reader):
    """Reads CommonRoad XML files.

    Args:
        egos: ``"one"`` picks, among the dynamic vehicles that move and are observed at every step, the one with
            the most moving neighbours (within 50 m, summed over the steps; the lowest id on ties). ``"all"``
            yields a segment for each of those vehicles, in order of id, with ``_ego<ID>`` added to its name; all
            in one frame, on one map. ``"problem"`` yields one for each planning problem, with ``_problem<ID>`` added.

    Raises a :class:`ConfigError` where ``egos`` is none of these.
    """

    name = "commonroad"
    patterns = ("*.xml",)

    def __init__(self, egos: Literal["one", "all", "problem"] = "one") -> None:
        base.check_choice("egos", egos, "one", "all", "problem")
        self.egos = egos

    def _read(self, path: Path) -> Iterator[Item]:
        root = base.load_xml(path)
        name, version = root.get("benchmarkID", ""), root.get("commonRoadVersion")
        refuse(root.tag != "commonRoad", f"not a CommonRoad file, but <{root.tag[:40]}>", "commonRoad")
        refuse(version not in VERSIONS, f"{version!r}, expected {' or '.join(VERSIONS)}", "commonRoadVersion")
        refuse(not name, "missing", "benchmarkID")
        with located(segment=name):
            problems = root.findall("planningProblem") if self.egos == "problem" else [None]
            refuse(not problems, "missing", "planningProblem")
            for problem in problems:
                yield from self._segments(root, name, path, problem)

    def _segments(self, root: ET.Element, name: str, path: Path, problem: ET.Element | None) -> Iterator[Item]:
        dt = base.number(root.get("timeStepSize"), "timeStepSize")
        refuse(dt <= 0, f"must be positive, is {dt:g}", "timeStepSize")
        odd: dict[str, str] = {}
        agents, table, valid, dynamic, first_step = _tracks(root, dt, odd, problem)
        position, candidates = table[..., 1:3], np.zeros(1, np.int64)
        if problem is None:
            candidates = base.busiest_first(agents["agent_id"], agents["agent_type"], position, valid, dynamic)
        refuse(not len(candidates), "no moving vehicle is observed at every step", "dynamicObstacle")
        ego = int(candidates[0])
        origin = np.round(position[ego, np.argmax(valid[ego])])
        steps = first_step + np.arange(valid.shape[1])
        segment = RunSegment(
            segment_id=name,
            source=self.name,
            dt=dt,
            ego=ego,
            **agents,
            **motion(position - origin, table[..., 3], table[..., 4:6], valid),
            origin=np.array([*origin, 0.0]),
            **_map(root, steps, origin, odd),
            file=path.name,
            group=name,
            odd=odd,
        )
        if problem is None:
            yield from by_ego(segment, candidates, self.egos)
        else:
            yield segment.replace(segment_id=f"{name}_problem{agents['agent_id'][0]}", goal=_goal(problem, segment))


def _problem(node: ET.Element) -> tuple[int, int, Doubles, Box]:
    """Return the ego of a planning problem, as :func:`_obstacle` does."""
    name, first = f"planningProblem {node.get('id')}", node.find("initialState")
    refuse(first is None, "missing", f"{name}: initialState")
    log = np.array([_state(child, name, True) for child in node.findall("initialState")], np.float64)[:1]
    return base.integer(node.get("id"), "planningProblem id"), AgentType.VEHICLE, log, (STANDARD, np.zeros(2), 0.0)


def _goal(node: ET.Element, segment: RunSegment) -> list[float] | None:
    """Return where the first goal with a place has its middle, in the segment's frame; None if none has one."""
    field = f"planningProblem {node.get('id')}: goalState"
    for place in node.findall("goalState/position"):
        for lane in _references(place, "lanelet", field):
            rows = np.flatnonzero(segment.road.lane_id == lane)
            refuse(not len(rows), f"names lanelet {lane}, which is no lane", field)
            line = segment.road.lanes[int(rows[0])][:, :2].astype(np.float64)
            return list(lines.evenly(line, 3)[1].tolist())
        point = place.find("point")
        if point is None:  # several shapes are one area
            middle = np.mean([_shape([part], field)[1] for part in place], axis=0)
        else:
            middle = np.array(_point(point, field))
        return list((middle - segment.origin[:2]).tolist())
    return None


def _tracks(
    root: ET.Element, dt: float, odd: Odd, problem: ET.Element | None
) -> tuple[dict[str, Any], Doubles, Bools, Bools, int]:
    """Return all obstacles of either version, over the steps any dynamic one is present at; before them the ego of a
    planning problem, whose goals' times count, too.

    Gives ids, types and sizes, states [A, T, 6] (see :func:`_state`, with a velocity in place of speeds), where they
    are valid [A, T], which obstacles [A] are dynamic, and the format's first time step.
    """
    tags = ("dynamicObstacle", "staticObstacle")
    nodes = [(node, tag == tags[0]) for tag in tags for node in root.findall(tag)]
    nodes += [(node, _text(node, "role") == "dynamic") for node in root.findall("obstacle")]
    nodes = [(node, moves) for node, moves in nodes if moves or _text(node, "type") not in _SCENERY]
    nodes.sort(key=lambda entry: not entry[1])
    found = [(*each, moves) for node, moves in nodes for each in readable(NO_OBSTACLE, odd, _obstacle, node, moves)]
    if problem is not None:
        found.insert(0, (*_problem(problem), True))
    logs = [log for _, _, log, _, moves in found if moves]
    refuse(not logs, odd.get(NO_OBSTACLE, "has no dynamic obstacles"), "dynamicObstacle")
    first = min(int(log[:, 0].min()) for log in logs)
    steps = max([int(log[:, 0].max()) for log in logs] + _times(problem)) - first + 1
    schema.check_counts(len(found), steps, "time")
    table, valid = np.full((len(found), steps, 6), np.nan), np.zeros((len(found), steps), np.bool_)
    size = np.zeros((len(found), 3))
    for row, (_, _, log, (sides, offset, turn), moves) in enumerate(found):
        where = log[:, 0].astype(np.int64) - first if moves else np.arange(steps)
        table[row, where], valid[row, where] = log, True
        size[row, :2] = sides
        heading = table[row, :, 3]
        table[row, :, 1:3] += _rotated(np.broadcast_to(offset, (steps, 2)), heading)
        velocity = _rotated(table[row, :, 4:6], heading)
        unknown = valid[row] & np.isnan(velocity[:, 0])
        velocity[unknown] = _differences(table[row, :, 1:3], valid[row], dt)[unknown]
        table[row, :, 4:6] = velocity
        table[row, :, 3] += turn
    table[~valid] = 0
    agents = {
        "agent_id": np.array([each[0] for each in found], np.int64),
        "agent_type": np.array([each[1] for each in found], np.uint8),
        "size": base.to_float32(size),
    }
    return agents, table, valid, np.array([each[-1] for each in found], np.bool_), first


def _times(problem: ET.Element | None) -> list[int]:
    """Return the last time steps of the goals of a planning problem."""
    ways = ("goalState/time/intervalEnd", "goalState/time/exact")
    nodes = [] if problem is None else [node for way in ways for node in problem.findall(way)]
    return [base.integer(node.text, "planningProblem: time") for node in nodes]


def _text(node: ET.Element, tag: str) -> str:
    return (node.findtext(tag) or "").strip()


def _point(node: ET.Element, field: str) -> tuple[float, float]:
    return base.number(node.findtext("x"), field), base.number(node.findtext("y"), field)


def _points(node: ET.Element | None, field: str) -> Doubles:
    """Return [P, 2] the ``point`` children of an element, none if it is missing."""
    children = [] if node is None else node.findall("point")
    return np.array([_point(child, field) for child in children], np.float64).reshape(-1, 2)


def _references(node: ET.Element, tag: str, field: str) -> list[int]:
    children, field = node.findall(tag), f"{field}: {tag}"
    refuse(len(children) > MAX_REFERENCES, f"{len(children)} references, at most {MAX_REFERENCES}", field)
    return [base.integer(child.get("ref"), field) for child in children]


def _obstacle(node: ET.Element, moves: bool) -> tuple[int, int, Doubles, Box]:
    """Return an obstacle's id, type, states [N, 6] (see :func:`_state`) and box."""
    name = f"obstacle {node.get('id')}"
    role = _text(node, "role") if node.tag == "obstacle" else "dynamic"
    refuse(role not in {"dynamic", "static"}, f"unknown role {role!r}", f"{name}: role")
    states = [*node.findall("initialState"), *(node.findall("trajectory/state") if moves else [])]
    for tag in ("type", "initialState"):
        refuse(node.find(tag) is None, "missing", f"{name}: {tag}")
    log = np.array([_state(state, name, moves) for state in states], np.float64)
    if moves:
        predicted = node.find("occupancySet") is not None
        refuse(predicted, "predicted occupancies are not logged motion", f"{name}: occupancySet")
        steps, counts = np.unique(log[:, 0], return_counts=True)
        refuse((counts > 1).any(), f"two states at step {steps[counts > 1][:1]}", f"{name}: time")
    else:  # at rest whatever its file says
        log[:, [0, 4, 5]] = 0
    kind = _TYPES.get(_text(node, "type"), AgentType.OTHER)
    return base.integer(node.get("id"), "obstacle id"), kind, log, _shape(node.findall("shape/*"), f"{name}: shape")


def _state(node: ET.Element, name: str, moves: bool) -> tuple[float, ...]:
    """Return time step, x, y, heading, forward and lateral speed (NaN where not given)."""

    def exact(tag: str, default: float | None) -> float:
        if default is not None and node.find(tag) is None:
            return default
        return base.number(node.findtext(f"{tag}/exact"), f"{name}: {tag}")

    place, needed = node.find("position/point"), None if moves else 0.0
    if place is None:
        raise DataError("no point", field=f"{name}: position")
    speeds = exact("velocity", np.nan), exact("velocityY", 0.0)
    time = np.floor(exact("time", needed) + 0.5)
    return time, *_point(place, f"{name}: position"), exact("orientation", needed), *speeds


def _differences(position: Doubles, valid: Bools, dt: float) -> Doubles:
    """Return [T, 2] velocity from the positions at the neighbouring valid steps, 0 for a single one."""
    velocity = np.zeros_like(position)
    steps = np.flatnonzero(valid)
    if len(steps) > 1:
        velocity[steps] = np.gradient(position[steps], steps * dt, axis=0)
    return velocity


def _rotated(vectors: Doubles, angle: Doubles | float) -> Doubles:
    """Return vectors [..., 2] turned by angles [...] counter-clockwise."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _shape(parts: list[ET.Element], field: str) -> Box:
    known = [part for part in parts if part.tag in {"rectangle", "circle", "polygon"}]
    refuse(len(parts) != 1 or parts != known, "expected one rectangle, circle or polygon", field)
    (part,) = parts
    if part.tag == "polygon":
        corners = _points(part, field)
        refuse(len(corners) < 3, f"a polygon of {len(corners)} points", field)
        low, high = corners.min(axis=0), corners.max(axis=0)
        return (high - low).tolist(), (low + high) / 2, 0.0
    center = part.find("center")
    middle = np.zeros(2) if center is None else np.array(_point(center, field))
    if part.tag == "circle":
        return [2 * base.number(part.findtext("radius"), field)] * 2, middle, 0.0
    sides = [base.number(part.findtext(side), field) for side in ("length", "width")]
    return sides, middle, base.number(part.findtext("orientation", "0"), field)


@dataclass(frozen=True)
class _Lanelet:
    """A lanelet: its lane, halfway between its bounds [P, 2], its types, and what else it says. ``marked`` are
    painted bounds, ``lights`` ids of traffic lights, ``stop`` [2] is its stop line, or where it ends.
    """

    lane: Lane
    left: Doubles
    right: Doubles
    kinds: Set[str]
    marked: list[Doubles]
    lights: list[int]
    stop: Doubles

    @property
    def ring(self) -> Doubles:
        """The closed outline of the lanelet [2 P + 1, 2]."""
        return np.concatenate([self.left, self.right[::-1], self.left[:1]])


def _map(root: ET.Element, steps: NDArray[np.int64], origin: Doubles, odd: Odd) -> dict[str, Any]:
    """Return map and lights of either version as fields of a run segment, whose time steps [T] are given."""
    limits: dict[int, float] = {}
    for node in root.findall("trafficSign"):
        for limit in readable(NO_SIGN, odd, _speed_limits, node):
            refuse(limits.keys() & limit.keys(), "two of one id", f"trafficSign {[*limit]}")
            limits |= limit
    nodes = root.findall("lanelet")
    lanelets = [each for node in nodes for each in readable(NO_LANELET, odd, _lanelet, node, limits)]
    surface = [lanelet for lanelet in lanelets if not lanelet.kinds & _WALKWAYS]
    ways = [lanelet for lanelet in surface if not lanelet.kinds & _BESIDE]
    refuse(not ways, f"has no lanes {odd.get(NO_LANELET, '')}".strip(), "lanelet")
    tags = set((root.get("tags") or "").split()) | {child.tag for child in root.findall("scenarioTags/*")}
    lanes = [replace(each.lane, kind=each.lane.kind or _lane_type(tags)) for each in ways]
    rings = lines.drivable_rings([lanelet.ring for lanelet in surface])
    links = lines.flow([each.lane for each in surface])
    ends = lines.cut_ends([(each.left, each.right) for each in surface], links)
    marks = lines.painted(line for each in ways for line in each.marked)
    marks += [(each.ring, MarkType.CROSSWALK) for each in lanelets if "crosswalk" in each.kinds]
    return {
        "road": lines.road_map(lanes, origin, lines.opened(rings, ends), marks),
        **lines.lights(_signals(root, ways, steps, odd), len(steps), origin),
    }


def _speed_limits(sign: ET.Element) -> dict[int, float]:
    """Return sign id -> speed limit in m/s; empty for other signs."""
    limits = {}
    for element in sign.findall("trafficSignElement"):
        value = element.findtext("additionalValue")
        if _text(element, "trafficSignID") in _SPEED_SIGNS and value is not None:
            sign_id = base.integer(sign.get("id"), "trafficSign id")
            limits[sign_id] = base.number(value, "trafficSign additionalValue")
    return limits


def _lanelet(node: ET.Element, limits: dict[int, float]) -> _Lanelet:
    lanelet_id = base.integer(node.get("id"), "lanelet id")
    field = f"lanelet {lanelet_id}"
    bounds = [node.find(f"{side}Bound") for side in ("left", "right")]
    left, right = (_points(bound, f"{field}: bound") for bound in bounds)
    refuse(min(len(left), len(right)) < 2, "fewer than two points", f"{field}: bound")
    if len(left) != len(right):
        count = max(len(left), len(right))
        left, right = lines.evenly(left, count), lines.evenly(right, count)
    speeds = [base.number(child.text, f"{field}: speedLimit") for child in node.findall("speedLimit")]
    speeds += [limits[ref] for ref in _references(node, "trafficSignRef", field) if ref in limits]
    limit = min((speed for speed in speeds if speed > 0), default=np.nan)
    kinds = {(kind.text or "").strip() for tag in ("laneletType", "type") for kind in node.findall(tag)}
    flows = [_references(node, tag, field) for tag in ("successor", "predecessor")]
    same = "[@drivingDir='same']"
    beside = [_references(node, f"adjacent{side}{same}", field) for side in ("Left", "Right")]
    center = (left + right) / 2
    width = lines.median_width(left, right)
    lane = Lane(lanelet_id, center, _lane_type(kinds), width, limit, *flows, *beside)
    paint = ["" if bound is None else _text(bound, "lineMarking") for bound in bounds]
    bare = {"", "no_marking", "unknown"}
    marked = [line for line, mark in zip((left, right), paint, strict=True) if mark not in bare]
    line = _points(node.find("stopLine"), f"{field}: stopLine")
    signals = _references(node, "trafficLightRef", field)
    return _Lanelet(lane, left, right, kinds, marked, signals, line.mean(axis=0) if len(line) else center[-1])


def _lane_type(kinds: Set[str]) -> LaneType:
    return next((lane_type for lane_type, names in _LANE_TYPES if kinds & names), LaneType.UNDEFINED)


def _signals(root: ET.Element, ways: Sequence[_Lanelet], steps: NDArray[np.int64], odd: Odd) -> Lights:
    """Return lane -> (stop point [2], state [T]) of the traffic lights."""
    turns: dict[int, str] = {}
    for incoming in root.findall("intersection/incoming"):
        for side in ("Left", "Straight", "Right"):
            turns |= dict.fromkeys(_references(incoming, f"successors{side}", "intersection"), side.lower())
    index = {way.lane.name: k for k, way in enumerate(ways)}
    known: dict[int, tuple[str, Codes]] = {}
    wanted = {ref for way in ways for ref in way.lights}
    for node in root.findall("trafficLight"):
        for name, direction, states in readable(NO_LIGHT, odd, _light, node, steps, wanted):
            refuse(name in known, "two of one id", f"trafficLight {name}")
            known[name] = direction, states
            schema.check_signals(len(known), len(steps), "trafficLight")
    found: Lights = {}
    for k, way in enumerate(ways):
        after = [index[ref] for ref in way.lane.successors if ref in index]
        for direction, states in (known[ref] for ref in way.lights if ref in known):
            for target in after or [k]:
                turn = turns.get(ways[target].lane.name)
                if direction == "all" or turn is None or turn in direction:
                    found.setdefault(target, (way.stop, states))
        schema.check_signals(len(found), len(steps), "trafficLight")
    return found


def _light(node: ET.Element, steps: NDArray[np.int64], wanted: set[int]) -> tuple[int, str, Codes] | None:
    """Return (id, direction, state at each time step) of a light that some lanelet refers to. Its cycle repeats, its
    first element beginning at the time offset.
    """
    name = base.integer(node.get("id"), "trafficLight id")
    if name not in wanted:
        return None
    field = f"trafficLight {name}"
    direction = (node.findtext("direction") or "all").strip().lower()
    cycle = node.find("cycle")
    if cycle is None or node.findtext("active", "true").strip() not in {"true", "1"}:
        return name, direction, np.full(len(steps), SignalState.UNKNOWN, np.uint8)
    elements = cycle.findall("cycleElement")
    colors = [_text(element, "color") for element in elements]
    unknown = [color for color in colors if color not in _COLORS]
    refuse(unknown, f"unknown colors {unknown[:3]}", f"{field}: color")
    durations = [base.integer(element.findtext("duration"), f"{field}: duration") for element in elements]
    fine = min(durations, default=0) >= 1 and sum(durations) <= MAX_CYCLE
    refuse(not fine, "needs elements that last at least one step", f"{field}: cycle")
    offset = base.integer(cycle.findtext("timeOffset", "0"), f"{field}: timeOffset") % sum(durations)
    phase = (steps - offset) % sum(durations)
    which = np.searchsorted(np.cumsum(durations), phase, side="right")
    return name, direction, np.array([_COLORS[color] for color in colors], np.uint8)[which]
