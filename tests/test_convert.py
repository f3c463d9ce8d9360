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


def test_nothing_usable_is_an_error_and_leaves_nothing(logs: Write, out: Path) -> None:
    path = logs("a.scene", *(f"broken {k}" for k in range(7)))
    with pytest.raises(DataError) as error:
        convert(FakeReader(), [path], out)
    text = str(error.value)
    assert text.startswith("none of 7 records could be converted")
    assert "a.scene, segment bad-4, field tracks: 13 is not 7" in text
    assert "bad-5" not in text
    assert text.endswith("and 2 more")
    assert left(out) == []


def test_what_exists_is_not_written_over(logs: Write, out: Path, tmp_path: Path) -> None:
    path = logs("a.scene", "straight 1")
    with pytest.raises(DataError, match="not a segment store"):
        convert(FakeReader(), [path], tmp_path / "logs")
    with pytest.raises(DataError, match="not a segment store"):
        convert(FakeReader(), [path], path)
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
    path = logs("a.scene", "straight 1", "crossing 2", "crossing 3", "broken 4", "lonely 7")
    convert(FakeReader(), [path], out)
    found = json.loads(json.dumps(info(out)))
    store = list(SegmentStore(out))
    assert found["agents"] == sum(s.num_agents for s in store) == 11
    assert (found["segments"], found["signals"], found["maps"], found["version"]) == (3, 24, 2, 1)
    assert found["checksum"] == SegmentStore(out).checksum()
    assert found["sources"] == {"made": 1, "other": 2}
    assert found["steps"] == {"min": 46, "mean": 46, "max": 46}
    assert found["duration"]["max"] == pytest.approx(9.0)
    assert found["lanes"] == {"min": 3, "mean": pytest.approx(43 / 3), "max": 20}
    points = [sum(len(getattr(s.road, k).points) for k in ("lanes", "boundary", "marks")) for s in store]
    assert found["map_points"]["max"] == max(points)
    assert found["bytes"] == sum(p.stat().st_size for p in out.rglob("*") if p.is_file())
    bad, lonely = found["skipped_details"]
    place = {"file": str(path), "segment": "bad-4", "field": "tracks"}
    assert bad == {**place, "message": "13 is not 7"}
    # The paper's exclusions are counted apart from what can't be used.
    assert lonely["exclusion"] == "interactive_agents"
    assert (found["skipped"], found["exclusions"]["interactive_agents"]) == (2, 1)
    assert found["problems"] == {"tracks: # is not #": 1}
