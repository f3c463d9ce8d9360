"""Obstacles of CommonRoad files as tracks."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from symphony.data.bounds import check_counts
from symphony.data.segment import AgentType, Bools
from symphony.data.sources.commonroad_xml import (
    Doubles,
    center,
    integer,
    midpoint,
    number,
    point,
    points,
    rotate,
)
from symphony.errors import DataError

_TYPES = {
    **dict.fromkeys(
        ("car", "truck", "bus", "priorityVehicle", "parkedVehicle", "train", "motorcycle", "taxi"),
        AgentType.VEHICLE,
    ),
    "pedestrian": AgentType.PEDESTRIAN,
    "bicycle": AgentType.CYCLIST,
}
_SCENERY = frozenset({"roadBoundary", "building", "pillar", "median_strip"})


@dataclass(frozen=True)
class Tracks:
    """Obstacles over the steps any dynamic one is present at, in logged coordinates.

    Attributes:
        first_step: the format's time step of column 0.
        agent_id: [A] int64.
        agent_type: [A] uint8.
        size: [A, 3] length, width, 0.
        position: [A, T, 2] box centre, 0 where not valid; likewise heading [A, T] and velocity [A, T, 2].
        valid: [A, T].
        dynamic: [A] whether the obstacle is a dynamic one.
    """

    first_step: int
    agent_id: NDArray[np.int64]
    agent_type: NDArray[np.uint8]
    size: Doubles
    position: Doubles
    heading: Doubles
    velocity: Doubles
    valid: Bools
    dynamic: Bools


def read_tracks(root: ET.Element, dt: float) -> Tracks:
    """Read all dynamic and static obstacles of either version of the format.

    Raises:
        DataError: there is no dynamic obstacle, or one can't be read.
    """
    dynamic, static = _obstacles(root)
    if not dynamic:
        raise DataError("has no dynamic obstacles", field="dynamicObstacle")
    logs = [_states(node) for node in dynamic]
    first = min(int(log[:, 0].min()) for log in logs)
    steps = max(int(log[:, 0].max()) for log in logs) - first + 1
    nodes = dynamic + static
    agents = len(nodes)
    check_counts(agents, steps, "time")
    table = np.full((agents, steps, 6), np.nan)
    valid = np.zeros((agents, steps), np.bool_)
    size = np.zeros((agents, 3))
    for row, (node, log) in enumerate(zip(nodes, [*logs, *map(_rest, static)], strict=True)):
        where = log[:, 0].astype(np.int64) - first if row < len(dynamic) else np.arange(steps)
        table[row, where] = log
        valid[row, where] = True
        size[row, :2], offset, turn = _shape(node)
        table[row, :, 1:3] += rotate(np.broadcast_to(offset, (steps, 2)), table[row, :, 3])
        velocity = rotate(table[row, :, 4:6], table[row, :, 3])
        unknown = valid[row] & np.isnan(velocity[:, 0])
        velocity[unknown] = _differences(table[row, :, 1:3], valid[row], dt)[unknown]
        table[row, :, 4:6] = velocity
        table[row, :, 3] += turn
    table[~valid] = 0
    return Tracks(
        first_step=first,
        agent_id=np.array([integer(node.get("id"), "obstacle id") for node in nodes], np.int64),
        agent_type=np.array([_type(node) for node in nodes], np.uint8),
        size=size,
        position=table[..., 1:3],
        heading=table[..., 3],
        velocity=table[..., 4:6],
        valid=valid,
        dynamic=np.arange(agents) < len(dynamic),
    )


def _obstacles(root: ET.Element) -> tuple[list[ET.Element], list[ET.Element]]:
    dynamic, static = root.findall("dynamicObstacle"), root.findall("staticObstacle")
    for node in root.findall("obstacle"):
        role = (node.findtext("role") or "").strip()
        if role not in {"dynamic", "static"}:
            raise DataError(f"unknown role {role!r}", field=f"obstacle {node.get('id')}: role")
        (dynamic if role == "dynamic" else static).append(node)
    return dynamic, [node for node in static if (node.findtext("type") or "").strip() not in _SCENERY]


def _type(node: ET.Element) -> int:
    return _TYPES.get((node.findtext("type") or "").strip(), AgentType.OTHER)


def _states(node: ET.Element) -> Doubles:
    """[N, 6] time step, x, y, heading, forward and lateral speed (NaN where not given) of a dynamic obstacle."""
    name = f"obstacle {node.get('id')}"
    initial = node.find("initialState")
    if initial is None:
        raise DataError("missing", field=f"{name}: initialState")
    if node.find("occupancySet") is not None:
        raise DataError("predicted occupancies are no logged motion", field=f"{name}: occupancySet")
    states = [initial, *node.findall("trajectory/state")]
    log = np.array([_state(state, name) for state in states], np.float64)
    steps, counts = np.unique(log[:, 0], return_counts=True)
    if (counts > 1).any():
        raise DataError(f"two states at step {steps[counts > 1][0]:.0f}", field=f"{name}: time")
    return log


def _rest(node: ET.Element) -> Doubles:
    """[1, 6] the state of a static obstacle, at rest whatever its file says."""
    name = f"obstacle {node.get('id')}"
    initial = node.find("initialState")
    if initial is None:
        raise DataError("missing", field=f"{name}: initialState")
    return np.array([[0, *_state(initial, name, static=True)[1:4], 0, 0]], np.float64)


def _state(node: ET.Element, name: str, static: bool = False) -> tuple[float, ...]:
    found: dict[str, float] = {"time": 0.0, "orientation": 0.0} if static else {}
    position = None
    for child in node:
        tag = child.tag
        if tag == "position":
            position = center(child, f"{name}: position")
        elif tag in {"time", "orientation", "velocity", "velocityY"}:
            found[tag] = midpoint(child, f"{name}: {tag}")
    if position is None:
        raise DataError("missing", field=f"{name}: position")
    for tag in ("time", "orientation"):
        if tag not in found:
            raise DataError("missing", field=f"{name}: {tag}")
    forward = found.get("velocity", np.nan)
    return (
        np.floor(found["time"] + 0.5),
        *position,
        found["orientation"],
        forward,
        found.get("velocityY", 0.0),
    )


def _differences(position: Doubles, valid: Bools, dt: float) -> Doubles:
    """[T, 2] velocity from the positions at the neighbouring valid steps, 0 for a single one."""
    velocity = np.zeros_like(position)
    steps = np.flatnonzero(valid)
    if len(steps) > 1:
        velocity[steps] = np.gradient(position[steps], steps * dt, axis=0)
    return velocity


def _shape(node: ET.Element) -> tuple[tuple[float, float], Doubles, float]:
    """((length, width), box centre in the obstacle's frame [2], turn of the box) of the bounding box."""
    field = f"obstacle {node.get('id')}: shape"
    shape = node.find("shape")
    parts = (
        [] if shape is None else [part for part in shape if part.tag in {"rectangle", "circle", "polygon"}]
    )
    if not parts:
        raise DataError("no rectangle, circle or polygon", field=field)
    if len(parts) == 1 and parts[0].tag == "rectangle":
        size, middle, turn = _rectangle(parts[0], field)
        return size, middle, turn
    corners = np.concatenate([_corners(part, field) for part in parts])
    low, high = corners.min(axis=0), corners.max(axis=0)
    length, width = (high - low).tolist()
    return (length, width), (low + high) / 2, 0.0


def _rectangle(node: ET.Element, field: str) -> tuple[tuple[float, float], Doubles, float]:
    size = number(node.findtext("length"), field), number(node.findtext("width"), field)
    middle = node.find("center")
    turn = node.findtext("orientation")
    place = np.array((0.0, 0.0) if middle is None else point(middle, field))
    return size, place, 0.0 if turn is None else number(turn, field)


def _corners(node: ET.Element, field: str) -> Doubles:
    """[N, 2] points whose bounding box is the shape's."""
    if node.tag == "polygon":
        corners = points(node, field)
        if len(corners) < 3:
            raise DataError(f"a polygon of {len(corners)} points", field=field)
        return corners
    if node.tag == "circle":
        middle = node.find("center")
        radius = number(node.findtext("radius"), field)
        place = np.array((0.0, 0.0) if middle is None else point(middle, field))
        return place + np.array([[-radius, -radius], [radius, radius]])
    (length, width), place, turn = _rectangle(node, field)
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (length / 2, width / 2)
    return place + rotate(corners, turn)
