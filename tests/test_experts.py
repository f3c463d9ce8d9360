"""Demonstrations fitted together are those fitted one by one."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_segments import crossing, hide, straight_road
from symphony.data.builtin import builtin_store
from symphony.data.segment import RunSegment
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, Displacement
from symphony.geometry import with_speed
from symphony.learning import experts as module
from symphony.learning.demonstrations import ItemCache
from symphony.learning.experts import Experts, fit_experts

DYNAMICS = pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])


def segments() -> list[RunSegment]:
    """Of several lengths and time steps, with gaps, with made and recorded traffic."""
    store = SegmentStore(builtin_store("train"))
    return [
        straight_road(4, steps=31),
        hide(crossing(5), 2, slice(10, 20)),
        store[3],
        straight_road(3, steps=11).replace(dt=0.1),
        hide(straight_road(5), 1, slice(0, 7)),
        store[40],
    ]


@DYNAMICS
@pytest.mark.parametrize("together", [1, 12, 10_000])
def test_fitting_together_is_fitting_one_by_one(
    dynamics: Any, together: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "TOGETHER", together)
    given = segments()
    for segment, found in zip(given, fit_experts(given, dynamics), strict=True):
        (alone,) = fit_experts([segment], dynamics)
        for name in ("agent", "valid", "actions"):
            one, many = getattr(alone, name), getattr(found, name)
            assert one.dtype == many.dtype
            if one.is_floating_point():
                torch.testing.assert_close(many, one, atol=1e-6, rtol=0)
            else:
                assert torch.equal(many, one)
        torch.testing.assert_close(found.states, alone.states, atol=1e-6, rtol=0)
        torch.testing.assert_close(found.error, alone.error, atol=1e-6, rtol=0)


@DYNAMICS
def test_the_fit_is_that_of_the_dynamics(dynamics: Any) -> None:
    for segment, found in zip(segments(), fit_experts(segments(), dynamics), strict=True):
        rows = found.agent.numpy()
        parts = segment.position[rows, :, :2], segment.heading[rows, :, None], segment.velocity[rows]
        actions, states = dynamics.fit(
            with_speed(torch.from_numpy(np.concatenate(parts, -1))),
            torch.from_numpy(segment.valid[rows]),
            torch.from_numpy(segment.size[rows, :2]),
            segment.dt,
        )
        assert len(rows) > 1
        torch.testing.assert_close(found.actions.to(actions.dtype), actions, atol=1e-6, rtol=0)
        torch.testing.assert_close(found.states, states, atol=1e-6, rtol=0)
        assert found.states.untyped_storage().nbytes() == states.nbytes


def test_the_cache_makes_what_is_missing_together_and_lets_the_oldest_go() -> None:
    asked: list[list[int]] = []

    def make(items: Any) -> list[Experts]:
        asked.append(list(items))
        return [Experts(torch.tensor([item]), *(torch.zeros(1) for _ in range(5))) for item in items]

    cache = ItemCache(make, lambda e: e.nbytes, keep=3)
    assert [int(e.agent) for e in cache.many([4, 2, 4])] == [4, 2, 4]
    assert int(cache(2).agent) == 2
    cache.many([4])
    assert [int(e.agent) for e in cache.many([5, 6, 7, 8])] == [5, 6, 7, 8]
    assert int(cache(8).agent) == 8
    cache(4)
    assert asked == [[4, 2], [5, 6, 7, 8], [4]]


@settings(max_examples=50)
@given(st.lists(st.lists(st.integers(0, 9), min_size=1, max_size=4), max_size=20), st.integers(1, 60))
def test_the_cache_holds_no_more_bytes_than_it_may_and_gives_what_was_asked_for(
    calls: list[list[int]], limit: int
) -> None:
    cache = ItemCache(lambda items: [bytes(3 * item) for item in items], len, limit=limit, name="bytes")
    crowded = False
    for items in calls:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert [len(value) for value in cache.many(items)] == [3 * item for item in items]
        # One item is held however large it is.
        held = sum(3 * item for item in cache.kept)
        assert held <= limit or len(cache.kept) == 1
        assert all(size == 3 * item for item, (_, size) in cache.kept.items())
        # It is said once, when the first has to go.
        assert len(told) <= (not crowded)
        crowded = crowded or bool(told)
