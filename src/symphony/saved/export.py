"""Single saved rollouts for other tools: CommonRoad scenarios (XML 2020a) and JSON.

Legend: A agents, U states, L lanes, Q lights. Coordinates are those of the source: the segment's, plus its origin.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
import zlib
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import AgentType, LaneType, Polylines, RunSegment, SignalState
from symphony.saved.rollouts import PLAYBACK, SavedRollouts
from symphony.saved.world import World, world_of

Reals = NDArray[np.float64]

WIDTHS = {LaneType.BIKE_LANE: 1.6}
NOMINAL_WIDTH = 3.6
"""Metres, of lanes whose width is not known."""
TRUCK = 7.0
"""Metres of length from which a vehicle is a truck."""
STRAIGHT = 0.5
"""Radians that a lane may turn and still lead straight on."""

_TYPES = {AgentType.PEDESTRIAN: "pedestrian", AgentType.CYCLIST: "bicycle"}
_LANES = {LaneType.FREEWAY: "highway", LaneType.SURFACE_STREET: "urban", LaneType.BIKE_LANE: "bicycleLane"}
_COLORS = {
    **dict.fromkeys((SignalState.STOP, SignalState.ARROW_STOP), "red"),
    **dict.fromkeys((SignalState.CAUTION, SignalState.ARROW_CAUTION), "yellow"),
    **dict.fromkeys((SignalState.GO, SignalState.ARROW_GO), "green"),
}


def commonroad(saved: SavedRollouts, rollout: int) -> str:
    """A rollout as a CommonRoad scenario.

    Every agent is a dynamic obstacle with the id it has in the source (all shifted alike if some are not positive);
    one that is lost for some steps becomes an obstacle more for each stretch. Lanelets lie half a lane's width to
    either side of the centre lines, nominal where the width is not known; lanes of a single point are left out.
    Lights that flash or are not known are inactive.

    Args:
        saved: the rollouts.
        rollout: which of them.
    """
    segment = saved.segment
    letters = "".join(word.capitalize() for word in re.findall("[A-Za-z]+", segment.segment_id)) or "Segment"
    # The format's names have room for letters and numbers only: this one tells segments apart.
    number = 1 + zlib.crc32(segment.segment_id.encode()) % 999_999
    root = ET.Element(
        "commonRoad",
        commonRoadVersion="2020a",
        benchmarkID=f"ZAM_{letters[:60]}-{number}_{rollout + 1}_T-1",
        timeStepSize=repr(float(segment.dt)),
        author="",
        affiliation="",
        source=f"symphony: segment {segment.segment_id}, rollout {rollout}",
        date="1970-01-01",
    )
    location = ET.SubElement(root, "location")
    for tag, value in (("geoNameId", "-999"), ("gpsLatitude", "999"), ("gpsLongitude", "999")):
        _text(location, tag, value)
    ET.SubElement(ET.SubElement(root, "scenarioTags"), "simulated")
    obstacles = _obstacles(saved, rollout)
    # Of a run that failed at once nobody may be left.
    taken = max((int(obstacle.get("id", 0)) for obstacle in obstacles), default=0)
    _Network(segment, slice(saved.start, saved.last + 1), 1 + taken).add(root)
    root.extend(obstacles)
    ET.indent(root)
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + ET.tostring(root, encoding="unicode") + "\n"


def _text(parent: ET.Element, tag: str, value: Any) -> ET.Element:
    node = ET.SubElement(parent, tag)
    node.text = value if isinstance(value, str) else f"{value:.6f}"
    return node


def _point(parent: ET.Element, place: Any) -> None:
    node = ET.SubElement(parent, "point")
    for tag, value in zip("xy", place, strict=True):
        _text(node, tag, float(value))


def _obstacles(saved: SavedRollouts, rollout: int) -> list[ET.Element]:
    segment, world = saved.segment, world_of(saved, rollout)
    ids = segment.agent_id + max(0, 1 - int(segment.agent_id.min()))
    spare = int(ids.max())
    found = []
    for row in np.flatnonzero(world.valid.any(1)).tolist():
        seen = np.flatnonzero(world.valid[row])
        for k, steps in enumerate(np.split(seen, np.flatnonzero(np.diff(seen) > 1) + 1)):
            spare += k > 0
            node = ET.Element("dynamicObstacle", id=str(spare if k else int(ids[row])))
            kind, length = AgentType(segment.agent_type[row]), segment.size[row, 0]
            vehicle = "truck" if length >= TRUCK else "car"
            _text(node, "type", vehicle if kind == AgentType.VEHICLE else _TYPES.get(kind, "unknown"))
            shape = ET.SubElement(ET.SubElement(node, "shape"), "rectangle")
            for tag, value in zip(("length", "width"), segment.size[row], strict=False):
                _text(shape, tag, float(value))
            _state(ET.SubElement(node, "initialState"), world, row, int(steps[0]), segment.origin)
            if len(steps) > 1:
                trajectory = ET.SubElement(node, "trajectory")
                for step in steps[1:].tolist():
                    _state(ET.SubElement(trajectory, "state"), world, row, step, segment.origin)
            found.append(node)
    return found


def _state(node: ET.Element, world: World, row: int, step: int, origin: Reals) -> None:
    _point(ET.SubElement(node, "position"), world.position[row, step] + origin[:2])
    _text(ET.SubElement(node, "orientation"), "exact", float(world.heading[row, step]))
    _text(ET.SubElement(node, "time"), "exact", str(step))
    _text(ET.SubElement(node, "velocity"), "exact", float(world.speed[row, step]))


class _Network:
    """Lanelets, speed limits, lights and the turns at intersections, with ids from ``first`` on."""

    def __init__(self, segment: RunSegment, within: slice, first: int) -> None:
        self.segment, self.road, self.within, self.next = segment, segment.road, within, first
        self.lines = {}
        for k in range(len(self.road.lanes)):
            line = self.road.lanes[k][:, :2].astype(np.float64)
            line = line[np.concatenate([[True], (np.diff(line, axis=0) != 0).any(1)])]
            if len(line) > 1:
                self.lines[k] = line + segment.origin[:2]
        self.ids = {k: self._number() for k in self.lines}
        self.flow = self._pairs("successors")

    def _number(self) -> int:
        self.next += 1
        return self.next - 1

    def _pairs(self, name: str) -> list[tuple[int, int]]:
        pairs = getattr(self.road, name).tolist()
        return [(a, b) for a, b in pairs if a in self.lines and b in self.lines]

    def add(self, root: ET.Element) -> None:
        """Add all elements in the order that the format wants."""
        limits = self.road.speed_limit
        known = limits[list(self.lines)]
        signs = {float(limit): self._number() for limit in np.unique(known[np.isfinite(known)])}
        # Id, row, lanes that lead to it, and the direction it is for: the format hangs a light on the lane before it
        # and tells turns apart by direction.
        lights: list[tuple[int, int, list[int], str]] = []
        for light, lane in enumerate(self.segment.signal_lane.tolist()):
            if lane in self.lines:
                before = [a for a, b in self.flow if b == lane]
                turn = self._turn(lane) if before else "all"
                lights.append((self._number(), light, before or [lane], turn))
        for k in self.lines:
            refs = [("trafficSignRef", signs[limit]) for limit in [float(limits[k])] if limit in signs]
            refs += [("trafficLightRef", number) for number, _, lanes, _ in lights if k in lanes]
            self._lanelet(root, k, refs)
        for limit, number in signs.items():
            node = ET.SubElement(root, "trafficSign", id=str(number))
            element = ET.SubElement(node, "trafficSignElement")
            _text(element, "trafficSignID", "274")
            _text(element, "additionalValue", limit)
            first = next(k for k in self.lines if float(limits[k]) == limit)
            _point(ET.SubElement(node, "position"), self.lines[first][0])
            _text(node, "virtual", "true")
        for number, light, _, turn in lights:
            self._light(root, number, light, turn)
        # An intersection for each lane with lights, so that readers can tell which way each of its turns goes.
        for lane in sorted({lane for _, _, lanes, turn in lights for lane in lanes if turn != "all"}):
            node = ET.SubElement(root, "intersection", id=str(self._number()))
            incoming = ET.SubElement(node, "incoming", id=str(self._number()))
            ET.SubElement(incoming, "incomingLanelet", ref=str(self.ids[lane]))
            after = sorted((self._turn(b), b) for a, b in self.flow if a == lane)
            for turn in ("right", "straight", "left"):
                for _, other in (pair for pair in after if pair[0] == turn):
                    ET.SubElement(incoming, f"successors{turn.capitalize()}", ref=str(self.ids[other]))

    def _lanelet(self, root: ET.Element, k: int, refs: list[tuple[str, int]]) -> None:
        node = ET.SubElement(root, "lanelet", id=str(self.ids[k]))
        width, kind = float(self.road.lane_width[k]), LaneType(self.road.lane_type[k])
        if not np.isfinite(width):
            width = WIDTHS.get(kind, NOMINAL_WIDTH)
        aside = 0.5 * width * _normals(self.lines[k])
        for tag, bound in (("leftBound", self.lines[k] + aside), ("rightBound", self.lines[k] - aside)):
            side = ET.SubElement(node, tag)
            for place in bound:
                _point(side, place)
        links = [("predecessor", a) for a, b in self.flow if b == k]
        links += [("successor", b) for a, b in self.flow if a == k]
        for tag, other in links:
            ET.SubElement(node, tag, ref=str(self.ids[other]))
        for tag, name in (("adjacentLeft", "left_neighbors"), ("adjacentRight", "right_neighbors")):
            beside = [b for a, b in self._pairs(name) if a == k]
            if beside:  # the format knows one on either side
                ET.SubElement(node, tag, ref=str(self.ids[beside[0]]), drivingDir="same")
        _text(node, "laneletType", _LANES.get(kind, "unknown"))
        for tag, number in refs:
            ET.SubElement(node, tag, ref=str(number))

    def _turn(self, lane: int) -> str:
        heading = np.unwrap(np.arctan2(*np.diff(self.lines[lane], axis=0).T[::-1]))
        turn = heading[-1] - heading[0]
        return "straight" if abs(turn) < STRAIGHT else "left" if turn > 0 else "right"

    def _light(self, root: ET.Element, number: int, light: int, turn: str) -> None:
        node = ET.SubElement(root, "trafficLight", id=str(number))
        cycle = ET.SubElement(node, "cycle")
        states = self.segment.signal_state[light, self.within].tolist()
        for color, run in groupby(_COLORS.get(SignalState(state), "inactive") for state in states):
            element = ET.SubElement(cycle, "cycleElement")
            _text(element, "duration", str(len(list(run))))
            _text(element, "color", color)
        _text(cycle, "timeOffset", "0")
        place = self.segment.signal_point[light, :2] + self.segment.origin[:2]
        _point(ET.SubElement(node, "position"), place)
        _text(node, "direction", turn)
        _text(node, "active", "true")


def _normals(line: Reals) -> Reals:
    """[P, 2] to the left at each point, as long as keeps the bounds at their distance at corners (at most 1.5)."""
    along = np.diff(line, axis=0)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    left = np.stack([-along[:, 1], along[:, 0]], -1)
    before, after = np.concatenate([left[:1], left]), np.concatenate([left, left[-1:]])
    middle = before + after
    length = np.linalg.norm(middle, axis=-1, keepdims=True)
    middle = np.where(length > 1e-6, middle / np.maximum(length, 1e-6), before)
    return middle * np.minimum(2 / np.maximum(length, 1e-6), 1.5)


def to_dict(saved: SavedRollouts, rollout: int) -> dict[str, Any]:
    """A rollout as JSON can hold it: agents with their states by step, lights, map, routes, events.

    States are lists of step, x, y (m), heading (rad), speed (m/s).
    """
    segment, world = saved.segment, world_of(saved, rollout)
    drivers = dict(zip(saved.agents.tolist(), saved.drivers, strict=True))
    rank = {row: n for n, row in enumerate(saved.agents.tolist())}
    place = world.position + segment.origin[:2]

    def agent(row: int) -> dict[str, Any]:
        steps = np.flatnonzero(world.valid[row]).tolist()
        values = np.column_stack([place[row], world.heading[row], world.speed[row]])
        found = {
            "id": int(segment.agent_id[row]),
            "type": AgentType(segment.agent_type[row]).name.lower(),
            "length": float(segment.size[row, 0]),
            "width": float(segment.size[row, 1]),
            "ego": row == segment.ego,
            "driver": drivers.get(row, PLAYBACK),
            "states": [[step, *(round(value, 6) for value in values[step].tolist())] for step in steps],
        }
        if row in rank:
            n = rank[row]
            route = saved.route(rollout, n)
            found["route"] = None if route is None else (route + segment.origin[:2]).tolist()
            for name in ("collision", "offroad"):
                flags = getattr(saved, name)[rollout, :, n] & saved.counted[rollout, :, n]
                found[name] = (1 + np.flatnonzero(flags)).tolist()
        return found

    def lines(found: Polylines) -> list[Any]:
        return [(found[k][:, :2] + segment.origin[:2]).tolist() for k in range(len(found))]

    within = slice(saved.start, saved.last + 1)
    lights = zip(
        segment.signal_lane.tolist(), segment.signal_point, segment.signal_state[:, within], strict=True
    )
    return {
        "segment": segment.segment_id,
        "rollout": rollout,
        "dt": float(segment.dt),
        "steps": saved.steps,
        "failed": saved.failed.get(rollout),
        "agents": [agent(row) for row in np.flatnonzero(world.valid.any(1)).tolist()],
        "lights": [
            {
                "lane": lane,
                "stop": (point[:2] + segment.origin[:2]).tolist(),
                "states": [SignalState(state).name.lower() for state in states],
            }
            for lane, point, states in lights
        ],
        "map": {name: lines(getattr(segment.road, name)) for name in ("lanes", "boundary", "marks")},
    }
