"""Rare manoeuvres made more frequent, and the weights that make up for it."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import save
from tensordict import TensorDictBase
from torch import Tensor

from helpers_agents import small
from helpers_collectors import STREAM, Policy, Walk, X, starts
from helpers_saved import played
from helpers_segments import crossing
from symphony import keys
from symphony.collectors import BeamSearchResult, KeepBest, Systematic, beam_search
from symphony.collectors.beam_search import _tilted
from symphony.config import EvaluateConfig
from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, DrivingEnv, ObservationConfig
from symphony.errors import ConfigError, DataError
from symphony.evaluation.evaluator import evaluate_dataset
from symphony.evaluation.report import Report, add_segment
from symphony.simulation import SceneDataset
from symphony.simulation.crowd import crowd_dataset
from symphony.simulation.driving import simulated
from symphony.simulation.importance import BRAKING, Tilt, cut_in, hard_braking
from symphony.simulation.saved_tensors import KEY, read_tensors, tensors_of
from symphony.simulation.saving import save_simulation

FAR = 1.2
"""How far a walker comes rarely."""


def rare(records: Sequence[TensorDictBase]) -> Tensor:
    """[*b, S] whether a walker is far out at some step of the period."""
    there = torch.stack([record.get(("next", *X)) for record in records], -1)
    return (there > FAR).flatten(-3).any(-1).float()


def walk(
    strength: float | None, *, rows: int = 3000, score: float = 0.0, leaves: int | None = None
) -> BeamSearchResult:
    env = Walk(agents=1)
    start = starts(env, rows, branches=4, seed=3)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        return beam_search(
            env,
            Policy(1),
            lambda state: score * state.get(X).squeeze(-1),
            start,
            steps=6,
            prune_every=2,
            rule=Systematic(1.0),
            noise=torch.rand(rows, 3, generator=generator),
            slot_keys=[STREAM],
            tilt=None if strength is None else (lambda records: strength * rare(records)),
            leaves=leaves,
        )


def happened(found: BeamSearchResult) -> Tensor:
    """[rows, L] whether it happened to a leaf at any step."""
    return (found.trajectories.get(("next", *X)) > FAR).flatten(2).any(-1).double()


def mean_error(values: Tensor) -> tuple[float, float]:
    """Of a mean over rows, which are independent."""
    each = values.mean(1)
    return float(each.mean()), float(each.std() / math.sqrt(len(each)))


def test_weights_give_back_the_rate_that_the_tilt_has_raised() -> None:
    plain, tilted = walk(None), walk(1.5)
    usual, usual_error = mean_error(happened(plain))
    raised, _ = mean_error(happened(tilted))
    assert tilted.log_weights is not None
    weight = tilted.log_weights.exp()
    restored, error = mean_error(happened(tilted) * weight)
    assert raised > usual + 10 * (error + usual_error)
    assert abs(restored - usual) < 4 * math.hypot(error, usual_error)
    # Without scores nothing but the tilt prunes: weights are 1 on average.
    mean, error = mean_error(weight)
    assert abs(mean - 1) < 4 * error


@pytest.mark.parametrize("score", [0.0, 0.5])
def test_leaves_in_the_order_of_their_totals_keep_their_own_weights(score: float) -> None:
    plain, ranked = walk(1.5, score=score, rows=200), walk(1.5, score=score, rows=200, leaves=4)
    assert plain.log_weights is not None
    assert ranked.log_weights is not None
    assert not torch.equal(plain.slots, ranked.slots)
    for b in range(len(plain.slots)):
        # Leaves of one history have one weight.
        weights = {tuple(plain.slots[b, :, k].tolist()): plain.log_weights[b, k] for k in range(4)}
        for k in range(4):
            assert ranked.log_weights[b, k] == weights[tuple(ranked.slots[b, :, k].tolist())]


def test_a_tilt_makes_up_for_itself_beside_scores_too() -> None:
    # Against many branches, as a ratio of means: few branches are pruned towards other histories than many.
    plain, tilted = walk(None, score=0.5), walk(1.0, score=0.5)
    usual, usual_error = mean_error(happened(plain))
    assert tilted.log_weights is not None
    weight = tilted.log_weights.exp()
    restored = float((happened(tilted) * weight).sum() / weight.sum())
    _, error = mean_error(happened(tilted) * weight)
    assert float(happened(tilted).mean()) > usual + 0.02
    assert abs(restored - usual) < 5 * math.hypot(error, usual_error)


def test_tilted_odds_times_weights_are_the_odds_without_a_tilt() -> None:
    generator = torch.Generator().manual_seed(0)
    totals, lift = 5 * torch.randn(2, 50, 6, generator=generator, dtype=torch.float64)
    for temperature in (0.3, 1.0, 4.0):
        tilted, weight = _tilted(Systematic(temperature), totals, lift)
        odds = (-tilted / temperature).softmax(-1)
        torch.testing.assert_close(odds * weight.exp(), (-totals / temperature).softmax(-1))


@pytest.mark.parametrize(
    "odd", [[math.nan], [math.inf], [-math.inf], [-math.inf] * 2, [math.nan] * 5, [math.nan, math.inf]]
)
def test_totals_that_are_not_finite_spoil_no_weights(odd: list[float]) -> None:
    rule, lift = Systematic(0.6), torch.tensor([2.0, 0.0, 1.0, 2.0, 0.5])
    totals = torch.cat([torch.tensor(odd), torch.tensor([0.3, 1.0, -2.0, 0.0, 1.5])])[:5]
    tilted, weight = _tilted(rule, totals, lift)
    odds = rule.log_weights(tilted).softmax(-1)
    assert bool(weight.isfinite().all())
    torch.testing.assert_close(
        odds * weight.exp(), rule.log_weights(totals).softmax(-1), atol=1e-6, rtol=1e-5
    )


def test_a_tilt_of_nothing_changes_nothing() -> None:
    plain, tilted = walk(None, rows=50, score=0.5), walk(0.0, rows=50, score=0.5)
    assert plain.log_weights is None
    assert tilted.log_weights is not None
    assert not tilted.log_weights.any()
    assert torch.equal(plain.parents, tilted.parents)
    for key, value in plain.trajectories.items(True, True):
        assert torch.equal(value, tilted.trajectories.get(key))


@pytest.mark.parametrize(
    "settings", [{"leaves": 2}, {"retries": 1, "retry_above": 0.0}, {"rule": KeepBest()}], ids=str
)
def test_a_tilt_is_refused_where_weights_would_be_wrong(settings: dict[str, Any]) -> None:
    env = Walk(agents=1)
    arguments: dict[str, Any] = {"rule": Systematic(1.0), "noise": torch.rand(2, 1)} | settings
    with pytest.raises(ConfigError, match="tilt"):
        beam_search(
            env,
            Policy(1),
            lambda state: state.get(X).squeeze(-1),
            starts(env, 2, branches=4),
            steps=2,
            prune_every=2,
            tilt=rare,
            **arguments,
        )


def states(*agents: tuple[float, float, float, float]) -> Tensor:
    """[1, 1, N, 4]"""
    return torch.tensor(agents)[None, None]


SIZE = torch.tensor([[4.0, 2.0], [4.0, 2.0]])


def test_hard_braking_is_what_loses_more_than_its_threshold() -> None:
    before = states((0, 0, 0, 10), (50, 0, 0, 10))
    after = states((2, 0, 0, 10 - 0.2 * BRAKING - 0.01), (52, 0, 0, 10 - 0.2 * BRAKING + 0.01))
    assert hard_braking(before, after, SIZE, 0.2).tolist() == [[[True, False]]]


def test_who_comes_closely_in_front_of_another_from_the_side_cuts_in() -> None:
    follower = (0.0, 0.0, 0.0, 10.0)
    beside, ahead = (10.0, 2.5, 0.0, 10.0), (12.0, 1.9, -0.1, 10.0)
    assert cut_in(states(follower, beside), states(follower, ahead), SIZE, 0.2).tolist() == [[[False, True]]]
    # Turned about with the whole plane it is the same; who was there before, is far ahead or behind, did not cut in.
    for before, after in (
        (ahead, ahead),
        ((40.0, 2.5, 0.0, 10.0), (42.0, 1.9, 0.0, 10.0)),
        ((-10.0, 2.5, 0.0, 10.0), (-8.0, 1.9, 0.0, 10.0)),
    ):
        assert not cut_in(states(follower, before), states(follower, after), SIZE, 0.2).any()


@pytest.mark.parametrize("driver", [0, 1])
def test_branches_are_lifted_where_it_happens_to_a_driven_agent_that_is_there(driver: int) -> None:
    scenes = SceneDataset(SegmentStore(builtin_store("test"))).scenes([0])
    env = DrivingEnv(scenes, Bicycle(), ObservationConfig.nothing())
    record = env.step(env.rand_action(env.start(torch.zeros(3, dtype=torch.int64))))
    for key in (keys.VALID, ("next", *keys.VALID)):
        record.set(key, torch.ones_like(record.get(key)))
    state = record[keys.STATE].clone()
    state[..., 3] = 20.0
    after = state.clone()
    after[1, driver, 3] -= 1.1 * BRAKING * env.dt  # in the second branch only
    record.set(keys.STATE, state).set(("next", *keys.STATE), after)

    def lifts(changed: TensorDictBase, *, ego: bool = True) -> list[float]:
        return Tilt(env, 2.0, "hard_braking", ego=ego)([changed]).tolist()

    assert lifts(record) == [0.0, 2.0, 0.0]
    assert lifts(record, ego=False) == [0.0, 2.0 * driver, 0.0]
    gone = record.clone()
    gone[("next", *keys.VALID)][:, driver] = False
    late = record.clone().set(keys.STEP, scenes.last_step.expand(3)[:, None])
    for nothing in (gone, late):
        assert lifts(nothing) == [0.0, 0.0, 0.0]


def test_weights_are_kept_with_rollouts_and_the_report_makes_up_for_the_tilt(tmp_path: Path) -> None:
    saved = played(crossing(), agents=(0,), rollouts=2)
    collision = saved.state.copy()
    collision[1, 1:, 0] = collision[1, :1, 0]  # the second stays where it is
    weight = np.log([0.5, 2.0])
    saved = dataclasses.replace(saved, state=collision, log_weight=weight)
    arrays, facts = tensors_of(saved)
    data = save(arrays, metadata={KEY: json.dumps(facts)})
    again = read_tensors(data, tmp_path, saved.segment.segment_id)
    assert again.log_weight is not None
    np.testing.assert_array_equal(again.log_weight, weight)
    found = Report("made", "interactive")
    add_segment(found, again)
    total = found.totals()
    first, second = (row["progress"] for row in found.rows)
    assert second == 0 < first
    assert total["progress"] == pytest.approx(first / 2)
    assert total["untilted_progress"] == pytest.approx(0.2 * first)
    assert total["effective_runs"] == pytest.approx(2.5**2 / 4.25)
    for bad in (weight.astype(np.float32), weight[:1], np.array([0.0, np.nan])):
        with pytest.raises(DataError, match="log_weight"):
            read_tensors(
                save(arrays | {"log_weight": bad}, metadata={KEY: json.dumps(facts)}),
                tmp_path,
                saved.segment.segment_id,
            )


def test_simulations_are_tilted_by_the_same_random_numbers(tmp_path: Path) -> None:
    agent, store = small(), SegmentStore(builtin_store("test"))
    config = EvaluateConfig(rollouts=4, branches=4, rule="systematic")
    dataset = crowd_dataset(store, agent, config, [0])
    runs = {
        tilt: save_simulation(
            tmp_path / str(tilt), agent, dataset, dataclasses.replace(config, tilt=tilt, duration=2)
        )[0]
        for tilt in (0.0, 1e-9, 3.0)
    }
    assert runs[0.0].log_weight is None
    assert runs[1e-9].log_weight is not None
    assert np.abs(runs[1e-9].log_weight).max() < 1e-7
    np.testing.assert_array_equal(runs[0.0].state, runs[1e-9].state)
    for wrong in ({"rollouts": 2}, {"rule": "best"}):
        with pytest.raises(ConfigError, match="tilt"):
            simulated(agent, dataset.scenes([0]), dataclasses.replace(config, tilt=1.0, **wrong))
    with pytest.raises(ConfigError, match="tilt"):
        evaluate_dataset(agent, dataset, dataclasses.replace(config, tilt=1.0))
