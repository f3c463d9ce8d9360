"""How closely the action space follows real and simulated logs."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from symphony.data.builtin import builtin_store
from symphony.data.resample import resample, smooth
from symphony.data.segment import RunSegment
from symphony.data.sources import get_reader
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle
from symphony.learning.experts import fit_experts


def final_errors(segments: list[RunSegment]) -> torch.Tensor:
    return torch.cat([fit_experts([segment], Bicycle())[0].error for segment in segments])


@pytest.mark.parametrize("split", ["train", "test"])
def test_greedy_fit_of_the_built_in_set(split: str) -> None:
    store = SegmentStore(builtin_store(split))
    errors = final_errors([store[item] for item in range(0, len(store), 3)])
    assert len(errors) > 100
    assert errors.mean() < 0.15


@pytest.mark.samples
def test_greedy_fit_of_ngsim(samples: Path) -> None:
    reader = get_reader("commonroad")
    found = []
    for file in sorted((samples / "commonroad" / "ngsim").glob("*.xml")):
        for segment in reader.read(file):
            assert isinstance(segment, RunSegment)
            found.append(resample(smooth(segment, 0.4), 0.2))
    errors = final_errors(found)
    assert len(found) == 20
    assert errors.mean() < 0.5
    assert errors.quantile(0.95) < 0.5
