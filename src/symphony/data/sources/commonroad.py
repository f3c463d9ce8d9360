"""Reader of CommonRoad scenarios: XML files of version 2018b or 2020a.

An own reader, because every release of ``commonroad-io`` since 2023 pins protobuf 3.20, which nothing else here
can live with, and the last that installs (2022.1) brings scipy and does not refuse XML entities.

How the format maps onto :class:`~symphony.data.segment.RunSegment`:

- ``segment_id`` and ``group`` are the benchmark id. Steps run from the first to the last at which any dynamic
  obstacle exists.
- Coordinates are taken relative to the first position, rounded to metres, of the ego that ``egos="one"`` picks; z is
  0 throughout.
- A state variable given as an interval, or a position given as a region, becomes its middle. The velocity is the
  logged speed along the logged orientation, or a finite difference of positions where no speed is logged. A box
  bounds the obstacle's shape (the rectangle itself, usually). Static obstacles are at rest at every step.
- Types: bicycles are cyclists; cars, trucks, buses, taxis, trains and motorcycles are vehicles; whatever is
  neither that nor a pedestrian is OTHER; scenery (buildings, pillars, road boundaries, median strips) is left out.
- A lane is halfway between a lanelet's bounds; neighbours are adjacent lanelets of the same direction. The
  boundary encloses the union of the lanelets, and is open where the network is cut, at lanelets without successor or
  predecessor. Sidewalks are left out, crosswalks are marks.
- Nobody in these files is the ego, so the reader picks one (:class:`CommonRoadReader`).
- Obstacles, lanelets, signs and lights that can't be read are left out, and noted.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from symphony.data.bounds import check_counts
from symphony.data.segment import AgentType, Bools, RunSegment
from symphony.data.sources.base import Item, Reader, busiest_first, readable, to_float32
from symphony.data.sources.commonroad_map import read_map
from symphony.data.sources.xml_files import Doubles, integer, load_xml, number, point, points
from symphony.errors import ConfigError, DataError

VERSIONS = ("2018b", "2020a")
NO_OBSTACLE = "an obstacle left out that can't be read"

_TYPES = {
    **dict.fromkeys(
        ("car", "truck", "bus", "priorityVehicle", "parkedVehicle", "train", "motorcycle", "taxi"),
        AgentType.VEHICLE,
    ),
    "pedestrian": AgentType.PEDESTRIAN,
    "bicycle": AgentType.CYCLIST,
}
Box = tuple[tuple[float, float], Doubles, float]
"""(length, width) of the box around an obstacle's shape, its centre in the obstacle's frame [2], its turn."""
_SCENERY = frozenset({"roadBoundary", "building", "pillar", "median_strip"})


class CommonRoadReader(Reader):
    """Reads CommonRoad XML files.

    Args:
        egos: ``"one"`` picks, among the dynamic vehicles that move and are observed at every step, the one with
            the most moving neighbours (within 50 m, summed over the steps; the lowest id on ties). ``"all"``
            yields a segment for each of those vehicles, in order of id, with ``_ego<ID>`` added to its name; all
            in one frame, on one map.

    Raises:
        ConfigError: ``egos`` is neither.
    """

    name = "commonroad"
    patterns = ("*.xml",)

    def __init__(self, egos: Literal["one", "all"] = "one") -> None:
        if egos not in {"one", "all"}:
            raise ConfigError(f"egos must be 'one' or 'all', is {egos!r}")
        self.egos = egos

    def _read(self, path: Path) -> Iterator[Item]:
        root = load_xml(path, "CommonRoad")
        if root.tag != "commonRoad":
            raise DataError(f"not a CommonRoad file: its root is <{root.tag[:40]}>", field="commonRoad")
        version = root.get("commonRoadVersion")
        if version not in VERSIONS:
            message = f"version {version!r}, expected one of {', '.join(VERSIONS)}"
            raise DataError(message, field="commonRoadVersion")
        name = root.get("benchmarkID", "")
        if not name:
            raise DataError("missing", field="benchmarkID")
        try:
            yield from self._segments(root, name, path)
        except DataError as error:
            raise error.at(segment=name) from error

    def _segments(self, root: ET.Element, name: str, path: Path) -> Iterator[Item]:
        dt = number(root.get("timeStepSize"), "timeStepSize")
        if dt <= 0:
            raise DataError(f"must be positive, is {dt:g}", field="timeStepSize")
        odd: dict[str, str] = {}
        tracks, dynamic, first_step = _read_tracks(root, dt, odd)
        position, valid = tracks["position"], tracks["valid"]
        candidates = busiest_first(tracks["agent_id"], tracks["agent_type"], position, valid, dynamic)
        if not len(candidates):
            raise DataError("no moving vehicle is observed at every step", field="dynamicObstacle")
        ego = int(candidates[0])
        origin = np.round(position[ego, np.argmax(valid[ego])])
        position = np.where(valid[..., None], position - origin, 0.0)
        tracks["position"] = to_float32(np.pad(position, ((0, 0), (0, 0), (0, 1))))
        steps = first_step + np.arange(valid.shape[1])
        first = RunSegment(
            segment_id=name,
            source=self.name,
            dt=dt,
            ego=ego,
            **tracks,
            **read_map(root, steps, origin, odd),
            origin=np.array([*origin, 0.0]),
            file=path.name,
            group=name,
            odd=odd,
        )
        if self.egos == "one":
            yield first
            return
        # All in the frame of the first, so that a store keeps one map for them.
        for ego in sorted(candidates.tolist(), key=lambda row: int(first.agent_id[row])):
            yield first.replace(ego=ego, segment_id=f"{name}_ego{first.agent_id[ego]}")


def _read_tracks(root: ET.Element, dt: float, odd: dict[str, str]) -> tuple[dict[str, Any], Bools, int]:
    """All obstacles of either version of the format, over the steps any dynamic one is present at.

    Gives fields of a run segment in logged coordinates [A, T, ...] (positions are flat), which obstacles [A] are
    dynamic, and the format's first time step.
    """
    tags = ("dynamicObstacle", "staticObstacle")
    nodes = [(node, tag == tags[0]) for tag in tags for node in root.findall(tag)]
    nodes += [(node, _text(node, "role") == "dynamic") for node in root.findall("obstacle")]
    nodes = [(node, moves) for node, moves in nodes if moves or _text(node, "type") not in _SCENERY]
    nodes.sort(key=lambda entry: not entry[1])
    found = [
        (each, moves) for node, moves in nodes for each in readable(NO_OBSTACLE, odd, _obstacle, node, moves)
    ]
    logs = [log for (_, _, log, _), moves in found if moves]
    if not logs:
        raise DataError(odd.get(NO_OBSTACLE, "has no dynamic obstacles"), field="dynamicObstacle")
    first = min(int(log[:, 0].min()) for log in logs)
    steps = max(int(log[:, 0].max()) for log in logs) - first + 1
    agents = len(found)
    check_counts(agents, steps, "time")
    table = np.full((agents, steps, 6), np.nan)
    valid = np.zeros((agents, steps), np.bool_)
    size = np.zeros((agents, 3))
    for row, ((_, _, log, shape), moves) in enumerate(found):
        where = log[:, 0].astype(np.int64) - first if moves else np.arange(steps)
        table[row, where] = log
        valid[row, where] = True
        size[row, :2], offset, turn = shape
        table[row, :, 1:3] += _rotated(np.broadcast_to(offset, (steps, 2)), table[row, :, 3])
        velocity = _rotated(table[row, :, 4:6], table[row, :, 3])
        unknown = valid[row] & np.isnan(velocity[:, 0])
        velocity[unknown] = _differences(table[row, :, 1:3], valid[row], dt)[unknown]
        table[row, :, 4:6] = velocity
        table[row, :, 3] += turn
    table[~valid] = 0
    fields = {
        "agent_id": np.array([name for (name, *_), _ in found], np.int64),
        "agent_type": np.array([kind for (_, kind, *_), _ in found], np.uint8),
        "size": to_float32(size),
        "position": table[..., 1:3],
        "heading": to_float32(table[..., 3]),
        "velocity": to_float32(table[..., 4:6]),
        "valid": valid,
    }
    return fields, np.array([moves for _, moves in found], np.bool_), first


def _text(node: ET.Element, tag: str) -> str:
    return (node.findtext(tag) or "").strip()


def _obstacle(node: ET.Element, moves: bool) -> tuple[int, int, Doubles, Box]:
    """An obstacle: its id, type, states [N, 6] (see :func:`_state`) and box."""
    name = f"obstacle {node.get('id')}"
    if node.tag == "obstacle" and _text(node, "role") not in {"dynamic", "static"}:
        raise DataError(f"unknown role {_text(node, 'role')!r}", field=f"{name}: role")
    initial = node.find("initialState")
    if initial is None:
        raise DataError("missing", field=f"{name}: initialState")
    if moves:
        if node.find("occupancySet") is not None:
            raise DataError("predicted occupancies are no logged motion", field=f"{name}: occupancySet")
        states = [initial, *node.findall("trajectory/state")]
        log = np.array([_state(state, name) for state in states], np.float64)
        steps, counts = np.unique(log[:, 0], return_counts=True)
        if (counts > 1).any():
            raise DataError(f"two states at step {steps[counts > 1][0]:.0f}", field=f"{name}: time")
    else:  # at rest whatever its file says
        log = np.array([[0, *_state(initial, name, static=True)[1:4], 0, 0]], np.float64)
    kind = _TYPES.get(_text(node, "type"), AgentType.OTHER)
    return integer(node.get("id"), "obstacle id"), kind, log, _shape(node, f"{name}: shape")


def _state(node: ET.Element, name: str, static: bool = False) -> tuple[float, ...]:
    """Time step, x, y, heading, forward and lateral speed (NaN where not given)."""
    found: dict[str, float] = {"time": 0.0, "orientation": 0.0} if static else {}
    position = None
    for child in node:
        field = f"{name}: {child.tag}"
        if child.tag == "position":
            position = _center(child, field)
        elif child.tag in {"time", "orientation", "velocity", "velocityY"}:
            exact = child.find("exact")
            texts = [child.findtext("intervalStart"), child.findtext("intervalEnd")]
            numbers = [number(text, field) for text in (texts if exact is None else [exact.text] * 2)]
            found[child.tag] = (numbers[0] + numbers[1]) / 2
    if position is None:
        raise DataError("missing", field=f"{name}: position")
    for tag in ("time", "orientation"):
        if tag not in found:
            raise DataError("missing", field=f"{name}: {tag}")
    speeds = found.get("velocity", np.nan), found.get("velocityY", 0.0)
    return (np.floor(found["time"] + 0.5), *position, found["orientation"], *speeds)


def _center(node: ET.Element, field: str) -> tuple[float, float]:
    """A position: a point, or the centre of the region (rectangle, circle, polygon) it is known to lie in."""
    exact = node.find("point")
    if exact is not None:
        return point(exact, field)
    corners = points(node.find("polygon"), field)
    if len(corners):
        low, high = corners.min(axis=0), corners.max(axis=0)
        return float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2
    for shape in ("rectangle", "circle"):
        middle = node.find(f"{shape}/center")
        if middle is not None:
            return point(middle, field)
    raise DataError("neither a point nor a rectangle, circle or polygon with a centre", field=field)


def _differences(position: Doubles, valid: Bools, dt: float) -> Doubles:
    """[T, 2] velocity from the positions at the neighbouring valid steps, 0 for a single one."""
    velocity = np.zeros_like(position)
    steps = np.flatnonzero(valid)
    if len(steps) > 1:
        velocity[steps] = np.gradient(position[steps], steps * dt, axis=0)
    return velocity


def _rotated(vectors: Doubles, angle: Doubles | float) -> Doubles:
    """Vectors [..., 2] turned by angles [...] counter-clockwise."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _shape(node: ET.Element, field: str) -> Box:
    shape = node.find("shape")
    parts = [part for part in shape if part.tag in _CORNERS] if shape is not None else []
    if not parts:
        raise DataError("no rectangle, circle or polygon", field=field)
    if len(parts) == 1 and parts[0].tag == "rectangle":
        return _rectangle(parts[0], field)
    corners = np.concatenate([_CORNERS[part.tag](part, field) for part in parts])
    low, high = corners.min(axis=0), corners.max(axis=0)
    length, width = (high - low).tolist()
    return (length, width), (low + high) / 2, 0.0


def _rectangle(node: ET.Element, field: str) -> Box:
    size = number(node.findtext("length"), field), number(node.findtext("width"), field)
    turn = node.findtext("orientation")
    return size, _middle(node, field), 0.0 if turn is None else number(turn, field)


def _middle(node: ET.Element, field: str) -> Doubles:
    middle = node.find("center")
    return np.array((0.0, 0.0) if middle is None else point(middle, field))


def _rectangle_corners(node: ET.Element, field: str) -> Doubles:
    (length, width), place, turn = _rectangle(node, field)
    return place + _rotated(np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (length / 2, width / 2), turn)


def _circle_corners(node: ET.Element, field: str) -> Doubles:
    radius = number(node.findtext("radius"), field)
    return _middle(node, field) + np.array([[-radius, -radius], [radius, radius]])


def _polygon_corners(node: ET.Element, field: str) -> Doubles:
    corners = points(node, field)
    if len(corners) < 3:
        raise DataError(f"a polygon of {len(corners)} points", field=field)
    return corners


_CORNERS = {"rectangle": _rectangle_corners, "circle": _circle_corners, "polygon": _polygon_corners}
"""Shapes of an obstacle -> points [N, 2] whose bounding box is the shape's."""
