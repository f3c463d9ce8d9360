"""The table of metrics by hand, against scipy, and its laws."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from symphony.metrics import RolloutMetrics, curvature_histogram, jensen_shannon

NUMBERS = ("collision_rate", "offroad_time", "ade", "min_sade", "curvature_jsd")


def random_inputs(seed, batch=7, rollouts=4, agents=2, steps=5):
    rng = np.random.default_rng(seed)
    shape = batch, rollouts, agents, steps
    return {
        "segment_ids": [f"s{k:02d}" for k in rng.permutation(batch)],
        "collided": torch.tensor(rng.random(shape) < 0.05),
        "offroad": torch.tensor(rng.random(shape) < 0.1),
        "displacement": torch.tensor(rng.gamma(2, 2, shape), dtype=torch.float32),
        "simulated": torch.ones(shape, dtype=torch.bool),
        "logged": torch.tensor(rng.random((batch, agents, steps)) < 0.8),
        "curvature": [rng.normal(0, 0.1, rng.integers(0, 9)) for _ in range(batch)],
        "curvature_log": [rng.normal(0, 0.2, rng.integers(1, 3)) for _ in range(batch)],
    }


def part(inputs, take):
    """The same for some of the segments."""
    return {k: v[take] if isinstance(v, torch.Tensor) else [v[i] for i in take] for k, v in inputs.items()}


def scored(*inputs):
    metrics = RolloutMetrics()
    for one in inputs:
        metrics.update(**one)
    return metrics


def test_by_hand():
    """Two segments, two rollouts, two agents, two steps."""
    collided = torch.zeros(2, 2, 2, 2, dtype=torch.bool)
    collided[0, 1, 0, :] = True  # one rollout of the four, whichever steps
    offroad = torch.zeros(2, 2, 2, 2, dtype=torch.bool)
    offroad[0, 0, 0, 0] = offroad[1, 1, 1, 0] = offroad[1, 1, 1, 1] = True  # 3 of 16 agent-steps
    # Segment 0: agent 0 is 1 m off in rollout 0 and 2 m in rollout 1, agent 1 is 5 m and 3 m off. Together rollout 1
    # is nearer (10 < 12), although agent 0 alone is nearer in rollout 0.
    displacement = torch.zeros(2, 2, 2, 2)
    displacement[0, 0, 0], displacement[0, 0, 1] = 1, 5
    displacement[0, 1, 0], displacement[0, 1, 1] = 2, 3
    # Segment 1: of agent 1 only the first step is logged.
    displacement[1, 0], displacement[1, 1] = 4, 1
    displacement[1, :, 1, 1] = 1e6
    logged = torch.ones(2, 2, 2, dtype=torch.bool)
    logged[1, 1, 1] = False
    metrics = RolloutMetrics()
    metrics.update(
        ["a", "b"],
        collided=collided,
        offroad=offroad,
        displacement=displacement,
        simulated=torch.ones_like(collided),
        logged=logged,
        curvature=[np.array([0.1, 0.1]), np.array([0.1, -0.2])],
        curvature_log=[np.array([0.1]), np.array([-0.2])],
    )
    numbers = metrics.compute()
    assert numbers["collision_rate"] == pytest.approx(25)
    assert numbers["offroad_time"] == pytest.approx(100 * 3 / 16)
    assert numbers["ade"] == pytest.approx(((12 + 10) / 2 + (12 + 3) / 2) / 7)
    assert numbers["min_sade"] == pytest.approx((10 + 3) / 7)
    p, q, m = np.array([0.25, 0.75]), np.array([0.5, 0.5]), np.array([0.375, 0.625])
    divergence = ((p * np.log(p / m)).sum() + (q * np.log(q / m)).sum()) / 2
    assert numbers["curvature_jsd"] == pytest.approx(divergence)
    assert (numbers["segments"], numbers["rollouts"]) == (2, 2)
    first, second = metrics.rows()
    assert (first["segment"], second["segment"]) == ("a", "b")
    assert first["collision_rate"] == 50
    assert second["offroad_time"] == pytest.approx(25)
    assert (first["ade"], first["min_sade"]) == (pytest.approx(11 / 4), pytest.approx(10 / 4))
    assert (second["ade"], second["min_sade"]) == (pytest.approx(7.5 / 3), pytest.approx(1))


def test_collision_counts_rollouts_not_steps_or_agents():
    inputs = random_inputs(0, batch=1)
    inputs["collided"] = torch.ones_like(inputs["collided"])
    assert scored(inputs).compute()["collision_rate"] == 100
    inputs["collided"][:, :2] = False
    assert scored(inputs).compute()["collision_rate"] == 50


def test_what_is_not_simulated_or_logged_is_not_read():
    inputs = random_inputs(1)
    inputs["simulated"][:, :, 1, 3:] = False
    before = scored(inputs).compute()
    inputs["collided"][:, :, 1, 3:] = True
    inputs["offroad"][:, :, 1, 3:] = True
    inputs["displacement"][:, :, 1, 3:] = torch.nan
    inputs["displacement"][~inputs["logged"][:, None].expand_as(inputs["displacement"])] = torch.inf
    assert scored(inputs).compute() == before


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 6), max_size=3))
def test_batches_processes_and_order_change_nothing(seed, cuts):
    inputs = random_inputs(seed)
    whole = scored(inputs)
    parts = [list(x) for x in np.split(np.random.default_rng(seed).permutation(7), sorted(cuts))]
    batches = scored(*(part(inputs, take) for take in parts))
    assert batches.compute() == whole.compute()
    assert batches.rows() == whole.rows()
    merged = RolloutMetrics()
    for take in reversed(parts):
        # As it would come from another process.
        merged.merge(pickle.loads(pickle.dumps(scored(part(inputs, take)))))  # noqa: S301
    assert merged.compute() == whole.compute()
    assert merged.rows() == whole.rows()


def test_a_segment_seen_twice_is_refused():
    inputs = random_inputs(2)
    metrics = scored(inputs)
    before = metrics.compute()
    with pytest.raises(ValueError, match="twice"):
        metrics.update(**part(inputs, [3]))
    with pytest.raises(ValueError, match="twice"):
        metrics.merge(scored(part(inputs, [0])))
    assert metrics.compute() == before


@pytest.mark.parametrize("name", ["collided", "offroad", "displacement", "logged", "simulated"])
def test_wrong_shapes_are_refused(name):
    inputs = random_inputs(3)
    inputs[name] = inputs[name].transpose(-1, -2)
    with pytest.raises(ValueError, match="expected"):
        scored(inputs)


def test_bad_numbers_name_their_segment():
    inputs = random_inputs(3)
    inputs["logged"][4, 0, 0] = True
    inputs["displacement"][4, 1, 0, 0] = torch.nan
    with pytest.raises(ValueError, match=inputs["segment_ids"][4]):
        scored(inputs)
    inputs = random_inputs(3)
    inputs["curvature"][0] = np.array([np.nan])
    with pytest.raises(ValueError, match="finite"):
        scored(inputs)


def test_standard_error_of_equal_segments_is_that_of_the_mean():
    inputs = random_inputs(4, batch=12)
    inputs["logged"] = torch.ones_like(inputs["logged"])
    metrics = scored(inputs)
    rows, numbers = metrics.rows(), metrics.compute()
    for name in NUMBERS[:4]:
        values = np.array([row[name] for row in rows])
        assert numbers[name] == pytest.approx(values.mean())
        assert numbers[f"{name}_se"] == pytest.approx(values.std(ddof=1) / math.sqrt(12))


def test_standard_errors_match_the_bootstrap():
    inputs = random_inputs(5, batch=150)
    metrics = scored(inputs)
    numbers = metrics.compute()
    rng = np.random.default_rng(0)
    segments = list(metrics.segments.values())
    draws = []
    for _ in range(80):
        again = RolloutMetrics()
        again.segments = {str(k): segments[i] for k, i in enumerate(rng.integers(0, 150, 150))}
        draws.append(again.compute())
    # Resampling segments biases the divergence itself, but hardly its spread.
    for name, tolerance in zip(NUMBERS, (0.25, 0.25, 0.25, 0.25, 0.5), strict=True):
        assert numbers[f"{name}_se"] == pytest.approx(np.std([d[name] for d in draws]), rel=tolerance)


def test_one_segment_has_no_standard_error():
    numbers = scored(random_inputs(6, batch=1)).compute()
    assert all(math.isnan(numbers[f"{name}_se"]) for name in NUMBERS)


def test_no_branch_visited_gives_no_divergence():
    inputs = random_inputs(7)
    inputs["curvature"] = [np.zeros(0)] * 7
    numbers = scored(inputs).compute()
    assert math.isnan(numbers["curvature_jsd"])
    assert not math.isnan(numbers["ade"])


def test_histogram_bins():
    counts = curvature_histogram(np.array([-5, -1, -0.0051, -0.0049, 0, 0.0049, 0.01, 0.9949, 0.996, 7]))
    assert len(counts) == 201
    assert counts.sum() == 10
    assert {k - 100: n for k, n in enumerate(counts) if n} == {-100: 2, -1: 1, 0: 3, 1: 1, 99: 1, 100: 2}


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_divergence_agrees_with_scipy(seed, share):
    distance = pytest.importorskip("scipy.spatial.distance")
    rng = np.random.default_rng(seed)
    p, q = (rng.integers(0, 9, 201) * (rng.random(201) < share) for _ in range(2))
    p[seed % 201] += 1
    q[(seed // 7) % 201] += 1
    assert float(jensen_shannon(p, q)) == pytest.approx(distance.jensenshannon(p, q) ** 2, abs=1e-12)


def test_divergence_laws():
    rng = np.random.default_rng(0)
    p, q = rng.integers(0, 5, (2, 6, 201))
    np.testing.assert_allclose(jensen_shannon(p, q), jensen_shannon(q, p))
    np.testing.assert_allclose(jensen_shannon(p, 3 * p), 0, atol=1e-15)
    assert (jensen_shannon(p, q) > 0).all()
    np.testing.assert_allclose(jensen_shannon(p, q)[2], jensen_shannon(p[2], q[2]))
    assert float(jensen_shannon(np.array([1, 0]), np.array([0, 3]))) == pytest.approx(math.log(2))
    assert np.isnan(jensen_shannon(np.array([0, 0]), np.array([0, 3])))
    assert np.isnan(jensen_shannon(np.array([1, 0]), np.array([0, 0])))


def random_groups(count, seed):
    return [f"g{k}" for k in np.random.default_rng(seed).integers(0, 3, count)]


def test_errors_over_groups_by_hand():
    """The sum of a group's segments is its one observation."""
    inputs = random_inputs(11, batch=9)
    groups = random_groups(9, 1)
    found, plain = scored(inputs | {"groups": groups}).compute(), scored(inputs).compute()
    assert found["groups"] == len(set(groups)) == 3
    assert "groups" not in plain
    assert [found[name] for name in NUMBERS] == [plain[name] for name in NUMBERS]
    metrics = scored(inputs)
    collided = np.array([metrics.segments[name].collided for name in inputs["segment_ids"]])
    totals, weights = np.zeros((2, 3))
    for group, hits in zip(groups, collided, strict=True):
        totals[int(group[1])] += 100 * hits
        weights[int(group[1])] += 4
    named = dict(zip(inputs["segment_ids"], groups, strict=True))
    assert {row["segment"]: row["group"] for row in metrics.rows()} == {name: name for name in named}
    grouped = scored(inputs | {"groups": groups})
    assert {row["segment"]: row["group"] for row in grouped.rows()} == named
    residual = totals - found["collision_rate"] * weights
    expected = np.sqrt(3 / 2 * (residual**2).sum()) / weights.sum()
    assert found["collision_rate_se"] == pytest.approx(expected)
    histograms = np.zeros((2, 3, 201))
    for name, group in zip(inputs["segment_ids"], groups, strict=True):
        for k, counts in enumerate((metrics.segments[name].histogram, metrics.segments[name].histogram_log)):
            histograms[k, int(group[1])] += counts
    left = [jensen_shannon(*(h.sum(0) - h[k] for h in histograms)) for k in range(3)]
    jackknife = np.sqrt(2 / 3 * ((left - np.mean(left)) ** 2).sum())
    assert found["curvature_jsd_se"] == pytest.approx(jackknife)


