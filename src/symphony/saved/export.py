"""Single saved rollouts for other tools: CommonRoad scenarios (XML 2020a) without planning problems. Agents that come
later have an initial state at that time, which CommonRoad's reader takes; its schema knows the time 0 only. What is
seen at a single state is left out.

Legend: A agents, U states, L lanes, Q lights. Coordinates are those of the source: the segment's, plus its origin.
"""

from __future__ import annotations

import hashlib
import re
import xml.etree.ElementTree as ET
from itertools import count, groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import AgentType, LaneType, RunSegment, SignalState
from symphony.planners.view import normals
from symphony.saved.rollouts import SavedRollouts, World, world_of

Reals = NDArray[np.float64]

TRUCK = 7.0  # metres of length from which a vehicle is a truck
STRAIGHT = 0.5  # radians that a lane may turn and still lead straight on

_TYPES = {AgentType.PEDESTRIAN: "pedestrian", AgentType.CYCLIST: "bicycle"}
_LANES = {LaneType.FREEWAY: "highway", LaneType.SURFACE_STREET: "urban", LaneType.BIKE_LANE: "bicycleLane"}
_COLORS = {"STOP": "red", "CAUTION": "yellow", "GO": "green"}


def commonroad(saved: SavedRollouts, rollout: int) -> str:
    """Return a rollout as a CommonRoad scenario.

    Agents are dynamic obstacles with their ids of the source (all shifted alike if some are not positive), others for
    each further stretch of steps at which they are seen. Lanelets are nominally wide where the log does not say, and
    none where it has a lane of a single point. Lights that flash or are not known are inactive.
    """
    segment = saved.segment
    letters = "".join(word.capitalize() for word in re.findall("[A-Za-z]+", segment.segment_id)) or "Segment"
    number = 1 + int(hashlib.sha256(segment.segment_id.encode()).hexdigest()[:12], 16)  # names hold nothing else
    name = f"ZAM_{letters[:60]}-{number}_{rollout + 1}_T-1"
    about = {"commonRoadVersion": "2020a", "benchmarkID": name, "timeStepSize": repr(float(segment.dt))}
    source = f"symphony: segment {segment.segment_id}, rollout {rollout}"
    about |= {"author": "", "affiliation": "", "source": source}
    root = ET.Element("commonRoad", about, date="1970-01-01")
    location = _add(root, "location")
    for tag, value in (("geoNameId", "-999"), ("gpsLatitude", "999"), ("gpsLongitude", "999")):
        _add(location, tag, value)
    _add(_add(root, "scenarioTags"), "simulated")
    obstacles = _obstacles(saved, rollout)
    taken = max((int(obstacle.get("id", 0)) for obstacle in obstacles), default=0)  # nobody may be left
    _Network(segment, slice(saved.start, saved.last + 1), 1 + taken).add(root)
    root.extend(obstacles)
    ET.indent(root)
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + ET.tostring(root, encoding="unicode") + "\n"


def _add(parent: ET.Element, tag: str, value: Any = None, **attributes: Any) -> ET.Element:
    node = ET.SubElement(parent, tag, {name: str(held) for name, held in attributes.items()})
    if value is not None:
        node.text = value if isinstance(value, str) else f"{float(value):.6f}"
    return node


def _point(parent: ET.Element, tag: str, place: Any) -> None:
    node = _add(parent if tag == "point" else _add(parent, tag), "point")
    for axis, value in zip("xy", place, strict=True):
        _add(node, axis, value)


def _obstacles(saved: SavedRollouts, rollout: int) -> list[ET.Element]:
    segment, world = saved.segment, world_of(saved, rollout)
    ids = segment.agent_id + max(0, 1 - int(segment.agent_id.min()))
    spare = count(int(ids.max()) + 1)
    found = []
    for row in np.flatnonzero(world.valid.any(1)).tolist():
        seen = np.flatnonzero(world.valid[row])
        parts = np.split(seen, np.flatnonzero(np.diff(seen) > 1) + 1)
        for k, steps in enumerate(part for part in parts if len(part) > 1):  # one state is no trajectory
            node = ET.Element("dynamicObstacle", id=str(next(spare) if k else int(ids[row])))
            kind, (length, width) = AgentType(segment.agent_type[row]), segment.size[row, :2]
            vehicle = "truck" if length >= TRUCK else "car"
            _add(node, "type", vehicle if kind == AgentType.VEHICLE else _TYPES.get(kind, "unknown"))
            shape = _add(_add(node, "shape"), "rectangle")
            _add(shape, "length", length)
            _add(shape, "width", width)
            _state(_add(node, "initialState"), world, row, steps[0], segment.origin)
            trajectory = _add(node, "trajectory")
            for step in steps[1:]:
                _state(_add(trajectory, "state"), world, row, step, segment.origin)
            found.append(node)
    return found


def _state(node: ET.Element, world: World, row: int, step: int, origin: Reals) -> None:
    _point(node, "position", world.position[row, step] + origin[:2])
    values = {"orientation": world.heading[row, step], "time": str(step), "velocity": world.speed[row, step]}
    for tag, value in values.items():
        _add(_add(node, tag), "exact", value)


