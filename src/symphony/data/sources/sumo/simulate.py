"""Running a simulation and turning SUMO's output into smooth tracks and light states."""

from __future__ import annotations

import xml.etree.ElementTree as ET  # files are our own
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from symphony.data.segment import SignalState
from symphony.data.sources.sumo.process import run_program
from symphony.data.sources.sumo.roads import Network
from symphony.errors import DataError

Doubles = NDArray[np.float64]

STEP = 0.1
"""Seconds per simulation step and per recorded position."""
_SIGMA = 0.25
_REACH = 8
"""Samples on either side of the smoothing kernel; tracks lose as many at both ends."""
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
_STATE_TABLE = np.zeros(128, np.uint8)
_STATE_TABLE[[ord(letter) for letter in _STATES]] = list(_STATES.values())


@dataclass(frozen=True)
class Traffic:
    """Tracks of all V vehicles and all lights at N times, in the network's frame.

    Attributes:
        time: [N] seconds since the start of the simulation, :data:`STEP` apart.
        size: [V, 3] boxes.
        position: [V, N, 2] box centres; NaN where the vehicle is absent.
        heading: [V, N] unwrapped along time; NaN where absent.
        velocity: [V, N, 2] m/s; NaN where absent.
        present: [V, N] bool.
        lights: per traffic light, [links, N] uint8 :class:`SignalState`.
    """

    time: Doubles
    size: NDArray[np.float32]
    position: Doubles
    heading: Doubles
    velocity: Doubles
    present: NDArray[np.bool_]
    lights: dict[str, NDArray[np.uint8]]


