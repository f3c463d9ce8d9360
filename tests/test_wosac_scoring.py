"""From features to the WOSAC score: numbers worked out by hand, and laws."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from helpers_wosac import made_rollouts, made_scenario
from symphony.errors import ConfigError, DataError
from symphony.wosac.scorer import (
    CHALLENGE_2024,
    CHALLENGE_2025,
    CHALLENGES,
    SimulatedRollouts,
    WosacFeatures,
    compute_features,
    mean_scores,
    object_scores,
    score,
    score_features,
)
from symphony.wosac.scorer.config import BUCKETS, Bernoulli, Histogram
from symphony.wosac.scorer.estimators import (
    bernoulli_log_likelihood,
    bin_of,
    histogram_log_likelihood,
    kernel_log_likelihood,
)


def made_features(**changes: Any) -> WosacFeatures:
    scenario = made_scenario(**changes)
    return compute_features(scenario, made_rollouts(scenario, 4))


def test_bins() -> None:
    values = torch.tensor([-1.0, 0, 1.999, 2, 9.99, 10, 50, math.nan, math.inf, -math.inf])
    assert bin_of(values, Histogram(0.0, 10.0, 5)).tolist() == [0, 0, 0, 1, 4, 4, 4, 4, 4, 0]


def test_histogram_by_hand() -> None:
    # Two rollouts of two steps: three of the four values lie in the first bin, one that is no number in the last.
    simulated = torch.tensor([[[0.5, 0.1]], [[math.nan, 0.9]]])
    log = torch.tensor([[0.2, 1.5, 3.9]])[:, :2]
    estimator = Histogram(0.0, 4.0, 4, pseudocount=0.5)
    found = histogram_log_likelihood(log, simulated, estimator)
    torch.testing.assert_close(found, torch.tensor([[3.5 / 6, 0.5 / 6]]).log())
    apart = histogram_log_likelihood(log, simulated, replace(estimator, independent_timesteps=False))
    torch.testing.assert_close(apart, torch.tensor([[1.5 / 4, 0.5 / 4]]).log())


def test_histogram_for_each_object_or_for_all() -> None:
    simulated = torch.tensor([[[0.5], [1.5]]])
    log = torch.tensor([[0.5], [0.5]])
    estimator = Histogram(0.0, 2.0, 2, pseudocount=0.1)
    torch.testing.assert_close(
        histogram_log_likelihood(log, simulated, estimator).exp(), torch.tensor([[1.1 / 1.2], [0.1 / 1.2]])
    )
    pooled = histogram_log_likelihood(log, simulated, replace(estimator, aggregate_objects=True))
    torch.testing.assert_close(pooled.exp(), torch.full((2, 1), 0.5))


def test_bernoulli_by_hand() -> None:
    simulated = torch.tensor([[True, False], [True, False], [False, False]])
    log = torch.tensor([True, True])
    found = bernoulli_log_likelihood(log, simulated, Bernoulli(0.1)).exp()
    torch.testing.assert_close(found, torch.tensor([2.1 / 3.2, 0.1 / 3.2]))
    pooled = bernoulli_log_likelihood(log, simulated, Bernoulli(0.1, aggregate_objects=True)).exp()
    torch.testing.assert_close(pooled, torch.full((2,), 2.1 / 6.2))


def test_kernel_density_of_the_only_sample_is_one() -> None:
    value = torch.tensor([[0.3, 0.7]])
    torch.testing.assert_close(
        kernel_log_likelihood(value, value[None], 0.1, independent_timesteps=False), 0 * value
    )
    both = kernel_log_likelihood(value, value[None], 0.1)
    torch.testing.assert_close(both.exp(), torch.full((1, 2), (1 + math.exp(-8)) / 2))


@given(st.integers(0, 2**32 - 1), st.booleans(), st.booleans())
def test_likelihoods_of_all_bins_sum_to_one(seed: int, independent: bool, aggregate: bool) -> None:
    generator = torch.Generator().manual_seed(seed)
    simulated = 3 * torch.randn(5, 2, 4, generator=generator)
    estimator = Histogram(-2.0, 2.0, 4, 0.1, independent, aggregate)
    centers = torch.tensor([-1.5, -0.5, 0.5, 1.5])
    total = sum(histogram_log_likelihood(c.expand(2, 4), simulated, estimator).exp() for c in centers)
    torch.testing.assert_close(total, torch.ones(2, 4))


def test_weights_sum_to_one_and_the_years_differ_in_two() -> None:
    for config in CHALLENGES.values():
        assert sum(part.weight for part in config.components.values()) == pytest.approx(1)
    other = {
        name for name, part in CHALLENGE_2024.components.items() if part != CHALLENGE_2025.components[name]
    }
    assert other == {"distance_to_road_edge", "traffic_light_violation"}
    assert sorted(sum(BUCKETS.values(), ())) == sorted(CHALLENGE_2025.components)


@pytest.mark.parametrize("year", CHALLENGES)
def test_the_metametric_is_the_weighted_sum(year: str) -> None:
    config = CHALLENGES[year]
    scores = score_features(made_features(), config)
    weights = {name: part.weight for name, part in config.components.items()}
    assert scores.metametric == pytest.approx(sum(weights[n] * v for n, v in scores.likelihoods.items()))
    shares = {bucket: sum(weights[name] for name in names) for bucket, names in BUCKETS.items()}
    assert scores.metametric == pytest.approx(sum(shares[b] * v for b, v in scores.buckets.items()))
    assert all(0 < value <= 1 for value in scores.likelihoods.values())


def test_steps_at_which_the_log_is_not_valid_do_not_count() -> None:
    features = made_features()
    hidden = features.log_valid.clone()
    hidden[:, 40:60] = False
    masked = replace(features, log_valid=hidden)
    wild = features.log.distance_to_road_edge.clone()
    wild[:, 40:60] = 1e9
    changed = replace(masked, log=replace(features.log, distance_to_road_edge=wild))
    assert score_features(changed) == score_features(masked) != score_features(features)


def test_a_flag_counts_only_where_the_log_is_valid() -> None:
    features = made_features()
    flags = torch.zeros_like(features.simulated.offroad_per_step)
    flags[0, 0, 50] = True
    one = replace(features, simulated=replace(features.simulated, offroad_per_step=flags))
    assert score_features(one).simulated_offroad_rate == pytest.approx(1 / 8)
    hidden = features.log_valid.clone()
    hidden[0, 50] = False
    assert score_features(replace(one, log_valid=hidden)).simulated_offroad_rate == 0


def test_only_vehicles_have_a_time_to_collision_and_run_red_lights() -> None:
    features = made_features()
    walking = replace(features, object_type=torch.tensor([2, 1]))
    scores = score_features(walking)
    # The first object runs the light in log and rollouts; as a pedestrian it is taken not to, and the rate stays.
    assert scores.simulated_traffic_light_violation_rate == 0.5
    assert scores.likelihoods["traffic_light_violation"] == pytest.approx(4.001 / 4.002, abs=1e-6)
    assert object_scores(walking)[0]["time_to_collision_likelihood"] != pytest.approx(0)
    assert math.isnan(object_scores(walking)[0]["time_to_collision_likelihood"])
    with pytest.raises(DataError, match="no step") as caught:
        score_features(replace(features, object_type=torch.tensor([2, 3])))
    assert caught.value.field == "time_to_collision"


def test_displacement_of_the_best_rollout() -> None:
    scenario = made_scenario()
    log = made_rollouts(scenario, 2, noise=0.0)
    y = log.y.clone()
    y[0] += 1.0
    y[1, 0] += 4.0
    found = score(scenario, replace(log, y=y))
    assert found.average_displacement_error == pytest.approx((1 + 1 + 4 + 0) / 4 * 80 / 91, rel=1e-5)
    assert found.min_average_displacement_error == pytest.approx(80 / 91, rel=1e-5)
    parts = object_scores(compute_features(scenario, replace(log, y=y)))
    for name, values in (("average_displacement_error", (2.5, 0.5)), ("min_ade", (1.0, 0.0))):
        expected = [value * 80 / 91 for value in values]
        assert [part[name] for part in parts] == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_playback_scores_better_than_noise() -> None:
    scenario = made_scenario()
    scores = [score(scenario, made_rollouts(scenario, 4, noise=noise)) for noise in (0.0, 0.5, 3.0)]
    assert scores[0].metametric > scores[1].metametric > scores[2].metametric


def test_the_same_rollouts_twice_score_almost_the_same() -> None:
    # But for the pseudocounts, whose share is halved.
    scenario = made_scenario()
    once = made_rollouts(scenario, 16)
    twice = SimulatedRollouts(
        once.object_id, *(getattr(once, n).repeat(2, 1, 1) for n in ("x", "y", "z", "heading"))
    )
    a, b = score(scenario, once), score(scenario, twice)
    assert a.metametric == pytest.approx(b.metametric, abs=2e-3)
    assert a.average_displacement_error == pytest.approx(b.average_displacement_error)


def test_means_over_scenarios() -> None:
    scores = [score_features(made_features(seed=seed)) for seed in (0, 1, 2)]
    mean = mean_scores(scores).to_dict()
    assert set(mean) == set(scores[0].to_dict())
    for name, value in mean.items():
        assert value == pytest.approx(sum(s.to_dict()[name] for s in scores) / 3)


def test_errors_name_the_scenario() -> None:
    scenario = made_scenario()
    with pytest.raises(DataError) as caught:
        score(replace(scenario, object_type=torch.full((4,), 2)), made_rollouts(scenario))
    assert caught.value.segment == "made"


@pytest.mark.parametrize("make", [
    lambda: Histogram(1.0, 1.0, 5),
    lambda: Histogram(0.0, 1.0, 0),
    lambda: Histogram(0.0, 1.0, 5, pseudocount=0.0),
    lambda: Bernoulli(0.0),
])  # fmt: skip
def test_estimators_that_cannot_be(make: Any) -> None:
    with pytest.raises(ConfigError):
        make()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_device_does_not_matter() -> None:
    scenario = made_scenario()
    rollouts = made_rollouts(scenario, 8)
    here, there = score(scenario, rollouts), score(scenario.to("cuda"), rollouts.to("cuda"))
    assert here.to_dict() == pytest.approx(there.to_dict(), abs=1e-3)
