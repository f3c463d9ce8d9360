"""Parked cars along the kerbs of a run segment, and people who walk beside the road.

For simulated logs, which have neither: an agent that has never passed a parked car stops beside it. Nobody steps onto
the road.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from symphony.data.segment import AgentType, Polylines, RunSegment, validate
from symphony.errors import ConfigError
from symphony.geometry import box_corners, box_gap, segments_of, signed_distance

Line = NDArray[np.float64]

SPACING = 6.5
"""Metres from one place to park to the next."""
REACH = 0.25
"""Metres by which a parked car may reach over the road's edge."""
CLEARANCE = 0.25
"""Metres between a parked car and whoever ever passes."""
MOST = 60
"""Parked cars in a segment: those nearest to the ego's way."""
MAX_PEDESTRIANS = 100
_STRAIGHT = 0.15
"""Metres between the kerb and its chord, along a car."""
_STOP = 8.0
"""Metres before and behind a stop point that are kept free."""
_FIRST_CAR, _FIRST_WALKER = 1_000_000, 2_000_000
"""Ids."""


@dataclass(frozen=True)
class Roadside:
    """What stands and walks beside the road.

    Attributes:
        parked: share of the places along straight kerbs that are taken.
        pedestrians: people, at most (whose way would lead over a road or through a car is left out).

    Raises:
        ConfigError: a number out of range.
    """

    parked: float = 0.0
    pedestrians: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.parked <= 1:
            raise ConfigError(f"parked must be between 0 and 1, is {self.parked}")
        if not 0 <= self.pedestrians <= MAX_PEDESTRIANS:
            raise ConfigError(f"pedestrians must be between 0 and {MAX_PEDESTRIANS}, is {self.pedestrians}")


def add_roadside(segment: RunSegment, roadside: Roadside, seed: int) -> RunSegment:
    """The segment with parked cars and pedestrians after its own agents, of whom nobody changes.

    Args:
        segment: any; its boundary is the kerb.
        roadside: how much of it.
        seed: of every random choice.
    """
    if not (roadside.parked or roadside.pedestrians):
        return segment
    rng = np.random.default_rng(seed)
    kerbs = _kerbs(segment.road.boundary)
    cars = _parked(segment, kerbs, roadside.parked, rng)
    walkers = _walkers(segment, kerbs, roadside.pedestrians, cars, rng)
    for first, kind, (pose, size) in (
        (_FIRST_CAR, AgentType.VEHICLE, cars),
        (_FIRST_WALKER, AgentType.PEDESTRIAN, walkers),
    ):
        segment = _with_agents(segment, first, kind, pose, size)
    return validate(segment)


def _with_agents(segment: RunSegment, first: int, kind: AgentType, pose: Line, size: Line) -> RunSegment:
    """With agents of a type, poses x, y, heading [M, T, 3] and sizes [M, 3]."""
    count, steps = pose.shape[:2]
    velocity = np.gradient(pose[..., :2], segment.dt, axis=1) if count else pose[..., :2]
    place = np.pad(pose[..., :2], ((0, 0), (0, 0), (0, 1)))

    def more(mine: NDArray[np.generic], others: NDArray[np.generic]) -> NDArray[np.generic]:
        return np.concatenate([mine, others.astype(mine.dtype)])

    changes = {
        "agent_id": np.arange(first, first + count),
        "agent_type": np.full(count, kind),
        "size": size,
        "position": place,
        "heading": pose[..., 2],
        "velocity": velocity,
        "valid": np.ones((count, steps), np.bool_),
    }
    return segment.replace(**{name: more(getattr(segment, name), value) for name, value in changes.items()})


def _kerbs(boundary: Polylines) -> list[Line]:
    """Lines [P, 2] with a length, the road on their left."""
    lines = np.split(boundary.points[:, :2].astype(np.float64), boundary.offsets[1:-1])
    return [line for line in lines if len(line) > 1 and np.ptp(line, axis=0).max() > 0]


