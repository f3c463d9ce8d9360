"""Demonstrations kept with their store."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from symphony.data.builtin import builtin_store
from symphony.data.store import SegmentStore
from symphony.envs import Bicycle, Displacement
from symphony.learning import SceneDataset
from symphony.learning.experts import VERSION, Experts


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A copy of the built-in store, without what was kept with it."""
    return Path(
        shutil.copytree(builtin_store("train"), tmp_path / "s", ignore=shutil.ignore_patterns("experts"))
    )


def files(store: Path) -> list[Path]:
    return sorted((store / "experts").glob("*.npz"))


def same(a: Experts, b: Experts) -> None:
    for name in ("agent", "states", "actions", "valid", "error"):
        one, other = getattr(a, name), getattr(b, name)
        assert one.dtype == other.dtype, name
        assert torch.equal(one, other), name
    for one, other in zip(a.routes, b.routes, strict=True):
        for name in ("points", "count", "right"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name
        assert one.logged == other.logged


@pytest.mark.parametrize("routes", [True, False])
@pytest.mark.parametrize("dynamics", [Bicycle(), Displacement()])
def test_what_was_kept_is_what_was_fitted(
    store: Path, dynamics: Bicycle | Displacement, routes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = SceneDataset(SegmentStore(store), 2, dynamics, routes=routes).experts.many([0, 1, 2])
    assert len(files(store)) == 3
    monkeypatch.setattr("symphony.learning.demonstrations.fit_experts", None)  # nothing is fitted again
    again = SceneDataset(SegmentStore(store), 2, dynamics, routes=routes).experts.many([2, 0, 1])
    for a, b in zip(first, [again[1], again[2], again[0]], strict=True):
        same(a, b)


def test_another_action_space_or_duration_is_kept_apart(store: Path) -> None:
    SceneDataset(SegmentStore(store), 2, Bicycle()).experts(0)
    SceneDataset(SegmentStore(store), 2, Bicycle(num_acceleration=21)).experts(0)
    SceneDataset(SegmentStore(store), 2, Bicycle(), duration=5).experts(0)
    SceneDataset(SegmentStore(store), 2, Bicycle(), routes=True).experts(0)
    assert len(files(store)) == 4


@pytest.mark.parametrize("damage", ["cut", "empty", "noise"])
def test_damaged_files_are_made_anew(store: Path, damage: str) -> None:
    data = SceneDataset(SegmentStore(store), 2, Bicycle(), routes=True)
    right = data.experts(0)
    (file,) = files(store)
    content = file.read_bytes()
    file.write_bytes({"cut": content[: len(content) // 2], "empty": b"", "noise": b"x" * 500}[damage])
    same(SceneDataset(SegmentStore(store), 2, Bicycle(), routes=True).experts(0), right)
    assert file.read_bytes() == content


def test_nothing_is_written_into_the_package() -> None:
    SceneDataset(SegmentStore(builtin_store("test")), 2, Bicycle()).experts(0)
    assert not (builtin_store("test") / "experts").exists()


def test_without_a_place_nothing_is_kept(store: Path) -> None:
    (store / "experts").write_text("not a folder")
    assert len(SceneDataset(SegmentStore(store), 2, Bicycle()).experts(0).agent)


def test_the_version_is_raised_when_the_fit_or_the_routes_change(store: Path) -> None:
    """If this fails, raise VERSION and renew the digest: what stores kept is not what would be fitted now."""
    found = SceneDataset(SegmentStore(store), 2, Bicycle(), routes=True).experts.many(range(6))
    # Whole numbers only, as the last bits of others depend on the processor.
    facts = [
        [len(expert.agent), [[t.logged, t.count.tolist(), t.right.tolist()] for t in expert.routes]]
        for expert in found
    ]
    digest = hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]
    assert (VERSION, digest) == (3, "2d0eaede120071d5")


@pytest.mark.parametrize("place", [8, 20])
def test_a_damaged_file_is_made_anew(store: Path, place: int) -> None:
    first = SceneDataset(SegmentStore(store), 2, Bicycle()).experts(0)
    (file,) = files(store)
    whole = file.read_bytes()
    # In the directory at the end: version, flags, compression, sizes.
    place += whole.rindex(b"PK\x01\x02")
    for bit in range(8):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << bit
        file.write_bytes(bytes(damaged))
        same(SceneDataset(SegmentStore(store), 2, Bicycle()).experts(0), first)
