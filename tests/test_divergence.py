"""The share of sampling in a divergence."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from symphony.metrics import jensen_shannon, sampled_divergence, sampling_floor

BINS = 15


def perfect(segments: int, rollouts: int, rng: Any, copies: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Visits of a policy that does what the log does: both drawn from what is usual in each segment."""
    usual = rng.dirichlet(np.full(BINS, 0.3), segments)
    policy = np.stack([rng.multinomial(rollouts, p) for p in usual])
    return policy, np.stack([rng.multinomial(1, p) for p in usual])


@pytest.mark.parametrize(("segments", "rollouts"), [(100, 4), (100, 16), (400, 4)])
def test_a_perfect_policy_is_corrected_to_zero(segments: int, rollouts: int) -> None:
    rng = np.random.default_rng(segments + rollouts + 1)
    trials = [sampled_divergence(*perfect(segments, rollouts, rng)) for _ in range(60)]
    found = np.array([[one.value, one.corrected, one.error] for one in trials])
    value, corrected, error = found.mean(0)
    assert abs(corrected) < min(error, value / 4), "zero within its error"
    assert found[:, 1].std() < 2 * error


def test_what_differs_is_left_when_the_bias_is_taken_away() -> None:
    rng = np.random.default_rng(0)
    p, q = rng.dirichlet(np.ones(BINS), 2)
    middle = (p + q) / 2
    true = 0.5 * (p * np.log(p / middle) + q * np.log(q / middle)).sum()
    found = [sampled_divergence(rng.multinomial(4, p, 200), rng.multinomial(1, q, 200)) for _ in range(60)]
    corrected, value = (np.array(x) for x in ([d.corrected for d in found], [d.value for d in found]))
    assert abs(corrected.mean() - true) < 3 * corrected.std() / math.sqrt(60) + 0.02 * true
    assert abs(value.mean() - true) > abs(corrected.mean() - true)
    assert np.mean([d.error for d in found]) == pytest.approx(corrected.std(), rel=0.3)


def test_of_two_samples_the_error_is_half_the_difference_of_what_each_says() -> None:
    counts, log = np.array([[3, 1], [1, 5]]), np.array([[1, 0], [1, 1]])
    found = sampled_divergence(counts, log)
    whole = float(jensen_shannon(counts.sum(0), log.sum(0)))
    each = [2 * whole - float(jensen_shannon(counts[k], log[k])) for k in (1, 0)]
    assert found.value == pytest.approx(whole)
    assert found.corrected == pytest.approx(sum(each) / 2)
    assert found.error == pytest.approx(abs(each[0] - each[1]) / 2)
    alone = sampled_divergence(counts[:1], log[:1])
    assert (alone.value > 0, *np.isnan([alone.corrected, alone.error])) == (True, True, True)


@pytest.mark.parametrize("segments", [50, 200])
def test_the_floor_is_what_a_log_scores_against_what_it_was_drawn_from(segments: int) -> None:
    rng = np.random.default_rng(segments)
    p = rng.dirichlet(np.full(BINS, 0.5))
    logs = [np.eye(BINS, dtype=int)[rng.choice(BINS, segments, p=p)] for _ in range(60)]
    floors = [sampling_floor(log) for log in logs]
    # One of the two samples is as large as life, as many rollouts would be.
    other = [float(jensen_shannon(log.sum(0), p)) for log in logs]
    assert np.mean(floors) == pytest.approx(np.mean(other), rel=0.25)
    assert sampling_floor(np.concatenate([logs[0]] * 4)) == pytest.approx(floors[0] / 4, rel=0.25)
    assert sampling_floor(np.array([[1, 0], [0, 0]])) == 0  # some draws have no visit at all
    pairs = [float(jensen_shannon(one.sum(0), two.sum(0))) for one, two in pairwise(logs)]
    assert np.mean(pairs) == pytest.approx(2 * np.mean(floors), rel=0.25)
    # A perfect policy on the very segments scores less, if segments differ in what is usual.
    trials = [perfect(segments, 1600, rng) for _ in range(20)]
    scored = np.mean([sampled_divergence(policy, log).value for policy, log in trials])
    assert scored < np.mean([sampling_floor(log) for _, log in trials])
