"""The score of rollouts of one scenario, and the mean over scenarios."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from symphony.errors import DataError
from symphony.wosac.scorer.config import BUCKETS, CHALLENGES, CURRENT, WosacConfig
from symphony.wosac.scorer.features import WosacFeatures, compute_features
from symphony.wosac.scorer.scenario import VEHICLE, SimulatedRollouts, WosacScenario

_COUNTED, _FLAGGED = 0.1, 0.001
"""What is added to the count of every bin of a histogram, and to that of yes and of no."""
_FLAGS = {
    "collision_indication": "collision_per_step",
    "offroad_indication": "offroad_per_step",
    "traffic_light_violation": "traffic_light_violation_per_step",
}
"""Features that the yes-or-no components come from."""
_RATES = {f"simulated_{flag.removesuffix('_per_step')}_rate": flag for flag in _FLAGS.values()}


def score(
    scenario: WosacScenario, rollouts: SimulatedRollouts, config: WosacConfig = CHALLENGES["2025"]
) -> dict[str, float]:
    """Score the rollouts of a scenario.

    Returns ``metametric``, the score of the challenge: the weighted sum of the likelihoods; each component's
    likelihood (``NAME_likelihood``, 0 to 1); the weighted means of the groups of components (``kinematic_metrics``,
    ``interactive_metrics``, ``map_based_metrics``); metres from the log with the history, as the mean over rollouts
    and objects (``average_displacement_error``) and of the best rollout (``min_ade``); shares of rollouts and objects
    that collide, leave the road or run a red light at a step with a valid log (``simulated_collision_rate`` etc.).

    A :class:`DataError` names scenario, field and agent where the two don't fit, or a component can't be scored.
    """
    try:
        return score_features(compute_features(scenario, rollouts), config)
    except DataError as error:
        raise error.at(segment=scenario.scenario_id) from None


def score_features(features: WosacFeatures, config: WosacConfig = CHALLENGES["2025"]) -> dict[str, float]:
    """Return the same as :func:`score`, from features that were computed before.

    Raises a :class:`DataError` where at no step the log says anything about a component; names it.
    """
    found = {}
    for name, values in log_likelihoods(features, config).items():
        mask = _mask(features.log_valid, features.object_type, name)
        _check(mask, name)
        found[name] = math.exp(values[mask].double().mean().item())
    weight = {name: component.weight for name, component in config.items()}
    displacement = features.simulated["average_displacement_error"]
    return {
        "metametric": sum(weight[name] * value for name, value in found.items()),
        **{f"{name}_likelihood": value for name, value in found.items()},
        **{
            f"{bucket}_metrics": sum(weight[n] * found[n] for n in names) / sum(weight[n] for n in names)
            for bucket, names in BUCKETS.items()
        },
        "average_displacement_error": displacement.mean().item(),
        "min_ade": displacement.mean(-1).amin().item(),
        **{name: _ever(features, flag)[1].float().mean().item() for name, flag in _RATES.items()},
    }


def mean_scores(scores: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean over scenarios of every number; needs at least one."""
    every = list(scores)
    return {name: math.fsum(one[name] for one in every) / len(every) for name in every[0]}


def check_scored(scenario: WosacScenario, config: WosacConfig = CHALLENGES["2025"]) -> None:
    """Check that the log of a scenario says something about every component, before anything is simulated.

    Raises:
        DataError: it doesn't, such as one without vehicles or a future; names scenario and component.
    """
    rows = np.isin(scenario.object_id, scenario.evaluated)
    valid, kind = scenario.valid[rows, CURRENT + 1 :], scenario.object_type[rows]
    try:
        for name in config:
            _check(_mask(torch.from_numpy(valid), torch.from_numpy(kind), name), name)
    except DataError as error:
        raise error.at(segment=scenario.scenario_id) from None


def _check(mask: Tensor, name: str) -> None:
    if not mask.any():
        raise DataError("the log is valid at no step that could be scored", field=name)


def object_scores(features: WosacFeatures, config: WosacConfig = CHALLENGES["2025"]) -> list[dict[str, Any]]:
    """Return the part of each scored object: the likelihoods of its own log, its errors, the shares of its rollouts.

    The score of the scenario is not the mean of these: a scenario's likelihoods take all objects' steps together. NaN
    where the object has no step to score.
    """
    parts: dict[str, list[Any]] = {
        "object_id": features.object_id.tolist(),
        "object_type": features.object_type.tolist(),
    }
    for name, values in log_likelihoods(features, config).items():
        mask = _mask(features.log_valid, features.object_type, name).view(len(values), -1)
        total = torch.where(mask, values.view(len(values), -1), 0.0).sum(-1)
        parts[f"{name}_likelihood"] = (total / mask.sum(-1)).exp().tolist()
    displacement = features.simulated["average_displacement_error"]
    parts["average_displacement_error"] = displacement.mean(0).tolist()
    parts["min_ade"] = displacement.amin(0).tolist()
    for name, flag in _RATES.items():
        parts[name] = _ever(features, flag)[1].float().mean(0).tolist()
    return [{name: values[k] for name, values in parts.items()} for k in range(len(features.object_id))]


