"""Stores that changed on the disk: whoever reads what changed is told where, and nothing else is."""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_segments import crossing, straight_road
from helpers_store import files, fill, unlike
from symphony.cli import main
from symphony.data.segment import RunSegment, content_hash
from symphony.data.store import SegmentStore
from symphony.data.store_format import SEGMENTS
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    fill(tmp_path / "store", [crossing(seed=1), straight_road(seed=2), crossing(seed=3)])
    return tmp_path / "store"


def change(path: Path, offset: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(offset)
        assert file.read(len(data)) != data
        file.seek(offset)
        file.write(data)


def test_unknown_headers_are_refused(folder: Path) -> None:
    for text, message in (
        ('{"format": "symphony segment store", "version": 2}', "reads a symphony segment store of version 1"),
        ('{"format": "zarr", "version": 1}', "is 'zarr'"),
        ("{", "cannot be read as JSON"),
        ("[]", "not an object"),
    ):
        (folder / "store.json").write_text(text)
        for use in (SegmentStore, lambda path: StoreWriter(path, append=True)):
            with pytest.raises(DataError, match=message):
                use(folder)


def test_every_missing_or_short_file_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "store"
    fill(folder, unlike(3))
    assert len(files(folder)) == 32
    for path in files(folder):
        whole = path.read_bytes()
        path.unlink()
        with pytest.raises(DataError, match=path.name):
            SegmentStore(folder)
        path.write_bytes(whole[:-1])
        if path.name == "segments.idx":
            assert len(SegmentStore(folder)) == 2
        elif whole:  # nobody uses the optional field
            with pytest.raises(DataError, match=path.name):
                SegmentStore(folder)
        path.write_bytes(whole)
    assert len(SegmentStore(folder)) == 3


def test_one_float_that_changed_is_noticed_where_it_is_read(folder: Path) -> None:
    begin = int(SegmentStore(folder)._segments[1]["begin"][SEGMENTS.axes["states"]])
    change(folder / "columns" / "position.bin", 12 * begin, np.float32(1.5).tobytes())
    store = SegmentStore(folder)
    for sound in (0, 2):
        assert isinstance(store[sound], RunSegment)
    for read in (lambda: store[1], lambda: pickle.loads(pickle.dumps(store))[1], store.verify):  # noqa: S301
        with pytest.raises(DataError, match="does not match its hash") as caught:
            read()
        assert (caught.value.file, caught.value.segment) == (folder, "straight-2")


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


def rehash(folder: Path) -> None:
    """Give what is in a store the hashes it has now, as who wants to deceive would."""
    store = SegmentStore(folder)
    index = SEGMENTS.index_path(folder)
    records = np.fromfile(index, SEGMENTS.record)
    for k in range(len(records)):
        records[k]["hash"] = np.frombuffer(bytes.fromhex(content_hash(store._read(k))), np.uint8)
    index.write_bytes(records.tobytes())


@pytest.mark.parametrize(
    ("column", "data", "field"),
    [
        ("heading", np.float32(np.nan).tobytes(), "heading"),
        ("agent_type", b"\x77", "agent_type"),
        ("lanes.points", np.float32(1e30).tobytes(), "road.lanes"),
        ("lanes.offsets", np.int64(7).tobytes(), "road.lanes"),
        ("successors", np.int32(-5).tobytes(), "road.successors"),
    ],
)
def test_what_breaks_the_schema_is_refused_whatever_its_hash(
    folder: Path, column: str, data: bytes, field: str
) -> None:
    change(folder / "columns" / f"{column}.bin", 0, data)
    rehash(folder)
    with pytest.raises(DataError) as caught:
        SegmentStore(folder)[0]
    assert (caught.value.file, caught.value.segment, caught.value.field) == (folder, "crossing-1", field)


@pytest.mark.parametrize("column", ["segment_id", "source", "file", "tags"])
@pytest.mark.parametrize("data", [b"\xff", b"["])
def test_texts_that_are_none(tmp_path: Path, column: str, data: bytes) -> None:
    with StoreWriter(tmp_path / "b") as writer:
        writer.append(crossing(file="b.xml"), tags={"a": "b"})
    change(tmp_path / "b" / "columns" / f"{column}.bin", 0, data)
    with pytest.raises(DataError, match=r"field tags: not JSON" if column == "tags" else "its hash"):
        _ = SegmentStore(tmp_path / "b")[0]


WRONG = [(field, value) for field in ("steps", "map", "ego", "count") for value in (2**62, -1, 2**63 - 1)]


@pytest.mark.parametrize(("field", "value"), [*WRONG, ("steps", 0), ("count", 0), ("begin", 0)])
def test_records_that_contradict_themselves(folder: Path, field: str, value: Any) -> None:
    index = SEGMENTS.index_path(folder)
    records = np.fromfile(index, SEGMENTS.record)
    records[2][field] = value
    index.write_bytes(records.tobytes())
    with pytest.raises(DataError):
        SegmentStore(folder).verify()


def test_an_index_that_was_cut_short_is_recognised(folder: Path) -> None:
    with StoreWriter(folder, append=True) as writer:
        writer.write_report({"converted": 3})
    assert len(SegmentStore(folder)) == 3
    os.truncate(SEGMENTS.index_path(folder), 2 * SEGMENTS.record.itemsize + 5)
    with pytest.raises(DataError, match="cut short") as caught:
        SegmentStore(folder)
    assert caught.value.file == SEGMENTS.index_path(folder)


def test_the_command_verifies(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "verify", str(folder)]) == 0
    assert "3 segments are what was written" in capsys.readouterr().out
    change(folder / "columns" / "heading.bin", 0, np.float32(1.25).tobytes())
    assert main(["data", "verify", str(folder)]) == 1
    found = capsys.readouterr().err
    assert f"file {folder}, segment crossing-1: content does not match its hash" in found
