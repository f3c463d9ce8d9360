"""Every method on every device: the same numbers within rounding."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import pytest
import torch

from helpers_runs import tiny
from helpers_segments import crossing, straight_road
from helpers_store import fill
from symphony.config import EvaluateConfig, Method, MGAILConfig
from symphony.data.store import SegmentStore
from symphony.evaluation import evaluate
from symphony.recipes import train
from symphony.training.logging import read_metrics

ON_CUDA = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]
# Sampled actions, and with them all that follows, may differ once rounding tips one; the first losses do not.
FIRST = ("loss_policy", "loss_goals", "loss_discriminator")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "store"
    fill(path, [make(4, seed=seed, steps=6) for seed in range(2) for make in (straight_road, crossing)])
    return path


@pytest.mark.parametrize(
    ("method", "device"),
    [("mgail_ts_h", "cpu"), *(pytest.param(method, "cuda", marks=ON_CUDA) for method in get_args(Method))],
)
def test_a_method_trains_and_is_evaluated_on_the_device_it_is_given(
    method: Any, device: str, store: Path, tmp_path: Path
) -> None:
    short = MGAILConfig(regression=0, head_start=0, rollouts=4)

    def first_update(name: str, where: str) -> dict[str, Any]:
        return read_metrics(train(tiny(method, store, tmp_path / name, steps=2, mgail=short, device=where)))[
            0
        ]

    here, there = first_update("here", "cpu"), first_update("there", device)
    compared = [name for name in FIRST if name in here]
    assert "loss_policy" in compared
    for name in compared:
        assert there[name] == pytest.approx(here[name], abs=0 if device == "cpu" else 1e-3)
    config = EvaluateConfig(rollouts=2, device=device)
    found = evaluate(str(tmp_path / "there"), SegmentStore(store), config).numbers()
    assert found["rollouts"] == 2
    assert 0 <= found["collision_rate"] <= 100
