"""Vehicles: a mix of drivers and bodies, and random walks through the network as routes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from symphony.data.sources.sumo.roads import Network

Doubles = NDArray[np.float64]
Chances = list[Doubles] | None

# Share, (least, most) length, width and height in metres, SUMO's vehicle class.
_BODIES = (
    (0.78, (4.0, 5.1), (1.72, 1.95), (1.4, 1.8), "passenger"),
    (0.12, (5.2, 6.2), (1.95, 2.1), (2.0, 2.6), "delivery"),
    (0.07, (7.0, 9.5), (2.2, 2.45), (2.8, 3.6), "truck"),
    (0.03, (10.5, 12.0), (2.45, 2.55), (3.0, 3.4), "bus"),
)
_DRIVERS = ("IDM", "EIDM", "Krauss")
TYPES = 24
_STRAIGHT = 0.6
"""Radians between two streets up to which one goes on as the other."""
DEPART_WITHIN = 15.0
"""Seconds in which the vehicles of a closed network enter it."""


def _types(rng: np.random.Generator, sublane: bool) -> tuple[list[str], NDArray[np.float32], Doubles]:
    """XML, boxes [TYPES, 3] and shares [TYPES] of the vehicle types."""
    # At least one type per body, so that a run's mix has all of them.
    bodies = np.concatenate([np.arange(len(_BODIES)), rng.choice([0, 0, 0, 0, 1, 2], TYPES - len(_BODIES))])
    counts = np.bincount(bodies, minlength=len(_BODIES))
    lines, sizes, shares = [], [], []
    for k, body in enumerate(bodies):
        share, length, width, height, name = _BODIES[body]
        size = [rng.uniform(*length), rng.uniform(*width), rng.uniform(*height)]
        heavy = 0.75 if body >= 2 else 1.0
        tau = float(np.clip(rng.normal(1.3, 0.3), 0.9, 2.2))
        extra = ' latAlignment="center" maxSpeedLat="0.8"' if sublane else ""
        lines.append(
            f'<vType id="t{k}" vClass="{name}" length="{size[0]:.2f}" width="{size[1]:.2f}" '
            f'height="{size[2]:.2f}" carFollowModel="{rng.choice(_DRIVERS)}" sigma="{rng.uniform(0.1, 0.5):.2f}" '
            f'speedFactor="normc(0.98,0.08,0.6,1.3)" tau="{tau:.2f}" accel="{heavy * rng.uniform(1.6, 2.9):.2f}" '
            f'decel="{rng.uniform(2.8, 4.2):.2f}" minGap="{rng.uniform(1.6, 3.2):.2f}"{extra}/>'
        )
        sizes.append(np.round(size, 2))
        shares.append(share / counts[body])
    return lines, np.asarray(sizes, np.float32), np.asarray(shares) / np.sum(shares)


def _walk(
    rng: np.random.Generator,
    start: int,
    following: list[list[int]],
    chance: Chances,
    length: Doubles,
    reach: float,
) -> list[int]:
    """Edges of a random walk until it is ``reach`` metres long or ends; next edges are as likely without a chance."""
    route, total = [start], float(length[start])
    while total < reach and following[route[-1]]:
        at = route[-1]
        if chance is None:
            route.append(following[at][int(rng.integers(len(following[at])))])
        else:
            route.append(int(rng.choice(following[at], p=chance[at])))
        total += float(length[route[-1]])
    return route


def _chances(network: Network, following: list[list[int]], straight: float) -> list[Doubles]:
    """Per edge, the chances of the edges that follow: ``straight`` for the one straight on, to 1 for a turn."""
    first, last = network.edge_headings()
    chances = []
    for edge, after in enumerate(following):
        turn = np.abs(np.angle(np.exp(1j * (first[after] - last[edge]))))
        weight = np.where(turn < _STRAIGHT, straight, 1.0)
        chances.append(weight / weight.sum() if len(after) else weight)
    return chances


def write_demand(
    network: Network,
    rng: np.random.Generator,
    folder: Path,
    duration: float,
    *,
    through: bool,
    sublane: bool,
    straight: float = 1.0,
) -> tuple[Path, NDArray[np.float32]]:
    """Write vehicle types and vehicles, with routes that last for so many seconds, into ``traffic.rou.xml``.

    If ``through``, traffic enters at the sources of the network during the whole run and leaves it at the end; else a
    fixed number of vehicles starts everywhere and circulates. A route goes straight on at a junction so many times
    likelier than it takes one of the turns. Gives the file, and of vehicle k (its id in SUMO) the box ``size[k]``.
    """
    types, sizes, shares = _types(rng, sublane)
    following, length, lanes = network.edge_graph()
    speed = network.edge_speed()
    chance = None if straight == 1.0 else _chances(network, following, straight)
    if through:
        # Each lane carries 600-1 300 vehicles per hour.
        departs, starts = [], []
        for edge in network.sources():
            flow = lanes[edge] * rng.uniform(600, 1300) / 3600
            times = np.cumsum(rng.exponential(1 / flow, int(flow * duration * 1.5) + 5))
            departs += times[times < duration].tolist()
            starts += [edge] * int((times < duration).sum())
        place = 'departPos="base" departLane="best" departSpeed="avg"'
    else:
        count = max(8, round(float((lanes * length).sum()) / 1000 * rng.uniform(6, 15)))
        departs = rng.uniform(0, DEPART_WITHIN, count).tolist()
        weight = lanes * length
        starts = rng.choice(len(length), count, p=weight / weight.sum()).tolist()
        place = 'departPos="random_free" departLane="best" departSpeed="speedLimit"'
    order = np.argsort(departs, kind="stable")
    kinds = rng.choice(TYPES, len(order), p=shares)
    lines = ["<routes>", *types]
    for k, i in enumerate(order):
        reach = (duration - departs[i] + 30) * float(speed.max())
        route = _walk(rng, starts[i], following, chance, length, reach)
        edges = " ".join(network.edge_names[e] for e in route)
        lines.append(
            f'<vehicle id="{k}" type="t{kinds[k]}" depart="{departs[i]:.2f}" {place}>'
            f'<route edges="{edges}"/></vehicle>'
        )
    file = folder / "traffic.rou.xml"
    file.write_text("\n".join([*lines, "</routes>"]))
    return file, sizes[kinds]