@given(st.integers(0, 2**32 - 1))
def test_a_group_each_is_as_no_groups(seed):
    inputs = random_inputs(seed)
    single = scored(inputs | {"groups": inputs["segment_ids"]}).compute()
    plain = scored(inputs).compute()
    assert single.pop("groups") == single["segments"]
    assert single.keys() == plain.keys()
    for name, value in plain.items():
        assert single[name] == pytest.approx(value, nan_ok=True), name


def test_copies_of_a_segment_in_one_group_tell_nothing_new():
    """Without groups, four copies would halve the error."""
    inputs = random_inputs(5)
    copies = RolloutMetrics()
    for k in range(4):
        again = inputs | {"segment_ids": [f"{name}-{k}" for name in inputs["segment_ids"]]}
        copies.update(**again, groups=inputs["segment_ids"])
    once, found = scored(inputs).compute(), copies.compute()
    assert found["groups"] == 7
    for name in NUMBERS:
        assert found[name] == pytest.approx(once[name])
        assert found[f"{name}_se"] == pytest.approx(once[f"{name}_se"])


def test_groups_for_a_part_are_refused():
    one, two = random_inputs(6), random_inputs(7)
    two["segment_ids"] = [f"t{k}" for k in range(7)]
    metrics = scored(one | {"groups": random_groups(7, 0)}, two)
    with pytest.raises(ValueError, match="groups were given for 7 of 14 segments"):
        metrics.compute()
    with pytest.raises(ValueError, match="2 groups for 7 segments"):
        scored(one | {"groups": ["a", "b"]})


