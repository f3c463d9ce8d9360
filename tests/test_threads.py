"""What the number of threads changes: no rollout, and weights by rounding only."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers_runs import same_weights, tiny, weights
from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony.agents import load_agent
from symphony.config import EvaluateConfig
from symphony.data.store import SegmentStore
from symphony.learning import SceneDataset
from symphony.recipes import train
from symphony.rollouts.driving import simulate_batch


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "store"
    fill(path, [straight_road(4, seed=0, steps=10), crossing(4, seed=0, steps=9)])
    return path


def by(threads: int, work: Callable[[], Any]) -> Any:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return work()
    finally:
        torch.set_num_threads(before)


def test_rollouts_are_the_same_with_any_number_of_threads(store: Path) -> None:
    agent, config = load_agent("pretrained:bc_ts_h"), EvaluateConfig(rollouts=2, branches=4)
    scenes = SceneDataset(SegmentStore(store), 2, agent.dynamics, routes=True).scenes([0, 1])
    one, two = (by(count, lambda: simulate_batch(agent, scenes, config).rollouts) for count in (1, 2))
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


def test_weights_repeat_with_as_many_threads_and_are_close_with_others(store: Path, tmp_path: Path) -> None:
    one, two, again = (
        by(count, lambda name=name: weights(train(tiny("bc_ts", store, tmp_path / name, steps=2))))  # type: ignore[misc]
        for name, count in (("one", 1), ("two", 2), ("again", 2))
    )
    assert same_weights(two, again)
    for name, value in one.items():
        torch.testing.assert_close(two[name], value, rtol=1e-3, atol=1e-5)
