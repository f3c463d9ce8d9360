"""Conversion: what is kept, skipped and told; killed, continued or shared, the same store and report."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import multiprocessing
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers_convert import FakeReader, scene
from helpers_processes import apart
from helpers_segments import crossing, hide
from helpers_sources import off_road
from helpers_store import contents
from symphony import parallel as engine
from symphony.data import convert as conversion
from symphony.data import store_format, store_writer
from symphony.data.builtin import builtin_store
from symphony.data.convert import Report, convert, expand, info, merge
from symphony.data.odd import crop
from symphony.data.report import Skip
from symphony.data.resample import resample, smooth
from symphony.data.segment import Polylines, SignalState, content_hash, validate
from symphony.data.selection import road_points
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.errors import ConfigError, DataError, SymphonyError

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


def test_what_lies_between_the_new_steps_or_before_the_ego(logs: Write, out: Path, monkeypatch: Any) -> None:
    """An agent that is seen at odd steps alone is left out; a light keeps what the log knew before the ego came."""
    log = hide(hide(crossing(4, steps=91, dt=0.1), 0, slice(0, 3)), 3, np.arange(91) != 8)
    state = np.where(np.arange(91) == 1, SignalState.STOP, SignalState.UNKNOWN) + np.zeros_like(log.signal_state)
    log = log.replace(signal_state=state.astype(np.uint8))
    monkeypatch.setattr("helpers_convert.scene", lambda *_: log)
    convert(FakeReader(), [logs("a.scene", "crossing 0")], out, hold_lights=True)
    (found,) = SegmentStore(out)
    assert found.agent_id.tolist() == log.agent_id[:3].tolist()
    assert (found.signal_state == SignalState.STOP).all()


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
    assert "a.scene, segment bad-4, field tracks: 13 is not 7" in str(error.value)
    assert left(out) == []


def test_what_exists_is_not_written_over(logs: Write, out: Path, tmp_path: Path) -> None:
    path = logs("a.scene", "straight 1")
    for place in (path.parent, path):
        with pytest.raises(DataError, match="not a segment store"):
            convert(FakeReader(), [path], place)
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


def test_an_output_may_be_a_link(logs: Write, tmp_path: Path) -> None:
    (place := tmp_path / "place").mkdir()
    (link := tmp_path / "link").symlink_to(place)
    convert(FakeReader(), [logs("a.scene", "straight 1")], link, interactive=1)
    assert len(SegmentStore(place)) == len(SegmentStore(link)) == 1


def test_directories_are_searched(logs: Write, tmp_path: Path) -> None:
    paths = [logs("b.scene"), logs("deep/a.scene"), logs("c.scene-00001-of-00009"), logs("a.txt")]
    patterns, folder = FakeReader.patterns, tmp_path / "logs"
    assert expand([folder], patterns) == sorted(paths[:3])
    assert expand([paths[3], folder, paths[0]], patterns) == [paths[3], *sorted(paths[:3])]
    for nothing, message in (([tmp_path / "nowhere"], "no such file"), ([], "no files given")):
        with pytest.raises(DataError, match=message):
            expand([*nothing], patterns)


def test_info_counts_what_is_there(logs: Write, out: Path) -> None:
    path = logs("a.scene", "straight 1", "crossing 2", "crossing 3", "broken 4", "lonely 7")
    convert(FakeReader(), [path], out)
    found = json.loads(json.dumps(info(out)))
    store = list(SegmentStore(out))
    assert found["agents"] == sum(s.num_agents for s in store) == 11
    assert (found["segments"], found["signals"], found["maps"], found["version"]) == (3, 24, 2, 1)
    assert found["checksum"] == SegmentStore(out).checksum()
    assert found["sources"] == {"made": 1, "other": 2}
    assert found["lanes"] == {"min": 3, "mean": pytest.approx(43 / 3), "max": 20}
    assert found["bytes"] == sum(p.stat().st_size for p in out.rglob("*") if p.is_file())
    bad, lonely = found["skipped_details"]
    assert bad == {"file": str(path), "segment": "bad-4", "field": "tracks", "message": "13 is not 7"}
    # The paper's exclusions are counted apart from what can't be used.
    assert lonely["exclusion"] == "interactive_agents"
    assert (found["skipped"], found["exclusions"]["interactive_agents"]) == (2, 1)


PARTS = [builtin_store("train"), builtin_store("test")]


def test_the_merged_store_holds_every_segment_as_it_was(tmp_path: Path) -> None:
    stores = [SegmentStore(path) for path in PARTS]
    merged = merge(PARTS, tmp_path / "all")
    merged.verify()
    assert len(merged) == sum(map(len, stores))
    offset = 0
    for store in stores:
        for k in (0, len(store) - 1):
            assert content_hash(merged[offset + k]) == content_hash(store[k])
            assert merged.tags(offset + k) == store.tags(k)
        offset += len(store)
    assert merged.groups.tolist() == [name for store in stores for name in store.groups.tolist()]
    shutil.copytree(PARTS[1], part := tmp_path / "part")
    counted = {"overlaps": 3, "joined_gaps": 2, "odd": {"a kind": 1}}
    (part / "report.json").write_text(json.dumps(Report(**counted).to_json()))
    both = merge([part], tmp_path / "both", mirror=True)
    assert [both.report[name] for name in counted] == [6, 4, {"a kind": 2}]
    assert len(both) == both.report["converted"] == 2 * len(stores[1])
    assert (both.tags(-1), both.ids[-1]) == (stores[1].tags(-1), f"{stores[1].ids[-1]}-mirrored")
    assert set(both.groups) == set(stores[1].groups)  # of the same recordings
    with pytest.raises(DataError, match="already"):
        merge([tmp_path / "both"], tmp_path / "thrice", mirror=True)


def test_a_merge_that_was_killed_is_begun_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with StoreWriter(tmp_path / "all.merging") as writer:
        writer.copy(SegmentStore(PARTS[0]), 3)
        with pytest.raises(DataError, match="another process"):
            merge(PARTS[1:], tmp_path / "all")

    def stopped(path: Path, **_: Any) -> None:
        if path.suffix != ".lock":
            raise KeyboardInterrupt
        os.unlink(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", stopped)
        with pytest.raises(KeyboardInterrupt):  # while what it left is removed
            merge(PARTS[1:], tmp_path / "all")
    assert merge(PARTS[1:], tmp_path / "all").checksum() == SegmentStore(PARTS[1]).checksum()
    assert not (tmp_path / "all.merging").exists()
    own = merge(PARTS[1:], tmp_path / "more.merging").path
    with pytest.raises(DataError, match="is a store, in the way"):
        merge(PARTS[1:], tmp_path / "more")
    assert SegmentStore(own).checksum() == SegmentStore(PARTS[1]).checksum()


def test_a_conversion_to_the_same_name_is_left_alone(logs: Write, tmp_path: Path) -> None:
    files = [logs("a.scene", "straight 1"), logs("b.scene", "interrupt")]
    with pytest.raises(KeyboardInterrupt):
        convert(FakeReader(), files, tmp_path / "mine")
    begun = contents(tmp_path / "mine.partial")
    with pytest.raises(DataError, match="unfinished conversion to that name"):
        merge(PARTS[1:], tmp_path / "mine")
    assert contents(tmp_path / "mine.partial") == begun


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


def test_the_same_segment_twice_another_time_step_and_what_is_there_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="in the store already"):
        merge([PARTS[0], PARTS[0]], tmp_path / "twice")
    assert not list(tmp_path.iterdir())
    with StoreWriter(tmp_path / "damaged") as writer:
        writer.copy(SegmentStore(PARTS[1]), 0)
    column = tmp_path / "damaged/columns/lanes.points.bin"
    column.write_bytes(bytes([column.read_bytes()[0] ^ 1]) + column.read_bytes()[1:])
    with pytest.raises(DataError, match="damaged: a map does not match its hash"):
        merge([tmp_path / "damaged", PARTS[0]], tmp_path / "both")
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


@given(st.floats(5, 400), st.integers(0, 20))
def test_what_stays_is_what_it_was(radius: float, seed: int) -> None:
    segment = crossing(seed=seed).replace(joined_gaps=5)
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
        assert away < radius + 1 if a in rows else away > radius - 1
    for old, new, name in ((segment.road, found.road, n) for n in ("successors", "left_neighbors")):
        before, after = (set(map(tuple, r.lane_id[getattr(r, name)].tolist())) for r in (old, new))
        assert after == {pair for pair in before if {*pair} <= set(new.lane_id.tolist())}
    joined = segment.road.lane_id[segment.road.successors[-5:]]
    assert found.joined_gaps == np.isin(joined, found.road.lane_id).all(1).sum()
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


LOGS = {"a.scene": ["straight 1", "broken 5", "crossing 2"], "b.scene": ["straight 1", "lonely 7"]}
LOGS |= {"c.scene": ["stop"], "d.scene": ["crossing 3", "straight 1", "straight 4", "straight 4"]}


@pytest.fixture(autouse=True)
def no_sync(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk's own cache is not under test, and waiting for it is slow."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    return write(tmp_path / "paths", LOGS)


def write(folder: Path, paths: dict[str, list[str]]) -> list[Path]:
    folder.mkdir()
    for name, lines in paths.items():
        (folder / name).write_text("\n".join(lines))
    return [folder / name for name in paths]


def snapshots(folder: Path, action: Callable[[], Any]) -> list[Path]:
    """Copies of a folder as a process leaves it that is killed before it changes a file; a few of like moments."""
    taken: list[Path] = []
    count = itertools.count()

    def spied(change: Callable[..., Any], every: int = 1) -> Callable[..., Any]:
        def wrapper(*args: Any, **options: Any) -> Any:
            if next(count) % every == 0:
                taken.append(folder.parent / "moments" / str(len(taken)))
                shutil.copytree(folder, taken[-1])
            return change(*args, **options)

        return wrapper

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_writer, "_write_at", spied(store_writer._write_at, 97))
        for name, every in {"rename": 1, "replace": 1, "rmdir": 3, "unlink": 97}.items():
            patch.setattr(os, name, spied(getattr(os, name), every))
        action()
    assert len(taken) > 10
    return taken


def test_killed_at_any_change(paths: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conversion, "PART_FILES", 2)
    home = tmp_path / "home"
    home.mkdir()

    def run(folder: Path) -> Any:
        return convert(FakeReader(), paths, folder / "store")

    report = run(tmp_path / "whole")
    expected = contents(tmp_path / "whole" / "store")
    for moment in snapshots(home, lambda: run(home)):
        if contents(moment / "store") != expected or (moment / "store.partial" / "job.json").exists():
            assert run(moment) == report
        elif (moment / "store.partial").exists():
            (moment / "store.partial").rmdir()  # all that was left to do
        assert contents(moment / "store") == expected
        assert [p.name for p in moment.iterdir()] == ["store"]


def converted(folder: Path, workers: int, told: Connection) -> None:
    """Convert in a process that may be killed, and tell how it goes."""
    os.fsync = lambda descriptor: None
    conversion.PART_FILES = 3
    # Of all that this process holds, workers need little.
    preload = multiprocessing.get_context("forkserver").set_forkserver_preload
    engine.get_ready = lambda _: preload([convert.__module__, FakeReader.__module__])

    def progress(*_: Any) -> None:
        told.send("on")

    convert(FakeReader(), [folder / "paths"], folder / "store", workers=workers, progress=progress)
    told.send("end")


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_kill_9_at_random_moments(tmp_path: Path) -> None:
    rng = random.Random(1)
    scenes = (f"{rng.choice(['straight', 'crossing', 'broken'])} {k}" for k in range(64))
    paths = {f"{k:02d}.scene": list(itertools.islice(scenes, 4)) for k in range(16)}
    whole = convert(FakeReader(), write(tmp_path / "paths", paths), tmp_path / "whole")
    kills, ended = 0, False
    while not ended:
        heard, told = multiprocessing.Pipe(duplex=False)
        process = apart(converted, tmp_path, 2, told)
        told.close()
        ended = heard.recv() == "end"
        if kills < 2:  # to start two workers takes seconds
            time.sleep(rng.uniform(0, 0.04))
            process.kill()
        with contextlib.suppress(EOFError):
            while not ended:
                ended = heard.recv() == "end"
        process.join()
        kills += process.exitcode == -signal.SIGKILL
    assert kills >= 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["paths", "store", "whole"]
    assert contents(tmp_path / "store") == contents(tmp_path / "whole")
    assert SegmentStore(tmp_path / "store").report == whole.to_json()


def test_finished_files_stay(paths: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conversion, "PART_FILES", 1)
    paths[3].write_text("crossing 3\ninterrupt\nstraight 4")
    with pytest.raises(KeyboardInterrupt):
        convert(FakeReader(), paths, tmp_path / "store")
    read: list[str] = []

    class Watched(FakeReader):
        _stops = False

        def _read(self, path: Path) -> Any:
            read.append(path.name)
            return super()._read(path)

    convert(Watched(), paths, tmp_path / "store")
    assert read == ["d.scene"]


def test_workers_change_nothing(paths: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conversion, "PART_FILES", 1)
    told: dict[int, list[tuple[int, int, int]]] = {1: [], 3: []}
    for workers, heard in told.items():

        def listen(done: int, total: int, report: Report, heard: Any = heard) -> None:
            heard.append((done, total, report.converted))

        convert(FakeReader(), paths, tmp_path / f"by{workers}", workers=workers, progress=listen)
    assert contents(tmp_path / "by1") == contents(tmp_path / "by3")
    assert told[1] == told[3]
    assert not multiprocessing.active_children()


class Deadly(FakeReader):
    def _read(self, path: Path) -> Any:
        if path.name == "c.scene" and multiprocessing.parent_process() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        return super()._read(path)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_worker_dies(paths: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conversion, "PART_FILES", 1)
    with pytest.raises(SymphonyError, match="a worker process ended"):
        convert(Deadly(), paths, tmp_path / "store", workers=2)
    assert (tmp_path / "store.partial").is_dir()
    convert(Deadly(), paths, tmp_path / "store")
    convert(FakeReader(), paths, tmp_path / "whole")
    assert contents(tmp_path / "store") == contents(tmp_path / "whole")


@pytest.mark.parametrize(("what", "message"), [
    ("rate", "rate is 10.0, but the conversion that was interrupted had 5.0"),
    ("fewer", r"the files are others, .* \(.*d\.scene\)"), ("order", "in another order"),
    ("map", r"have changed, since the conversion was interrupted \(.*b\.map\)"),
    ("option", "options is {'option': 'option'}, but .* had {'option': 'usual'}"),
])  # fmt: skip
def test_other_arguments_do_not_go_on(paths: list[Path], tmp_path: Path, what: str, message: str) -> None:
    class WithMaps(FakeReader):
        def __init__(self, option: str = "usual") -> None:
            self.option = option

        def companions(self, path: Path) -> tuple[Path, ...]:
            return (path.with_suffix(".map"),)

    for log in paths[:2]:
        log.with_suffix(".map").write_text("a map")
    paths[3].write_text("interrupt")
    with pytest.raises(KeyboardInterrupt):
        convert(WithMaps(), paths, tmp_path / "store")
    if what == "map":
        os.utime(paths[1].with_suffix(".map"), ns=(0, 1))
    files = {"fewer": paths[:3], "order": paths[::-1]}.get(what, paths)
    reader = WithMaps("option" if what == "option" else "usual")
    with pytest.raises(ConfigError, match=message):
        convert(reader, files, tmp_path / "store", rate=10.0 if what == "rate" else 5.0)
    assert (tmp_path / "store.partial" / "job.json").is_file()


def test_a_folder_of_somebodys_own_is_left_alone(paths: list[Path], tmp_path: Path) -> None:
    """A folder with notes and a store, under the name that unfinished work gets."""
    (tmp_path / "store.partial").mkdir()
    (tmp_path / "store.partial" / "notes.txt").write_text("mine")
    convert(FakeReader(), paths[1:2], tmp_path / "other.partial")
    before = contents(tmp_path)
    for name in ("store", "other"):
        with pytest.raises(DataError, match="no conversion left"):
            convert(FakeReader(), paths, tmp_path / name)
    assert contents(tmp_path) == before


def test_what_is_in_the_way_is_told(paths: list[Path], tmp_path: Path) -> None:
    out, partial = tmp_path / "store", tmp_path / "store.partial"
    paths[3].write_text("straight 9\ninterrupt")
    with pytest.raises(KeyboardInterrupt):
        convert(FakeReader(), paths, out)
    with store_format.lock(partial), pytest.raises(DataError, match="being written by another process"):
        convert(FakeReader(), paths, out)
    convert(FakeReader(), paths[:1], tmp_path / "other")
    (tmp_path / "other").rename(out)
    with pytest.raises(DataError, match="unfinished conversion to that name: delete one of them"):
        convert(FakeReader(), paths, out)
    shutil.rmtree(out)
    job = json.loads((partial / "job.json").read_text())
    for wrong in ({"files": [1]}, *(job | {part: 7} for part in job), job | {"changed": {"a": None}}):
        (partial / "job.json").write_text(json.dumps(wrong))
        with pytest.raises(DataError, match="not the job of a conversion"):
            convert(FakeReader(), paths, out)
