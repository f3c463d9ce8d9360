"""The score of rollouts of one scenario, and the mean over scenarios."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from symphony.errors import DataError
from symphony.wosac.scorer.config import (
    BUCKETS,
    CHALLENGE_2025,
    CURRENT,
    Bernoulli,
    FlagComponent,
    NumberComponent,
    WosacConfig,
)
from symphony.wosac.scorer.estimators import bernoulli_log_likelihood, histogram_log_likelihood
from symphony.wosac.scorer.features import WosacFeatures, compute_features
from symphony.wosac.scorer.kinematics import speed_mask
from symphony.wosac.scorer.scenario import VEHICLE, SimulatedRollouts, WosacScenario

_FLAGS = {
    "collision_indication": "collision_per_step",
    "offroad_indication": "offroad_per_step",
    "traffic_light_violation": "traffic_light_violation_per_step",
}
"""Features that the yes-or-no components come from."""
_RATES = {
    "simulated_collision_rate": "collision_per_step",
    "simulated_offroad_rate": "offroad_per_step",
    "simulated_traffic_light_violation_rate": "traffic_light_violation_per_step",
}


@dataclass(frozen=True)
class WosacScores:
    """Scores of one scenario, or means over several.

    Attributes:
        metametric: weighted sum of the likelihoods, the score of the challenge.
        likelihoods: of every component, 0 to 1, by name.
        buckets: weighted means of the likelihoods of each group of components.
        average_displacement_error: metres from the log, mean over rollouts and objects, history included.
        min_average_displacement_error: that of the best rollout.
        simulated_collision_rate: share of rollouts and objects that collide at a step at which the log is valid.
        simulated_offroad_rate: share that leave the road.
        simulated_traffic_light_violation_rate: share that run a red light, whatever they are.
    """

    metametric: float
    likelihoods: Mapping[str, float]
    buckets: Mapping[str, float]
    average_displacement_error: float
    min_average_displacement_error: float
    simulated_collision_rate: float
    simulated_offroad_rate: float
    simulated_traffic_light_violation_rate: float

    def to_dict(self) -> dict[str, float]:
        """All of it, flat, with ``_likelihood`` after the components' names."""
        return {
            "metametric": self.metametric,
            **{f"{name}_likelihood": value for name, value in self.likelihoods.items()},
            **{f"{name}_metrics": value for name, value in self.buckets.items()},
            "average_displacement_error": self.average_displacement_error,
            "min_ade": self.min_average_displacement_error,
            "simulated_collision_rate": self.simulated_collision_rate,
            "simulated_offroad_rate": self.simulated_offroad_rate,
            "simulated_traffic_light_violation_rate": self.simulated_traffic_light_violation_rate,
        }


def score(
    scenario: WosacScenario, rollouts: SimulatedRollouts, config: WosacConfig = CHALLENGE_2025
) -> WosacScores:
    """Score the rollouts of a scenario.

    Raises:
        DataError: the two don't fit together, or there is nothing to score a component with; names scenario, field
            and agent.
    """
    try:
        return score_features(compute_features(scenario, rollouts), config)
    except DataError as error:
        raise error.at(segment=scenario.scenario_id) from None


def score_features(features: WosacFeatures, config: WosacConfig = CHALLENGE_2025) -> WosacScores:
    """Score features that were computed before.

    Raises:
        DataError: at no step the log says anything about a component; names it.
    """
    likelihoods = {}
    for name, values in log_likelihoods(features, config).items():
        mask = component_mask(features, name)
        _check(mask, name)
        likelihoods[name] = math.exp(values[mask].double().mean().item())
    weights = {name: component.weight for name, component in config.components.items()}
    displacement = features.simulated.average_displacement_error
    rates = {
        name: _ever(features, flag, vehicles=False)[1].float().mean().item() for name, flag in _RATES.items()
    }
    return WosacScores(
        metametric=sum(weights[name] * value for name, value in likelihoods.items()),
        likelihoods=likelihoods,
        buckets={bucket: _mean(likelihoods, weights, names) for bucket, names in BUCKETS.items()},
        average_displacement_error=displacement.mean().item(),
        min_average_displacement_error=displacement.mean(-1).amin().item(),
        **rates,
    )


