"""Numbers that are not finite end a simulation with an error that says where; none is compared or drawn from."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from helpers_agents import make_agent
from helpers_runs import build, tiny
from helpers_segments import crossing, straight_road
from symphony import keys
from symphony.config import EvaluateConfig, ValidationConfig
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import SymphonyError
from symphony.evaluation import evaluate
from symphony.rollouts.unroll import NotFiniteError

LENGTHS = (7, 4, 8)
"""Steps of the segments ``straight-0``, ``crossing-1`` and ``crossing-2``."""
SEARCHES = (("none", "best"), ("best", "best"), ("tree", "systematic"), ("backtrack", "best"))


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> SegmentStore:
    path = tmp_path_factory.mktemp("data") / "store"
    with StoreWriter(path) as writer:
        writer.append(straight_road(4, seed=0, steps=LENGTHS[0]))
        writer.append(crossing(4, seed=1, steps=LENGTHS[1]))
        writer.append(crossing(4, seed=2, steps=LENGTHS[2]))
    return SegmentStore(path)


class Spoiled(TensorDictModuleBase):
    """A network that, in one scene from one step on, puts out a bad number for one branch's first agent."""

    def __init__(self, inner: Any, key: keys.Key, scene: int, step: int, value: float = math.nan) -> None:
        super().__init__()
        self.inner, self.key, self.scene, self.step, self.value = inner, key, scene, step, value
        self.in_keys, self.out_keys = inner.in_keys, inner.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = self.inner(tensordict)
        now = (out.get(keys.SCENE) == self.scene) & (out.get(keys.STEP) >= self.step)
        value = out.get(self.key).clone()
        place = torch.zeros(value.shape, dtype=torch.bool)
        place[..., 0, :] = True
        now = now.reshape(*now.shape[:-1], *(1,) * (value.ndim - now.ndim + 1))
        return out.set(self.key, value.masked_fill(place & now, self.value))


@cache
def drives(store: SegmentStore, space: str, cells: int, config: EvaluateConfig) -> None:
    """That nothing is wrong with an agent whose networks nobody has broken."""
    evaluate(make_agent(space, cells), store, config)


@pytest.mark.parametrize(("space", "cells", "search", "rule"), [
    *(("bicycle", 0, *how) for how in SEARCHES),
    *(("displacement", cells, "tree", "systematic") for cells in (0, 5)),
])  # fmt: skip
@pytest.mark.parametrize("network", ["policy", "goals", "discriminator"])
def test_weights_that_are_not_finite_are_found_at_once(store, network, space, cells, search, rule):
    config = EvaluateConfig(rollouts=2, search=search, rule=rule)
    drives(store, space, cells, config)
    broken = make_agent(space, cells)
    with torch.no_grad():
        for parameter in broken.modules[network].parameters():
            parameter.fill_(math.nan)
    if network == "discriminator" and search == "none":
        evaluate(broken, store, config)  # which does not ask it
        return
    name = {"goals": "goal policy"}.get(network, network)
    step = 1 if network == "discriminator" else 0
    expected = (
        f"segment straight-0: the {name} put out a number that is not finite for agent 0 at step {step}"
    )
    with pytest.raises(NotFiniteError, match=expected) as caught:
        evaluate(broken, store, config)
    assert isinstance(caught.value, SymphonyError)


@pytest.mark.parametrize(("search", "rule", "value", "batch"), [
    *((*how, math.nan, 3) for how in SEARCHES),
    ("tree", "best", math.inf, 3),
    ("none", "best", math.nan, 1),
])  # fmt: skip
def test_segment_and_step_are_those_where_it_began(store, search, rule, value, batch):
    good = make_agent()
    config = EvaluateConfig(rollouts=2, search=search, rule=rule, batch=batch)
    # Items of a batch of one are all its scene 0: the first segment is the bad one there.
    scene, segment = (0, "straight-0") if batch == 1 else (2, "crossing-2")
    broken = replace(good, policy=Spoiled(good.policy, keys.LOGITS, scene, 4, value))
    with pytest.raises(NotFiniteError, match=f"segment {segment}: the policy .* at step 4$"):
        evaluate(broken, store, config)
    if search != "none":
        broken = replace(good, discriminator=Spoiled(good.discriminator, keys.SCORE, scene, 4, value))
        with pytest.raises(NotFiniteError, match=f"segment {segment}: the discriminator .* at step 4$"):
            evaluate(broken, store, config)


def test_what_comes_after_the_end_of_a_segment_is_none_of_its_business(store: SegmentStore) -> None:
    """Else a short segment could be refused beside a longer one, and be fine alone."""
    good, config = make_agent(), EvaluateConfig(rollouts=2, search="tree")
    usual = evaluate(good, store, config).metrics.rows()
    last = LENGTHS[1] - 1
    broken = replace(
        good,
        policy=Spoiled(good.policy, keys.LOGITS, 1, last),
        discriminator=Spoiled(good.discriminator, keys.SCORE, 1, last + 1),
    )
    assert evaluate(broken, store, config).metrics.rows() == usual
    for early in (
        replace(good, policy=Spoiled(good.policy, keys.LOGITS, 1, last - 1)),
        replace(good, discriminator=Spoiled(good.discriminator, keys.SCORE, 1, last)),
    ):
        with pytest.raises(NotFiniteError, match="crossing-1"):
            evaluate(early, store, config)


def test_a_run_that_breaks_while_it_trains_is_not_validated_in_silence(store, tmp_path):
    validation = ValidationConfig(data=store.path, rollouts=1)
    trainer = build(tiny("bc", store.path, tmp_path / "run", validation=validation))
    assert trainer.validator is not None
    with torch.no_grad():
        for parameter in trainer.agent.modules["policy"].parameters():
            parameter.fill_(math.inf)
    with pytest.raises(NotFiniteError, match="segment straight-0: the policy"):
        trainer.validator(2)
