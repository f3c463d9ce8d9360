"""Small Argoverse 2 scenarios, written by the tests themselves."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

FAR = np.array([5010.0, -3003.3])
"""Where the made scenarios lie: x at the edge of a map tile, far enough for float32 to lose half a millimetre."""

NAME = "0a1b2c3d-0000-1111-2222-333344445555"
CARS = {"AV": (15.0, 0.0, 10.0), "101": (20.0, 3.6, 8.0), "102": (60.0, 7.2, -9.0)}
"""Track -> start x, y and speed along x of the vehicles."""

MISSING = "pyarrow is not installed (pip install 'symphony-traffic[argoverse2]')"
needs_pyarrow = pytest.importorskip("pyarrow", reason=MISSING)

Columns = dict[str, list[Any]]


def points(line: Iterable[tuple[float, float]]) -> list[dict[str, float]]:
    return [{"x": float(FAR[0] + x), "y": float(FAR[1] + y), "z": 21.5} for x, y in line]


def track(columns: Any, name: str, kind: str, steps: range, start: Any, speed: float, category=1) -> None:
    """Add a track at constant speed along +x (or -x)."""
    for step in steps:
        who = {"track_id": name, "object_type": kind, "object_category": category, "timestep": step}
        place = {"position_x": FAR[0] + start[0] + speed * 0.1 * step, "position_y": FAR[1] + start[1]}
        motion = {"heading": 0.0 if speed >= 0 else np.pi, "velocity_x": speed, "velocity_y": 0.0}
        for key, value in {**who, "observed": step < 8, **place, **motion}.items():
            columns.setdefault(key, []).append(value)


def scenario(steps: int = 20) -> Columns:
    """Three cars, one against the others, and one each of what else there is; 8 steps of history."""
    columns: Columns = {}
    track(columns, "102", "vehicle", range(steps), CARS["102"], CARS["102"][2], category=3)
    track(columns, "101", "vehicle", range(steps), CARS["101"], CARS["101"][2], category=2)
    track(columns, "7", "pedestrian", range(2, steps - 2), (50, -6), 1.0)
    track(columns, "8", "cyclist", range(steps), (30, -3), 4.0)
    track(columns, "9", "static", range(3, 5), (40, 11), 0.0, category=0)
    track(columns, "AV", "vehicle", range(steps), CARS["AV"], CARS["AV"][2])
    begin = 3.15986559459579e17
    same = {"scenario_id": NAME, "focal_track_id": "102", "num_timestamps": steps, "city": "austin"}
    same |= {"start_timestamp": begin, "end_timestamp": begin + 1e8 * (steps - 1), "map_id": 74806}
    return columns | {name: [value] * len(columns["timestep"]) for name, value in same.items()}


def lane(lane_id: int, y: float, begin: float, end: float, width: float = 3.6, **more: Any) -> dict[str, Any]:
    """A straight lane from ``begin`` to ``end`` (towards -x where that is less)."""
    side = np.sign(end - begin) * width / 2
    middle = (begin + end) / 2
    lines = {
        "centerline": points([(begin, y), (middle, y), (end, y)]),
        "left_lane_boundary": points([(begin, y + side), (end, y + side)]),
        "right_lane_boundary": points([(begin, y - side), (middle, y - side), (end, y - side)]),
    }
    paint = dict.fromkeys(("left_lane_mark_type", "right_lane_mark_type"), "NONE")
    links = {"successors": [], "predecessors": [], "left_neighbor_id": None, "right_neighbor_id": None}
    return {"id": lane_id, "lane_type": "VEHICLE", **lines, **paint, **links, **more}


def city() -> dict[str, Any]:
    """Lanes 10 → 11 at y = 0 and 20 → 21 at y = 3.6 along +x, 30 at y = 7.2 along -x, bike lane 40 at y = -3. The map
    ends at x = 0 and x = 120, both edges of tiles; lane 11 goes on into lane 12, which is not there.
    """
    dashed = {"left_lane_mark_type": "DASHED_WHITE"}
    lanes = [
        lane(10, 0, 0, 60, successors=[11], left_neighbor_id=20, **dashed),
        lane(11, 0, 60, 120, successors=[12], left_neighbor_id=21),
        lane(20, 3.6, 0, 60, left_neighbor_id=30, right_neighbor_id=10, right_lane_mark_type="DASHED_WHITE"),
        lane(21, 3.6, 60, 120, predecessors=[20], right_neighbor_id=11),
        lane(30, 7.2, 120, 0, left_neighbor_id=20, left_lane_mark_type="DOUBLE_SOLID_YELLOW"),
        lane(40, -3, 0, 120, 1.5, lane_type="BIKE", right_neighbor_id=99),
    ]
    areas = [[(0, -4), (60, -4), (60, 9.5), (0, 9.5)], [(120, 9.5), (60, 9.5), (60, -4), (120, -4)]]
    return {
        "lane_segments": {str(node["id"]): node for node in lanes},
        "drivable_areas": {str(k): {"id": k, "area_boundary": points(area)} for k, area in enumerate(areas)},
        "pedestrian_crossings": {
            "5": {"id": 5, "edge1": points([(58, -4), (58, 9.5)]), "edge2": points([(62, 9.5), (62, -4)])}
        },
    }


def write(folder: Path, columns: Any = None, map_: Any = None, name: str = NAME, types: Any = None) -> Path:
    """Write a scenario (the made one by default) and its map; columns get the type of their values or ``types``."""
    import pyarrow as pa
    from pyarrow import parquet

    columns = scenario() if columns is None else columns
    arrays = {key: pa.array(values, (types or {}).get(key)) for key, values in columns.items()}
    path = folder / f"scenario_{name}.parquet"
    parquet.write_table(pa.table(arrays), path)
    (folder / f"log_map_archive_{name}.json").write_text(json.dumps(city() if map_ is None else map_))
    return path
