"""A small ScenarioNet scenario, as the converter of nuScenes leaves it."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np

FAR = np.array([1300.0, 1050.0])
"""Where the made city lies."""
STEPS = 25
AREAS = ((0, -2, 40), (0, 2, 40), (60, -2, 20))
"""Corner and length of the lanes' areas, which are 4 m wide."""


def line(*points: tuple[float, float]) -> list[tuple[float, ...]]:
    """A lane's line as nuScenes' lanes have it: a list of tuples."""
    return [tuple((FAR + point).tolist()) for point in points]


def ring(*points: tuple[float, float]) -> Any:
    return FAR + np.array(points, float)


def track(x: float, y: float, speed: float, kind="VEHICLE", first=0, size=(4.5, 2, 1.6)) -> dict[str, Any]:
    """Somebody at constant speed along +x, seen from a step on."""
    valid = np.arange(STEPS) >= first
    position = np.zeros((STEPS, 3))
    position[:, 0] = x + speed * 0.1 * np.arange(STEPS)
    position[:, 1], position[:, 2] = y, 0.9
    position[:, :2] += FAR
    state = {"heading": np.zeros(STEPS), "valid": valid.astype(float)}
    state["position"] = np.where(valid[:, None], position, 0.0)
    state["velocity"] = np.where(valid[:, None], (speed, 0.0), 0.0)
    for name, side in zip(("length", "width", "height"), size, strict=True):
        state[name] = np.where(valid, side, 0.0)[:, None]
    return {"type": kind, "state": state, "metadata": {"track_length": STEPS, "type": kind.lower()}}


def scenario() -> dict[str, Any]:
    """Two lanes of 40 m side by side, a connector of 20 m after one of them, and one after that. The recording
    vehicle drives in the right lane; a cone, a walker and a late car are there too.
    """
    lane, white = {"type": "LANE_SURFACE_STREET"}, {"type": "ROAD_LINE_SOLID_SINGLE_WHITE"}
    outline = (0, -2), (0, 6), (80, 6), (80, -2), (0, -2)
    island = (45, 3), (55, 3), (55, 5), (45, 5), (45, 3)
    areas = [line((x, y), (x + length, y), (x + length, y + 4), (x, y + 4)) for x, y, length in AREAS]
    drive = {"dataset": "nuscenes", "map": "boston-seaport", "date": "2018-08-01"}
    return {
        "id": "scene-0001",
        "length": STEPS,
        "metadata": {**drive, "ts": np.arange(STEPS) * 0.1, "sdc_id": "ego"},
        "tracks": {
            "8f3a": track(12, 4, 9, first=3),
            "ego": track(0, 0, 10),
            "c0": track(30, -3, 0, "TRAFFIC_CONE", size=(0.4, 0.5, 1.0)),
            "p1": track(20, -3, 1, "PEDESTRIAN", size=(0.7, 0.6, 1.8)),
            "never": track(0, 0, 0, first=STEPS),
        },
        "dynamic_map_states": {},
        "map_features": {
            "boundary_0": {**white, "polyline": ring(*outline)},
            "boundary_1": {**white, "polyline": ring(*island)},
            "right": {**lane, "polyline": line((0, 0), (20, 0), (40, 0)), "polygon": areas[0]},
            "left": {**lane, "polyline": line((0, 4), (40, 4)), "polygon": areas[1]},
            "on": {**lane, "polyline": np.array(line((40, 0), (60, 0))), "speed_limit_kmh": 100},
            "end": {**lane, "polyline": line((60, 0), (80, 0)), "polygon": areas[2]},
            "paint": {"type": "ROAD_LINE_BROKEN_SINGLE_WHITE", "polyline": line((0, 2), (40, 2))},
        },
    }


def write(folder: Path, tree: dict[str, Any] | None = None, protocol: int = 4) -> Path:
    path = folder / "sd_made.pkl"
    path.write_bytes(pickle.dumps(scenario() if tree is None else tree, protocol))
    return path