def log_likelihoods(features: WosacFeatures, config: WosacConfig) -> dict[str, Tensor]:
    """Return ln of the likelihood of the log for every component: [E, 80], or [E] of yes or no; not masked."""
    found = {}
    for name, component in config.items():
        if component.bins is None:
            log, simulated = _ever(features, _FLAGS[name], vehicles=name == "traffic_light_violation")
            found[name] = flag_log_likelihood(log, simulated)
        else:
            log, simulated = features.log[name], features.simulated[name]
            found[name] = histogram_log_likelihood(log, simulated, component.bins)
    return found


def histogram_log_likelihood(
    log: Float[Tensor, "E T"], simulated: Float[Tensor, "R E T"], bins: tuple[float, float, int]
) -> Float[Tensor, "E T"]:
    """Return ln of the share of an object's simulated values, smoothed, in the bin of the logged value. Every
    simulated value counts, also at steps at which the log is not valid.
    """
    objects = torch.arange(len(log))[:, None]
    counts = torch.zeros(len(log) * bins[2])
    flat = (objects * bins[2] + bin_of(simulated, bins)).flatten()
    counts.scatter_add_(0, flat, torch.ones_like(flat, dtype=torch.float32))
    counts = counts.view(len(log), -1) + _COUNTED
    return (counts.gather(1, bin_of(log, bins)) / counts.sum(-1, keepdim=True)).log()


def bin_of(values: Float[Tensor, "*shape"], bins: tuple[float, float, int]) -> Int[Tensor, "*shape"]:
    """Return the index of each value's bin: outside counts as the nearest bin, NaN as the last one."""
    inner = bin_edges(bins)[1:-1].contiguous()
    index = torch.bucketize(values.contiguous(), inner, right=True)
    return torch.where(values.isnan(), bins[2] - 1, index)


def bin_edges(bins: tuple[float, float, int]) -> Float[Tensor, " K"]:
    """Return the bins' edges in float32, as the official scorer rounds them."""
    low, high = torch.tensor(bins[:2], dtype=torch.float32)
    edges = low + torch.arange(bins[2] + 1, dtype=torch.float32) * ((high - low) / bins[2])
    edges[-1] = high
    return edges


def flag_log_likelihood(log: Bool[Tensor, " E"], simulated: Bool[Tensor, "R E"]) -> Float[Tensor, " E"]:
    """Return ln of the share of rollouts, smoothed, that agree with the log."""
    agree = (simulated == log).float().sum(0)
    return ((agree + _FLAGGED) / (len(simulated) + 2 * _FLAGGED)).log()


def speed_mask(valid: Bool[Tensor, "*batch T"]) -> Bool[Tensor, "*batch T"]:
    """Return where the steps before and after are valid; the step itself need not be. False at both ends. Applied to
    itself it is the mask of the acceleration.
    """
    result = torch.zeros_like(valid)
    result[..., 1:-1] = valid[..., 2:] & valid[..., :-2]
    return result


def _mask(valid: Tensor, kind: Tensor, name: str) -> Tensor:
    """Return where a component's likelihood counts: [E, 80], or [E] of yes or no."""
    if name in _FLAGS:
        return torch.ones_like(valid[:, 0])
    if name in {"linear_speed", "angular_speed"}:
        return speed_mask(valid)
    if name in {"linear_acceleration", "angular_acceleration"}:
        return speed_mask(speed_mask(valid))
    if name == "time_to_collision":
        return valid & (kind == VEHICLE)[:, None]
    return valid


def _ever(features: WosacFeatures, flag: str, *, vehicles: bool = False) -> tuple[Tensor, Tensor]:
    """Return whether a flag is set at a valid step, [E] of the log, [R, E] of rollouts; maybe of vehicles alone."""
    log, simulated = ((source[flag] & features.log_valid).any(-1) for source in (features.log, features.simulated))
    kind = (features.object_type == VEHICLE) | (not vehicles)
    return log & kind, simulated & kind
