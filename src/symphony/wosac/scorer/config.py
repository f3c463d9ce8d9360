"""The components of the score in the challenges of 2024 and 2025: their features, weights and bins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

CURRENT, FUTURE = 10, 80
"""Index of the last step that is known to the simulator, number of steps that are simulated."""
DT = 0.1  # seconds per step
ROLLOUTS = 32  # rollouts of a scenario that the challenge asks for


@dataclass(frozen=True)
class Component:
    """A component of the score."""

    weight: float  # its weight in the metametric
    #: (low, high, number of bins) of the histogram of a number, in m, s and rad; what lies outside counts as
    #: low or high. None for a yes or no, such as whether an object ever collides.
    bins: tuple[float, float, int] | None = None


WosacConfig = Mapping[str, Component]  # the components of a challenge by their names

BUCKETS: Mapping[str, tuple[str, ...]] = {
    "kinematic": ("linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration"),
    "interactive": ("distance_to_nearest_object", "collision_indication", "time_to_collision"),
    "map_based": ("distance_to_road_edge", "offroad_indication", "traffic_light_violation"),
}
"""The groups of components that the leaderboard shows."""


def _challenge(road_edge: float, traffic_light: float) -> WosacConfig:
    return {
        "linear_speed": Component(0.05, (0.0, 25.0, 10)),
        "linear_acceleration": Component(0.05, (-12.0, 12.0, 11)),
        "angular_speed": Component(0.05, (-0.628, 0.628, 11)),
        "angular_acceleration": Component(0.05, (-3.14, 3.14, 11)),
        "distance_to_nearest_object": Component(0.10, (-5.0, 40.0, 10)),
        "collision_indication": Component(0.25),
        "time_to_collision": Component(0.10, (0.0, 5.0, 10)),
        "distance_to_road_edge": Component(road_edge, (-20.0, 40.0, 10)),
        "offroad_indication": Component(0.25),
        "traffic_light_violation": Component(traffic_light),
    }


CHALLENGES: Mapping[str, WosacConfig] = {"2024": _challenge(0.10, 0.0), "2025": _challenge(0.05, 0.05)}
