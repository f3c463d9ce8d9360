"""Extreme but legal scenes: forward, backward, search and metrics stay finite, whatever learns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers_extremes import SCENES
from helpers_runs import build, tiny
from helpers_segments import straight_road
from helpers_store import fill
from symphony.agents import Agent
from symphony.config import AgentConfig, EvaluateConfig, MGAILConfig
from symphony.data.segment import RunSegment, validate
from symphony.data.store import SegmentStore
from symphony.evaluation import evaluate

SETTINGS = ("bc", "bc_ts_h", "mgail_ts_h")
"""One without search, and those that have every part, with either action space; others are simulated like them."""


def learned(segments: Sequence[RunSegment], method: Any, out: Path) -> Agent:
    """What comes of three updates, one of every kind there is, on all segments at once."""
    fill(out / "store", list(segments))
    config = tiny(
        method,
        out / "store",
        out / "run",
        steps=3,
        segments=2 * len(segments),
        agent=AgentConfig(interactive=1, num_points=12, hidden=8),
        mgail=MGAILConfig(regression=1, head_start=1, rollouts=len(segments), expert_weight=0.5),
    )
    trainer = build(config)
    for step in range(3):
        values = trainer._update(step)
        counted = {k: v for k, v in values.items() if k.startswith(("loss", "gradient_norm"))}
        assert {name for name, value in counted.items() if not torch.isfinite(value).all()} == set()
        # AUCs are undefined where there is no collision, say.
        assert not any(torch.isinf(value).any() for value in values.values())
    assert all(torch.isfinite(p).all() for m in trainer.agent.modules.values() for p in m.parameters())
    return trainer.agent


def assert_metrics_finite(agent: Agent, store: Path) -> None:
    search = "none" if agent.discriminator is None else "tree"
    found = evaluate(agent, store, EvaluateConfig(rollouts=2, branches=2, search=search, batch=40))
    numbers = {k: v for k, v in found.numbers().items() if isinstance(v, float) and not k.endswith("_se")}
    # There are no others; where nobody passes a junction, its branches are taken by nobody; where there is no
    # boundary, nobody is off the road; and bounds are of what is zero.
    undefined = ("others_", "curvature_jsd")
    if not any(len(segment.road.boundary) for segment in SegmentStore(store)):
        undefined += ("offroad_time", "agent_offroad_time")
    numbers = {name: value for name, value in numbers.items() if not name.endswith("_bound")}
    bad = {k for k, v in numbers.items() if not math.isfinite(v) and not k.startswith(undefined)}
    assert bad == set()
    assert len(numbers) > 10


@pytest.fixture(scope="module")
def scenes() -> list[RunSegment]:
    return [validate(make().replace(segment_id=name)) for name, make in SCENES.items()]


@pytest.mark.parametrize("method", SETTINGS)
def test_every_part_of_the_methods(scenes: list[RunSegment], method: str, tmp_path: Path) -> None:
    agent = learned([each for each in scenes if each.dt == 0.2], method, tmp_path)
    assert_metrics_finite(agent, tmp_path / "store")


@pytest.mark.parametrize("dt", sorted({make().dt for make in SCENES.values()} - {0.2}))
def test_other_time_steps(scenes: list[RunSegment], dt: float, tmp_path: Path) -> None:
    agent = learned([each for each in scenes if each.dt == dt], "mgail_ts_h", tmp_path)
    assert_metrics_finite(agent, tmp_path / "store")


def test_a_long_log(tmp_path: Path) -> None:
    """Half a minute at 5 Hz, all simulated."""
    agent = learned([straight_road(2, steps=151)], "bc", tmp_path)
    assert_metrics_finite(agent, tmp_path / "store")
