"""No method of this package trains on padding, and every loss reads what something writes."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from helpers_losses import batch_of, losses, world
from helpers_objectives import learned
from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony import keys
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv, collate, scene
from symphony.learning.demonstrations import SceneDataset
from symphony.roadgraph import LaneGraph

BY_THE_CALLER = {keys.SIMULATED, keys.ROLLOUT, keys.NOISE_PLAN, keys.WEIGHT}
"""What depends on how batches are put together; the first two must be there, the others are optional."""
SEGMENTS = straight_road(3, seed=0, steps=8), crossing(2, seed=0, steps=8)
SPACES = pytest.mark.parametrize("space", ["bicycle", "displacement"])


def parts(space: str) -> tuple[Any, DrivingEnv, dict[str, Any]]:
    """An agent, the environment it learns in, and the losses of its networks."""
    # One scene with three interactive agents and one with two, hence with one that is padding.
    numbers = ([0, 1, 2], [0, 1])
    scenes = collate([scene(s, n, LaneGraph(s.road)) for s, n in zip(SEGMENTS, numbers, strict=True)])
    agent, env = world(space, scenes=scenes)
    found = losses(agent, env)
    return agent, env, {name: loss for name, loss in found.items() if name != "mgail" or space != "bicycle"}


def batch(env: DrivingEnv) -> TensorDict:
    """States with everything the losses ask for, labels of padded agents included."""
    td = batch_of(env, env.start(torch.tensor([0, 1, 0, 1]))).exclude(keys.GOAL_SET)
    valid = td[keys.VALID]
    assert valid.sum(-1).tolist() == [3, 2, 3, 2]
    torch.manual_seed(0)
    td = env.rand_action(td)
    for key in (keys.ROLLOUT, keys.SIMULATED):
        td[key] = torch.rand(valid.shape) < 0.5
    return td


@SPACES
def test_padded_agents_have_no_influence_on_any_loss(space):
    _, env, found = parts(space)
    clean, dirty = batch(env), batch(env)
    padded = ~dirty[keys.VALID]
    dirty[keys.ACTION][padded] = dirty[keys.ACTION][padded] + 1
    dirty[keys.GOAL][padded] = 0
    for key in (keys.ROLLOUT, keys.SIMULATED):
        dirty[key][padded] = ~dirty[key][padded]
    for key in (keys.OWN, keys.OBJECTS, keys.POINTS, keys.ROUTE, keys.ROUTES):
        dirty[key][padded] = 7.0
    for name, loss in found.items():
        results = []
        for td in (clean, dirty):
            torch.manual_seed(1)
            results.append(learned(loss, td.clone()))
        assert results[0][0][0] != 0, name
        torch.testing.assert_close(*results, equal_nan=True, msg=name)


@SPACES
def test_without_a_mask_no_method_trains(space):
    _, env, found = parts(space)
    td = batch(env)
    for loss in found.values():
        with pytest.raises(KeyError, match="valid"):
            loss(td.exclude(keys.VALID))


@SPACES
def test_what_losses_read_by_default_is_written_by_something(space, tmp_path):
    agent, env, found = parts(space)
    fill(tmp_path / "store", SEGMENTS)
    dataset, rng = SceneDataset(SegmentStore(tmp_path / "store"), routes=True), torch.Generator()
    batches = [env.fake_tensordict(), batch(env)]
    batches += [f([0, 1], 2, env.observation, rng) for f in (dataset.sample_states, dataset.sample_goals)]
    written = {key for td in batches for key in td.keys(True, True)} - BY_THE_CALLER
    written |= {key for module in agent.modules.values() for key in module.out_keys}
    one_place = {value for name, value in vars(keys).items() if name.isupper()}
    for name, loss in found.items():
        for field in fields(loss.default_keys):
            key = getattr(loss.tensor_keys, field.name)
            assert key in written | BY_THE_CALLER | {keys.NOISE}, (name, field.name)
            assert key in one_place | {"done"}, (name, field.name)