def test_one_group_has_no_error():
    found = scored(random_inputs(8) | {"groups": 7 * ["a"]}).compute()
    assert found["groups"] == 1
    assert all(math.isnan(found[f"{name}_se"]) for name in NUMBERS)


def test_a_rollout_whose_agents_leave_is_measured_over_the_steps_they_are_there():
    there = torch.ones(1, 2, 1, 50, dtype=torch.bool)
    there[0, 1, :, 5:] = False
    metrics = RolloutMetrics()
    metrics.update(
        ["a"],
        collided=torch.zeros_like(there),
        offroad=torch.zeros_like(there),
        displacement=torch.tensor([1.0, 3.0])[None, :, None, None].expand(there.shape),
        simulated=there,
        logged=torch.ones(1, 1, 50, dtype=torch.bool),
        curvature=[np.zeros(1)],
        curvature_log=[np.zeros(1)],
    )
    numbers = metrics.compute()
    assert numbers["ade"] == pytest.approx((50 * 1 + 5 * 3) / 55)
    assert numbers["min_sade"] == pytest.approx(1.0)
    row = metrics.rows()[0]
    assert (row["ade"], row["min_sade"]) == (numbers["ade"], numbers["min_sade"])


@pytest.mark.parametrize(("agents", "steps"), [(0, 1), (0, 13), (3, 50)])
def test_padding_changes_no_bit_of_a_distance(agents, steps):
    """A segment is padded as the longest and fullest of its batch is."""
    inputs = random_inputs(5, batch=3, agents=3, steps=37)
    inputs["displacement"] = (inputs["displacement"] / 4) ** 8
    padded = dict(inputs)
    for name in ("collided", "offroad", "displacement", "simulated", "logged"):
        padded[name] = torch.nn.functional.pad(inputs[name], (0, steps, 0, agents))
    assert scored(padded).rows() == scored(inputs).rows()


