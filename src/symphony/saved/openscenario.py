"""Single saved rollouts as OpenSCENARIO XML 1.2, in the coordinates of the source."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from copy import deepcopy
from typing import Any

import numpy as np

from symphony.data.resample import MIRRORED
from symphony.data.segment import AgentType
from symphony.saved.export import TRUCK
from symphony.saved.rollouts import SavedRollouts, world_of

AXLES = 0.28  # of a vehicle's length from its middle to either axle; poses are those of the rear one
HEIGHT = 1.6  # metres, of those whose height is not known


def openscenario(saved: SavedRollouts, rollout: int) -> str:
    """Return a rollout as an OpenSCENARIO scenario, whose agents follow trajectories of timed poses.

    An agent has an event for each stretch of steps at which it is present, and is invisible otherwise. Entities are
    named by their ids in the source, the ego is ``Ego``. The road network is the OpenDRIVE file that the source was
    made of, by its name, or none. Its lights run their own programs: no log knows the ids of its signals.
    """
    segment, world, dt = saved.segment, world_of(saved, rollout), float(saved.segment.dt)
    mapped = segment.file.endswith(".xodr") and not segment.segment_id.endswith(MIRRORED)
    about = f"symphony: segment {segment.segment_id}, rollout {rollout}"
    about += "" if mapped else "; its source has no OpenDRIVE map"
    entities, init, groups = _node("Entities"), _node("Actions"), []
    for row in np.flatnonzero(world.valid.any(1)).tolist():
        name = "Ego" if row == segment.ego else str(segment.agent_id[row])
        kind, size = AgentType(segment.agent_type[row]), segment.size[row].tolist()
        back = 0.0 if kind in (AgentType.PEDESTRIAN, AgentType.OTHER) else AXLES * size[0]
        along = np.stack([np.cos(world.heading[row]), np.sin(world.heading[row])], -1)
        place = world.position[row] + segment.origin[:2] - back * along
        poses = [
            _node("Position", _node("WorldPosition", x=x, y=y, h=h))
            for x, y, h in np.column_stack([place, world.heading[row]]).tolist()
        ]
        entities.append(_node("ScenarioObject", _body(kind, size, back), name=name))
        seen, events = np.flatnonzero(world.valid[row]), []
        for steps in np.split(seen, np.flatnonzero(np.diff(seen) > 1) + 1):
            first, last = int(steps[0]), int(steps[-1])
            vertices = [_node("Vertex", poses[step], time=step * dt) for step in steps]
            move = _teleport(poses[first]) if len(steps) == 1 else _follow(vertices)
            events += [_event("drive", first * dt, [_visible(True), move])]
            events += [_event("leave", (last + 1) * dt, [_visible(False)])] if last < saved.steps else []
        start = [_teleport(poses[seen[0]]), _visible(seen[0] == 0)]
        init.append(_node("Private", *start, entityRef=name))
        actors = _node("Actors", _node("EntityRef", entityRef=name), selectTriggeringEntities="false")
        maneuver = _node("Maneuver", *events, name="rollout")
        groups.append(_node("ManeuverGroup", actors, maneuver, maximumExecutionCount=1, name=name))
    acts = [_node("Act", *groups, _trigger(0.0), name="rollout")] if groups else []
    root = _node(
        "OpenSCENARIO",
        _node("FileHeader", revMajor=1, revMinor=2, date="1970-01-01T00:00:00", description=about, author=""),
        _node("CatalogLocations"),
        _node("RoadNetwork", *[_node("LogicFile", filepath=segment.file)][:mapped]),
        entities,
        _node(
            "Storyboard",
            _node("Init", init),
            *[_node("Story", act, name="rollout") for act in acts],
            _trigger(saved.steps * dt, "StopTrigger"),
        ),
    )
    ET.indent(root)
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + ET.tostring(root, encoding="unicode") + "\n"


def _node(tag: str, *children: ET.Element, **attributes: Any) -> ET.Element:
    shown = {k: f"{v:.6f}" if isinstance(v, float) else str(v) for k, v in attributes.items()}
    node = ET.Element(tag, shown)
    node.extend(children)
    return node


def _body(kind: AgentType, size: list[float], back: float) -> ET.Element:
    length, width, height = size[0], size[1], size[2] or HEIGHT
    parts = [
        _node(
            "BoundingBox",
            _node("Center", x=back, y=0.0, z=height / 2),
            _node("Dimensions", length=length, width=width, height=height),
        ),
        _node("Properties"),
    ]
    if kind == AgentType.PEDESTRIAN:
        return _node("Pedestrian", *parts, mass=80, name="pedestrian", pedestrianCategory="pedestrian")
    if kind == AgentType.OTHER:
        return _node("MiscObject", *parts, mass=100, name="other", miscObjectCategory="obstacle")
    name = "bicycle" if kind == AgentType.CYCLIST else "truck" if length >= TRUCK else "car"
    wheel = {"positionZ": 0.3, "trackWidth": 0.9 * width, "wheelDiameter": 0.6}
    front = _node("FrontAxle", maxSteering=0.6, positionX=2 * back, **wheel)
    parts.append(_node("Axles", front, _node("RearAxle", maxSteering=0.0, positionX=0.0, **wheel)))
    parts.append(_node("Performance", maxSpeed=80.0, maxAcceleration=10.0, maxDeceleration=10.0))
    return _node("Vehicle", *parts, name=name, vehicleCategory=name)


def _teleport(pose: ET.Element) -> ET.Element:
    return _node("PrivateAction", _node("TeleportAction", deepcopy(pose)))


def _visible(shown: bool) -> ET.Element:
    flags = dict.fromkeys(("graphics", "sensors", "traffic"), str(shown).lower())
    return _node("PrivateAction", _node("VisibilityAction", **flags))


def _follow(vertices: list[ET.Element]) -> ET.Element:
    line = _node("Trajectory", _node("Shape", _node("Polyline", *vertices)), closed="false", name="rollout")
    timing = _node("Timing", domainAbsoluteRelative="absolute", offset=0.0, scale=1.0)
    parts = [_node("TrajectoryRef", line), _node("TimeReference", timing)]
    parts.append(_node("TrajectoryFollowingMode", followingMode="position"))
    return _node("PrivateAction", _node("RoutingAction", _node("FollowTrajectoryAction", *parts)))


def _event(name: str, time: float, actions: list[ET.Element]) -> ET.Element:
    acts = [_node("Action", action, name=f"{name}{k}") for k, action in enumerate(actions)]
    return _node("Event", *acts, _trigger(time), name=f"{name} {time:.2f}", priority="parallel")


def _trigger(time: float, tag: str = "StartTrigger") -> ET.Element:
    at = _node("ByValueCondition", _node("SimulationTimeCondition", rule="greaterOrEqual", value=time))
    condition = _node("Condition", at, conditionEdge="none", delay=0.0, name=f"at {time:.2f} s")
    return _node(tag, _node("ConditionGroup", condition))
