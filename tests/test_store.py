"""The segment store: what goes in comes out, whatever dies on the way or changes on the disk."""

from __future__ import annotations

import itertools
import os
import pickle
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers_processes import apart
from helpers_segments import crossing, segments, straight_road
from helpers_store import files, fill, hashes, rehash, stored, unlike
from symphony.cli import main
from symphony.data import store_writer
from symphony.data.segment import RunSegment, content_hash
from symphony.data.store import SegmentStore
from symphony.data.store_format import SEGMENTS
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "store"


@pytest.fixture(autouse=True)
def no_sync(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk's own cache is not under test, and waiting for it is slow."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


def same(one: Path, other: Path) -> None:
    for file in files(one):
        assert file.read_bytes() == (other / file.relative_to(one)).read_bytes(), file


@settings(max_examples=10, deadline=None)
@given(st.lists(segments(), max_size=6, unique_by=lambda s: s.segment_id), st.integers(0, 6))
def test_round_trip(found: list[RunSegment], split: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "store"
        fill(path, found[:split])
        fill(path, found[split:], append=True)
        store = SegmentStore(path)
        assert (hashes(store), store.ids) == (hashes(found), [s.segment_id for s in found])
        for i, segment in enumerate(found):
            assert store.index_of(segment.segment_id) == i
            assert content_hash(store[i - len(found)]) == content_hash(segment)
        store.verify()
        for past in (len(found), -len(found) - 1):
            with pytest.raises(IndexError):
                store[past]


def test_groups_and_tags_come_back_and_change_no_hash(folder: Path, tmp_path: Path) -> None:
    with StoreWriter(folder) as writer:
        writer.append(straight_road(seed=1).replace(group="drive 1/ö"), tags={"n": 1, "goal": "left"})
        writer.append(straight_road(seed=2))
        writer.append(straight_road(seed=3), tags={"network": "town-5"})
        with pytest.raises(DataError, match="cannot name a tag"):
            writer.append(straight_road(seed=5), tags={"group": "mine"})
    fill(folder, unlike(3), append=True)
    store = SegmentStore(folder)
    # One without a group is its own; the generator's networks of earlier releases are groups.
    assert store.groups.tolist() == ["drive 1/ö", "straight-2", "town-5", "r0", "r1", "r2"]
    assert [segment.group for segment in store] == store.groups.tolist()
    assert [store.tags(i) for i in range(3)] == [{"n": 1, "goal": "left"}, {}, {"network": "town-5"}]
    assert content_hash(store[0]) == content_hash(straight_road(seed=1))
    with StoreWriter(tmp_path / "copy") as writer:
        assert [writer.copy(store, k) for k in range(6)] == list(range(6))
        with pytest.raises(DataError, match="segment r1, field segment_id: a segment of this name"):
            writer.copy(store, 4)
    same(folder, tmp_path / "copy")


def test_a_shared_map_is_stored_once(folder: Path) -> None:
    found = [*(crossing(seed=k) for k in range(4)), straight_road()]
    fill(folder, found[:2])
    store = fill(folder, found[2:], append=True)
    for array in (store[0].position, store[0].valid, store[0].road.lanes.points):
        assert not array.flags.owndata
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    assert (len(store.map_hashes), store.map_index.tolist()) == (2, [0, 0, 0, 0, 1])
    lanes = sum(len(store.road(k).lanes.points) for k in range(2))
    assert (folder / "columns" / "lanes.points.bin").stat().st_size == lanes * 12
    assert hashes(store) == hashes(found)


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


@pytest.mark.parametrize(("change", "field"), [
    ({"dt": -1.0}, "dt"), ({"agent_id": np.arange(3, dtype=np.int32)}, "agent_id"),
    ({"heading": np.full((3, 51), np.nan, np.float32)}, "heading"), ({"segment_id": "r0"}, "segment_id"),
])  # fmt: skip
def test_what_is_refused_leaves_no_trace(folder: Path, change: dict[str, Any], field: str) -> None:
    found = unlike(3)
    with StoreWriter(folder) as writer:
        writer.append(found[0])
        bad = straight_road(file="log.xml").replace(**change)
        with pytest.raises(DataError) as caught:
            writer.append(bad)
        error = caught.value
        assert (error.field, error.segment, error.file) == (field, bad.segment_id, "log.xml")
        writer.append(found[1])
        writer.append(found[2])
    assert hashes(SegmentStore(folder)) == hashes(found)


def test_a_failed_write_is_undone(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full after a few columns; the writer goes on once there is room."""
    found, write, calls = unlike(3), store_writer._write_at, itertools.count()

    def full(*args: Any) -> None:
        if next(calls) == 18:  # past the map's columns, amid the segment's
            raise OSError(28, "no space left on device")
        write(*args)

    with StoreWriter(folder) as writer:
        writer.append(found[0])
        with monkeypatch.context() as patch:
            patch.setattr(store_writer, "_write_at", full)
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


def test_foreign_directories_are_left_alone(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for append in (False, True):
        for place in (tmp_path, tmp_path / "notes.txt"):
            with pytest.raises(DataError, match="not empty and not a segment store"):
                StoreWriter(place, append=append)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]
    for place, message in ((tmp_path, "no store.json"), (folder, "no such directory")):
        with pytest.raises(DataError, match=message):
            SegmentStore(place)
    fill(folder, [straight_road()])
    with pytest.raises(DataError, match="already a segment store"):
        StoreWriter(folder)
    (folder / "store.json").unlink()
    with pytest.raises(DataError, match="refusing to write"):
        StoreWriter(folder, append=True)


@settings(max_examples=6, deadline=None)
@given(data=st.data())
def test_any_unfinished_tail_is_cut_off(data: st.DataObject) -> None:
    """Files hold any part of the fourth segment, or noise in place of it; the index says three."""
    with tempfile.TemporaryDirectory() as name:
        path, three, four, clean = (Path(name) / each for each in ("store", "three", "four", "clean"))
        for store, count in ((path, 3), (three, 3), (four, 4), (clean, 5)):
            fill(store, unlike(count))
        for file in files(path):
            old, new = file.read_bytes(), (four / file.relative_to(path)).read_bytes()
            tail = new[len(old) :]
            whole = file.name == "segments.idx"
            tail = tail[: data.draw(st.integers(0, len(tail) - whole))]
            if not whole and data.draw(st.booleans()):
                tail = data.draw(st.binary(max_size=40))
            file.write_bytes(old + tail)
        assert hashes(SegmentStore(path)) == hashes(unlike(3))
        fill(path, [], append=True)
        same(path, three)
        fill(path, unlike(2, start=3), append=True)
        same(path, clean)


def test_killed_between_any_two_writes(folder: Path) -> None:
    found, write, seen = unlike(2), store_writer._write_at, list[int]()
    moments: list[Path] = []

    def spy(*args: Any) -> None:
        moments.append(folder.parent / f"moment{len(moments)}")
        shutil.copytree(folder, moments[-1])
        write(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_writer, "_write_at", spy)
        fill(folder, found)
    for path in moments:
        before = SegmentStore(path)
        seen.append(len(before))
        assert hashes(before) == hashes(found[: len(before)])
        fill(path, found[len(before) :], append=True)
        same(path, folder)
    assert set(seen) == {0, 1}


@pytest.mark.parametrize("survivors", [0, 5, 40])
def test_killed_before_the_header_was_there(folder: Path, survivors: int) -> None:
    fill(folder, [])
    (folder / "store.json").rename(folder / ".store.1.new.json")
    for file in files(folder)[survivors:]:
        file.unlink()
    fill(folder, unlike(2))
    assert hashes(SegmentStore(folder)) == hashes(unlike(2))


def watch(path: Path, count: int) -> None:
    """Open a store again and again until it holds enough segments, verifying all."""
    seen = 0
    while seen < count:
        store = SegmentStore(path)
        store.verify()
        assert store.ids == [f"r{k}" for k in range(len(store))]
        assert len(store) >= seen
        seen = len(store)


def test_processes_read_while_a_writer_appends(folder: Path) -> None:
    fill(folder, [])
    readers = [apart(watch, folder, 40) for _ in range(2)]
    fill(folder, unlike(20), append=True)
    fill(folder, unlike(20, start=20), append=True)
    for reader in readers:
        reader.join(60)
        assert reader.exitcode == 0


filled = stored(lambda: [crossing(seed=1), straight_road(seed=2), crossing(seed=3)], scope="function")


def change(path: Path, offset: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(offset)
        assert file.read(len(data)) != data
        file.seek(offset)
        file.write(data)


def test_unknown_headers_are_refused(filled: Path) -> None:
    for text, message in (
        ('{"format": "symphony segment store", "version": 2}', "reads a symphony segment store of version 1"),
        ('{"format": "zarr", "version": 1}', "is 'zarr'"), ("{", "not valid JSON"), ("[]", "not a JSON object"),
    ):  # fmt: skip
        (filled / "store.json").write_text(text)
        for use in (SegmentStore, lambda path: StoreWriter(path, append=True)):
            with pytest.raises(DataError, match=message):
                use(filled)


def test_every_missing_or_short_file_is_named(tmp_path: Path) -> None:
    filled = tmp_path / "store"
    fill(filled, unlike(3))
    assert len(files(filled)) == 32
    for path in files(filled):
        whole = path.read_bytes()
        path.unlink()
        with pytest.raises(DataError, match=path.name):
            SegmentStore(filled)
        path.write_bytes(whole[:-1])
        if path.name == "segments.idx":
            assert len(SegmentStore(filled)) == 2
        elif whole:  # nobody uses the optional field
            with pytest.raises(DataError, match=path.name):
                SegmentStore(filled)
        path.write_bytes(whole)
    assert len(SegmentStore(filled)) == 3


def test_one_float_that_changed_is_noticed_where_it_is_read(filled: Path) -> None:
    begin = int(SegmentStore(filled)._segments[1]["begin"][SEGMENTS.axes["states"]])
    change(filled / "columns" / "position.bin", 12 * begin, np.float32(1.5).tobytes())
    store = SegmentStore(filled)
    for sound in (0, 2):
        assert isinstance(store[sound], RunSegment)
    for read in (lambda: store[1], lambda: pickle.loads(pickle.dumps(store))[1], store.verify):  # noqa: S301
        with pytest.raises(DataError, match="does not match its hash") as caught:
            read()
        assert (caught.value.file, caught.value.segment) == (filled, "straight-2")


@pytest.mark.parametrize("column", ["segment_id", "source", "file", "tags"])
def test_text_that_is_none_is_refused_and_never_replaced(tmp_path: Path, column: str) -> None:
    with StoreWriter(tmp_path) as writer:
        for seed in range(2):
            writer.append(crossing(seed=seed).replace(file="log"), tags={"seed": seed})
    store, whole = SegmentStore(tmp_path), {"segment_id": "ids", "source": "sources", "tags": "groups"}
    path = tmp_path / "columns" / f"{column}.bin"
    change(path, path.stat().st_size // 2, b"\xff")
    for read in (lambda: store[1], lambda: getattr(store, whole[column]) if column in whole else store[1]):
        with pytest.raises(DataError, match="not UTF-8") as caught:
            read()
        assert (caught.value.file, caught.value.segment, caught.value.field) == (tmp_path, "number 1", column)


def test_every_changed_byte_is_noticed(tmp_path: Path) -> None:
    fill(tmp_path / "store", unlike(3))
    rng = np.random.default_rng(0)
    for path in files(tmp_path / "store"):
        good = path.read_bytes()
        for bit in rng.integers(0, 8 * len(good), 6 if good else 0).tolist():
            damaged = bytearray(good)
            damaged[bit // 8] ^= 1 << bit % 8
            path.write_bytes(damaged)
            with pytest.raises(DataError) as caught:
                SegmentStore(tmp_path / "store").verify()
            assert caught.value.file is not None, path
        path.write_bytes(good)
    SegmentStore(tmp_path / "store").verify()


@pytest.mark.parametrize(("column", "data", "field"), [
    ("heading", np.float32(np.nan).tobytes(), "heading"), ("agent_type", b"\x77", "agent_type"),
    ("lanes.points", np.float32(1e30).tobytes(), "road.lanes"),
    ("lanes.offsets", np.int64(7).tobytes(), "road.lanes"), ("successors", np.int32(-5).tobytes(), "road.successors"),
])  # fmt: skip
def test_what_breaks_the_schema_is_refused(filled: Path, column: str, data: bytes, field: str) -> None:
    change(filled / "columns" / f"{column}.bin", 0, data)
    rehash(filled)
    with pytest.raises(DataError) as caught:
        SegmentStore(filled)[0]
    assert (caught.value.file, caught.value.segment, caught.value.field) == (filled, "crossing-1", field)


WRONG = [(field, value) for field in ("steps", "map", "ego", "count") for value in (2**62, -1, 2**63 - 1)]


@pytest.mark.parametrize(("field", "value"), [*WRONG, ("steps", 0), ("count", 0), ("begin", 0)])
def test_records_that_contradict_themselves(filled: Path, field: str, value: Any) -> None:
    index = SEGMENTS.index_path(filled)
    records = np.fromfile(index, SEGMENTS.record)
    records[2][field] = value
    index.write_bytes(records.tobytes())
    with pytest.raises(DataError):
        SegmentStore(filled).verify()


def test_an_index_that_goes_back_is_refused(filled: Path) -> None:
    records = np.fromfile(index := SEGMENTS.index_path(filled), SEGMENTS.record)
    for field, row, change in (("count", 0, -9), ("begin", 1, -9), ("count", 1, 9)):
        records[field][row] += change
    index.write_bytes(records.tobytes())
    with pytest.raises(DataError, match="do not follow one another"):
        SegmentStore(filled)


def test_an_index_that_was_cut_short_is_recognised(filled: Path) -> None:
    with StoreWriter(filled, append=True) as writer:
        writer.write_report({"converted": 3})
    assert len(SegmentStore(filled)) == 3
    os.truncate(SEGMENTS.index_path(filled), 2 * SEGMENTS.record.itemsize + 5)
    with pytest.raises(DataError, match="cut short") as caught:
        SegmentStore(filled)
    assert caught.value.file == SEGMENTS.index_path(filled)


def test_the_command_verifies(filled: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "verify", str(filled)]) == 0
    assert "3 segments are as they were written" in capsys.readouterr().out
    change(filled / "columns" / "heading.bin", 0, np.float32(1.25).tobytes())
    assert main(["data", "verify", str(filled)]) == 1
    found = capsys.readouterr().err
    assert f"file {filled}, segment crossing-1: content does not match its hash" in found
