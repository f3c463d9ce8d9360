"""Traffic: a mix of drivers and bodies on random walks through a network, simulated by SUMO into smooth tracks."""

from __future__ import annotations

import xml.etree.ElementTree as ET  # files are our own
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import AgentType, Bools, Floats, SignalState, wrap
from symphony.data.sources.base import Doubles
from symphony.data.sources.sumo.networks import KERB
from symphony.data.sources.sumo.process import run_program
from symphony.data.sources.sumo.roads import Network
from symphony.errors import DataError

# Share, (least, most) length, width and height in metres, SUMO's vehicle class.
_BODIES = (
    (0.78, (4.0, 5.1), (1.72, 1.95), (1.4, 1.8), "passenger"),
    (0.12, (5.2, 6.2), (1.95, 2.1), (2.0, 2.6), "delivery"),
    (0.07, (7.0, 9.5), (2.2, 2.45), (2.8, 3.6), "truck"),
    (0.03, (10.5, 12.0), (2.45, 2.55), (3.0, 3.4), "bus"),
)
# (Least, most) length, width and height in metres and speed in m/s, class and settings of those who cycle and walk.
_CYCLE = (
    *((1.6, 1.85), (0.55, 0.7), (1.6, 1.85), (3.5, 6.5), "bicycle"),
    'minGap="1.0" latAlignment="right" maxSpeedLat="0.6"',
)
_WALKER = (0.35, 0.5), (0.45, 0.6), (1.5, 1.9), (1.0, 1.7), "pedestrian", ""
_CYCLES, _CYCLING = 4, 0.15  # types of the first, and their share of those on the road
_WALKERS, _WALKING = 4, (8, 24)  # types of the second, and how many walk for each kilometre of sidewalk
_LONGEST_PARKED, _WIDEST_PASSING = 6.0, 2.0  # metres
_GAP, _AHEAD = 0.6, 3.2  # metres that vehicles keep beside them and, at most, ahead; SUMO puts nobody nearer
_DRIVERS = ("IDM", "EIDM", "Krauss")
TYPES = 24
ROUTES = "traffic.rou.xml"
_STRAIGHT = 0.6  # radians between two streets up to which one goes on as the other
DEPART_WITHIN = 15.0  # seconds in which the vehicles of a closed network enter it
STEP = 0.1  # seconds per simulation step and per recorded position
_SIGMA, _REACH = 0.25, 8
"""Seconds, and samples on either side, of the smoothing kernel; tracks lose as many at both ends."""
REACTION = 0.6
"""Seconds by which lights come early: SUMO's drivers react to them at once, and smoothed tracks .2 s before that."""
_FRONT_OVERHANG, _REAR_OVERHANG = 0.19, 0.22
"""Distance of the axles from the ends of the box, as shares of its length."""
_STATES = {
    **dict.fromkeys("ru", SignalState.STOP),
    **dict.fromkeys("yY", SignalState.CAUTION),
    **dict.fromkeys("gG", SignalState.GO),
    "s": SignalState.FLASHING_STOP,
    "o": SignalState.FLASHING_CAUTION,
    "O": SignalState.UNKNOWN,
}
"""SUMO's letters for the state of a light."""


def _types(rng: np.random.Generator, sublane: bool, street: bool) -> tuple[list[str], Floats, Doubles]:
    """Return XML, boxes [K, 3] and shares [K] of :data:`TYPES` of vehicles; in streets also of those who cycle and,
    with shares of 0, of those who walk.
    """
    # At least one type per body, so that a run's mix has all of them.
    bodies = np.concatenate([np.arange(len(_BODIES)), rng.choice([0, 0, 0, 0, 1, 2], TYPES - len(_BODIES))])
    counts = np.bincount(bodies, minlength=len(_BODIES))
    lines, sizes, shares = [], [], []
    for k, body in enumerate(bodies):
        share, *ranges, name = _BODIES[body]
        size = [rng.uniform(*each) for each in ranges]
        heavy = 0.75 if body >= 2 else 1.0
        tau = float(np.clip(rng.normal(1.3, 0.3), 0.9, 2.2))
        extra = ' latAlignment="center" maxSpeedLat="0.8"' if sublane else ""
        lines.append(
            f'<vType id="t{k}" vClass="{name}" length="{size[0]:.2f}" width="{size[1]:.2f}" '
            f'height="{size[2]:.2f}" carFollowModel="{rng.choice(_DRIVERS)}" sigma="{rng.uniform(0.1, 0.5):.2f}" '
            f'speedFactor="normc(0.98,0.08,0.6,1.3)" tau="{tau:.2f}" accel="{heavy * rng.uniform(1.6, 2.9):.2f}" '
            f'decel="{rng.uniform(2.8, 4.2):.2f}" minGap="{rng.uniform(1.6, _AHEAD):.2f}"{extra}/>'
        )
        sizes.append(np.round(size, 2))
        shares.append(share / counts[body])
    if street:
        # Wider ones would stand behind a parked car for ever, as nobody uses the lane of oncoming traffic.
        shares = [share * (size[1] < _WIDEST_PASSING) for share, size in zip(shares, sizes, strict=True)]
        shares += [np.sum(shares) * _CYCLING / (1 - _CYCLING) / _CYCLES] * _CYCLES + [0.0] * _WALKERS
        for k in range(TYPES, TYPES + _CYCLES + _WALKERS):
            *ranges, speeds, name, extra = _CYCLE if k < TYPES + _CYCLES else _WALKER
            size, speed = [rng.uniform(*each) for each in ranges], rng.uniform(*speeds)
            lines.append(
                f'<vType id="t{k}" vClass="{name}" length="{size[0]:.2f}" width="{size[1]:.2f}" '
                f'height="{size[2]:.2f}" maxSpeed="{speed:.2f}" {extra}/>'
            )
            sizes.append(np.round(size, 2))
    return lines, np.asarray(sizes, np.float32), np.asarray(shares) / np.sum(shares)


