"""Personas, what is measured of logged vehicles and what agents are told; and what the number of threads changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from helpers_runs import build, same_weights, tiny, weights
from helpers_segments import CAR, crossing, make_segment, straight_road
from helpers_store import fill
from symphony import keys
from symphony.agents import load_agent
from symphony.agents.checkpoint import CheckpointError
from symphony.config import METHODS, AgentConfig, EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError
from symphony.learning.demonstrations import SceneDataset
from symphony.learning.personas import PersonaScale, styles
from symphony.recipes import train
from symphony.roadgraph import LaneGraph
from symphony.rollouts.control import given_personas
from symphony.rollouts.driving import simulate_batch

OWN = AgentConfig(num_points=12, hidden=8, persona=True)


def column(gap, speeds):
    """Two cars behind one another in the rightmost lane of a road with a limit of 14 m/s, at constant speeds."""
    start, speed = np.array([20.0, 20.0 + CAR[0] + gap]), np.array(speeds)
    x = start[:, None] + speed[:, None] * np.arange(11) * 0.2
    zeros = np.zeros_like(x)
    moving = np.stack([np.broadcast_to(speed[:, None], x.shape), zeros], -1)
    return make_segment(straight_road(3).road, np.stack([x, zeros], -1), zeros, moving)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "store"
    fill(path, [maker(4, seed=seed, steps=8) for seed in range(3) for maker in (straight_road, crossing)])
    return path


def scenes(store):
    return SceneDataset(SegmentStore(store), 2, routes=True).scenes([0, 1])


def driven(agent, data, asked="", search="none"):
    config = EvaluateConfig(rollouts=2, branches=2, search=search, persona=asked)
    return simulate_batch(agent, data, config).rollouts.state


@settings(max_examples=20, deadline=None)
@given(speed=st.floats(5, 13), headway=st.floats(0.3, 2.5))
def test_headway_is_of_who_follows_and_speed_of_who_is_free(speed, headway):
    def found(gap, *speeds, **changes):
        segment = column(gap, speeds).replace(**changes)
        return styles(segment, LaneGraph(segment.road))

    steady = found(2.0 + speed * headway, speed, speed)
    np.testing.assert_allclose(steady[[0, 1], [0, 1]], [headway, speed / 14], rtol=1e-3)
    assert np.isnan(steady[[0, 1], [1, 0]]).all()
    # Who stands, or is there too briefly, tells nothing.
    assert np.isnan(found(5.0, 0.0, 0.0)).all()
    assert np.isnan(found(9.0, speed, speed, valid=np.arange(22).reshape(2, 11) % 11 < 4)).all()
    # Nor does who catches up, changes speed, or creeps in a queue: that is the situation.
    assert np.isnan(found(15.0, speed + 1.1, speed)[0, 0])
    assert not np.isnan(found(15.0, speed + 0.9, speed)[0, 0])
    assert np.isnan(found(5.0, 3.9, 3.9)[0, 0])
    braking = np.zeros((2, 11, 2), np.float32)
    braking[..., 0] = speed + 2.0 - np.arange(11) * 0.2
    assert np.isnan(found(9.0, speed, speed, velocity=braking)[0, 0])


@given(st.lists(
    st.tuples(*(st.one_of(st.just(np.nan), st.floats(0.1, 5.0)) for _ in range(2))), min_size=1, max_size=30
))  # fmt: skip
def test_personas_are_ranks_among_all(values):
    found = np.array(values)
    scale = PersonaScale.of([found[:3], found[3:]])
    personas = scale.personas(found)
    assert np.abs(personas).max() < 1
    for column_of, told in zip(found.T, personas.T, strict=True):
        known = ~np.isnan(column_of)
        assert not told[~known].any()
        assert not known.any() or abs(float(told[known].mean())) < 1e-6
        assert (np.diff(told[known][np.argsort(column_of[known], kind="stable")]) >= 0).all()
    table = scale.table()
    assert table.shape == (1024, 2)
    assert {tuple(row) for row in table.tolist()} <= {tuple(row) for row in [*personas.tolist(), (0.0, 0.0)]}


@pytest.mark.parametrize("method", METHODS)
def test_every_recipe_tells_its_agent_the_personas_of_the_log(store, tmp_path, method):
    trainer = build(tiny(method, store, tmp_path / "run", agent=OWN))
    assert torch.equal(trainer.agent.personas, trainer.data.personas.table())
    assert trainer.agent.personas.any()
    assert keys.PERSONA in trainer.agent.policy.in_keys
    without = build(tiny(method, store, tmp_path / "plain")).agent
    assert without.personas is None
    assert keys.PERSONA not in without.policy.in_keys


def test_an_agent_drives_in_the_style_that_it_is_told(store, tmp_path):
    agent = load_agent(str(train(tiny("bc_ts_h", store, tmp_path / "run", agent=OWN))))
    # After four updates a style means next to nothing to it.
    first = next(module for module in agent.policy.modules() if isinstance(module, nn.Linear))
    with torch.no_grad():
        first.weight[:, -2:] *= 100
    data = scenes(store)
    for search in ("none", "tree"):
        assert torch.equal(driven(agent, data, "", search), driven(agent, data, "", search))
        timid, bold = (driven(agent, data, f"headway={x},speed={x}", search) for x in (0, 1))
        assert not torch.equal(timid, bold)
    given, own = given_personas(agent.personas, "speed=.25"), agent.personas
    assert torch.equal(given[:, 0], own[:, 0])
    assert (given[:, 1] == -0.5).all()


def test_what_is_no_persona_is_refused(store):
    for wrong in ("headway=.8,headway=.3", "fast", "speed=2", "headway=x", "headway=.5,colour=.1"):
        with pytest.raises(ConfigError, match=r"headway=\.8,speed=\.3"):
            EvaluateConfig(persona=wrong)
    with pytest.raises(ConfigError, match="without personas"):
        driven(load_agent("pretrained:bc_ts_h"), scenes(store), "speed=.5")


def test_a_warm_start_without_personas_drives_as_before(store, tmp_path):
    before, data = train(tiny("bc_h", store, tmp_path / "before")), scenes(store)
    after = build(tiny("bc_h", store, tmp_path / "after", agent=OWN, warm_start=before)).agent
    for asked in ("", "headway=1,speed=0"):
        assert torch.equal(driven(after, data, asked), driven(load_agent(str(before)), data))


@pytest.mark.parametrize(("method", "setting", "old", "new"), [
    ("bc", "features", "gaps", "paper"), ("bc_h", "goal_features", "points", OWN.goal_features)
])  # fmt: skip
def test_inputs_that_would_take_the_weights_of_others_are_refused(method, setting, old, new, store, tmp_path):
    own = replace(OWN, persona=False)
    run = train(tiny(method, store, tmp_path / "before", agent=replace(own, **{setting: old})))
    # Settings that differ are named with what they were.
    with pytest.raises(CheckpointError, match=rf"(policy|goals)\..*agent\.{setting} \(was {old}\)"):
        build(tiny(method, store, tmp_path / "after", agent=replace(own, **{setting: new}), warm_start=run))


def by(threads, work):
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return work()
    finally:
        torch.set_num_threads(before)


def test_rollouts_are_the_same_with_any_number_of_threads(store):
    agent, data = load_agent("pretrained:bc_ts_h"), scenes(store)
    one, two = (by(count, lambda: driven(agent, data, search="tree")) for count in (1, 2))
    assert torch.equal(one, two)


def test_weights_repeat_with_as_many_threads_and_are_close_with_others(store, tmp_path):
    one, two, again = (
        by(count, lambda name=name: weights(train(tiny("bc_ts", store, tmp_path / name, steps=2))))
        for name, count in (("one", 1), ("two", 2), ("again", 2))
    )
    assert same_weights(two, again)
    for name, value in one.items():
        torch.testing.assert_close(two[name], value, rtol=1e-3, atol=1e-5)
