"""The table of metrics against plain loops and scipy, and its laws."""

from __future__ import annotations

import dataclasses
import math
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from symphony.metrics import CollisionKind, CollisionKinds, RolloutMetrics, curvature_histogram, jensen_shannon

NUMBERS = ("collision_rate", "offroad_time", "ade", "min_sade", "curvature_jsd")


def kinds_of(kind: Any, step: Any = 0, playback: Any = False) -> CollisionKinds:
    """First collisions; whether they are with playback counts only where there are any."""
    kind = torch.as_tensor(kind)
    step, playback = (torch.as_tensor(value).expand(kind.shape) for value in (step, playback))
    return CollisionKinds(kind, torch.where(kind < 0, -1, step), kind, playback & (kind >= 0))


def random_inputs(seed: int, batch: int = 7, rollouts: int = 4, agents: int = 2, steps: int = 5) -> Any:
    rng, shape, logged = np.random.default_rng(seed), (batch, rollouts, agents, steps), (batch, agents, steps)
    hits = np.where(rng.random((2, *shape[:3])) < 0.2, rng.integers(0, 8, (2, *shape[:3])), -1)
    names = [f"s{k:02d}" for k in rng.permutation(batch)]
    bounded = torch.tensor(rng.random(batch) < 0.9)
    return {
        "segment_ids": names, "groups": names, "bounded": bounded, "simulated": torch.ones(shape, dtype=torch.bool),
        "logged": torch.tensor(rng.random(logged) < 0.8), "at_states": torch.tensor(rng.random(shape) < 0.02),
        "offroad": torch.tensor(rng.random(shape) < 0.1) & bounded[:, None, None, None],
        "displacement": torch.tensor(rng.gamma(2, 2, shape), dtype=torch.float32),
        "speed": torch.tensor(rng.gamma(0.5, 8, shape), dtype=torch.float32),
        "speed_log": torch.tensor(rng.gamma(0.5, 8, logged), dtype=torch.float32),
        "last": torch.tensor(rng.integers(0, steps, batch)),
        "curvature": [rng.normal(0, 0.1, rng.integers(0, 9)) for _ in range(batch)],
        "curvature_log": [rng.normal(0, 0.2, rng.integers(1, 3)) for _ in range(batch)],
    } | {
        name: kinds_of(kind, rng.integers(0, steps, kind.shape), rng.random(kind.shape) < 0.5)
        for name, kind in zip(("kinds", "kinds_logged"), hits, strict=True)
    }  # fmt: skip


def part(inputs: dict[str, Any], take: list[int]) -> dict[str, Any]:
    """Return the same metrics for some of the segments."""

    def of(value: Any) -> Any:
        if isinstance(value, CollisionKinds):
            return CollisionKinds(*map(of, value))
        return value[take] if isinstance(value, torch.Tensor) else [value[i] for i in take]

    return {name: of(value) for name, value in inputs.items()}


def scored(*inputs: dict[str, Any]) -> RolloutMetrics:
    metrics = RolloutMetrics()
    for one in inputs:
        metrics.update(**one)
    return metrics


def same(one: Any, other: Any) -> bool:
    return repr(one) == repr(other)  # NaN is NaN


def equal(one: RolloutMetrics, other: RolloutMetrics) -> bool:
    return same((one.compute(), one.rows()), (other.compute(), other.rows()))


def test_distances_and_the_divergence_by_hand() -> None:
    """Two segments, two rollouts, two agents, two steps."""
    # Segment 0: agent 0 is 1 m off in rollout 0 and 2 m in rollout 1, agent 1 is 5 m and 3 m off. Together rollout 1
    # is nearer (10 < 12), although agent 0 alone is nearer in rollout 0. Segment 1: 4 m and 1 m, and of agent 1 only
    # the first step is logged.
    displacement = torch.tensor([[[1.0, 5], [2, 3]], [[4, 4], [1, 1]]])[..., None].repeat(1, 1, 1, 2)
    displacement[1, :, 1, 1] = 1e6
    inputs = random_inputs(0, batch=2, rollouts=2, steps=2)
    inputs |= {"segment_ids": ["a", "b"], "displacement": displacement}
    inputs["logged"] = torch.tensor([[[True, True], [True, True]], [[True, True], [True, False]]])
    inputs["curvature"] = [np.array([0.1, 0.1]), np.array([0.1, -0.2])]
    metrics = scored(inputs | {"curvature_log": [np.array([0.1]), np.array([-0.2])]})
    numbers, (first, second) = metrics.compute(), metrics.rows()
    assert numbers["collision_rear_ended"] == np.mean([row["collision_rear_ended"] for row in (first, second)])
    assert numbers["ade"] == pytest.approx(((12 + 10) / 2 + (12 + 3) / 2) / 7)
    assert numbers["min_sade"] == pytest.approx((10 + 3) / 7)
    assert (first["ade"], first["min_sade"]) == (pytest.approx(11 / 4), pytest.approx(10 / 4))
    assert (second["ade"], second["min_sade"]) == (pytest.approx(7.5 / 3), pytest.approx(1))
    p, q, m = (np.array(share) for share in ([0.25, 0.75], [0.5, 0.5], [0.375, 0.625]))
    divergence = ((p * np.log(p / m)).sum() + (q * np.log(q / m)).sum()) / 2
    assert numbers["curvature_jsd"] == pytest.approx(divergence)


