"""Training by MGAIL: its phases, what each of them changes, and what comes out."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from helpers_runs import build, pieces, same_weights, stopped, tiny, trained_as, weights
from helpers_segments import crossing, hide, straight_road
from helpers_store import stored
from symphony import keys
from symphony.agents import load_agent
from symphony.cli import main
from symphony.config import EvaluateConfig, MGAILConfig, TrainConfig
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.envs import Displacement
from symphony.errors import ConfigError
from symphony.evaluation import evaluate
from symphony.learning.demonstrations import SceneDataset
from symphony.recipes import train
from symphony.training import Trainer
from symphony.training.logging import read_metrics

METHODS = ("mgail", "mgail_h", "mgail_ts", "mgail_ts_h")
SHORT = MGAILConfig(regression=2, head_start=2, rollouts=3)
STILL = MGAILConfig(regression=0, head_start=9, rollouts=3)
"""Keeps a policy as it is."""
SETTINGS = EvaluateConfig(rollouts=2)


def config(method: Any, store: Path, out: Path, **changes: Any) -> TrainConfig:
    """Two updates of regression, two of the discriminator alone, two of both."""
    return replace(tiny(method, store, out, steps=6, mgail=SHORT), **changes)


def made(steps: int, last: int) -> list[RunSegment]:
    """Segments of some steps; in the last one, a vehicle comes into sight after the start."""
    late = hide(crossing(5, seed=1, steps=last), 3, slice(0, 2))
    return [straight_road(4, seed=0, steps=steps), crossing(4, seed=0, steps=steps), late]


store, seconds = stored(lambda: made(4, 5)), stored(lambda: made(11, 13))
trained = trained_as(config)


def copies(trainer: Trainer) -> dict[str, list[Tensor]]:
    modules = trainer.agent.modules
    return {name: [p.detach().clone() for p in module.parameters()] for name, module in modules.items()}


def moved(before: dict[str, list[Tensor]], after: dict[str, list[Tensor]]) -> set[str]:
    """Networks of which most weights changed; none may have changed in part of them only."""
    changed = {k: [not torch.equal(*pair) for pair in zip(before[k], after[k], strict=True)] for k in before}
    shares = {name: sum(found) / len(found) for name, found in changed.items()}
    assert all(share == 0 or share > 0.7 for share in shares.values()), shares
    return {name for name, share in shares.items() if share}


@pytest.mark.parametrize(("method", "cells"), [*((method, 0) for method in METHODS[:3]), (METHODS[3], 5)])
def test_each_phase_changes_the_networks_it_is_for(store, tmp_path, method, cells, monkeypatch):
    monkeypatch.setattr("symphony.learning.demonstrations.PASSES", 20)
    settings = config(method, store, tmp_path, mgail=replace(SHORT, head_start=1, expert_weight=0.0))
    settings = replace(settings, steps=4, agent=replace(settings.agent, cells=cells))
    trainer = build(settings)
    goals, rates = {"goals"} if method.endswith("_h") else set(), []
    phases = [{"policy"}] * 2 + [{"discriminator"}] + [{"policy", "discriminator"}]
    for step, phase in enumerate(phases):
        before = copies(trainer)
        record = trainer._update(step)
        assert moved(before, copies(trainer)) == phase | (goals if step < 3 else set())
        assert {name.removeprefix("loss_") for name in record if name.startswith("loss_")} == phase | goals
        assert ("loss_discriminator" in record) == ("search_auc_collision" in record) == (step >= 2)
        assert ("policy_mgail_score" in record) == (step >= 3)
        assert all(not value.requires_grad for value in record.values())
        assert all(math.isfinite(v) for k, v in record.items() if k.startswith(("loss", "gradient")))
        rates.append(trainer.optimizers["policy"].param_groups[0]["lr"])
    # The policy's rate starts anew with the second phase, at one of its own.
    assert rates[0] == trainer.config.learning_rate > rates[1] > rates[2] == SHORT.learning_rate > rates[3]
    assert all(len({phase.rates(step).get("goals") for phase in trainer.phases}) == 1 for step in range(4))
    assert [trainer.data.goal_updates(10, each) for each in (1, 2)] == [3, 2]  # of 13 agents
    # Goals and discriminator learn nothing from the loss of the policy.
    used = pieces(trainer)
    for module in trainer.agent.modules.values():
        module.zero_grad(set_to_none=True)
    used["mgail_loss"](used["replay"].repeatable(3, torch.Generator()))["loss_mgail"].backward()
    for name, module in trainer.agent.modules.items():
        with_gradient = [p.grad is not None for p in module.parameters()]
        assert all(with_gradient) if name == "policy" else not any(with_gradient)


@pytest.mark.parametrize(("method", "cells"), [*((method, 0) for method in METHODS[:3]), (METHODS[3], 5)])
def test_the_gradient_goes_along_what_survived(store: Path, tmp_path: Path, method: str, cells: int) -> None:
    """Rollouts that are simulated again lead through the very states that the search found."""
    settings = config(method, store, tmp_path)
    trainer = build(replace(settings, agent=replace(settings.agent, cells=cells)))
    replay, policy = pieces(trainer)["replay"], trainer.agent.modules["policy"]
    trainer.rng.manual_seed(0)
    replay.refresh(4)
    env, found = replay.env, replay.leaves
    assert found.shape[:2] == (2, 2)
    begin = replay.repeatable(99, torch.Generator().manual_seed(1))  # which mixes scenes
    assert begin.shape == (4,)
    paths, now, states = found.flatten(0, 1), begin.exclude("noise_plan"), []
    with torch.no_grad():
        for noise in begin["noise_plan"].unbind(1):
            states.append(now[keys.STATE])
            now = env.step(policy(now.copy().set(keys.NOISE, noise)))["next"]
    replayed = torch.stack(states, 1)
    # In an order of their own.
    same = (replayed[:, None] == paths[keys.STATE][None]).flatten(2).all(-1)
    assert same.any(1).all()
    assert same.any(0).all()
    assert (begin[keys.GOAL] >= 0).any() == method.endswith("_h")


@pytest.mark.parametrize("method", ["mgail", "mgail_ts_h"])
def test_regression_beside_it_and_more_updates_of_the_discriminator(store, tmp_path, method):
    found: list[dict[str, Tensor]] = []
    both = MGAILConfig(regression=0, head_start=0, rollouts=3, discriminator_updates=2)
    for weight in (0.5, 1.0):
        trainer = build(config(method, store, tmp_path, mgail=replace(both, expert_weight=weight)))
        steps: list[int] = []
        trainer.optimizers["discriminator"].register_step_post_hook(lambda *_, steps=steps: steps.append(1))
        found.append(trainer._update(0))
        assert len(steps) == 2
        parts = found[-1]["loss_mgail"] + found[-1]["loss_regression"]
        torch.testing.assert_close(found[-1]["loss_policy"], parts)
    half, whole = (record["loss_regression"] for record in found)
    torch.testing.assert_close(2 * half, whole)
    assert half != 0


def test_a_run_that_ends_before_its_adversarial_updates_says_so(store, tmp_path, capsys):
    early = MGAILConfig(regression=1, head_start=1, rollouts=2)
    train(config("mgail", store, tmp_path / "short", steps=2, mgail=early))
    assert "warning: the run ends at update 2, before the first of adversarial" in capsys.readouterr().err
    train(config("mgail", store, tmp_path / "long", steps=3, mgail=early))
    assert "warning" not in capsys.readouterr().err


@pytest.mark.parametrize(("method", "dies_at"), [("mgail", 5), ("mgail_ts_h", 3)])
def test_a_killed_run_ends_like_an_unbroken_one(store, trained, tmp_path, method, dies_at):
    settings = config(method, store, tmp_path / "run", resume=True)
    stopped(trained(method), settings.out, dies_at - 1)
    train(settings)
    assert same_weights(weights(settings.out), weights(trained(method)))
    assert [r["step"] for r in read_metrics(settings.out)] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("method", ["mgail", "mgail_ts_h"])
def test_an_agent_is_evaluated_as_it_was_trained_or_otherwise(trained, store, method):
    agent = load_agent(str(trained(method)))
    assert (agent.dynamics, agent.goals is None) == (Displacement(), not method.endswith("_h"))
    usual, kinds = evaluate(agent, store, SETTINGS).numbers(), ("tree", "none")
    assert usual["search"] == kinds["_ts" not in method]
    assert all(math.isfinite(float(usual[name])) for name in ("ade", "collision_rate", "offroad_time"))
    other = evaluate(agent, store, replace(SETTINGS, search=kinds["_ts" in method], rule="best")).numbers()
    assert usual["search"] != other["search"]
    assert other["ade"] != usual["ade"]


def test_a_rule_of_the_user_that_fails_is_an_error_in_a_line(store, tmp_path, capsys):
    rule = tmp_path / "mine.py"
    rule.write_text("def rule():\n    return lambda totals, noise: totals['nothing']\n")
    words = f"--data {store} --out {tmp_path}/run --wandb disabled --search.rule {rule}:rule"
    assert main(f"train bc_ts {words} --agent.hidden 8 --search.branches 2".split()) == 1
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("symphony: error: <function rule.<locals>.<lambda> at")
    assert "Error: " in last


def test_adversarial_training_starts_from_a_regression(store: Path, tmp_path: Path) -> None:
    plain = train(config("mgail", store, tmp_path / "plain", steps=2))
    fresh = weights(plain)
    out = train(config("mgail_ts", store, tmp_path / "warm", warm_start=plain, steps=2, mgail=STILL))
    after = weights(out)
    assert after.keys() == fresh.keys()
    for name, value in after.items():
        assert torch.equal(value, fresh[name]) == name.startswith("policy.") or value.numel() < 2
    bicycle = train(tiny("bc", store, tmp_path / "bc", steps=1))
    for cells in (0, 7):  # with as many outputs as a bicycle's 7 x 7 actions the weights alone would fit
        other = config("mgail", store, tmp_path / "other", warm_start=bicycle)
        with pytest.raises(ConfigError, match="another action_space: bicycle, not displacement"):
            train(replace(other, agent=replace(other.agent, cells=cells)))


def test_the_duration_cuts_segments(seconds: Path, tmp_path: Path) -> None:
    trainer = build(config("mgail_h", seconds, tmp_path, duration=1))
    for step in range(5):
        trainer._update(step)
    replay, short = pieces(trainer)["replay"], trainer.data
    scenes = replay.env.scenes
    assert replay.leaves.shape == (2, 2, 5)
    assert (scenes.last_step == 5).all()
    assert scenes.log_state.shape[1] == short.fitted(scenes.segment.tolist(), scenes)[0].shape[1] == 6
    whole = SceneDataset(SegmentStore(seconds), 2, Displacement())
    for item in range(3):
        cut, full = short.segment(item), whole.segment(item)
        assert (cut.position == full.position[:, :6]).all()
        assert cut.signal_state.shape[1] == cut.valid.shape[1] == cut.num_steps == 6
        assert short.experts(item).states.shape[1] == 6
