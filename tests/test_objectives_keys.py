"""Every loss reads what something writes."""

from __future__ import annotations

from dataclasses import fields

import pytest
import torch

from helpers_losses import batch_of, losses, world
from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony import keys
from symphony.data.store import SegmentStore
from symphony.learning.demonstrations import SceneDataset

BY_THE_CALLER = {keys.SIMULATED, keys.ROLLOUT, keys.NOISE_PLAN, keys.WEIGHT}
"""What depends on how batches are put together; the first two must be there, the others are optional."""


@pytest.mark.parametrize("space", ["bicycle", "displacement"])
def test_what_losses_read_by_default_is_written_by_something(space, tmp_path):
    agent, env = world(space)
    found = {name: loss for name, loss in losses(agent, env).items() if name != "mgail" or space != "bicycle"}
    fill(tmp_path / "store", [straight_road(3, seed=0, steps=8), crossing(2, seed=0, steps=8)])
    dataset, rng = SceneDataset(SegmentStore(tmp_path / "store"), routes=True), torch.Generator()
    batches = [env.fake_tensordict(), batch_of(env, env.start(torch.tensor([0, 1]))).exclude(keys.GOAL_SET)]
    batches += [f([0, 1], 2, env.observation, rng) for f in (dataset.sample_states, dataset.sample_goals)]
    written = {key for td in batches for key in td.keys(True, True)} - BY_THE_CALLER
    written |= {key for module in agent.modules.values() for key in module.out_keys}
    one_place = {value for name, value in vars(keys).items() if name.isupper()}
    for name, loss in found.items():
        for field in fields(loss.default_keys):
            key = getattr(loss.tensor_keys, field.name)
            assert key in written | BY_THE_CALLER | {keys.NOISE}, (name, field.name)
            assert key in one_place | {"done"}, (name, field.name)
