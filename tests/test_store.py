"""The segment store: what goes in comes out, whatever dies on the way."""

from __future__ import annotations

import itertools
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_segments import crossing, segments, straight_road
from helpers_store import files, fill, hashes, unlike
from symphony.data.segment import RunSegment, content_hash
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "store"


@pytest.fixture(autouse=True)
def no_sync(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk's own cache is not under test, and waiting for it is slow."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@settings(max_examples=30, deadline=None)
@given(st.lists(segments(), max_size=6, unique_by=lambda s: s.segment_id), st.integers(0, 6))
def test_round_trip(found: list[RunSegment], split: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "store"
        fill(path, found[:split])
        fill(path, found[split:], append=True)
        store = SegmentStore(path)
        assert len(store) == len(found)
        assert hashes(store) == hashes(found)
        assert store.ids == [s.segment_id for s in found]
        for i, segment in enumerate(found):
            assert store.index_of(segment.segment_id) == i
            assert content_hash(store[i - len(found)]) == content_hash(segment)
            for field in ("dt", "ego", "current_step", "segment_id", "source", "file"):
                assert getattr(store[i], field) == getattr(segment, field)
        store.verify()
        for past in (len(found), -len(found) - 1):
            with pytest.raises(IndexError):
                store[past]


def test_groups_come_back_and_change_no_hash(folder: Path, tmp_path: Path) -> None:
    with StoreWriter(folder) as writer:
        writer.append(straight_road(seed=1).replace(group="drive 1/ö"), tags={"n": 1})
        writer.append(straight_road(seed=2))
        writer.append(straight_road(seed=3), tags={"network": "town-5"})
        writer.append(straight_road(seed=4).replace(group="drive 2"))
        with pytest.raises(DataError, match="no name for a tag"):
            writer.append(straight_road(seed=5), tags={"group": "mine"})
    store = SegmentStore(folder)
    own = store.ids[1]
    # One without a group is its own; the generator's networks of earlier releases are groups.
    assert store.groups.tolist() == ["drive 1/ö", own, "town-5", "drive 2"]
    assert [segment.group for segment in store] == store.groups.tolist()
    assert [store.tags(i) for i in range(4)] == [{"n": 1}, {}, {"network": "town-5"}, {}]
    store.verify()
    segment = straight_road(seed=1)
    assert content_hash(store[0]) == content_hash(segment) == content_hash(segment.replace(group="x"))
    with StoreWriter(tmp_path / "copy") as writer:
        for i in range(4):
            writer.copy(store, i)
    assert SegmentStore(tmp_path / "copy").groups.tolist() == store.groups.tolist()


def test_a_shared_map_is_stored_once(folder: Path) -> None:
    one = crossing(seed=0)
    fill(folder, [one])
    size = (folder / "columns" / "lanes.points.bin").stat().st_size
    same = [crossing(seed=k) for k in range(1, 4)]
    fill(folder, [*same, straight_road()], append=True)
    store = SegmentStore(folder)
    assert store.num_maps == 2
    assert store.map_index.tolist() == [0, 0, 0, 0, 1]
    lanes = sum(len(store.road(k).lanes.points) for k in range(2))
    assert (folder / "columns" / "lanes.points.bin").stat().st_size == lanes * 12
    assert size == len(one.road.lanes.points) * 12
    assert hashes(store) == hashes([one, *same, straight_road()])


def test_arrays_are_read_only_views_of_the_files(folder: Path) -> None:
    fill(folder, [crossing()])
    segment = SegmentStore(folder)[0]
    for array in (segment.position, segment.valid, segment.road.lanes.points, segment.signal_state):
        assert not array.flags.owndata
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    a, b = SegmentStore(folder), SegmentStore(folder)
    assert a[0].position.ctypes.data != b[0].position.ctypes.data
    assert np.shares_memory(a[0].position, a[0].position)


def test_checksum_ignores_order_and_layout_and_report(tmp_path: Path) -> None:
    found = unlike(5)
    fill(tmp_path / "a", found)
    fill(tmp_path / "b", found[3:])
    fill(tmp_path / "b", found[2::-1], append=True)
    with StoreWriter(tmp_path / "b", append=True) as writer:
        writer.write_report({"skipped": [1]})
    a, b = SegmentStore(tmp_path / "a"), SegmentStore(tmp_path / "b")
    assert a.ids != b.ids
    assert a.checksum() == b.checksum()
    assert (a.report, b.report) == ({}, {"skipped": [1]})
    fill(tmp_path / "c", [found[0].replace(dt=found[0].dt * 1.5), *found[1:]])
    fill(tmp_path / "d", found[1:])
    assert len({SegmentStore(tmp_path / name).checksum() for name in "acd"}) == 3


def test_a_name_is_refused_the_second_time(folder: Path) -> None:
    fill(folder, [straight_road(seed=1)])
    with StoreWriter(folder, append=True) as writer:
        assert writer.has("straight-1")
        assert not writer.has("straight-2")
        with pytest.raises(DataError, match="segment straight-1, field segment_id"):
            writer.append(straight_road(5, seed=1))
        assert writer.append(straight_road(seed=2)) == 1
    assert SegmentStore(folder).ids == ["straight-1", "straight-2"]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"dt": -1.0}, "dt"),
        ({"agent_id": np.arange(3, dtype=np.int32)}, "agent_id"),
        ({"origin": np.zeros(3, np.float32)}, "origin"),
        ({"heading": np.full((3, 51), np.nan, np.float32)}, "heading"),
    ],
)
def test_a_bad_segment_is_refused_and_leaves_no_trace(
    folder: Path, change: dict[str, object], field: str
) -> None:
    found = unlike(3)
    with StoreWriter(folder) as writer:
        writer.append(found[0])
        with pytest.raises(DataError) as caught:
            writer.append(straight_road(file="log.xml", **{}).replace(**change))
        assert (caught.value.field, caught.value.segment, caught.value.file) == (
            field,
            "straight-0",
            "log.xml",
        )
        writer.append(found[1])
        writer.append(found[2])
    assert hashes(SegmentStore(folder)) == hashes(found)
    SegmentStore(folder).verify()