def _along(line: Line, where: Line) -> tuple[Line, Line]:
    """Points [M, 2] and directions [M] at lengths [M] along a line."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    line, steps = line[np.concatenate([[True], steps > 0])], steps[steps > 0]
    length = np.concatenate([[0.0], np.cumsum(steps)])
    ahead, behind = (
        np.stack([np.interp(where + reach, length, axis) for axis in line.T], -1) for reach in (1.5, -1.5)
    )
    way = ahead - behind
    return np.stack([np.interp(where, length, axis) for axis in line.T], -1), np.arctan2(way[:, 1], way[:, 0])


def _length(line: Line) -> float:
    return float(np.hypot(*np.diff(line, axis=0).T).sum())


def _parked(
    segment: RunSegment, kerbs: list[Line], share: float, rng: np.random.Generator
) -> tuple[Line, Line]:
    """Poses [M, T, 3] and sizes [M, 3] of cars that stand at the kerb."""
    poses = [np.zeros((0, 3))]
    sizes = [np.zeros((0, 3))]
    for line in kerbs:
        where = np.arange(rng.uniform(3.0, SPACING), _length(line) - 3.0, SPACING)
        where = where[rng.random(len(where)) < share]
        size = np.clip(
            rng.normal((4.6, 1.85, 1.55), (0.3, 0.06, 0.1), (len(where), 3)),
            (3.6, 1.65, 1.3),
            (5.4, 2.1, 2.2),
        )
        point, direction = _along(line, where)
        front, back = (_along(line, where + reach)[0] for reach in (2.5, -2.5))
        straight = np.linalg.norm((front + back) / 2 - point, axis=-1) < _STRAIGHT
        right = np.stack([np.sin(direction), -np.cos(direction)], -1)
        aside = size[:, 1] / 2 - rng.uniform(-0.6, REACH, len(where))
        backwards = np.pi * (rng.random(len(where)) < 0.15)
        heading = direction + rng.normal(0, 0.02, len(where)) + backwards
        poses.append(np.concatenate([point + aside[:, None] * right, heading[:, None]], -1)[straight])
        sizes.append(size[straight])
    pose, size = np.concatenate(poses), np.concatenate(sizes)
    for keep in (_beside_the_road, _clear_of_stops, _out_of_the_way):
        kept = keep(segment, pose, size)
        pose, size = pose[kept], size[kept]
    way = segment.position[segment.ego, segment.valid[segment.ego], :2].astype(np.float64)
    away = np.linalg.norm(pose[:, None, :2] - way, axis=-1).min(1)
    order = np.argsort(away, kind="stable")
    chosen = _apart(pose[order], size[order])[:MOST]
    pose, size = pose[order][chosen], size[order][chosen]
    return np.repeat(pose[:, None], segment.num_steps, 1), size


def _walkers(
    segment: RunSegment, kerbs: list[Line], count: int, cars: tuple[Line, Line], rng: np.random.Generator
) -> tuple[Line, Line]:
    """Poses [M, T, 3] and sizes [M, 3] of people who walk, or stand, beside the road."""
    long = [line for line in kerbs if _length(line) > 20.0]
    time = segment.dt * np.arange(segment.num_steps)
    poses = [np.zeros((0, segment.num_steps, 3))]
    for _ in range(count if long else 0):
        line = long[int(rng.integers(len(long)))]
        speed = max(0.0, rng.normal(1.35, 0.2)) * (rng.random() < 0.8) * rng.choice([-1.0, 1.0])
        start, aside = rng.uniform(0.0, _length(line)), rng.uniform(0.6, 4.0)
        where = start + speed * time
        point, direction = _along(line, where)
        if where.min() < 0.0 or where.max() > _length(line):
            continue
        right = np.stack([np.sin(direction), -np.cos(direction)], -1)
        heading = np.unwrap(direction) + (np.pi if speed < 0 else 0.0)
        pose = np.concatenate([point + aside * right, heading[:, None]], -1)
        jumps = (
            np.linalg.norm(np.diff(pose[:, :2], axis=0), axis=-1) > 3.0 * segment.dt
        )  # around a sharp corner
        if not jumps.any() and (_signed(segment, pose[None, :, :2]) > 0.4).all():
            poses.append(pose[None])
    pose = np.concatenate(poses)
    size = np.tile([0.6, 0.6, 1.75], (len(pose), 1))
    standing, boxes = cars[0][:, 0], cars[1]
    free = [
        not len(standing) or bool((_gaps(one, size[k], standing, boxes) > 0.1).all())
        for k, one in enumerate(pose)
    ]
    return pose[free], size[free]


def _gaps(pose: Line, size: Line, standing: Line, boxes: Line) -> NDArray[np.float64]:
    """[T, M] metres between one box at poses [T, 3] and others that stand at [M, 3]."""
    here, there = torch.from_numpy(pose)[:, None], torch.from_numpy(standing)
    own, other = torch.from_numpy(size)[:2], torch.from_numpy(boxes)[:, :2]
    return box_gap(here[..., :2], here[..., 2], own, there[:, :2], there[:, 2], other).numpy()


def _signed(segment: RunSegment, points: Line) -> NDArray[np.float64]:
    """Metres from the road's edge, negative on the road, of points [1, M, 2]."""
    start, end, previous, following = segments_of(segment.road.boundary.points, segment.road.boundary.offsets)
    first, last = (torch.from_numpy(array.astype(np.float64))[None] for array in (start, end))
    before, after = (torch.from_numpy(array)[None] for array in (previous, following))
    there = torch.ones(1, len(start), dtype=torch.bool)
    return signed_distance(torch.from_numpy(points), first, last, there, before, after)[0].numpy()


