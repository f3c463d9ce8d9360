"""How features become a score: ranges, bins, smoothing and weights of the challenges of 2024 and 2025."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType

from symphony.errors import ConfigError

CURRENT, FUTURE = 10, 80
"""Index of the last step that is known to the simulator, number of steps that are simulated."""
DT = 0.1
"""Seconds per step."""
ROLLOUTS = 32
"""Rollouts of a scenario that the challenge asks for."""


@dataclass(frozen=True)
class Histogram:
    """Likelihood of a number under a histogram of the simulated ones.

    Attributes:
        low: smallest value; what is below counts as it.
        high: greatest value; what is above counts as it, and so does what is not a number.
        bins: number of bins of equal width.
        pseudocount: added to every bin's count.
        independent_timesteps: one histogram for all steps of an object, or one for each step.
        aggregate_objects: one histogram for all objects, or one for each object.
    """

    low: float
    high: float
    bins: int
    pseudocount: float = 0.1
    independent_timesteps: bool = True
    aggregate_objects: bool = False

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ConfigError(f"a histogram from {self.low:g} to {self.high:g} has no width")
        if self.bins < 1:
            raise ConfigError(f"a histogram needs a bin, has {self.bins}")
        if not self.pseudocount > 0:
            raise ConfigError(f"a pseudocount must be positive, is {self.pseudocount:g}")


@dataclass(frozen=True)
class Bernoulli:
    """Likelihood of a yes or no, such as whether an object ever collides.

    Attributes:
        pseudocount: added to the count of yes and to that of no.
        aggregate_objects: one estimate for all objects, or one for each object.
    """

    pseudocount: float = 0.001
    aggregate_objects: bool = False

    def __post_init__(self) -> None:
        if not self.pseudocount > 0:
            raise ConfigError(f"a pseudocount must be positive, is {self.pseudocount:g}")


@dataclass(frozen=True)
class NumberComponent:
    """A component of the score that compares numbers: its weight in the metametric and its estimator."""

    weight: float
    estimator: Histogram


@dataclass(frozen=True)
class FlagComponent:
    """A component of the score that compares yes or no: its weight in the metametric and its estimator."""

    weight: float
    estimator: Bernoulli = Bernoulli()


@dataclass(frozen=True)
class WosacConfig:
    """The components of the score, in m, s and rad."""

    name: str
    linear_speed: NumberComponent
    linear_acceleration: NumberComponent
    angular_speed: NumberComponent
    angular_acceleration: NumberComponent
    distance_to_nearest_object: NumberComponent
    collision_indication: FlagComponent
    time_to_collision: NumberComponent
    distance_to_road_edge: NumberComponent
    offroad_indication: FlagComponent
    traffic_light_violation: FlagComponent

    @property
    def components(self) -> Mapping[str, NumberComponent | FlagComponent]:
        """Every component by its name."""
        names = [field.name for field in fields(self) if field.name != "name"]
        return MappingProxyType({name: getattr(self, name) for name in names})


BUCKETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "kinematic": ("linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration"),
        "interactive": ("distance_to_nearest_object", "collision_indication", "time_to_collision"),
        "map_based": ("distance_to_road_edge", "offroad_indication", "traffic_light_violation"),
    }
)
"""The groups of components that the leaderboard shows."""


def _challenge(name: str, road_edge: float, traffic_light: float) -> WosacConfig:
    return WosacConfig(
        name=name,
        linear_speed=NumberComponent(0.05, Histogram(0.0, 25.0, 10)),
        linear_acceleration=NumberComponent(0.05, Histogram(-12.0, 12.0, 11)),
        angular_speed=NumberComponent(0.05, Histogram(-0.628, 0.628, 11)),
        angular_acceleration=NumberComponent(0.05, Histogram(-3.14, 3.14, 11)),
        distance_to_nearest_object=NumberComponent(0.10, Histogram(-5.0, 40.0, 10)),
        collision_indication=FlagComponent(0.25),
        time_to_collision=NumberComponent(0.10, Histogram(0.0, 5.0, 10)),
        distance_to_road_edge=NumberComponent(road_edge, Histogram(-20.0, 40.0, 10)),
        offroad_indication=FlagComponent(0.25),
        traffic_light_violation=FlagComponent(traffic_light),
    )


CHALLENGE_2024 = _challenge("2024", road_edge=0.10, traffic_light=0.0)
CHALLENGE_2025 = _challenge("2025", road_edge=0.05, traffic_light=0.05)
CHALLENGES: Mapping[str, WosacConfig] = MappingProxyType(
    {c.name: c for c in (CHALLENGE_2024, CHALLENGE_2025)}
)
