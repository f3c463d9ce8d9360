"""Encoding and max-pooling 1 024 agents x 200 points x 9 features at width 64, on one thread.

Compare the rows of one run: `pytest benchmarks/test_encoder_benchmark.py --benchmark-columns=median`.
"""

from __future__ import annotations

import pytest
import torch

from symphony.modules import mlp, pool_elements

AGENTS, POINTS, FEATURES, HIDDEN = 1024, 200, 9, 64


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("share", [1.0, 0.6], ids=["all valid", "60 percent valid"])
@pytest.mark.parametrize("mode", ["dense", "winner"])
@pytest.mark.parametrize("work", ["forward", "forward and backward"])
def test_pooling(benchmark, work, mode, share):
    torch.manual_seed(0)
    network = mlp((FEATURES, HIDDEN, HIDDEN))
    points = torch.randn(AGENTS, POINTS, FEATURES)
    mask = torch.rand(AGENTS, POINTS) < share
    benchmark.group = f"{work}, {100 * share:.0f} % valid"

    def forward():
        with torch.no_grad():
            return pool_elements(network, points, mask, mode=mode)

    def both():
        network.zero_grad()
        pooled = pool_elements(network, points, mask, mode=mode)
        pooled.sum().backward()
        return pooled.detach()

    pooled = benchmark.pedantic(forward if work == "forward" else both, rounds=7, warmup_rounds=1)
    assert pooled.shape == (AGENTS, HIDDEN)
