"""Conversion: what is kept, what is skipped and told, and that a failure leaves nothing behind."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from helpers_convert import FakeReader, scene
from symphony.data.convert import Report, convert, expand, info
from symphony.data.resample import resample, smooth
from symphony.data.segment import content_hash
from symphony.data.store import SegmentStore
from symphony.errors import ConfigError, DataError

Write = Callable[..., Path]


@pytest.fixture
def logs(tmp_path: Path) -> Write:
    """Writes a log file of the given lines."""

    def write(name: str, *lines: str) -> Path:
        path = tmp_path / "logs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines))
        return path

    return write


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "made" / "store"


def left(out: Path) -> list[str]:
    return sorted(p.name for p in out.parent.iterdir()) if out.parent.exists() else []


def test_segments_are_smoothed_resampled_and_kept_in_order(logs: Write, out: Path) -> None:
    path = logs("a.scene", "straight 1", "crossing 2", "straight 3")
    report = convert(FakeReader(), [path], out, rate=4.0, smooth=0.3)
    expected = [scene("straight", 1), scene("crossing", 2), scene("straight", 3)]
    expected = [resample(smooth(s.replace(file="a.scene"), 0.3), 0.25) for s in expected]
    store = SegmentStore(out)
    assert [content_hash(s) for s in store] == [content_hash(s) for s in expected]
    assert (report.converted, report.files, report.skipped) == (3, 1, [])
    assert report.settings == {"reader": "fake", "rate": 4.0, "interactive": 2, "smooth": 0.3}
    assert store.report == report.to_json()
    assert left(out) == ["store"]
    store.verify()


def test_bad_records_and_files_are_told_and_passed_over(logs: Write, out: Path) -> None:
    files = [
        logs("a.scene", "straight 1", "broken 5", "broken 6", "lonely 7", "straight 1", "straight 2"),
        logs("b.scene", "straight 3", "stop", "straight 4"),
        logs("c.scene", "straight 5"),
    ]
    report = convert(FakeReader(), files, out)
    assert SegmentStore(out).ids == ["straight-1", "straight-2", "straight-3", "straight-5"]
    assert (report.converted, report.files) == (4, 3)
    found = [(Path(s.file).name, s.segment, s.field, s.message) for s in report.skipped]
    assert found == [
        ("a.scene", "bad-5", "tracks", "13 is not 7"),
        ("a.scene", "bad-6", "tracks", "13 is not 7"),
        ("a.scene", "lonely-7", "agents", "needs 2 interactive agents at its first step, has 1"),
        ("a.scene", "straight-1", "segment_id", "a segment of this name is in the store already"),
        ("b.scene", "", "", "checksum of record 4 does not match"),
    ]
    assert report.reasons["tracks: # is not #"] == 2
    assert sum(report.reasons.values()) == len(report.skipped) == 5
    assert Report.from_json(json.loads(json.dumps(report.to_json()))) == report


@pytest.mark.parametrize("parents", [0, 1])
def test_nothing_usable_is_an_error_and_leaves_nothing(logs: Write, out: Path, parents: int) -> None:
    if not parents:
        out.parent.mkdir()
    path = logs("a.scene", *(f"broken {k}" for k in range(7)))
    with pytest.raises(DataError) as error:
        convert(FakeReader(), [path], out)
    text = str(error.value)
    assert text.startswith("none of 7 records could be converted")
    assert "a.scene, segment bad-4, field tracks: 13 is not 7" in text
    assert "bad-5" not in text
    assert text.endswith("and 2 more")
    assert left(out) == []
    assert out.parent.exists() == (not parents)


def test_appending_skips_what_is_there(logs: Write, out: Path) -> None:
    one, two = logs("a.scene", "straight 1", "broken 5"), logs("b.scene", "crossing 2", "straight 1")
    convert(FakeReader(), [one], out, append=True)
    report = convert(FakeReader(), [one, two], out, append=True)
    assert (report.converted, report.present, len(report.skipped)) == (1, 2, 1)
    assert convert(FakeReader(), [one], out, append=True).present == 1
    store = SegmentStore(out)
    assert store.ids == ["straight-1", "crossing-2"]
    assert store.report["converted"] == 2
    assert len(store.report["skipped"]) == 1
    convert(FakeReader(), [one, two], out.with_name("whole"))
    assert SegmentStore(out.with_name("whole")).checksum() == store.checksum()


def test_appending_keeps_the_store_whatever_happens(logs: Write, out: Path) -> None:
    convert(FakeReader(), [logs("a.scene", "straight 1")], out)
    first = SegmentStore(out).report
    with pytest.raises(DataError, match="none of 1 records"):
        convert(FakeReader(), [logs("b.scene", "broken 1")], out, append=True)
    assert left(out) == ["store"]
    path = logs("c.scene", "straight 1", "straight 2", "broken 3", "interrupt", "straight 4")
    with pytest.raises(KeyboardInterrupt):
        convert(FakeReader(), [path], out, append=True)
    assert SegmentStore(out).ids == ["straight-1"]
    assert SegmentStore(out).report == first
    assert info(out)["unfinished"] == {"files": 0, "of": 1}
    reader = FakeReader()
    reader._stops = False
    with pytest.raises(DataError, match="append to it"):
        convert(reader, [path], out)
    report = convert(reader, [path], out, append=True)
    assert (report.converted, report.present, len(report.skipped)) == (2, 1, 1)
    assert SegmentStore(out).ids == ["straight-1", "straight-2", "straight-4"]
    assert (info(out)["skipped"], info(out)["files"], info(out)["unfinished"]) == (1, 2, None)
    with pytest.raises(DataError, match="field rate: holds segments at 5 steps per second, not 10"):
        convert(FakeReader(), [logs("c.scene", "straight 3")], out, rate=10, append=True)


def test_what_exists_is_not_written_over(logs: Write, out: Path, tmp_path: Path) -> None:
    path = logs("a.scene", "straight 1")
    with pytest.raises(DataError, match="not a segment store"):
        convert(FakeReader(), [path], tmp_path / "logs")
    with pytest.raises(DataError, match="not a segment store"):
        convert(FakeReader(), [path], path, append=True)
    assert path.read_text() == "straight 1"
    convert(FakeReader(), [path], out)
    checksum = SegmentStore(out).checksum()
    with pytest.raises(DataError, match="a segment store already"):
        convert(FakeReader(), [logs("b.scene", "straight 2")], out)
    assert SegmentStore(out).checksum() == checksum


@pytest.mark.parametrize(
    "bad", [{"rate": 0}, {"rate": float("nan")}, {"rate": float("inf")}, {"smooth": -1}, {"interactive": 0}]
)
def test_bad_arguments_are_named(logs: Write, out: Path, bad: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=next(iter(bad))):
        convert(FakeReader(), [logs("a.scene", "straight 1")], out, **bad)
    with pytest.raises(ConfigError, match="unknown data source"):
        convert("nosuch", [logs("a.scene", "straight 1")], out)
    assert left(out) == []


def test_directories_are_searched(logs: Write, tmp_path: Path) -> None:
    paths = [logs("b.scene"), logs("deep/a.scene"), logs("c.scene-00001-of-00009"), logs("a.txt")]
    patterns = FakeReader.patterns
    folder = tmp_path / "logs"
    assert expand([folder], patterns) == sorted(paths[:3])
    assert expand([paths[3], folder, paths[0]], patterns) == [paths[3], *sorted(paths[:3])]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"no \.scene or \.scene-\*-of-\* files in .*empty"):
        expand([tmp_path / "empty"], patterns)
    with pytest.raises(DataError, match="nowhere: no such file"):
        expand([folder, tmp_path / "nowhere"], patterns)
    with pytest.raises(DataError, match="no files given"):
        expand([], patterns)


def test_progress_is_told_after_each_record_and_file(logs: Write, out: Path) -> None:
    told: list[tuple[int, int, int, int]] = []

    def listen(done: int, total: int, report: Report) -> None:
        told.append((done, total, report.converted, len(report.skipped)))

    files = [logs("a.scene", "straight 1", "broken 2"), logs("b.scene", "straight 3")]
    convert(FakeReader(), files, out, progress=listen)
    assert told == [(0, 2, 1, 0), (0, 2, 1, 1), (1, 2, 1, 1), (1, 2, 2, 1), (2, 2, 2, 1)]


def test_info_counts_what_is_there(logs: Write, out: Path) -> None:
    path = logs("a.scene", "straight 1", "crossing 2", "crossing 3", "broken 4")
    convert(FakeReader(), [path], out)
    found = json.loads(json.dumps(info(out)))
    store = list(SegmentStore(out))
    assert found["segments"] == 3
    assert found["agents"] == sum(s.num_agents for s in store) == 11
    assert found["signals"] == 24
    assert found["checksum"] == SegmentStore(out).checksum()
    assert found["sources"] == {"made": 1, "other": 2}
    assert found["maps"] == 2
    assert found["steps"] == {"min": 46, "mean": 46, "max": 46}
    assert found["duration"]["max"] == pytest.approx(9.0)
    assert found["dt"]["min"] == found["dt"]["max"] == 0.2
    assert found["lanes"] == {"min": 3, "mean": pytest.approx(43 / 3), "max": 20}
    points = [
        len(s.road.lanes.points) + len(s.road.boundary.points) + len(s.road.marks.points) for s in store
    ]
    assert found["map_points"]["max"] == max(points)
    assert found["bytes"] == sum(p.stat().st_size for p in out.rglob("*") if p.is_file())
    assert found["skipped"] == 1
    assert found["skipped_details"][0] == {
        "file": str(path),
        "segment": "bad-4",
        "field": "tracks",
        "message": "13 is not 7",
    }
    assert found["version"] == 1
