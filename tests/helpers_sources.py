"""Small files in the formats the readers know, written by the tests themselves."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import HealthCheck, settings
from numpy.typing import NDArray

from symphony.data.segment import RoadMap, RunSegment
from symphony.data.sources import get_reader, womd
from symphony.data.sources import womd_pb2 as pb
from symphony.errors import DataError
from symphony.geometry import segments_of, signed_distance

IN_FOLDER = settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
"""Of laws whose examples are written into one folder."""
FAR = np.array([-7792.0, 81234.0, -184.0])
"""Where the made WOMD scenarios lie: far enough that float32 would lose millimetres."""


@contextmanager
def little_memory(most: float) -> Iterator[None]:
    """Check that what is allocated inside stays below a number of bytes."""
    tracemalloc.start()
    try:
        yield
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < most


def read_one(name: str, path: Path, **options: object) -> RunSegment:
    """The only record of a file, which must be good."""
    (item,) = get_reader(name, **options).read(path)
    assert isinstance(item, RunSegment), item
    return item


def read_error(name: str, path: Path, **options: object) -> DataError:
    """The only record of a file, which must be bad."""
    (item,) = get_reader(name, **options).read(path)
    assert isinstance(item, DataError), item
    return item


def womd_points(target: Iterable[object], line: Iterable[tuple[float, float]]) -> None:
    for x, y in line:
        target.add(x=FAR[0] + x, y=FAR[1] + y, z=FAR[2])  # type: ignore[attr-defined]


def womd_scenario(name: str = "0123456789abcdef", tracks: int = 3, steps: int = 5) -> pb.Scenario:
    """Cars on two lanes side by side, each with a successor; one light, one of everything else. Lane 10 runs along y
    = 0 into 11; lane 20 along y = 4 into 21. Track k has id 100 + k, lane k modulo 2, speed 10 + k and starts at x =
    5 k; the last track is the recording vehicle.
    """
    scenario = pb.Scenario(scenario_id=name, current_time_index=1, sdc_track_index=tracks - 1)
    scenario.timestamps_seconds.extend(0.1 * k + 1e-5 * (k % 3) for k in range(steps))
    for k in range(tracks):
        track = scenario.tracks.add(id=100 + k, object_type=1)
        for step in range(steps):
            x, y, z = FAR + np.array([5 * k + (10 + k) * 0.1 * step, 4 * (k % 2), 0])
            box = {"length": 4.5 + k, "width": 2.0, "height": 1.5, "heading": 0.01 * k}
            motion = {"velocity_x": 10 + k, "velocity_y": 0.5}
            track.states.add(center_x=x, center_y=y, center_z=z, **box, **motion, valid=True)
    for y, first in ((0.0, 10), (4.0, 20)):
        for part, start in enumerate((0.0, 50.0)):
            feature = scenario.map_features.add(id=first + part)
            feature.lane.type = 2
            feature.lane.speed_limit_mph = 25
            womd_points(feature.lane.polyline, [(start + x, y) for x in (0, 25, 50)])
            (feature.lane.entry_lanes if part else feature.lane.exit_lanes).append(first + 1 - part)
            near = feature.lane.left_neighbors if first == 10 else feature.lane.right_neighbors
            near.add(feature_id=30 - first + part)
    edge, line, crosswalk, sign = (scenario.map_features.add(id=k) for k in (30, 40, 50, 60))
    womd_points(edge.road_edge.polyline, [(0, -2), (100, -2)])
    womd_points(line.road_line.polyline, [(0, 2), (50, 2), (100, 2)])
    womd_points(crosswalk.crosswalk.polygon, [(48, -2), (50, -2), (50, 6), (48, 6)])
    sign.stop_sign.lane.append(20)
    sign.stop_sign.position.CopyFrom(pb.MapPoint(x=FAR[0] + 48, y=FAR[1] + 7, z=FAR[2]))
    for step in range(steps):
        light = scenario.dynamic_map_states.add().lane_states.add(lane=11, state=4 if step < 3 else 6)
        light.stop_point.CopyFrom(pb.MapPoint(x=FAR[0] + 49, y=FAR[1], z=FAR[2]))
    scenario.tracks_to_predict.add(track_index=0, difficulty=1)
    scenario.objects_of_interest.extend([100, 101])
    return scenario


def bound(side: str, points: Iterable[tuple[float, float]], marking: str = "") -> str:
    inner = "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in points)
    return f"<{side}Bound>{inner}{f'<lineMarking>{marking}</lineMarking>' if marking else ''}</{side}Bound>"


def lanelet(lanelet_id: int, left: Any, right: Any, inner: str = "") -> str:
    """A lanelet; ``inner`` is what follows its bounds."""
    return f'<lanelet id="{lanelet_id}">{bound("left", left)}{bound("right", right)}{inner}</lanelet>'


def exact(tag: str, value: object) -> str:
    return f"<{tag}><exact>{value}</exact></{tag}>"


def state(step: int, x: float, y: float, heading: float = 0.0, speed: float | None = 10.0, tag="state") -> str:
    inner = f"<position><point><x>{x}</x><y>{y}</y></point></position>"
    inner += exact("orientation", heading) + exact("time", step)
    return f"<{tag}>{inner}{exact('velocity', speed) if speed is not None else ''}</{tag}>"


RECTANGLE = "<rectangle><length>4.5</length><width>2.0</width></rectangle>"


def obstacle(
    obstacle_id: int, states: list[str], version="2020a", kind="car", shape=RECTANGLE, role="dynamic"
) -> str:
    """An obstacle in either version's way of writing it; the first of ``states`` is the initial one."""
    first = states[0].replace("<state>", "<initialState>").replace("</state>", "</initialState>")
    path = f"<trajectory>{''.join(states[1:])}</trajectory>" if states[1:] else ""
    inner = f"<type>{kind}</type><shape>{shape}</shape>{first}{path}"
    if version == "2018b":
        return f'<obstacle id="{obstacle_id}"><role>{role}</role>{inner}</obstacle>'
    return f'<{role}Obstacle id="{obstacle_id}">{inner}</{role}Obstacle>'


