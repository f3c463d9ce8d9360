"""Conversion: what is kept, what is skipped and told, and that a failure leaves nothing behind."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers_convert import FakeReader, scene
from helpers_segments import crossing
from helpers_sources import off_road
from symphony.data.builtin import builtin_store
from symphony.data.convert import Report, convert, expand, info, merge
from symphony.data.odd import crop
from symphony.data.report import Skip
from symphony.data.resample import resample, smooth
from symphony.data.segment import Polylines, content_hash, validate
from symphony.data.selection import road_points
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
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


def test_bad_arguments_are_named(logs: Write, out: Path) -> None:
    bad: dict[str, Any] = {"rate": float("nan"), "smooth": -1, "interactive": 0, "radius": 0}
    for name, value in bad.items():
        with pytest.raises(ConfigError, match=f"{name} must be between"):
            convert(FakeReader(), [logs("a.scene", "straight 1")], out, **{name: value})
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


# --- several stores as one -----------------------------------------------------------------------------------

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
    with StoreWriter(tmp_path / "half") as writer:
        writer.copy(store, 0)
        writer.write_report({"settings": {"segments": 9}, "generation": {"complete": False}})
    with pytest.raises(DataError, match=r"half: holds 1 of 9 segments"):
        merge([PARTS[1], tmp_path / "half"], tmp_path / "all")


# --- cropping: what is near stays as it is, what is far goes ------------------------------------------------------


@given(st.floats(5, 400), st.integers(0, 20))
def test_what_stays_is_what_it_was(radius: float, seed: int) -> None:
    segment = crossing(seed=seed)
    assert content_hash(crop(segment, 5000)) == content_hash(segment)
    found = validate(crop(segment, radius))
    rows = np.flatnonzero(np.isin(segment.agent_id, found.agent_id))
    for name in ("agent_id", "agent_type", "size", "position", "heading", "velocity", "valid"):
        np.testing.assert_array_equal(getattr(found, name), getattr(segment, name)[rows])
    assert found.agent_id[found.ego] == segment.agent_id[segment.ego]
    path = segment.position[segment.ego, segment.valid[segment.ego], :2]
    for a in range(segment.num_agents):
        spots = segment.position[a, segment.valid[a], :2]
        away = np.hypot(*(spots[:, None] - path).transpose(2, 0, 1)).min() if len(spots) else np.inf
        # The path has corners, its ends are round: both to the same millimetre.
        if a in rows:
            assert away < radius + 1
        else:
            assert away > radius - 1
    for old, new, name in ((segment.road, found.road, n) for n in ("successors", "left_neighbors")):
        kept = {
            (a, b) for a, b in old.lane_id[getattr(old, name)].tolist() if {a, b} <= set(new.lane_id.tolist())
        }
        assert {(a, b) for a, b in new.lane_id[getattr(new, name)].tolist()} == kept
    light = dict(zip(segment.road.lane_id[segment.signal_lane], segment.signal_state.tolist(), strict=True))
    for lane, states in zip(found.road.lane_id[found.signal_lane], found.signal_state.tolist(), strict=True):
        assert light[lane] == states


def test_the_boundary_near_the_ego_is_as_it_was() -> None:
    segment = crossing()
    lines = [segment.road.boundary[k] for k in range(len(segment.road.boundary))]
    far = [np.float32([(400 + 2 * k, 300, 0) for k in range(50)])]
    whole = dataclasses.replace(segment.road, boundary=Polylines.of([*lines[:2], *far, *lines[2:], *far]))
    found = crop(segment.replace(road=whole), 30)
    assert len(found.road.boundary) == len(lines)
    assert road_points(found) < road_points(segment.replace(road=whole))
    path = segment.position[segment.ego, :, :2]
    spots = np.concatenate([path + shift for shift in ((0, 0), (3, 0), (-3, 0), (0, 6), (0, -6))])
    np.testing.assert_allclose(off_road(found.road, spots), off_road(segment.road, spots), atol=1e-4)