def _beside_the_road(segment: RunSegment, pose: Line, size: Line) -> NDArray[np.bool_]:
    """[M] whose corners and sides reach over no edge by more than :data:`REACH`: on a narrow island nobody parks."""
    box = [torch.from_numpy(value) for value in (pose[:, :2], pose[:, 2], size[:, :2])]
    corner = box_corners(*box)
    middle = (corner + corner.roll(1, -2)) / 2
    points = torch.cat([corner, middle], -2).numpy()
    depth = -_signed(segment, points.reshape(1, -1, 2)).reshape(points.shape[:2])
    beside: NDArray[np.bool_] = np.all(depth < REACH + 0.1, axis=1)
    return beside


def _clear_of_stops(segment: RunSegment, pose: Line, size: Line) -> NDArray[np.bool_]:
    """[M] who stand away from the stop points of lights."""
    away = np.linalg.norm(pose[:, None, :2] - segment.signal_point[:, :2].astype(np.float64), axis=-1)
    clear: NDArray[np.bool_] = np.all(away > _STOP, axis=1)
    return clear


def _out_of_the_way(segment: RunSegment, pose: Line, size: Line) -> NDArray[np.bool_]:
    """[M] whom nobody's box comes near at any step."""
    agent, step = np.nonzero(segment.valid)
    track = np.concatenate(
        [segment.position[agent, step, :2], segment.heading[agent, step, None]], -1
    ).astype(np.float64)
    box = segment.size[agent].astype(np.float64)
    free = np.ones(len(pose), np.bool_)
    for k in range(len(pose)):
        near = (
            np.linalg.norm(track[:, :2] - pose[k, :2], axis=-1)
            < 0.5 * (np.hypot(*size[k, :2]) + np.hypot(*box[:, :2].T)) + 1
        )
        if near.any():
            free[k] = (_gaps(pose[k][None], size[k], track[near], box[near]) > CLEARANCE).all()
    return free


def _apart(pose: Line, size: Line) -> list[int]:
    """Of boxes [M, 3] those that overlap none before them."""
    chosen: list[int] = []
    for k in range(len(pose)):
        if not chosen or (_gaps(pose[k][None], size[k], pose[chosen], size[chosen]) > 0.3).all():
            chosen.append(k)
    return chosen