@given(st.integers(0, 2**32 - 1))
def test_every_rate_is_what_plain_counting_finds(seed: int) -> None:
    inputs = random_inputs(seed, agents=3)
    inputs["simulated"] = torch.rand(inputs["simulated"].shape) < 0.8
    for name in ("speed", "speed_log"):  # some go backwards
        inputs[name].view(-1)[::9].neg_()
    numbers = scored(inputs).compute()
    there, log = inputs["simulated"], inputs["logged"][:, None].expand_as(inputs["simulated"])
    both = there & log
    (first, playback), hits = inputs["kinds"].first(), inputs["kinds_logged"]
    bounded = inputs["bounded"][:, None, None, None].expand_as(there)
    speeds = {"": inputs["speed"], "_log": inputs["speed_log"][:, None].expand_as(there)}
    driven = both.any(-1)

    def percent(flags: Any, of: Any) -> Any:
        count = float(of.sum()) if isinstance(of, torch.Tensor) else of
        return pytest.approx(100 * float(flags.sum()) / count if count else math.nan, nan_ok=True)

    rollouts = first.numel()
    expected = {
        "collision_rate": percent(first >= 0, rollouts),
        "collision_rate_at_states": percent((inputs["at_states"] & there).flatten(2).any(-1), rollouts),
        "collision_with_playback": percent(playback, rollouts),
        "collision_rear_ended_by_playback": percent(playback & (first == CollisionKind.REAR_ENDED), rollouts),
        "offroad_time": percent(inputs["offroad"] & there & bounded, there & bounded),
        "agent_collision_rate": percent(hits.kind >= 0, driven),
        "agent_collision_with_playback": percent(hits.playback, driven),
        "agent_offroad_time": percent(inputs["offroad"] & both & bounded, both & bounded),
        "agent_progress": percent(speeds[""][both].double(), speeds["_log"][both].double()),
    }
    for each in CollisionKind:
        name = each.name.lower()
        expected[f"collision_{name}"] = percent(first == each, rollouts)
        expected[f"agent_collision_{name}"] = percent(hits.kind == each, driven)
    for beside, speed in speeds.items():
        row = torch.arange(len(there))
        at_end, slow = both[row, :, :, inputs["last"]], (speed.abs() < 0.5)[row, :, :, inputs["last"]]
        expected[f"standing{beside}"] = percent(slow & at_end, at_end)
        expected[f"agent_standing{beside}"] = percent((speed.abs() < 0.5) & both, both)
        expected[f"agent_speed{beside}"] = pytest.approx(float(speed[both].double().mean()))
    distance = pytest.importorskip("scipy.stats").wasserstein_distance
    bins = [(speed[both].abs() / 0.5).floor().clamp(max=89) * 0.5 for speed in speeds.values()]
    expected |= {"agent_speed_distance": pytest.approx(distance(*bins)), "segments": 7, "rollouts": 4}
    for name, value in expected.items():
        assert numbers[name] == value, name


def test_what_is_not_simulated_or_logged_is_not_read() -> None:
    inputs = random_inputs(1)
    inputs["simulated"][:, :, 1, 3:] = False
    before = scored(inputs)
    inputs["at_states"][:, :, 1, 3:] = True
    inputs["offroad"][:, :, 1, 3:] = True
    inputs["displacement"][:, :, 1, 3:] = torch.nan
    inputs["displacement"][~inputs["logged"][:, None].expand_as(inputs["displacement"])] = torch.inf
    assert equal(scored(inputs), before)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 6), max_size=3))
def test_batches_processes_and_order_change_nothing(seed: int, cuts: list[int]) -> None:
    inputs = random_inputs(seed)
    whole = scored(inputs)
    parts = [x.tolist() for x in np.split(np.random.default_rng(seed).permutation(7), sorted(cuts))]
    batches, merged = scored(*(part(inputs, take) for take in parts)), RolloutMetrics()
    for take in reversed(parts):
        # As it would come from another process.
        merged.merge(pickle.loads(pickle.dumps(scored(part(inputs, take)))))  # noqa: S301
    assert equal(batches, whole)
    assert equal(merged, whole)


