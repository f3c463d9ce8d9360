"""The simulator alone, with observations, and in a search, beside two yardsticks of the same run.

``make bench``: CPU time of one thread. Machines differ and are shared, so read the rows as ratios: the brute force
does the simulator's work plainly, the matrix product is what the processor can do.
"""

from __future__ import annotations

import resource
from typing import Any

import pytest
import torch

from workloads import WORKLOADS


@pytest.mark.parametrize("name", list(WORKLOADS))
@torch.no_grad()
def test_workload(benchmark: Any, name: str) -> None:
    torch.set_num_threads(1)
    work, steps = WORKLOADS[name]()
    faults: list[int] = []

    def once() -> None:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        work()
        faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)

    long = name.startswith("search")
    benchmark.pedantic(once, rounds=5 if long else 15, warmup_rounds=1 if long else 25)
    benchmark.extra_info["per_second"] = round(steps / benchmark.stats["median"])
    benchmark.extra_info["page_faults"] = sorted(faults)[len(faults) // 2]