def write_demand(
    network: Network,
    rng: np.random.Generator,
    folder: Path,
    duration: float,
    *,
    through: bool,
    around: bool,
    sublane: bool,
    street: bool = False,
    straight: float = 1.0,
) -> tuple[Floats, NDArray[np.uint8]]:
    """Write vehicle types and vehicles, with routes that last ``duration`` seconds, into the file :data:`ROUTES`.

    If ``through``, traffic enters at the sources of the network during the whole run and leaves it at the end; if
    ``around``, a fixed number of vehicles starts everywhere; in a ``street`` some of them cycle, others stand at the
    kerb, and people walk. A route is a random walk, at junctions ``straight`` times as likely to go straight on as to
    take any one turn. Returns the box [3] and the :class:`AgentType` of each vehicle or person k (its id in SUMO).
    """
    types, sizes, shares = _types(rng, sublane, street)
    following, length, lanes = network.edge_graph()
    speed = float(network.speed.max())
    chance: list[Doubles] = []
    if straight != 1.0:
        first, last = network.edge_headings()
        for edge, after in enumerate(following):
            turn = np.abs(np.angle(np.exp(1j * (first[after] - last[edge]))))
            weight = np.where(turn < _STRAIGHT, straight, 1.0)
            chance.append(weight / weight.sum() if len(after) else weight)
    departs, starts, places = list[float](), list[int](), list[str]()
    if through:
        # Each lane carries 600-1 300 vehicles per hour.
        for edge in network.sources():
            flow = lanes[edge] * rng.uniform(600, 1300) / 3600
            times = np.cumsum(rng.exponential(1 / flow, int(flow * duration * 1.5) + 5))
            departs += times[times < duration].tolist()
            starts += [edge] * int((times < duration).sum())
        places += ['departPos="base" departLane="best" departSpeed="avg"'] * len(departs)
    if around:
        weight = lanes * length
        count = max(8, round(float(weight.sum()) / 1000 * rng.uniform(6, 15)))
        departs += rng.uniform(0, DEPART_WITHIN, count).tolist()
        starts += rng.choice(len(length), count, p=weight / weight.sum()).tolist()
        places += ['departPos="random_free" departLane="best" departSpeed="speedLimit"'] * count
    order = np.argsort(departs, kind="stable")
    kinds = rng.choice(len(types), len(order), p=shares)
    lines = ["<routes>", *types]
    if street:
        for more in (_parked, _walking):
            found, those = more(network, rng, sizes, len(kinds))
            lines, kinds = lines + found, np.concatenate([kinds, those])
    for k, i in enumerate(order):
        at = starts[i]
        route, total = [at], float(length[at])
        while total < (duration - departs[i] + 30) * speed and following[at]:
            at = int(rng.choice(following[at], p=chance[at] if chance else None))
            route.append(at)
            total += float(length[at])
        edges = " ".join(network.edge_names[e] for e in route)
        lines.append(
            f'<vehicle id="{k}" type="t{kinds[k]}" depart="{departs[i]:.2f}" {places[i]}>'
            f'<route edges="{edges}"/></vehicle>'
        )
    (folder / ROUTES).write_text("\n".join([*lines, "</routes>"]))
    agent_type = np.select(
        [kinds < TYPES, kinds < TYPES + _CYCLES], [AgentType.VEHICLE, AgentType.CYCLIST], AgentType.PEDESTRIAN
    )
    return sizes[kinds], agent_type.astype(np.uint8)


