"""Several stores as one."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers_convert import FakeReader
from symphony.data.builtin import builtin_store
from symphony.data.convert import convert, merge
from symphony.data.report import Report, Skip
from symphony.data.segment import content_hash
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import DataError

PARTS = [builtin_store("train"), builtin_store("test")]


def test_the_merged_store_holds_every_segment_as_it_was(tmp_path: Path) -> None:
    stores = [SegmentStore(path) for path in PARTS]
    told: list[tuple[int, int]] = []
    merged = merge(PARTS, tmp_path / "all", lambda done, total: told.append((done, total)))
    merged.verify()
    assert len(merged) == sum(map(len, stores)) == told[-1][0] == told[-1][1]
    offset = 0
    for store in stores:
        for k in (0, len(store) - 1):
            assert content_hash(merged[offset + k]) == content_hash(store[k])
            assert merged.tags(offset + k) == store.tags(k)
        offset += len(store)
    assert merged.groups.tolist() == [name for store in stores for name in store.groups.tolist()]


def test_a_merge_that_was_killed_is_begun_anew(tmp_path: Path) -> None:
    with StoreWriter(tmp_path / "all.merging") as writer:
        writer.copy(SegmentStore(PARTS[0]), 3)
        with pytest.raises(DataError, match="another process"):
            merge(PARTS[1:], tmp_path / "all")
    assert merge(PARTS[1:], tmp_path / "all").checksum() == SegmentStore(PARTS[1]).checksum()
    assert not (tmp_path / "all.merging").exists()


def test_a_conversion_to_the_same_name_is_left_alone(tmp_path: Path) -> None:
    logs = [tmp_path / name for name in ("a.scene", "b.scene")]
    logs[0].write_text("straight 1")
    logs[1].write_text("interrupt")
    with pytest.raises(KeyboardInterrupt):
        convert(FakeReader(), logs, tmp_path / "mine")
    begun = {path: path.read_bytes() for path in (tmp_path / "mine.partial").rglob("*") if path.is_file()}
    with pytest.raises(DataError, match="unfinished conversion to that name"):
        merge(PARTS[1:], tmp_path / "mine")
    assert {path: path.read_bytes() for path in begun} == begun


def test_the_report_of_a_merged_store_joins_those_of_its_parts(tmp_path: Path) -> None:
    reports = []
    for k, name in enumerate("ab"):
        with StoreWriter(tmp_path / name) as writer:
            writer.append(SegmentStore(PARTS[k])[0])
            report = Report(converted=1, files=1, overlaps=k + 1, odd={"jitter": 1}, skipped=[Skip(name)])
            writer.write_report(report.to_json())
        reports.append(report)
    merged = merge([tmp_path / "a", tmp_path / "b"], tmp_path / "both")
    found = Report.from_json(merged.report)
    assert (found.converted, found.files, found.overlaps, found.odd) == (2, 2, 3, {"jitter": 2})
    assert [skip.message for skip in found.skipped] == ["a", "b"]
    # So one that was cut short is seen.
    index = tmp_path / "both" / "segments.idx"
    index.write_bytes(index.read_bytes()[: index.stat().st_size // 2])
    with pytest.raises(DataError, match="cut short"):
        SegmentStore(tmp_path / "both")


def test_the_same_segment_twice_another_time_step_and_what_is_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="in the store already"):
        merge([PARTS[0], PARTS[0]], tmp_path / "twice")
    assert not (tmp_path / "twice").exists()
    store = SegmentStore(PARTS[0])
    with StoreWriter(tmp_path / "slow") as writer:
        writer.append(store[0].replace(dt=0.1, segment_id="slow"))
    with pytest.raises(DataError, match=r"0\.1 s, 0\.2 s"):
        merge([PARTS[1], tmp_path / "slow"], tmp_path / "mixed")
    with pytest.raises(DataError, match="exists already"):
        merge(PARTS, tmp_path / "slow")


def test_a_store_that_is_not_finished_is_not_merged(tmp_path: Path) -> None:
    store = SegmentStore(PARTS[0])
    with StoreWriter(tmp_path / "half") as writer:
        writer.copy(store, 0)
        writer.write_report({"settings": {"segments": 9}, "generation": {"complete": False}})
    with pytest.raises(DataError, match=r"half: holds 1 of 9 segments"):
        merge([PARTS[1], tmp_path / "half"], tmp_path / "all")
