"""The features compared between log and rollouts: one number or flag per scored object and step."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.errors import DataError
from symphony.wosac.scorer.boxes import Boxes, distance_to_nearest, time_to_collision
from symphony.wosac.scorer.config import CURRENT, DT
from symphony.wosac.scorer.lights import Lanes, Signals, red_light_violations
from symphony.wosac.scorer.road import Edges, distance_to_road_edge
from symphony.wosac.scorer.scenario import STATES, SURFACE_STREET, SimulatedRollouts, WosacScenario


@dataclass(frozen=True)
class WosacFeatures:
    """Features of a scenario's E scored objects at steps 11 to 90, of the log and of R rollouts.

    By name: ``linear_speed`` (m/s, in space), ``linear_acceleration`` (m/s², change of the speed), ``angular_speed``
    (rad/s), ``angular_acceleration`` (rad/s²), ``distance_to_nearest_object`` (m, below 0 is ``collision_per_step``),
    ``time_to_collision`` (s, at most 5), ``distance_to_road_edge`` (m, above 0 is ``offroad_per_step``),
    ``traffic_light_violation_per_step``, ``average_displacement_error`` ([..., E], m from the log, with the history).
    """

    object_id: Int[Tensor, " E"]  # ascending
    object_type: Int[Tensor, " E"]
    log_valid: Bool[Tensor, "E 80"]  # where the log is valid
    log: dict[str, Tensor]  # [E, 80] by name
    simulated: dict[str, Tensor]  # [R, E, 80] by name


def compute_features(scenario: WosacScenario, rollouts: SimulatedRollouts) -> WosacFeatures:
    """Return the features of log and rollouts.

    Raises a :class:`DataError` where the two don't fit together; names scenario, field and agent.
    """
    try:
        rollouts.check(scenario.sim_agents, scenario.future)
    except DataError as error:
        raise error.at(segment=scenario.scenario_id) from None
    with torch.no_grad(), _one_thread():
        tracks = _tracks(scenario, rollouts)
        features = _features(tracks, scenario)
        rows = tracks.rows[: tracks.evaluated]
        return WosacFeatures(
            object_id=torch.from_numpy(scenario.object_id[rows]),
            object_type=torch.from_numpy(scenario.object_type[rows]),
            log_valid=tracks.valid[0, : tracks.evaluated, CURRENT + 1 :],
            log={name: values[0] for name, values in features.items()},
            simulated={name: values[1:] for name, values in features.items()},
        )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Run many small steps on one thread: several would mostly wait for each other, and burn time."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class _Tracks(NamedTuple):
    """Logged history and simulated future of n agents over 91 steps, float32 as the definitions have it.

    Row 0 of R is the log itself, with the log's own validity. The others are rollouts: history as logged, valid where
    it was, and a future that is valid throughout. Boxes have the size of step 10 throughout.
    """

    #: [n] of the scenario's objects: the E evaluated ones first, by ascending id, then the others
    rows: np.ndarray
    evaluated: int  # E
    x: Tensor  # [R, n, 91]
    y: Tensor  # [R, n, 91]
    z: Tensor  # [R, n, 91]
    heading: Tensor  # [R, n, 91]
    valid: Tensor  # [R, n, 91]
    size: Tensor  # [n, 3]


def _tracks(scenario: WosacScenario, rollouts: SimulatedRollouts) -> _Tracks:
    scored = np.unique(scenario.evaluated)
    rest = scenario.sim_agents[~np.isin(scenario.sim_agents, scored)]
    row = {int(name): k for k, name in enumerate(scenario.object_id)}
    column = {int(name): k for k, name in enumerate(rollouts.object_id)}
    rows, columns = (np.array([index[int(i)] for i in (*scored, *rest)]) for index in (row, column))
    now, count = CURRENT + 1, len(rollouts.x)
    logged = (*np.moveaxis(scenario.position[rows], -1, 0), scenario.heading[rows])
    states = []
    for log, name in zip(logged, STATES, strict=True):
        past = np.repeat(log[None, :, :now], count + 1, 0)
        future = np.concatenate([log[None, :, now:], getattr(rollouts, name)[:, columns]])
        # A log may hold anything where it is not valid.
        with np.errstate(over="ignore"):
            states.append(torch.from_numpy(np.concatenate([past, future], -1).astype(np.float32)))
    valid = np.repeat(scenario.valid[rows][None], count + 1, 0)
    valid[1:, :, now:] = True
    size = torch.from_numpy(scenario.size[rows].astype(np.float32))
    x, y, z, heading = states
    return _Tracks(rows, len(scored), x, y, z, heading, torch.from_numpy(valid), size)


def _features(tracks: _Tracks, scenario: WosacScenario) -> dict[str, Tensor]:
    """Return the features of the log, in row 0, and of all rollouts, [R, E, 80]."""
    count, valid = tracks.evaluated, tracks.valid
    future, scored = slice(CURRENT + 1, None), (slice(None), slice(tracks.evaluated))
    x, y, z, heading = (values[scored] for values in (tracks.x, tracks.y, tracks.z, tracks.heading))
    linear = speed(x, y, z)
    turning, turning_change = angular(heading)
    position = torch.stack((tracks.x, tracks.y), -1)
    boxes = Boxes(
        position[:, :, future],
        tracks.heading[..., future],
        tracks.size[None, :, None, :2].expand(position[:, :, future].shape),
        valid[..., future],
        speed(tracks.x, tracks.y)[..., future],
    )
    nearest = distance_to_nearest(boxes, count)
    center = torch.stack((x, y, z), -1)[:, :, future]
    size = tracks.size[None, :count, None].expand(center.shape)
    part = (*scored, future)
    edges = Edges.of(scenario.road_edges)
    edge = distance_to_road_edge(center, heading[..., future], size, valid[part], edges)
    street = (scenario.lane_type == SURFACE_STREET).nonzero()[0].tolist()
    lanes = Lanes.of([scenario.lanes[k] for k in street], scenario.lane_id[street])
    seen = scenario.signal_step, scenario.signal_lane, scenario.signal_state, scenario.signal_point
    violations = red_light_violations(position[scored], valid[scored], lanes, Signals.of(*seen, valid.shape[-1]))
    away = sum((axis - axis[:1]).square() for axis in (x, y, z)).sqrt()  # type: ignore[union-attr]
    known = valid[0, :count]
    return {
        "linear_speed": linear[..., future],
        "linear_acceleration": (central_difference(linear) / DT)[..., future],
        "angular_speed": turning[..., future],
        "angular_acceleration": turning_change[..., future],
        "distance_to_nearest_object": nearest,
        "collision_per_step": nearest < 0,
        "time_to_collision": time_to_collision(boxes, count),
        "distance_to_road_edge": edge,
        "offroad_per_step": edge > 0,
        "traffic_light_violation_per_step": violations[..., future],
        "average_displacement_error": torch.where(known, away, 0.0).sum(-1) / known.sum(-1),
    }


def central_difference(values: Float[Tensor, "*batch T"]) -> Float[Tensor, "*batch T"]:
    """Return half the difference between the next step and the one before; NaN at both ends."""
    result = torch.full_like(values, math.nan)
    result[..., 1:-1] = (values[..., 2:] - values[..., :-2]) / 2
    return result


def wrap(angle: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Wrap an angle to the same direction in [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def speed(*coordinates: Float[Tensor, "*batch T"]) -> Float[Tensor, "*batch T"]:
    """Return m/s along any number of axes in metres."""
    squared = torch.zeros_like(coordinates[0])
    for axis in coordinates:
        squared = squared + central_difference(axis).square()
    # On the CPU, PyTorch's square root is correctly rounded in float64 only.
    return squared.double().sqrt().to(squared.dtype) / DT


def angular(heading: Float[Tensor, "*batch T"]) -> tuple[Float[Tensor, "*batch T"], Float[Tensor, "*batch T"]]:
    """Return (rad/s, rad/s²); each difference over two steps is taken the short way round."""
    turn = wrap(central_difference(heading) * 2) / 2
    return turn / DT, wrap(central_difference(turn) * 2) / 2 / (DT * DT)