def simulate_traffic(
    network_file: Path,
    network: Network,
    routes: Path,
    size: NDArray[np.float32],
    rng: np.random.Generator,
    duration: float,
    warm_up: float,
    *,
    sublane: bool,
) -> Traffic:
    """Simulate, record from ``warm_up`` to ``duration`` seconds and smooth.

    Vehicles keep a lateral offset of their own from the centre of the lane that drifts with the distance driven.
    """
    folder = routes.parent
    events = [
        f'<timedEvent type="SaveTLSSwitchStates" source="{light}" dest="lights{k}.xml"/>'
        for k, light in enumerate(network.connectors)
    ]
    (folder / "lights.add.xml").write_text("\n".join(["<additional>", *events, "</additional>"]))
    arguments = (
        f"--net-file {network_file.name} --route-files {routes.name} --additional-files lights.add.xml "
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
    position, heading = _smooth(front, angle, size[:, 0], _wander(rng, len(size)))
    velocity = np.gradient(position, STEP, axis=1)
    # At both ends of a track the difference is with an absent neighbour.
    present = np.isfinite(velocity[..., 0]) & np.isfinite(velocity[..., 1])
    lights = {
        light: _read_lights(folder / f"lights{k}.xml", time) for k, light in enumerate(network.connectors)
    }
    return Traffic(time, size, position, heading, velocity, present, lights)


def _read_tracks(file: Path, time: Doubles, count: int) -> tuple[Doubles, Doubles]:
    """Front bumper [V, N, 2] and heading [V, N], NaN where absent."""
    front, heading = np.full((count, len(time), 2), np.nan), np.full((count, len(time)), np.nan)
    with file.open() as lines:
        header = lines.readline().strip().split(";")
        names = ("timestep_time", "vehicle_id", "vehicle_x", "vehicle_y", "vehicle_angle")
        columns = [header.index(name) for name in names]
        table = np.loadtxt(lines, delimiter=";", usecols=columns, ndmin=2)
    if len(table) == 0:
        raise DataError("no vehicle drove in the recorded time", file=file.name)
    step, vehicle = np.rint((table[:, 0] - time[0]) / STEP).astype(int), table[:, 1].astype(int)
    inside = (step >= 0) & (step < len(time))
    step, vehicle, table = step[inside], vehicle[inside], table[inside]
    front[vehicle, step] = table[:, 2:4]
    heading[vehicle, step] = np.pi / 2 - np.deg2rad(table[:, 4])
    return front, heading


def _wander(rng: np.random.Generator, count: int) -> Doubles:
    """[4, V, 4] constants of a slow sideways drift: amplitude, wave number and phase of four waves, and a bias."""
    amplitude = rng.normal(0, 0.09, (count, 4)).clip(-0.18, 0.18)
    number = 2 * np.pi / rng.uniform(40, 140, (count, 4))
    bias = np.repeat(rng.normal(0, 0.08, (count, 1)).clip(-0.16, 0.16), 4, axis=1) / 4
    return np.stack([amplitude, number, rng.uniform(0, 2 * np.pi, (count, 4)), bias])


def _offset(s: Doubles, wander: Doubles) -> Doubles:
    """Metres to the left [V, N] after the distance s [V, N]."""
    amplitude, number, phase, bias = wander[:, :, :, None]
    return (amplitude * np.cos(number * s[:, None] + phase) + bias).sum(1)


def _smooth(
    front: Doubles,
    heading: Doubles,
    length: NDArray[np.float32],
    wander: Doubles,
) -> tuple[Doubles, Doubles]:
    """Box centre [V, N, 2] and unwrapped heading [V, N] from the smoothed paths of both axles."""
    along = np.stack([np.cos(heading), np.sin(heading)], -1)
    left = np.stack([-along[..., 1], along[..., 0]], -1)
    size = length[:, None].astype(np.float64)
    step = np.nan_to_num(np.linalg.norm(np.diff(front, axis=1), axis=-1))
    travelled = np.pad(np.cumsum(step, axis=1), ((0, 0), (1, 0)))
    at_front, at_rear = size * _FRONT_OVERHANG, size * (1 - _REAR_OVERHANG)
    axles = []
    for back in (at_front, at_rear):
        sideways = _offset(travelled - back, wander)
        axles.append(_gaussian(front - back[..., None] * along + sideways[..., None] * left))
    ahead = axles[0] - axles[1]
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    center = axles[0] + (at_front - size / 2)[..., None] * ahead
    angle = np.arctan2(ahead[..., 1], ahead[..., 0])
    turn = np.nan_to_num((np.diff(angle, axis=1) + np.pi) % (2 * np.pi) - np.pi)
    first = np.argmax(np.isfinite(angle), axis=1)
    start = np.nan_to_num(angle[np.arange(len(angle)), first])
    unwrapped = start[:, None] + np.pad(np.cumsum(turn, axis=1), ((0, 0), (1, 0)))
    return center, np.where(np.isfinite(angle), unwrapped, np.nan)


def _gaussian(paths: Doubles) -> Doubles:
    """Smooth [V, N, 2] along N; samples closer than the kernel to an absent one become NaN."""
    offsets = np.arange(-_REACH, _REACH + 1)
    kernel = np.exp(-0.5 * (offsets * STEP / _SIGMA) ** 2)
    kernel /= kernel.sum()
    out = np.full_like(paths, np.nan)
    inner = out[:, _REACH : paths.shape[1] - _REACH]
    if inner.shape[1] > 0:
        inner[:] = 0
        for weight, shift in zip(kernel, range(2 * _REACH + 1), strict=True):
            inner += weight * paths[:, shift : shift + inner.shape[1]]
    return out


def _read_lights(file: Path, time: Doubles) -> NDArray[np.uint8]:
    """[links, N] states of one traffic light from its switches."""
    switches = [(float(e.attrib["time"]), e.attrib["state"]) for e in ET.parse(file).getroot()]  # noqa: S314
    letters = np.array([np.frombuffer(state.encode(), np.uint8) for _, state in switches])
    at = np.searchsorted([t for t, _ in switches], time + 1e-6, side="right") - 1
    return _STATE_TABLE[letters[at.clip(0)]].T.copy()
