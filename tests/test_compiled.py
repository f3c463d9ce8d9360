"""What numba compiles gives the same bits as NumPy, and nobody needs it."""

from __future__ import annotations

import builtins
import importlib.util
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv, ObservationConfig, collate, points, scene
from symphony.envs.compiled import Writer, _write_points, point_writer
from symphony.envs.tables import POINT_FEATURES

HAS_NUMBA = importlib.util.find_spec("numba") is not None


@pytest.fixture
def found_anew() -> Iterator[None]:
    point_writer.cache_clear()
    yield
    point_writer.cache_clear()


def both(agents: int, count: int, rows: int, seed: int, write: Writer) -> list[NDArray[np.float32]]:
    """What the blocks write, and what ``write`` does."""
    rng = np.random.default_rng(seed)
    table = rng.normal(0, 30, (rows, POINT_FEATURES)).astype(np.float32)
    index = rng.integers(0, rows, (agents, count))
    pose = [rng.normal(0, 30, agents).astype(np.float32) for _ in range(5)]
    outs = [np.full((agents, count, POINT_FEATURES), np.nan, np.float32) for _ in range(2)]
    for one, out in zip((points._write_in_blocks, write), outs, strict=True):
        one(index, table, *pose, np.float32(20.0), out)
    return outs


@given(st.integers(1, 6), st.integers(1, 9), st.integers(1, 12), st.integers(0, 1 << 16))
def test_one_pass_writes_the_bits_of_many(agents: int, count: int, rows: int, seed: int) -> None:
    blocks, one_pass = both(agents, count, rows, seed, _write_points)
    assert np.array_equal(blocks, one_pass)


@pytest.mark.skipif(not HAS_NUMBA, reason="needs the extra 'compiled'")
@pytest.mark.usefixtures("found_anew")
def test_compiled_it_writes_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SYMPHONY_COMPILED", raising=False)
    write = point_writer()
    assert write is not None
    blocks, compiled = both(300, 200, 2000, 0, write)
    assert np.array_equal(blocks, compiled)


def observed(count: int) -> Tensor:
    store = SegmentStore(builtin_store("train"))
    env = DrivingEnv(collate([scene(store[k], 2) for k in range(3)]), observation=ObservationConfig(4, count))
    return env.start(torch.arange(3))["agents", "observation", "points"]


@pytest.mark.parametrize("count", [30, 5000])
def test_an_environment_observes_what_the_writer_writes(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """With fewer points than there are, and with more."""
    monkeypatch.setattr(points, "point_writer", lambda: None)
    blocks, calls = observed(count), []

    def write(*arguments: Any) -> None:
        calls.append(len(arguments))
        _write_points(*arguments)

    monkeypatch.setattr(points, "point_writer", lambda: write)
    assert torch.equal(observed(count), blocks)
    assert calls == [9]


@pytest.mark.usefixtures("found_anew")
def test_the_environment_variable_turns_it_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SYMPHONY_COMPILED", "0")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: pytest.fail("looked for"))
    assert point_writer() is None


@pytest.mark.usefixtures("found_anew")
def test_a_numba_that_cannot_be_imported_is_said_and_done_without(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def refused(name: str, *arguments: Any, **more: Any) -> Any:
        if name == "numba":
            raise ImportError("Numba needs NumPy 2.4 or less")
        return real(name, *arguments, **more)

    monkeypatch.delenv("SYMPHONY_COMPILED", raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(builtins, "__import__", refused)
    with pytest.warns(RuntimeWarning, match="nothing is compiled: Numba needs NumPy"):
        assert point_writer() is None