def driver(obstacle_id: int, version="2020a", x=0.0, y=0.0, speed=10.0, steps=range(5)) -> str:
    """A car at constant speed along +x, at x at step 0."""
    return obstacle(obstacle_id, [state(k, x + speed * 0.1 * k, y, 0.0, speed) for k in steps], version)


ROAD = lanelet(10, [(0, 2), (25, 2), (50, 2)], [(0, -2), (25, -2), (50, -2)], '<successor ref="11"/>') + lanelet(
    11, [(50, 2), (100, 2)], [(50, -2), (100, -2)], '<predecessor ref="10"/>'
)
"""Two lanelets in a row, 4 m wide, along y = 0."""


def commonroad(*parts: str, version: str = "2020a", name: str = "ZAM_Made-1_1_T-1", tags: str = "") -> str:
    """A whole file."""
    head = f'commonRoadVersion="{version}" benchmarkID="{name}" timeStepSize="0.1" tags="{tags}"'
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<commonRoad {head}>{"".join(parts)}</commonRoad>\n'


def signed_area(ring: NDArray[Any]) -> float:
    """Return the signed area of a closed ring; positive counter-clockwise."""
    x, y = ring[:-1, 0], ring[:-1, 1]
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


def convert_xml(path: Path, *parts: str, **options: str) -> RunSegment:
    """Write a CommonRoad file of these parts and read it."""
    path.write_text(commonroad(*parts, **options), encoding="utf-8")
    return read_one("commonroad", path)


def off_road(road: RoadMap, spots: NDArray[Any]) -> NDArray[np.float32]:
    """[M] metres to the right of the nearest boundary, negative on its left, of points [M, 2]."""
    cut = segments_of(road.boundary.points, road.boundary.offsets)
    start, end, before, after = (torch.as_tensor(part)[None] for part in cut)
    where = torch.as_tensor(np.ascontiguousarray(spots), dtype=torch.float32)[None]
    known = torch.ones(start.shape[:2], dtype=torch.bool)
    return signed_distance(where, start, end, known, before, after)[0].numpy()


def write_records(path: Path, payloads: Iterable[bytes]) -> None:
    """A TFRecord file."""
    with path.open("wb") as file:
        for payload in payloads:
            length = struct.pack("<Q", len(payload))
            for part in (length, payload):
                file.write(part + struct.pack("<I", womd.masked_crc32c(part)))