class _Network:
    """Lanelets, speed limits, lights and the turns at intersections, with ids from ``first`` on."""

    def __init__(self, segment: RunSegment, within: slice, first: int) -> None:
        self.segment, self.road, self.within, self.number = segment, segment.road, within, count(first)
        self.lines = {}
        for k in range(len(self.road.lanes)):
            line = self.road.lanes[k][:, :2].astype(np.float64)
            line = line[np.concatenate([[True], (np.diff(line, axis=0) != 0).any(1)])]
            if len(line) > 1:
                self.lines[k] = line + segment.origin[:2]
        self.ids = {k: next(self.number) for k in self.lines}
        self.flow = self._pairs("successors")

    def _pairs(self, name: str) -> list[tuple[int, int]]:
        return [(a, b) for a, b in getattr(self.road, name).tolist() if a in self.lines and b in self.lines]

    def add(self, root: ET.Element) -> None:
        """Add all elements in the order that the format wants."""
        limits = {k: float(self.road.speed_limit[k]) for k in self.lines}
        signs = {limit: next(self.number) for limit in sorted({x for x in limits.values() if np.isfinite(x)})}
        # Id, row, lanes before it, where the format hangs lights, and the direction, which tells its turns apart.
        lights: list[tuple[int, int, list[int], str]] = []
        for light, lane in enumerate(self.segment.signal_lane.tolist()):
            if lane in self.lines:
                before = [a for a, b in self.flow if b == lane]
                turn = self._turn(lane) if before else "all"
                lights.append((next(self.number), light, before or [lane], turn))
        for k in self.lines:
            refs = [("trafficSignRef", signs[limits[k]])] if limits[k] in signs else []
            refs += [("trafficLightRef", number) for number, _, lanes, _ in lights if k in lanes]
            self._lanelet(root, k, refs)
        for limit, number in signs.items():
            element = _add(node := _add(root, "trafficSign", id=number), "trafficSignElement")
            _add(element, "trafficSignID", "274")
            _add(element, "additionalValue", limit)
            _point(node, "position", self.lines[next(k for k in self.lines if limits[k] == limit)][0])
            _add(node, "virtual", "true")
        for number, light, _, turn in lights:
            self._light(root, number, light, turn)
        # An intersection for each lane with lights, so that readers can tell which way each of its turns goes.
        for lane in sorted({lane for _, _, lanes, turn in lights for lane in lanes if turn != "all"}):
            node = _add(root, "intersection", id=next(self.number))
            incoming = _add(node, "incoming", id=next(self.number))
            _add(incoming, "incomingLanelet", ref=self.ids[lane])
            for turn in ("right", "straight", "left"):
                for other in sorted(b for a, b in self.flow if a == lane and self._turn(b) == turn):
                    _add(incoming, f"successors{turn.capitalize()}", ref=self.ids[other])

    def _lanelet(self, root: ET.Element, k: int, refs: list[tuple[str, int]]) -> None:
        node = _add(root, "lanelet", id=self.ids[k])
        kind, aside = LaneType(self.road.lane_type[k]), 0.5 * self.road.widths[k] * normals(self.lines[k])
        for tag, bound in (("leftBound", self.lines[k] + aside), ("rightBound", self.lines[k] - aside)):
            side = _add(node, tag)
            for place in bound:
                _point(side, "point", place)
        beside = [("predecessor", a) for a, b in self.flow if b == k]
        for tag, other in beside + [("successor", b) for a, b in self.flow if a == k]:
            _add(node, tag, ref=self.ids[other])
        for tag, name in (("adjacentLeft", "left_neighbors"), ("adjacentRight", "right_neighbors")):
            # The format knows one on either side.
            for other in [b for a, b in self._pairs(name) if a == k][:1]:
                _add(node, tag, ref=self.ids[other], drivingDir="same")
        _add(node, "laneletType", _LANES.get(kind, "unknown"))
        for tag, number in refs:
            _add(node, tag, ref=number)

    def _turn(self, lane: int) -> str:
        heading = np.unwrap(np.arctan2(*np.diff(self.lines[lane], axis=0).T[::-1]))
        turn = heading[-1] - heading[0]
        return "straight" if abs(turn) < STRAIGHT else "left" if turn > 0 else "right"

    def _light(self, root: ET.Element, number: int, light: int, turn: str) -> None:
        cycle = _add(node := _add(root, "trafficLight", id=number), "cycle")
        states = self.segment.signal_state[light, self.within].tolist()
        names = [SignalState(state).name.removeprefix("ARROW_") for state in states]
        for color, run in groupby(_COLORS.get(name, "inactive") for name in names):
            element = _add(cycle, "cycleElement")
            _add(element, "duration", str(len(list(run))))
            _add(element, "color", color)
        _point(node, "position", self.segment.signal_point[light, :2] + self.segment.origin[:2])
        _add(node, "direction", turn)
        _add(node, "active", "true")