def test_the_order_of_segments_changes_no_bit_of_a_metric_of_ones_own():
    metrics = scored(random_inputs(6, batch=40))
    values = dict(zip(sorted(metrics.segments), np.random.default_rng(0).random(40), strict=True))
    for seed in range(9):
        names = np.random.default_rng(seed).permutation(list(values))
        assert metrics.mean({name: values[name] for name in names}) == metrics.mean(values)


def test_a_metric_of_ones_own_that_is_infinite_somewhere_has_an_infinite_mean():
    """Left out, the rest would pass for the mean."""
    metrics = scored(random_inputs(6))
    values = dict.fromkeys(metrics.segments, 2.0)
    names = list(values)
    assert metrics.mean(values | {names[0]: math.nan}) == (2.0, 0.0)
    mean, error = metrics.mean(values | {names[0]: math.nan, names[1]: math.inf})
    assert mean == math.inf
    assert math.isnan(error)


def test_a_group_without_anything_to_count_is_no_sample():
    """Of two recordings of which one has no step to compare there is no error, as of one alone."""
    inputs = random_inputs(7, batch=4) | {"groups": ["a", "a", "b", "c"]}
    inputs["segment_ids"] = ["1", "2", "3", "4"]
    inputs["logged"][3] = False
    full, without = scored(inputs).compute(), scored(part(inputs, [0, 1, 2])).compute()
    for name in ("ade", "min_sade"):
        assert (full[name], full[f"{name}_se"]) == (without[name], without[f"{name}_se"])
    inputs["logged"][2] = False
    assert math.isnan(scored(inputs).compute()["ade_se"])
