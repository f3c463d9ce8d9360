"""Demonstrations: fitted together as one by one, close to the log, kept with their store and in memory."""

from __future__ import annotations

import hashlib
import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_segments import crossing, hide, straight_road
from helpers_store import fill
from symphony import keys
from symphony.data.builtin import builtin_store
from symphony.data.resample import resample, smooth
from symphony.data.segment import RunSegment
from symphony.data.sources import get_reader
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, Displacement, ObservationConfig
from symphony.geometry import with_speed
from symphony.learning import SceneDataset
from symphony.learning import experts as module
from symphony.learning.demonstrations import ItemCache
from symphony.learning.experts import VERSION, Experts, fit_experts

DYNAMICS = pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])


def segments() -> list[RunSegment]:
    """Of several lengths and time steps, with gaps, with made and recorded traffic."""
    store = SegmentStore(builtin_store("train"))
    short = straight_road(3, steps=11).replace(dt=0.1)
    hidden = hide(crossing(5), 2, slice(10, 20)), hide(straight_road(5), 1, slice(0, 7))
    return [straight_road(4, steps=31), hidden[0], store[3], short, hidden[1], store[40]]


@DYNAMICS
@pytest.mark.parametrize("together", [12, 10_000])
def test_fitting_together_is_the_fit_of_the_dynamics(dynamics, together, monkeypatch):
    monkeypatch.setattr(module, "TOGETHER", together)
    for segment, found in zip(segments(), fit_experts(segments(), dynamics), strict=True):
        rows = found.agent.numpy()
        parts = segment.position[rows, :, :2], segment.heading[rows, :, None], segment.velocity[rows]
        valid, size = torch.from_numpy(segment.valid[rows]), torch.from_numpy(segment.size[rows, :2])
        log = with_speed(torch.from_numpy(np.concatenate(parts, -1)))
        actions, states = dynamics.fit(log, valid, size, segment.dt)
        assert len(rows) > 1
        torch.testing.assert_close(found.actions.to(actions.dtype), actions, atol=1e-6, rtol=0)
        torch.testing.assert_close(found.states, states, atol=1e-6, rtol=0)
        assert torch.equal(found.valid, valid[:, 1:] & valid[:, :-1])
        assert found.states.untyped_storage().nbytes() == states.nbytes


def test_experts_drive_or_wait_in_a_lane_and_are_not_parked() -> None:
    segment = straight_road(4)
    position, velocity = segment.position.copy(), segment.velocity.copy()
    position[1:3] = position[1:3, :1]
    velocity[1:3] = 0
    position[2, :, 1] += 1.5  # beside its lane
    (found,) = fit_experts([segment.replace(position=position, velocity=velocity)], Bicycle())
    assert found.agent.tolist() == [0, 1, 3]
    assert found.error.max() < 0.15
    assert (found.actions[1] == 73).all()  # who waits neither steers nor brakes


@DYNAMICS
def test_expert_batches_show_what_the_environment_shows(dynamics: Any, tmp_path: Path) -> None:
    fill(tmp_path / "store", [straight_road(4, steps=11), crossing(4, steps=16)])
    dataset = SceneDataset(SegmentStore(tmp_path / "store"), 2, dynamics)
    sees, rng = ObservationConfig(num_objects=4, num_points=20), torch.Generator().manual_seed(0)
    batch = dataset.sample_states([0, 1], 50, sees, rng)
    assert batch[keys.POINTS].shape == (50, 1, 20, 23)
    assert batch[keys.VALID].all()
    assert batch[keys.OWN][..., 0].mean() > 0.3  # everybody drives at 6 to 15 m/s
    seen = batch[keys.OBJECTS][..., :2][batch[keys.OBJECTS_MASK]]
    assert seen.norm(dim=-1).min() * 20 > 1  # nobody sees itself


def final_errors(found: list[RunSegment]) -> torch.Tensor:
    return torch.cat([experts.error for experts in fit_experts(found, Bicycle())])


@pytest.mark.parametrize("split", ["train", "test"])
def test_the_fit_of_the_built_in_set_ends_near_the_log(split: str) -> None:
    store = SegmentStore(builtin_store(split))
    errors = final_errors([store[item] for item in range(0, len(store), 3)])
    assert len(errors) > 100
    assert errors.mean() < 0.15


@pytest.mark.samples
def test_the_fit_of_ngsim_ends_near_the_log(samples: Path) -> None:
    reader, files = get_reader("commonroad"), sorted((samples / "commonroad" / "ngsim").glob("*.xml"))
    found = [resample(smooth(segment, 0.4), 0.2) for file in files for segment in reader.read(file)]
    errors = final_errors(found)
    assert len(found) == 20
    assert errors.mean() < 0.5
    assert errors.quantile(0.95) < 0.5