def test_a_segment_seen_twice_is_refused() -> None:
    inputs = random_inputs(2)
    metrics = scored(inputs)
    before = metrics.compute()
    with pytest.raises(ValueError, match="twice"):
        metrics.update(**part(inputs, [3]))
    with pytest.raises(ValueError, match="twice"):
        metrics.merge(scored(part(inputs, [0])))
    assert same(metrics.compute(), before)


def test_standard_errors_match_the_bootstrap() -> None:
    metrics = scored(random_inputs(5, batch=150))
    numbers, rng = metrics.compute(), np.random.default_rng(0)
    segments, draws = list(metrics.segments.values()), []
    for _ in range(40):
        again = RolloutMetrics()
        for k, i in enumerate(rng.integers(0, 150, 150)):
            again.segments[str(k)] = dataclasses.replace(segments[i], group=str(k))
        draws.append(again.compute())
    # Resampling segments biases the divergence itself, but hardly its spread.
    for name, tolerance in zip(NUMBERS, (0.25, 0.25, 0.25, 0.25, 0.5), strict=True):
        assert numbers[f"{name}_se"] == pytest.approx(np.std([d[name] for d in draws]), rel=tolerance)


def test_a_group_without_anything_to_count_is_no_sample() -> None:
    """With two recordings, one of which has no step to compare, there is no error, as with one alone."""
    inputs = random_inputs(7, batch=4) | {"groups": ["a", "a", "b", "c"]}
    inputs["logged"][3] = False
    inputs["curvature"][3] = inputs["curvature_log"][3] = np.zeros(0)
    full, without = scored(inputs).compute(), scored(part(inputs, [0, 1, 2])).compute()
    for name in ("ade", "min_sade", "curvature_jsd"):
        assert (full[name], full[f"{name}_se"]) == (without[name], without[f"{name}_se"])
    assert full["curvature_jsd_corrected"] == without["curvature_jsd_corrected"]
    inputs["logged"][2] = False
    assert math.isnan(scored(inputs).compute()["ade_se"])
    one = scored(inputs | {"groups": 4 * ["a"]}).compute()
    assert all(math.isnan(one[f"{name}_se"]) for name in NUMBERS)


@pytest.mark.parametrize(("agents", "steps"), [(0, 1), (0, 13), (3, 50)])
def test_padding_changes_no_bit(agents: int, steps: int) -> None:
    """A segment is padded as the longest and fullest of its batch is."""
    inputs, pad = random_inputs(5, batch=3, agents=3, steps=37), torch.nn.functional.pad
    inputs["displacement"] = (inputs["displacement"] / 4) ** 8
    padded = dict(inputs)
    for name, value in list(inputs.items()):
        if isinstance(value, torch.Tensor) and value.ndim > 1:
            padded[name] = pad(value, (0, steps, 0, agents))
        elif isinstance(value, CollisionKinds):
            padded[name] = kinds_of(*(pad(each, (0, agents), value=-1) for each in value[:2]))
            inputs[name] = kinds_of(*value[:2])
    assert equal(scored(padded), scored(inputs))


def test_metrics_of_ones_own() -> None:
    metrics, rng = scored(random_inputs(6, batch=40)), np.random.default_rng(0)
    values = dict(zip(sorted(metrics.segments), rng.random(40), strict=True))
    for _ in range(9):
        other = {name: values[name] for name in rng.permutation(list(values))}
        assert metrics.mean(other) == metrics.mean(values)
    first, second, *_ = values
    some = dict.fromkeys(values, 2.0) | {first: math.nan}
    assert metrics.mean(some) == (2.0, 0.0)
    # Left out, the rest would pass for the mean.
    assert same(metrics.mean(some | {second: math.inf}), (math.inf, math.nan))
    assert all(map(math.isnan, metrics.mean(dict.fromkeys(values, math.nan))))


def test_histogram_bins() -> None:
    counts = curvature_histogram(np.array([-5, -1, -0.0051, -0.0049, 0, 0.0049, 0.01, 0.9949, 0.996, 7]))
    assert len(counts) == 201
    assert {k - 100: n for k, n in enumerate(counts) if n} == {-100: 2, -1: 1, 0: 3, 1: 1, 99: 1, 100: 2}


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_divergence_agrees_with_scipy(seed: int, share: float) -> None:
    distance, rng = pytest.importorskip("scipy.spatial.distance"), np.random.default_rng(seed)
    p, q = (rng.integers(0, 9, 201) * (rng.random(201) < share) for _ in range(2))
    p[seed % 201] += 1
    q[(seed // 7) % 201] += 1
    wanted, none = pytest.approx(distance.jensenshannon(p, q) ** 2, abs=1e-12), 0 * p
    assert jensen_shannon(np.stack([p, q]), np.stack([q, 3 * p])).tolist() == [wanted, wanted]
    assert np.isnan([jensen_shannon(none, q), jensen_shannon(p, none)]).all()
