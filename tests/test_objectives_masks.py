"""No method of this package trains on padding, and every loss reads what something writes."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from helpers_segments import crossing, straight_road
from symphony import keys
from symphony.agents.networks import (
    discriminator_network,
    dynamics_of,
    goal_network,
    observation_of,
    policy_network,
)
from symphony.config import AgentConfig, AgentSpec, DiscriminatorConfig
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.envs import DrivingEnv, collate, scene
from symphony.learning.demonstrations import SceneDataset
from symphony.objectives import BCLoss, DiscriminatorLoss, DistillationLoss, GoalLoss, MGAILLoss

BY_THE_CALLER = {keys.SIMULATED, keys.ROLLOUT, keys.NOISE_PLAN}
"""What depends on how batches are put together; the first three must be there, the last is optional."""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> SceneDataset:
    path = tmp_path_factory.mktemp("data") / "store"
    with StoreWriter(path) as writer:
        writer.append(straight_road(3, seed=0, steps=8))
        writer.append(crossing(2, seed=0, steps=8))
    return SceneDataset(SegmentStore(path), routes=True)


def spec_of(method: str, dataset: SceneDataset) -> AgentSpec:
    return AgentSpec(
        action_space="displacement" if method == "mgail_ts_h" else "bicycle",
        dt=dataset.dt,
        goals=True,
        agent=AgentConfig(num_points=12, hidden=8),
        discriminator=DiscriminatorConfig(hidden=8),
        searches=True,
    )


def networks(method: str, dataset: SceneDataset) -> tuple[Any, Any, Any]:
    spec = spec_of(method, dataset)
    return policy_network(spec), goal_network(spec), discriminator_network(spec)


def losses(method: str, dataset: SceneDataset) -> tuple[dict[str, Any], DrivingEnv]:
    """The losses of a method on its own networks, as a recipe makes them, and the environment they learn in."""
    spec = spec_of(method, dataset)
    torch.manual_seed(0)
    policy, goals, discriminator = networks(method, dataset)
    # One scene with three interactive agents and one with two, hence with one that is padding.
    scenes = collate([scene(dataset.segment(i), [0, 1, 2][: 3 - i], dataset.graph(i)) for i in (0, 1)])
    env = DrivingEnv(scenes, dynamics_of(spec), observation_of(spec))
    found: dict[str, Any] = {
        "bc": BCLoss(policy),
        "distillation": DistillationLoss(policy),
        "goal": GoalLoss(goals),
        "discriminator": DiscriminatorLoss(discriminator),
    }
    if method == "mgail_ts_h":
        found["mgail"] = MGAILLoss(policy, discriminator, env, horizon=2)
    return found, env


def batch(env: DrivingEnv) -> TensorDict:
    """States with everything the losses ask for, labels of padded agents included."""
    td = env.choices(env.with_goals(env.start(torch.tensor([0, 1, 0, 1]))))
    valid = td[keys.VALID]
    assert valid.sum(-1).tolist() == [3, 2, 3, 2]
    torch.manual_seed(0)
    td = env.rand_action(td)
    td[keys.ROLLOUT] = torch.rand(valid.shape) < 0.5
    td[keys.SIMULATED] = torch.rand(valid.shape) < 0.5
    return td


METHODS = ("bc_ts_h", "mgail_ts_h")


@pytest.mark.parametrize("method", METHODS)
def test_padded_agents_have_no_influence_on_any_loss(method: str, dataset: SceneDataset) -> None:
    results = []
    for dirty in (False, True):
        found, env = losses(method, dataset)
        td = batch(env)
        if dirty:
            padded = ~td[keys.VALID]
            td[keys.ACTION][padded] = td[keys.ACTION][padded] + 1
            for key in (keys.ROLLOUT, keys.SIMULATED):
                td[key][padded] = ~td[key][padded]
            td[keys.GOAL][padded] = 0
            for key in (keys.OWN, keys.OBJECTS, keys.POINTS, keys.ROUTE, keys.ROUTES):
                td[key][padded] = 7.0
        for name, loss in found.items():
            torch.manual_seed(1)
            out = loss(td.clone())
            value = next(out[key] for key in loss.out_keys if key.startswith("loss"))
            assert value != 0, name
            gradient = torch.autograd.grad(value, [p for p in loss.parameters() if p.requires_grad])
            results.append((dirty, name, value.detach(), gradient))
    clean, dirty_ones = ([r for r in results if r[0] == kind] for kind in (False, True))
    assert len(clean) == len(dirty_ones) >= 4
    for one, other in zip(clean, dirty_ones, strict=True):
        torch.testing.assert_close(other[2:], one[2:], msg=one[1])


@pytest.mark.parametrize("method", METHODS)
def test_without_a_mask_no_method_trains(method: str, dataset: SceneDataset) -> None:
    """Though the losses do not demand one of other projects: all networks read it."""
    found, env = losses(method, dataset)
    td = batch(env)
    for loss in found.values():
        assert loss.use_mask is None
        assert keys.VALID in loss.in_keys
        loss(td.clone())
        with pytest.raises(KeyError, match="valid"):
            loss(td.exclude(keys.VALID))


@pytest.mark.parametrize("method", METHODS)
def test_what_losses_read_by_default_is_written_by_something(method: str, dataset: SceneDataset) -> None:
    found, env = losses(method, dataset)
    written = {*env.fake_tensordict().keys(True, True), *batch(env).keys(True, True)}
    items, rng = [0, 1], torch.Generator().manual_seed(0)
    sees = env.observation
    written |= set(dataset.sample_states(items, 2, sees, rng).keys(True, True))
    written |= set(dataset.sample_goals(items, 2, sees, rng).keys(True, True))
    for module in networks(method, dataset):
        written |= set(module.out_keys)
    written -= BY_THE_CALLER
    one_place = {value for name, value in vars(keys).items() if name.isupper()}
    for name, loss in found.items():
        for field in fields(loss.default_keys):
            key = getattr(loss.tensor_keys, field.name)
            assert key in written | BY_THE_CALLER | {keys.NOISE}, (name, field.name)
            assert key in one_place | {"done"}, (name, field.name)