@settings(max_examples=50)
@given(
    st.lists(st.lists(st.integers(0, 9), min_size=1, max_size=4), max_size=20),
    st.integers(1, 60),
    st.none() | st.integers(1, 5),
)
def test_the_cache_gives_what_was_asked_for_and_holds_no_more_than_it_may(calls, limit, keep):
    asked: list[list[int]] = []

    def make(items: Any) -> list[bytes]:
        asked.append(list(items))
        return [bytes(3 * item) for item in items]

    cache = ItemCache(make, len, keep=keep, limit=limit, name="bytes")
    crowded = False
    for items in calls:
        held = set(cache.kept)
        asked.clear()
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert [len(value) for value in cache.many(items)] == [3 * item for item in items]
        # What is missing is made together; the oldest go, but one is held however large it is.
        missing = [item for item in dict.fromkeys(items) if item not in held]
        assert asked == ([missing] if missing else [])
        assert sum(3 * item for item in cache.kept) <= limit or len(cache.kept) == 1
        assert len(cache.kept) <= (keep or 99)
        assert items[-1] in cache.kept
        # It is said once, when the first has to go.
        assert len(told) <= (not crowded)
        crowded = crowded or bool(told)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A copy of the built-in store, without what was kept with it."""
    without = shutil.ignore_patterns("experts")
    return Path(shutil.copytree(builtin_store("train"), tmp_path / "s", ignore=without))


def files(store: Path) -> list[Path]:
    return sorted((store / "experts").glob("*.npz"))


def data(store: Path, dynamics: Any = None, **how: Any) -> SceneDataset:
    return SceneDataset(SegmentStore(store), 2, dynamics or Bicycle(), **how)


def same(a: Experts, b: Experts) -> None:
    for name in ("agent", "states", "actions", "valid", "error"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=0, msg=name)
    for one, other in zip(a.routes, b.routes, strict=True):
        for name in ("points", "count", "right", "logged"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name


@DYNAMICS
@pytest.mark.parametrize("routes", [True, False])
def test_what_was_kept_is_what_was_fitted(store, dynamics, routes, monkeypatch):
    first = data(store, dynamics, routes=routes).experts.many([0, 1, 2])
    assert len(files(store)) == 3
    monkeypatch.setattr("symphony.learning.demonstrations.fit_experts", None)  # nothing is fitted again
    again = data(store, dynamics, routes=routes).experts.many([2, 0, 1])
    for a, b in zip(first, [again[1], again[2], again[0]], strict=True):
        same(a, b)


def test_another_action_space_or_duration_is_kept_apart(store: Path) -> None:
    for dynamics, how in ((None, {}), (Bicycle(num_acceleration=21), {}), (None, {"duration": 5})):
        data(store, dynamics, **how).experts(0)
    data(store, routes=True).experts(0)
    assert len(files(store)) == 4


def test_damaged_files_are_made_anew(store: Path) -> None:
    right = data(store, routes=True).experts(0)
    (file,) = files(store)
    content = file.read_bytes()
    damaged = [content[: len(content) // 2], b"", b"x" * 500]
    directory = content.rindex(b"PK\x01\x02")  # at the end: version, flags, compression, sizes
    for place, bit in ((place, bit) for place in (8, 20) for bit in range(8)):
        at = directory + place
        damaged.append(content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :])
    for other in damaged:
        file.write_bytes(other)
        same(data(store, routes=True).experts(0), right)
    file.write_bytes(b"")
    data(store, routes=True).experts(0)
    assert file.read_bytes() == content


def test_where_there_is_no_place_nothing_is_kept(store: Path) -> None:
    data(builtin_store("test")).experts(0)
    assert not (builtin_store("test") / "experts").exists()
    (store / "experts").write_text("not a folder")
    assert len(data(store).experts(0).agent)


def test_the_version_is_raised_when_the_fit_or_the_routes_change(store: Path) -> None:
    """If this fails, raise VERSION and renew the digest: what stores kept is not what would be fitted now."""
    # Whole numbers only, as the last bits of others depend on the processor.
    facts = [
        [len(expert.agent), [[t.logged, t.count.tolist(), t.right.tolist()] for t in expert.routes]]
        for expert in data(store, routes=True).experts.many(range(6))
    ]
    digest = hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]
    assert (VERSION, digest) == (3, "2d0eaede120071d5")