def _parked(network: Network, rng: np.random.Generator, sizes: Floats, first: int) -> tuple[list[str], NDArray[Any]]:
    """Return vehicles, numbered from ``first``, that stand partly on the lanes of most streets, and their types."""
    lines, kinds, small = list[str](), list[int](), np.flatnonzero(sizes[:TYPES, 0] < _LONGEST_PARKED)
    length = network.edge_graph()[1]
    for edge in np.flatnonzero(length):
        # Of the lanes of an edge for cars the first is at the kerb, which in networks of our own is on the right.
        kerb, lane = network.width[np.argmax(network.edge == edge)] / 2, network.edge_names[edge]
        places = np.arange(12.0 + rng.uniform(0, 10), length[edge] - 15, _LONGEST_PARKED + _AHEAD)
        for at in places[rng.random(len(places)) < rng.uniform(-0.3, 0.8)]:
            kind = int(rng.choice(small))
            aside = kerb + sizes[kind, 1] / 2 - rng.uniform(0.1, min(0.8, 2 * kerb - _WIDEST_PASSING - _GAP))
            lines.append(
                f'<vehicle id="{first + len(kinds)}" type="t{kind}" depart="0" departPos="stop" departLane="{KERB}">'
                f'<route edges="{lane}"/><stop lane="{lane}_{KERB}" startPos="{at:.2f}" posLat="{-aside:.2f}" '
                f'endPos="{at + sizes[kind, 0]:.2f}" duration="100000"/></vehicle>'
            )
            kinds.append(kind)
    return lines, np.asarray(kinds, np.int64)


def _walking(
    network: Network, rng: np.random.Generator, sizes: Floats, first: int
) -> tuple[list[str], NDArray[np.int64]]:
    """Return people, numbered from ``first``, who walk from one street to another and a third, and their types."""
    length = network.edge_graph()[1]
    streets = np.flatnonzero(length)
    count = round(float(length.sum()) / 1000 * rng.uniform(*_WALKING))
    kinds = rng.integers(len(sizes) - _WALKERS, len(sizes), count)
    lines = []
    for k, kind in enumerate(kinds):
        start, *ends = rng.choice(streets, 3)
        at = rng.uniform(0, length[start])
        walks = "".join(f'<walk to="{network.edge_names[end]}"/>' for end in ends)
        begin = f'<person id="{first + k}" type="t{kind}" depart="0" departPos="{at:.2f}">'
        lines.append(begin + walks.replace("<walk", f'<walk from="{network.edge_names[start]}"', 1) + "</person>")
    return lines, kinds


@dataclass(frozen=True)
class Traffic:
    """Tracks of all V vehicles and people, and lights, at N times in the network's frame; NaN where one is absent."""

    size: Floats  # [V, 3] boxes
    agent_type: NDArray[np.uint8]  # [V] of :class:`AgentType`
    position: Doubles  # [V, N, 2] box centres
    heading: Doubles  # [V, N] unwrapped along time
    velocity: Doubles  # [V, N, 2] m/s
    present: Bools  # [V, N]
    lights: dict[str, NDArray[np.uint8]]  # per traffic light, [links, N] signal states


def simulate_traffic(
    network_file: Path,
    network: Network,
    demand: tuple[Floats, NDArray[np.uint8]],
    rng: np.random.Generator,
    duration: float,
    warm_up: float,
    *,
    sublane: bool,
) -> Traffic:
    """Simulate what :func:`write_demand` wrote, record from ``warm_up`` to ``duration`` seconds and smooth. Vehicles
    keep a lateral offset of their own from the centre of the lane that drifts with the distance driven.
    """
    folder, (size, agent_type) = network_file.parent, demand
    events = [
        f'<timedEvent type="SaveTLSSwitchStates" source="{light}" dest="lights{k}.xml"/>'
        for k, light in enumerate(network.connectors)
    ]
    (folder / "lights.add.xml").write_text("\n".join(["<additional>", *events, "</additional>"]))
    arguments = (
        f"--net-file {network_file.name} --route-files {ROUTES} --additional-files lights.add.xml "
        f"--end {duration:.1f} --step-length {STEP} --step-method.ballistic true --seed {rng.integers(2**30)} "
        "--extrapolate-departpos true --time-to-teleport -1 --precision 4 --collision.action warn "
        "--collision.check-junctions true --collision.mingap-factor 0 --no-step-log true --no-warnings true "
        f"--duration-log.disable true --device.fcd.begin {warm_up:.1f} --fcd-output tracks.csv "
        "--fcd-output.attributes x,y,angle --fcd-output.skip-empty true "
    )
    arguments += "--lateral-resolution 0.5" if sublane else "--lanechange.duration 3"
    run_program("sumo", arguments, folder)
    time = warm_up + STEP * np.arange(round((duration - warm_up) / STEP), dtype=np.float64)
    front, angle = _read_tracks(folder / "tracks.csv", time, len(size))
    position, heading = _smooth(front, angle, size[:, :1].astype(np.float64), _wander(rng, len(size)))
    velocity = np.gradient(position, STEP, axis=1)
    # At both ends of a track the difference is with an absent neighbour.
    present = np.asarray(np.isfinite(velocity).all(axis=-1))
    lights = {
        light: _read_lights(folder / f"lights{k}.xml", time + REACTION) for k, light in enumerate(network.connectors)
    }
    return Traffic(size, agent_type, position, heading, velocity, present, lights)