def test_a_failed_write_is_undone(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full after a few columns; the writer goes on once there is room."""
    from symphony.data import store_format

    found, write, calls = unlike(3), store_format._write_at, itertools.count()

    def full(*args: object) -> None:
        if next(calls) == 18:  # past the map's columns, amid the segment's
            raise OSError(28, "no space left on device")
        write(*args)

    with StoreWriter(folder) as writer:
        writer.append(found[0])
        with monkeypatch.context() as patch:
            patch.setattr(store_format, "_write_at", full)
            with pytest.raises(OSError, match="no space"):
                writer.append(found[1])
        assert not writer.has(found[1].segment_id)
        writer.append(found[2])
        writer.append(found[1])
    assert hashes(SegmentStore(folder)) == hashes([found[0], found[2], found[1]])


def test_only_one_writer_and_none_after_close(folder: Path) -> None:
    with StoreWriter(folder) as writer, pytest.raises(DataError, match="being written"):
        StoreWriter(folder, append=True)
    with pytest.raises(ValueError, match="closed"):
        writer.append(straight_road())
    fill(folder, [straight_road()], append=True)


# --- what may be written into and read ---------------------------------------------------------------------


def test_foreign_directories_are_left_alone(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for append in (False, True):
        with pytest.raises(DataError, match="not empty and not a segment store"):
            StoreWriter(tmp_path, append=append)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(DataError, match=r"no store\.json"):
        SegmentStore(tmp_path)
    with pytest.raises(DataError, match="no such directory"):
        SegmentStore(folder)
    for make in (SegmentStore, StoreWriter):
        with pytest.raises(DataError, match="not a directory"):
            make(tmp_path / "notes.txt")
    fill(folder, [straight_road()])
    with pytest.raises(DataError, match="already a segment store"):
        StoreWriter(folder)
    (folder / "store.json").unlink()
    with pytest.raises(DataError, match="refusing to write"):
        StoreWriter(folder, append=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            '{"format": "symphony segment store", "version": 2}',
            "field version: store version 2; .* reads version 1",
        ),
        ('{"format": "zarr", "version": 1}', "not a segment store"),
        ('{"format": "symphony segment store", "version": 1}', "other columns"),
        ("{", "cannot be read as JSON"),
        ("[]", "not an object"),
    ],
)
def test_unknown_headers_are_refused(folder: Path, text: str, message: str) -> None:
    fill(folder, [straight_road()])
    (folder / "store.json").write_text(text)
    for use in (SegmentStore, lambda path: StoreWriter(path, append=True)):
        with pytest.raises(DataError, match=message):
            use(folder)


def test_every_missing_or_short_file_is_named(folder: Path) -> None:
    fill(folder, unlike(3))
    assert len(files(folder)) == 32
    for path in files(folder):
        whole = path.read_bytes()
        path.unlink()
        for use in (SegmentStore, lambda path: StoreWriter(path, append=True)):
            with pytest.raises(DataError, match=f"{path.name}.*missing"):
                use(folder)
        path.write_bytes(whole[:-1])
        if not whole:  # nobody uses the optional field
            continue
        if path.name == "segments.idx":
            assert len(SegmentStore(folder)) == 2
        else:
            with pytest.raises(DataError, match=path.name):
                SegmentStore(folder)
        path.write_bytes(whole)
    assert len(SegmentStore(folder)) == 3


# --- many processes ----------------------------------------------------------------------------------------


# --- size --------------------------------------------------------------------------------------------------
