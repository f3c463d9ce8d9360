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
from helpers_store import fill
from symphony import keys
from symphony.agents import load_agent
from symphony.agents.checkpoint import CheckpointError
from symphony.config import METHODS, AgentConfig, EvaluateConfig
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.envs.scene import SceneBatch
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
    start, speed = np.array([20.0, 20.0 + CAR[0] + gap]), np.array(speeds)
    x = start[:, None] + speed[:, None] * np.arange(11) * 0.2
    zeros = np.zeros_like(x)
    moving = np.stack([np.broadcast_to(speed[:, None], x.shape), zeros], -1)
    return make_segment(straight_road(3).road, np.stack([x, zeros], -1), zeros, moving)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "store"
    fill(path, [maker(4, seed=seed, steps=8) for seed in range(3) for maker in (straight_road, crossing)])
    return path


def scenes(store: Path) -> SceneBatch:
    return SceneDataset(SegmentStore(store), 2, routes=True).scenes([0, 1])


def driven(agent: Any, data: SceneBatch, asked: str = "", search: Any = "none") -> torch.Tensor:
    config = EvaluateConfig(rollouts=2, branches=2, search=search, persona=asked)
    return simulate_batch(agent, data, config).rollouts.state


@settings(max_examples=20, deadline=None)
@given(speed=st.floats(5, 13), headway=st.floats(0.3, 2.5))
def test_headway_is_of_who_follows_and_speed_of_who_is_free(speed: float, headway: float) -> None:
    def found(gap: float, *speeds: float, **changes: Any) -> Any:
        segment = column(gap, speeds).replace(**changes)  # type: ignore[arg-type]
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
def test_personas_are_ranks_among_all(values: list[tuple[float, float]]) -> None:
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
def test_every_recipe_tells_its_agent_the_personas_of_the_log(
    store: Path, tmp_path: Path, method: str
) -> None:
    trainer = build(tiny(method, store, tmp_path / "run", agent=OWN))
    personas = trainer.agent.personas
    assert personas is not None
    assert torch.equal(personas, trainer.data.personas.table())
    assert personas.any()
    assert keys.PERSONA in trainer.agent.policy.in_keys
    without = build(tiny(method, store, tmp_path / "plain")).agent
    assert without.personas is None
    assert keys.PERSONA not in without.policy.in_keys


def test_an_agent_drives_in_the_style_that_it_is_told(store: Path, tmp_path: Path) -> None:
    agent = load_agent(str(train(tiny("bc_ts_h", store, tmp_path / "run", agent=OWN))))
    assert agent.policy is not None
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
    assert given is not None
    assert own is not None
    assert torch.equal(given[:, 0], own[:, 0])
    assert (given[:, 1] == -0.5).all()


def test_what_is_no_persona_is_refused(store: Path) -> None:
    for wrong in ("headway=.8,headway=.3", "fast", "speed=2", "headway=x", "headway=.5,colour=.1"):
        with pytest.raises(ConfigError, match=r"headway=\.8,speed=\.3"):
            EvaluateConfig(persona=wrong)
    with pytest.raises(ConfigError, match="without personas"):
        driven(load_agent("pretrained:bc_ts_h"), scenes(store), "speed=.5")


def test_a_warm_start_without_personas_drives_as_before(store: Path, tmp_path: Path) -> None:
    before = train(tiny("bc_h", store, tmp_path / "before"))
    after, plain = (
        build(tiny("bc_h", store, tmp_path / "after", agent=OWN, warm_start=before)).agent,
        str(before),
    )
    for asked in ("", "headway=1,speed=0"):
        assert torch.equal(driven(after, scenes(store), asked), driven(load_agent(plain), scenes(store)))


@pytest.mark.parametrize(("method", "before", "after"), [
    ("bc", {"features": "gaps"}, {"features": "paper"}),
    ("bc_h", {"goal_features": "points"}, {}),
])  # fmt: skip
def test_inputs_that_would_take_the_weights_of_others_are_refused(
    method: Any, before: dict[str, Any], after: dict[str, Any], store: Path, tmp_path: Path
) -> None:
    own = replace(OWN, persona=False)
    run = train(tiny(method, store, tmp_path / "before", agent=replace(own, **before)))
    # Settings that differ are named with what they were.
    told = [f"agent.{k} (was {v})" for k, v in before.items()]
    with pytest.raises(CheckpointError, match=f"(policy|goals)\\..*{re.escape(', '.join(told))}"):
        build(tiny(method, store, tmp_path / "after", agent=replace(own, **after), warm_start=run))