def check_scored(scenario: WosacScenario, config: WosacConfig = CHALLENGE_2025) -> None:
    """See that the log of a scenario says something about every component, before anything is simulated.

    Raises:
        DataError: it doesn't, such as one without vehicles or a future; names scenario and component.
    """
    rows = torch.isin(scenario.object_id, scenario.evaluated)
    valid, kind = scenario.valid[rows, CURRENT + 1 :], scenario.object_type[rows]
    try:
        for name in config.components:
            _check(_mask(valid, kind, name), name)
    except DataError as error:
        raise error.at(segment=scenario.scenario_id) from None


def _check(mask: Tensor, name: str) -> None:
    if not mask.any():
        raise DataError("the log is valid at no step that could be scored", field=name)


def object_scores(features: WosacFeatures, config: WosacConfig = CHALLENGE_2025) -> list[dict[str, Any]]:
    """What each scored object adds: the likelihoods of its own log, its errors and the shares of its rollouts.

    The score of the scenario is no mean of these: a scenario's likelihoods take all objects' steps together. NaN
    where the object has no step to score.
    """
    parts: dict[str, list[Any]] = {
        "object_id": features.object_id.tolist(),
        "object_type": features.object_type.tolist(),
    }
    for name, values in log_likelihoods(features, config).items():
        mask = component_mask(features, name).view(len(values), -1)
        total = torch.where(mask, values.view(len(values), -1), 0.0).sum(-1)
        parts[f"{name}_likelihood"] = (total / mask.sum(-1)).exp().tolist()
    displacement = features.simulated.average_displacement_error
    parts["average_displacement_error"] = displacement.mean(0).tolist()
    parts["min_ade"] = displacement.amin(0).tolist()
    for name, flag in _RATES.items():
        parts[name] = _ever(features, flag, vehicles=False)[1].float().mean(0).tolist()
    return [{name: values[k] for name, values in parts.items()} for k in range(len(features.object_id))]


def log_likelihoods(features: WosacFeatures, config: WosacConfig) -> dict[str, Tensor]:
    """ln of the likelihood of what was logged, for every component: [E, 80], or [E] of yes or no; not masked."""
    found = {}
    for name, component in config.components.items():
        if isinstance(component, NumberComponent):
            log, simulated = getattr(features.log, name), getattr(features.simulated, name)
            found[name] = histogram_log_likelihood(log, simulated, component.estimator)
        elif isinstance(component, FlagComponent):
            found[name] = _flag_likelihood(features, name, component.estimator)
    return found


def component_mask(features: WosacFeatures, name: str) -> Bool[Tensor, " E *steps"]:
    """Where a component's likelihood counts: [E, 80], or [E] of yes or no."""
    return _mask(features.log_valid, features.object_type, name)


def _mask(valid: Tensor, kind: Tensor, name: str) -> Tensor:
    if name in _FLAGS:
        return torch.ones_like(valid[:, 0])
    if name in {"linear_speed", "angular_speed"}:
        return speed_mask(valid)
    if name in {"linear_acceleration", "angular_acceleration"}:
        return speed_mask(speed_mask(valid))
    if name == "time_to_collision":
        return valid & (kind == VEHICLE)[:, None]
    return valid


def _flag_likelihood(features: WosacFeatures, name: str, estimator: Bernoulli) -> Tensor:
    log, simulated = _ever(features, _FLAGS[name], vehicles=name == "traffic_light_violation")
    return bernoulli_log_likelihood(log, simulated, estimator)


def _ever(features: WosacFeatures, flag: str, *, vehicles: bool) -> tuple[Tensor, Tensor]:
    """Whether a flag is set at any step at which the log is valid, [E] of the log and [R, E] of the rollouts."""
    log, simulated = (
        (getattr(source, flag) & features.log_valid).any(-1) for source in (features.log, features.simulated)
    )
    kind = (features.object_type == VEHICLE) | (not vehicles)
    return log & kind, simulated & kind


def _mean(values: Mapping[str, float], weights: Mapping[str, float], names: Iterable[str]) -> float:
    names = tuple(names)
    return sum(weights[name] * values[name] for name in names) / sum(weights[name] for name in names)


def mean_scores(scores: Iterable[WosacScores]) -> WosacScores:
    """The mean over scenarios of every number; needs at least one."""
    every = list(scores)

    def mean(*path: str) -> Any:
        first = getattr(every[0], path[0])
        if isinstance(first, Mapping):
            return {key: math.fsum(getattr(s, path[0])[key] for s in every) / len(every) for key in first}
        return math.fsum(getattr(s, path[0]) for s in every) / len(every)

    return WosacScores(**{name: mean(name) for name in WosacScores.__dataclass_fields__})