def _read_tracks(file: Path, time: Doubles, count: int) -> tuple[Doubles, Doubles]:
    """Return front bumper [V, N, 2] and heading [V, N], NaN where absent."""
    front, heading = np.full((count, len(time), 2), np.nan), np.full((count, len(time)), np.nan)
    with file.open() as lines:
        # The first of a time step names the columns for all: "vehicle_x", or "person_x".
        header = [name.partition("_")[2] for name in lines.readline().strip().split(";")]
        names = ("time", "id", "x", "y", "angle")
        table = np.loadtxt(lines, delimiter=";", usecols=[header.index(name) for name in names], ndmin=2)
    if len(table) == 0:
        raise DataError("no vehicle drove in the recorded time", file=file.name)
    step, vehicle = np.rint((table[:, 0] - time[0]) / STEP).astype(int), table[:, 1].astype(int)
    inside = (step >= 0) & (step < len(time))
    step, vehicle, table = step[inside], vehicle[inside], table[inside]
    front[vehicle, step] = table[:, 2:4]
    heading[vehicle, step] = np.pi / 2 - np.deg2rad(table[:, 4])
    return front, heading


def _wander(rng: np.random.Generator, count: int) -> Doubles:
    """Return [4, V, 4] constants of a sideways drift: amplitude, wave number and phase of four waves, and a bias."""
    amplitude = rng.normal(0, 0.09, (count, 4)).clip(-0.18, 0.18)
    number = 2 * np.pi / rng.uniform(40, 140, (count, 4))
    bias = np.repeat(rng.normal(0, 0.08, (count, 1)).clip(-0.16, 0.16), 4, axis=1) / 4
    return np.stack([amplitude, number, rng.uniform(0, 2 * np.pi, (count, 4)), bias])


def _smooth(front: Doubles, heading: Doubles, length: Doubles, wander: Doubles) -> tuple[Doubles, Doubles]:
    """Return box centre [V, N, 2] and unwrapped heading [V, N] from the smoothed paths of both axles."""
    along = np.stack([np.cos(heading), np.sin(heading)], -1)
    left = np.stack([-along[..., 1], along[..., 0]], -1)
    step = np.nan_to_num(np.linalg.norm(np.diff(front, axis=1), axis=-1))
    travelled = np.pad(np.cumsum(step, axis=1), ((0, 0), (1, 0)))
    at_front, at_rear = length * _FRONT_OVERHANG, length * (1 - _REAR_OVERHANG)
    amplitude, number, phase, bias = wander[:, :, :, None]
    axles = []
    for back in (at_front, at_rear):
        sideways = (amplitude * np.cos(number * (travelled - back)[:, None] + phase) + bias).sum(1)
        axles.append(_gaussian(front - back[..., None] * along + sideways[..., None] * left))
    ahead = axles[0] - axles[1]
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    center = axles[0] + (at_front - length / 2)[..., None] * ahead
    angle = np.arctan2(ahead[..., 1], ahead[..., 0])
    turn = np.nan_to_num(wrap(np.diff(angle, axis=1)))
    start = np.nan_to_num(angle[np.arange(len(angle)), np.argmax(np.isfinite(angle), axis=1)])
    unwrapped = start[:, None] + np.pad(np.cumsum(turn, axis=1), ((0, 0), (1, 0)))
    return center, np.where(np.isfinite(angle), unwrapped, np.nan)


def _gaussian(paths: Doubles) -> Doubles:
    """Smooth [V, N, 2] along N; samples closer than the kernel to an absent one become NaN."""
    kernel = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) * STEP / _SIGMA) ** 2)
    kernel /= kernel.sum()
    out = np.full_like(paths, np.nan)
    inner = out[:, _REACH : paths.shape[1] - _REACH]
    inner[:] = 0
    for shift, weight in enumerate(kernel):
        inner += weight * paths[:, shift : shift + inner.shape[1]]
    return out


def _read_lights(file: Path, time: Doubles) -> NDArray[np.uint8]:
    """Return [links, N] states of one traffic light from its switches."""
    switches = [(float(e.attrib["time"]), e.attrib["state"]) for e in ET.parse(file).getroot()]  # noqa: S314
    states = np.array([[_STATES.get(letter, 0) for letter in state] for _, state in switches], np.uint8)
    at = np.searchsorted([t for t, _ in switches], time + 1e-6, side="right") - 1
    return states[at.clip(0)].T.copy()
