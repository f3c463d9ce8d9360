"""What the search costs beyond simulating: 16 rows x 16 branches, 50 steps, in a trivial environment.

`pytest benchmarks/test_beam_benchmark.py --benchmark-columns=median --benchmark-sort=name`; the difference of the
rows, divided by 50, is the overhead per step. *Wide* adds an observation of 8 kB per branch, which keeping
everything must store twice (as found, and as the leaves' histories).
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from helpers_collectors import Policy, Walk, distance, starts
from symphony.collectors import KeepAll, KeepBest, beam_search

STEPS, ROWS, BRANCHES = 50, 16, 16


class WideWalk(Walk):
    """Each state comes with 2 048 numbers that only a policy would read."""

    def _state(self, x: Any, step: Any, stream: Any) -> TensorDict:
        return (
            super()
            ._state(x, step, stream)
            .set("wide", x[..., :1, 0].expand(*x.shape[:-2], 2048).contiguous())
        )


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with torch.no_grad():
        yield
    torch.set_num_threads(before)


def parts(wide: bool) -> tuple[Walk, Policy, TensorDictBase]:
    env = WideWalk() if wide else Walk()
    return env, Policy(), starts(env, ROWS, branches=BRANCHES)


WIDTHS = pytest.mark.parametrize("wide", [False, True], ids=["narrow", "wide"])


@WIDTHS
def test_bare_loop(benchmark: Any, wide: bool) -> None:
    """Environment, policy and score alone."""
    env, policy, start = parts(wide)
    benchmark.group = "wide" if wide else "narrow"

    def loop() -> None:
        now = start.copy()
        for _ in range(STEPS):
            now = env.step_mdp(env.step(policy(now)))
            distance(now)

    benchmark.pedantic(loop, rounds=15, warmup_rounds=2)


@WIDTHS
@pytest.mark.parametrize("keep", [(), None], ids=["keep nothing", "keep all"])
@pytest.mark.parametrize("rule", [KeepAll(), KeepBest(0.5)], ids=["no pruning", "pruning"])
def test_search(benchmark: Any, rule: Any, keep: Any, wide: bool) -> None:
    env, policy, start = parts(wide)
    benchmark.group = "wide" if wide else "narrow"

    def search() -> None:
        beam_search(env, policy, distance, start, steps=STEPS, rule=rule, keep=keep, slot_keys=["stream"])

    benchmark.pedantic(search, rounds=15, warmup_rounds=2)
