"""What numba compiles gives the same bits as NumPy, and nobody needs it."""

import builtins
import importlib.util

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import DrivingEnv, ObservationConfig, collate, points, scene
from symphony.envs.compiled import _write_points, point_writer
from symphony.envs.tables import POINT_FEATURES

HAS_NUMBA = importlib.util.find_spec("numba") is not None


def both(agents, count, rows, seed, write):
    """What the blocks write, and what ``write`` does."""
    rng = np.random.default_rng(seed)
    table = rng.normal(0, 30, (rows, POINT_FEATURES)).astype(np.float32)
    index = rng.integers(0, rows, (agents, count))
    pose = [rng.normal(0, 30, (agents, 1)).astype(np.float32) for _ in range(5)]
    outs = [np.full((agents, count, POINT_FEATURES), np.nan, np.float32) for _ in range(2)]
    points._write_in_blocks(index, table, pose, 20.0, outs[0])
    write(index, table, *(value[:, 0].copy() for value in pose), np.float32(20.0), outs[1])
    return outs


@given(st.integers(1, 6), st.integers(1, 9), st.integers(1, 12), st.integers(0, 1 << 16))
def test_one_pass_writes_the_bits_of_many(agents, count, rows, seed):
    blocks, one_pass = both(agents, count, rows, seed, _write_points)
    assert np.array_equal(blocks, one_pass)


@pytest.mark.skipif(not HAS_NUMBA, reason="needs the extra 'compiled'")
def test_compiled_it_writes_the_same_bits():
    write = point_writer()
    assert write is not None
    blocks, compiled = both(300, 200, 2000, 0, write)
    assert np.array_equal(blocks, compiled)


def observed(count):
    store = SegmentStore(builtin_store("train"))
    env = DrivingEnv(collate([scene(store[k], 2) for k in range(3)]), observation=ObservationConfig(4, count))
    return env.start(torch.arange(3))["agents", "observation", "points"]


@pytest.mark.parametrize("count", [30, 5000])
def test_an_environment_observes_what_the_writer_writes(monkeypatch, count):
    """With fewer points than there are, and with more."""
    monkeypatch.setattr(points, "point_writer", lambda: None)
    blocks, calls = observed(count), []

    def write(*arguments):
        calls.append(len(arguments))
        _write_points(*arguments)

    monkeypatch.setattr(points, "point_writer", lambda: write)
    assert torch.equal(observed(count), blocks)
    assert calls == [9]


@pytest.fixture
def found_anew():
    point_writer.cache_clear()
    yield
    point_writer.cache_clear()


@pytest.mark.usefixtures("found_anew")
def test_the_environment_variable_turns_it_off(monkeypatch):
    monkeypatch.setenv("SYMPHONY_COMPILED", "0")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: pytest.fail("looked for"))
    assert point_writer() is None


@pytest.mark.usefixtures("found_anew")
def test_a_numba_that_cannot_be_imported_is_said_and_done_without(monkeypatch):
    real = builtins.__import__

    def refused(name, *arguments, **more):
        if name == "numba":
            raise ImportError("Numba needs NumPy 2.4 or less")
        return real(name, *arguments, **more)

    monkeypatch.delenv("SYMPHONY_COMPILED", raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(builtins, "__import__", refused)
    with pytest.warns(RuntimeWarning, match="nothing is compiled: Numba needs NumPy"):
        assert point_writer() is None
