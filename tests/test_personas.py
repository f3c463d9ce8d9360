"""Personas: what is measured of logged vehicles, what agents are told, and how many agents act in a segment."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from helpers_runs import build, tiny
from helpers_segments import CAR, crossing, make_segment, straight_road
from symphony import keys
from symphony.agents import Agent, load_agent
from symphony.agents.checkpoint import CheckpointError
from symphony.config import METHODS, AgentConfig, EvaluateConfig
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError
from symphony.learning.demonstrations import SceneDataset
from symphony.learning.personas import PersonaScale, styles
from symphony.recipes import train
from symphony.roadgraph import LaneGraph
from symphony.rollouts.control import given_personas
from symphony.rollouts.driving import simulate_batch

OWN = AgentConfig(num_points=12, hidden=8, persona=True)


def column(gap: float, speeds: tuple[float, float]) -> RunSegment:
    """Two cars behind one another in the rightmost lane of a road with a limit of 14 m/s, at constant speeds."""
    road = straight_road(3).road
    start = np.array([20.0, 20.0 + CAR[0] + gap])
    speed = np.array(speeds)
    x = start[:, None] + speed[:, None] * np.arange(11) * 0.2
    zeros = np.zeros_like(x)
    moving = np.stack([np.broadcast_to(speed[:, None], x.shape), zeros], -1)
    return make_segment(road, np.stack([x, zeros], -1), zeros, moving)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "store"
    with StoreWriter(path) as writer:
        for seed in range(3):
            writer.append(straight_road(6, seed=seed, steps=8).replace(segment_id=f"road-{seed}"))
            writer.append(crossing(4, seed=seed, steps=9).replace(segment_id=f"crossing-{seed}"))
    return path


@settings(max_examples=20, deadline=None)
@given(speed=st.floats(5, 13), headway=st.floats(0.3, 2.5))
def test_headway_is_of_who_follows_and_speed_of_who_is_free(speed: float, headway: float) -> None:
    segment = column(2.0 + speed * headway, (speed, speed))
    found = styles(segment, LaneGraph(segment.road))
    np.testing.assert_allclose(found[0, 0], headway, rtol=1e-3)
    np.testing.assert_allclose(found[1, 1], speed / 14, rtol=1e-3)
    assert np.isnan(found[0, 1])
    assert np.isnan(found[1, 0])
    # Who stands, or is there too briefly, tells nothing.
    assert np.isnan(styles(column(5.0, (0.0, 0.0)), LaneGraph(segment.road))).all()
    brief = segment.replace(valid=segment.valid & (np.arange(11) < 4))
    assert np.isnan(styles(brief, LaneGraph(brief.road))).all()
    # Nor does who catches up, changes speed, or creeps in a queue: that is the situation.
    assert np.isnan(styles(column(15.0, (speed + 1.1, speed)), LaneGraph(segment.road))[0, 0])
    assert not np.isnan(styles(column(15.0, (speed + 0.9, speed)), LaneGraph(segment.road))[0, 0])
    assert np.isnan(styles(column(5.0, (3.9, 3.9)), LaneGraph(segment.road))[0, 0])
    braking = segment.velocity.copy()
    braking[..., 0] += 2.0 - np.arange(11) * 0.2
    assert np.isnan(styles(segment.replace(velocity=braking), LaneGraph(segment.road))[0, 0])


@given(
    values=st.lists(
        st.tuples(*(st.one_of(st.just(np.nan), st.floats(0.1, 5.0)) for _ in range(2))),
        min_size=1,
        max_size=30,
    )
)
def test_personas_are_ranks_among_all(values: list[tuple[float, float]]) -> None:
    found = np.array(values)
    scale = PersonaScale.of([found[:3], found[3:]])
    personas = scale.personas(found)
    assert np.abs(personas).max() < 1
    for column_of, told in zip(found.T, personas.T, strict=True):
        known = ~np.isnan(column_of)
        assert not told[~known].any()
        if known.any():
            assert abs(float(told[known].mean())) < 1e-6
        order = np.argsort(column_of[known], kind="stable")
        assert (np.diff(told[known][order]) >= 0).all()
    table = scale.table()
    assert table.shape == (1024, 2)
    assert {tuple(row) for row in table.tolist()} <= {tuple(row) for row in [*personas.tolist(), (0.0, 0.0)]}


@pytest.mark.parametrize("method", METHODS)
def test_every_recipe_tells_its_agent_the_personas_of_the_log(
    store: Path, tmp_path: Path, method: str
) -> None:
    trainer = build(tiny(method, store, tmp_path / "run", agent=OWN))
    personas, data = trainer.agent.personas, trainer.data
    assert personas is not None
    assert torch.equal(personas, data.personas.table())
    assert personas.any()
    assert keys.PERSONA in trainer.agent.policy.in_keys
    without = build(tiny(method, store, tmp_path / "plain"))
    assert without.agent.personas is None
    assert keys.PERSONA not in without.agent.policy.in_keys


@pytest.fixture(scope="module")
def agent(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Agent:
    run = train(tiny("bc_ts_h", store, tmp_path_factory.mktemp("runs") / "run", agent=OWN))
    agent = load_agent(str(run))
    assert agent.policy is not None
    # After four updates a style means next to nothing to it.
    first = next(module for module in agent.policy.modules() if isinstance(module, nn.Linear))
    with torch.no_grad():
        first.weight[:, -2:] *= 100
    return agent


def test_an_agent_drives_in_the_style_that_it_is_told(agent: Agent, store: Path) -> None:
    scenes = SceneDataset(SegmentStore(store), 2, agent.dynamics, routes=True).scenes([0, 1])

    def driven(asked: str, search: str = "none", seed: int = 0) -> torch.Tensor:
        config = EvaluateConfig(rollouts=2, branches=2, search=search, persona=asked, seed=seed)  # type: ignore[arg-type]
        return simulate_batch(agent, scenes, config).rollouts.state

    for search in ("none", "tree"):
        assert torch.equal(driven("", search), driven("", search))
        assert not torch.equal(driven("headway=0,speed=0", search), driven("headway=1,speed=1", search))
    assert agent.personas is not None
    given = given_personas(agent.personas, "speed=.25")
    assert given is not None
    assert torch.equal(given[:, 0], agent.personas[:, 0])
    assert (given[:, 1] == -0.5).all()


def test_what_is_no_persona_is_refused(store: Path) -> None:
    for wrong in ("headway=.8,headway=.3", "fast", "speed=2", "headway=x", "headway=.5,colour=.1"):
        with pytest.raises(ConfigError, match=r"headway=\.8,speed=\.3"):
            EvaluateConfig(persona=wrong)
    plain = load_agent("pretrained:bc_ts_h")
    scenes = SceneDataset(SegmentStore(store), 2, plain.dynamics, routes=True).scenes([0])
    with pytest.raises(ConfigError, match="without personas"):
        simulate_batch(plain, scenes, EvaluateConfig(rollouts=1, persona="speed=.5"))


def test_a_warm_start_without_personas_drives_as_before(store: Path, tmp_path: Path) -> None:
    before = train(tiny("bc_h", store, tmp_path / "before"))
    config = tiny("bc_h", store, tmp_path / "after", agent=OWN, warm_start=before)
    after, plain = build(config).agent, load_agent(str(before))
    scenes = SceneDataset(SegmentStore(store), 2, plain.dynamics, routes=True).scenes([0, 1])
    for asked in ("", "headway=1,speed=0"):
        told = simulate_batch(after, scenes, EvaluateConfig(rollouts=2, persona=asked)).rollouts.state
        assert torch.equal(told, simulate_batch(plain, scenes, EvaluateConfig(rollouts=2)).rollouts.state)


@pytest.mark.parametrize(
    ("method", "before", "after"),
    [
        ("bc", {"features": "gaps"}, {"features": "paper"}),
        ("bc_h", {"goal_features": "points"}, {}),
    ],
)
def test_inputs_that_would_take_the_weights_of_others_are_refused(
    method: Any, before: dict[str, Any], after: dict[str, Any], store: Path, tmp_path: Path
) -> None:
    own = replace(OWN, persona=False)
    first = method if "goal_features" in before else "bc"
    run = train(tiny(first, store, tmp_path / "before", agent=replace(own, **before)))
    # Settings that differ are named with what they were.
    told = [f"agent.{k} (was {v})" for k, v in before.items() if after.get(k) != v]
    expected = f"(policy|goals)\\..*{re.escape(', '.join(told))}"
    with pytest.raises(CheckpointError, match=expected):
        build(tiny(method, store, tmp_path / "after", agent=replace(own, **after), warm_start=run))
