"""What is compared between log and rollouts: one number or flag per scored object and step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.wosac.scorer import kinematics
from symphony.wosac.scorer.composite import Composite
from symphony.wosac.scorer.config import CURRENT
from symphony.wosac.scorer.interaction import distance_to_nearest, time_to_collision
from symphony.wosac.scorer.lights import Signals, red_light_violations, surface_street_lanes
from symphony.wosac.scorer.road import Edges, distance_to_road_edge
from symphony.wosac.scorer.scenario import SimulatedRollouts, WosacScenario


@dataclass(frozen=True)
class StepFeatures:
    """Features of E objects at steps 11 to 90, of the log or of R rollouts.

    Attributes:
        linear_speed: m/s in space.
        linear_acceleration: m/s², change of the speed.
        angular_speed: rad/s.
        angular_acceleration: rad/s².
        distance_to_nearest_object: m, negative in a collision.
        collision_per_step: whether it is negative.
        time_to_collision: s, at most 5.
        distance_to_road_edge: m, positive off the road.
        offroad_per_step: whether it is positive.
        traffic_light_violation_per_step: whether a red light is run.
        average_displacement_error: [..., E] m from the log, over history and future.
    """

    linear_speed: Float[Tensor, "*rollout E 80"]
    linear_acceleration: Float[Tensor, "*rollout E 80"]
    angular_speed: Float[Tensor, "*rollout E 80"]
    angular_acceleration: Float[Tensor, "*rollout E 80"]
    distance_to_nearest_object: Float[Tensor, "*rollout E 80"]
    collision_per_step: Bool[Tensor, "*rollout E 80"]
    time_to_collision: Float[Tensor, "*rollout E 80"]
    distance_to_road_edge: Float[Tensor, "*rollout E 80"]
    offroad_per_step: Bool[Tensor, "*rollout E 80"]
    traffic_light_violation_per_step: Bool[Tensor, "*rollout E 80"]
    average_displacement_error: Float[Tensor, "*rollout E"]

    def __getitem__(self, rollout: int | slice) -> StepFeatures:
        return StepFeatures(*(getattr(self, field.name)[rollout] for field in fields(self)))


@dataclass(frozen=True)
class WosacFeatures:
    """Features of a scenario's scored objects.

    Attributes:
        object_id: [E] ascending.
        object_type: [E].
        log_valid: [E, 80] where the log is valid.
        log: of the log.
        simulated: of R rollouts.
    """

    object_id: Int[Tensor, " E"]
    object_type: Int[Tensor, " E"]
    log_valid: Bool[Tensor, "E 80"]
    log: StepFeatures
    simulated: StepFeatures


def compute_features(scenario: WosacScenario, rollouts: SimulatedRollouts) -> WosacFeatures:
    """Features of log and rollouts, where the scenario's tensors lie.

    Raises:
        DataError: the two don't fit together; names scenario, field and agent.
    """
    rollouts = rollouts.to(scenario.valid.device)
    rollouts.check(scenario)
    with torch.no_grad(), _one_thread():
        scene = Composite.of(scenario, rollouts)
        scored = slice(scene.evaluated)
        future = slice(CURRENT + 1, None)
        features = _features(scene, scenario)
        return WosacFeatures(
            object_id=scene.object_id[scored],
            object_type=scene.object_type[scored],
            log_valid=scene.valid[0, scored, future],
            log=features[0],
            simulated=features[1:],
        )


@contextmanager
def _one_thread() -> Iterator[None]:
    """Many small steps: several threads would wait for each other most of the time, and burn it."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _features(scene: Composite, scenario: WosacScenario) -> StepFeatures:
    """Of the log and all rollouts, [R, E, 80]."""
    count = scene.evaluated
    scored, future = slice(count), slice(CURRENT + 1, None)
    x, y, z, heading = (values[:, scored] for values in (scene.x, scene.y, scene.z, scene.heading))
    speed = kinematics.speed(x, y, z)
    turning, turning_change = kinematics.angular(heading)
    nearest, collision_time = _interaction(scene)
    edge = _road_edge(scene, Edges.of(scenario.road_edges))
    return StepFeatures(
        linear_speed=speed[..., future],
        linear_acceleration=kinematics.acceleration(speed)[..., future],
        angular_speed=turning[..., future],
        angular_acceleration=turning_change[..., future],
        distance_to_nearest_object=nearest,
        collision_per_step=nearest < 0,
        time_to_collision=collision_time,
        distance_to_road_edge=edge,
        offroad_per_step=edge > 0,
        traffic_light_violation_per_step=_violations(scene, scenario)[..., future],
        average_displacement_error=_displacement(scene),
    )


def _interaction(scene: Composite) -> tuple[Tensor, Tensor]:
    future = slice(CURRENT + 1, None)
    position = torch.stack((scene.x, scene.y), dim=-1)[:, :, future]
    heading, valid = scene.heading[..., future], scene.valid[..., future]
    size = scene.size[None, :, None, :2].expand(position.shape)
    speed = kinematics.speed(scene.x, scene.y)[..., future]
    return (
        distance_to_nearest(position, heading, size, valid, scene.evaluated),
        time_to_collision(position, heading, size, valid, speed, scene.evaluated),
    )


def _road_edge(scene: Composite, edges: Edges) -> Tensor:
    part = (slice(None), slice(scene.evaluated), slice(CURRENT + 1, None))
    center = torch.stack([values[part] for values in (scene.x, scene.y, scene.z)], dim=-1)
    size = scene.size[None, : scene.evaluated, None].expand(center.shape)
    return distance_to_road_edge(center, scene.heading[part], size, scene.valid[part], edges)


def _violations(scene: Composite, scenario: WosacScenario) -> Tensor:
    position = torch.stack((scene.x, scene.y), dim=-1)[:, : scene.evaluated]
    valid = scene.valid[:, : scene.evaluated]
    signals = Signals.of(
        scenario.signal_step,
        scenario.signal_lane,
        scenario.signal_state,
        scenario.signal_point,
        valid.shape[-1],
    )
    return red_light_violations(position, valid, surface_street_lanes(scenario), signals)


def _displacement(scene: Composite) -> Tensor:
    """Mean distance from the log over the steps at which it is valid, history included."""
    track = torch.stack([values[:, : scene.evaluated] for values in (scene.x, scene.y, scene.z)])
    away = (track - track[:, :1]).square().sum(0).sqrt()
    valid = scene.valid[0, : scene.evaluated]
    return torch.where(valid, away, 0.0).sum(-1) / valid.sum(-1)
