"""Freeways with ramps. All networks are for driving on the right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from symphony.data.sources.sumo.plain import PlainNetwork, Point

RAMP_RADIUS = 190.0
"""Radius in metres of the largest map that fits between the ends of a freeway and of its ramps."""


def ramp(rng: np.random.Generator, folder: Path, longer: float = 0.0) -> Path:
    """Two carriageways, each with an on-ramp and an off-ramp: apart or joined by a weaving lane.

    All ends, those of the ramps too, are ``longer`` metres farther out than :data:`RAMP_RADIUS` asks for.
    """
    net = PlainNetwork()
    width = rng.uniform(3.5, 3.75)
    speed = float(rng.choice([24.6, 26.8, 29.1]))
    direction = rng.uniform(0, 2 * np.pi)
    # A longer road turns as much, not more.
    curvature = rng.uniform(-1, 1) / 1500 * (600 / (600 + longer))
    for side in range(2):
        lanes = int(rng.integers(2, 4))
        _carriageway(
            net,
            rng,
            side,
            (lanes, speed, width),
            direction + side * np.pi,
            curvature * (1 - 2 * side),
            longer,
        )
    return net.compile(folder, ["--default.junctions.radius", "4", "--junctions.scurve-stretch", "1.5"])


def _carriageway(
    net: PlainNetwork,
    rng: np.random.Generator,
    side: int,
    road: tuple[int, float, float],
    direction: float,
    curvature: float,
    longer: float,
) -> None:
    """One direction of a freeway: base, stretch beside the on-ramp, gap, stretch beside the off-ramp, end."""
    lanes, speed, width = road
    weaving = rng.random() < 0.4
    stations = np.cumsum([0, 300 + longer, rng.uniform(180, 260), 0 if weaving else rng.uniform(120, 200)])
    stations = np.append(stations, [stations[-1] + (0 if weaving else rng.uniform(130, 180))])
    stations = np.append(stations, stations[-1] + 300 + longer)
    shift = stations[-1] / 2
    median = 5.0

    def along(s: NDArray[np.float64], right: float | NDArray[np.float64]) -> Point:
        """Points at stations s, so far to the right of the edge of the median."""
        u = s - shift
        x, y = u, curvature * u**2 / 2
        normal = np.stack([curvature * u, -np.ones_like(u)], -1)
        out = np.stack([x, y], -1) + normal * (median + np.asarray(right))[..., None]
        spin = np.array([[np.cos(direction), -np.sin(direction)], [np.sin(direction), np.cos(direction)]])
        return out @ spin.T

    def stretch(a: float, b: float, right: float = 0.0) -> Point:
        return along(np.linspace(a, b, 12), right)

    marks = [
        stations[0],
        stations[1],
        stations[2],
        *([] if weaving else [stations[3], stations[4]]),
        stations[5],
    ]
    extra = [0, 1, 0] if weaving else [0, 1, 0, 1, 0]
    names = [f"c{side}m{k}" for k in range(len(marks))]
    for name, mark in zip(names, marks, strict=True):
        net.node(name, along(np.array([mark]), 0.0)[0], "priority")
    ids = []
    for k, more in enumerate(extra):
        total = lanes + more
        # The line given to SUMO is the left edge of the carriageway (spread to the right).
        ids.append(
            net.edge(
                names[k],
                names[k + 1],
                lanes=total,
                speed=speed,
                width=width,
                priority=9,
                shape=stretch(marks[k], marks[k + 1]),
            )
        )
    for k in range(len(extra) - 1):
        pairs = [(i + extra[k], i + extra[k + 1]) for i in range(lanes)]
        net.connect(ids[k], ids[k + 1], pairs)

    ramp_speed, edge = rng.uniform(15.5, 20), lanes * width
    on, off = 1, len(extra) - 1
    # Ramps are longer than a crop's radius, so that their ends are never on a map.
    reach = np.linspace(1.7, 0, 20)
    far = 150 + longer
    gap = (3 * reach + 30 * reach**2) * (far / 150)
    start = along(marks[on] - far * reach, edge + gap)
    end = along(marks[off] + far * reach[::-1], edge + gap[::-1])
    net.node(f"c{side}on", start[0], "priority")
    net.node(f"c{side}off", end[-1], "priority")
    options = {"lanes": 1, "width": width, "priority": 4}
    first = net.edge(f"c{side}on", names[on], speed=ramp_speed, shape=start, **options)  # type: ignore[arg-type]
    last = net.edge(names[off], f"c{side}off", speed=ramp_speed, shape=end, **options)  # type: ignore[arg-type]
    net.connect(first, ids[on], [(0, 0)])
    net.connect(ids[off - 1], last, [(0, 0)])
