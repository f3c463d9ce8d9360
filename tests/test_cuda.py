"""A real card: the numbers of the CPU within rounding, the same bits each time, and no waiting within a step."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

from helpers_losses import CASES, LOGGED, batch_for, losses, searched, world
from helpers_runs import same_weights, stopped, tiny, weights
from helpers_segments import crossing, straight_road
from helpers_store import stored
from symphony import keys
from symphony.collectors import KeepBest, Systematic
from symphony.config import EvaluateConfig, MGAILConfig
from symphony.data.store import SegmentStore
from symphony.evaluation import evaluate
from symphony.modules import SeededNoise
from symphony.recipes import train
from symphony.rollouts.unroll import simulate, start_states

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]
CUDA = "cuda"


@contextmanager
def never_waiting() -> Iterator[None]:
    """PyTorch refuses whatever would wait for the card."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that this is a prototype
        torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("space", ["bicycle", "displacement", "histogram"])
def test_simulations(space):
    found = []
    for device in ("cpu", CUDA, CUDA):
        agent, env = world(space, device)
        policy = TensorDictSequential(SeededNoise(0, agent.dynamics.numbers), agent.policy)
        start = start_states(env, agent.goals, trees=2, branches=1, seed=0)
        simulate(env, policy, start)  # makes constants
        with never_waiting() if device == CUDA else nullcontext():
            found.append(simulate(env, policy, start).state)
    here, there, again = (state.cpu() for state in found)
    assert torch.equal(there, again)
    torch.testing.assert_close(there, here, atol=1e-3, rtol=0)


@pytest.mark.parametrize("rule", [KeepBest(0.5), Systematic(0.6)], ids=repr)
def test_searches(rule):
    here = searched(*world("bicycle", "cpu"), rule)
    agent, env = world("bicycle", CUDA)
    there = searched(agent, env, rule)
    start = start_states(env, agent.goals, trees=1, branches=4, seed=0)
    with never_waiting():
        again = searched(agent, env, rule, start)
    assert torch.equal(there.totals, again.totals)
    assert torch.equal(there.trajectories[keys.STATE], again.trajectories[keys.STATE])
    assert here.trajectories.shape == there.trajectories.shape == (2, 1, 3, LOGGED - 1)
    torch.testing.assert_close(there.totals.cpu(), here.totals, atol=1e-3, rtol=0)
    states = [found.trajectories[keys.STATE].cpu() for found in (there, here)]
    torch.testing.assert_close(*states, atol=1e-3, rtol=0)


def loss_and_gradients(name: str, space: str, device: str) -> tuple[TensorDict, dict[str, torch.Tensor]]:
    agent, env = world(space, device)
    loss, batch = losses(agent, env)[name], batch_for(name, env, device)

    def total() -> TensorDict:
        torch.manual_seed(0)
        out = loss(batch)
        sum(value for key, value in out.items() if key.startswith("loss")).backward()
        return out

    out = total()
    if device == CUDA:
        loss.zero_grad()
        with never_waiting():
            out = total()
    gradients = {key: value.grad.cpu() for key, value in loss.named_parameters() if value.grad is not None}
    return out.detach().cpu(), gradients


@pytest.mark.parametrize(("name", "space"), CASES)
def test_losses_and_their_gradients(name, space):
    there, gradients = loss_and_gradients(name, space, CUDA)
    assert all(value.isfinite().all() for value in gradients.values())
    assert gradients
    if name in ("bc", "distillation", "goal"):  # others draw numbers, on each device its own
        here, expected = loss_and_gradients(name, space, "cpu")
        for key, value in expected.items():
            torch.testing.assert_close(gradients[key], value, atol=1e-4, rtol=1e-3, msg=key)
        for key, value in here.items():
            torch.testing.assert_close(there[key], value, atol=1e-4, rtol=1e-3, msg=key)


store = stored(lambda: [make(4, seed=seed, steps=6) for seed in range(2) for make in (straight_road, crossing)])


@pytest.mark.parametrize("method", ["bc_ts_h", "bc_rl_h", "mgail_ts_h"])
def test_training_and_evaluation_are_repeated_and_resumed_to_the_bit(method, store, tmp_path):
    def trained(name: str, resume: bool = False) -> Path:
        mgail = MGAILConfig(regression=0, head_start=0, rollouts=4)
        return train(tiny(method, store, tmp_path / name, mgail=mgail, device=CUDA, resume=resume))

    once, twice = trained("once"), trained("twice")
    stopped(once, tmp_path / "stopped", 2)
    resumed = trained("stopped", resume=True)
    assert same_weights(weights(once), weights(twice))
    assert same_weights(weights(once), weights(resumed))
    config = EvaluateConfig(rollouts=2, device=CUDA)
    numbers = [evaluate(str(run), SegmentStore(store), config).numbers() for run in (once, twice)]
    assert numbers[0] | {"agent": ""} == numbers[1] | {"agent": ""}
