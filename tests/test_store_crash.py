"""A writer that dies at any moment loses no segment that was on record, and none comes twice; readers of other
processes never see half of one.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from helpers_segments import random_segment
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


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same store after three and after four segments."""
    base = tmp_path_factory.mktemp("grown")
    fill(base / "three", unlike(3))
    fill(base / "four", unlike(4))
    return base / "three", base / "four"


# Without shrinking: a failure would take minutes to minimise and is as clear at full size.
@settings(
    max_examples=15,
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_any_unfinished_tail_is_cut_off(grown: tuple[Path, Path], data: st.DataObject) -> None:
    """Files hold any part of the fourth segment, or noise in place of it; the index says three."""
    three, four = grown
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "store"
        shutil.copytree(three, path)
        for file in files(path):
            old, new = file.read_bytes(), (four / file.relative_to(path)).read_bytes()
            tail = new[len(old) :]
            if file.name == "segments.idx":
                tail = tail[: data.draw(st.integers(0, len(tail) - 1))]
            else:
                tail = tail[: data.draw(st.integers(0, len(tail)))]
                if data.draw(st.booleans()):
                    tail = data.draw(st.binary(max_size=40))
            file.write_bytes(old + tail)
        assert hashes(SegmentStore(path)) == hashes(unlike(3))
        fill(path, [], append=True)
        for file in files(path):
            assert file.read_bytes() == (three / file.relative_to(path)).read_bytes()
        fill(path, unlike(2, start=3), append=True)
        assert hashes(SegmentStore(path)) == hashes(unlike(5))
        SegmentStore(path).verify()
        fill(Path(name) / "clean", unlike(5))
        for file in files(path):
            assert file.read_bytes() == (Path(name) / "clean" / file.relative_to(path)).read_bytes()


def moments(path: Path, found: list[RunSegment]) -> Iterator[Path]:
    """Copies of a store at every single write while segments are appended."""
    from symphony.data import store_format

    write = store_format._write_at
    taken: list[Path] = []

    def spy(*args: object) -> None:
        copy = path.parent / f"moment{len(taken)}"
        shutil.copytree(path, copy)
        taken.append(copy)
        write(*args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_format, "_write_at", spy)
        fill(path, found)
    yield from taken


def test_killed_between_any_two_writes(folder: Path) -> None:
    found = unlike(2)
    seen = set()
    for path in moments(folder, found):
        before = SegmentStore(path)
        seen.add(len(before))
        assert hashes(before) == hashes(found[: len(before)])
        with StoreWriter(path, append=True) as writer:
            for segment in found:
                if not writer.has(segment.segment_id):
                    writer.append(segment)
        assert hashes(SegmentStore(path)) == hashes(found)
    assert seen == {0, 1}


@pytest.mark.parametrize("survivors", [0, 1, 5, 40])
def test_killed_before_the_header_was_there(folder: Path, survivors: int) -> None:
    """The writer died while it laid out the empty store."""
    fill(folder, [])
    (folder / "store.json").unlink()
    (folder / "store.json.tmp").write_text("{")
    for file in files(folder)[survivors:]:
        file.unlink()
    fill(folder, unlike(2))
    assert hashes(SegmentStore(folder)) == hashes(unlike(2))


WRITE = """
import sys
sys.path.insert(0, sys.argv[2])
from helpers_segments import random_segment
from symphony.data.store_writer import StoreWriter
with StoreWriter(sys.argv[1], append=True) as writer:
    for k in range(len(writer), 100_000):
        writer.append(random_segment(f"r{k}", seed=k))
        sys.stdout.write(f"{k}\\n")
        sys.stdout.flush()
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_kill_9_loses_nothing_and_repeats_nothing(folder: Path) -> None:
    count = 0
    for pause in (0.0, 0.013, 0.041):
        command = [sys.executable, "-c", WRITE, str(folder), str(Path(__file__).parent)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            first = process.stdout.readline()
            time.sleep(pause)
            process.kill()
            confirmed = [int(line) for line in (first, *process.stdout)]
        assert process.returncode == -signal.SIGKILL
        assert confirmed[0] == count
        store = SegmentStore(folder)
        assert len(store) - 1 - confirmed[-1] in {0, 1}  # one may be written and not yet reported
        count = len(store)
    assert store.ids == [f"r{k}" for k in range(count)]
    assert hashes(store) == [content_hash(random_segment(f"r{k}", seed=k)) for k in range(count)]


def watch(path: Path, count: int) -> list[int]:
    """Open a store again and again until it holds so many segments, verifying all; how many it held each time."""
    seen = [0]
    while seen[-1] < count:
        store = SegmentStore(path)
        store.verify()
        assert store.ids == [f"r{k}" for k in range(len(store))]
        if len(store) != seen[-1]:
            seen.append(len(store))
    return seen


def test_processes_read_while_a_writer_appends(folder: Path) -> None:
    count = 60
    fill(folder, [])
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        results = [pool.apply_async(watch, (folder, count)) for _ in range(2)]
        fill(folder, unlike(count // 2), append=True)
        fill(folder, unlike(count - count // 2, start=count // 2), append=True)
        for result in results:
            seen = result.get(timeout=60)
            assert seen[-1] == count
            assert seen == sorted(seen)
    assert hashes(SegmentStore(folder)) == hashes(unlike(count))


def test_copying_a_segment_is_appending_it(folder: Path, tmp_path: Path) -> None:
    found = [*unlike(3), unlike(1)[0].replace(segment_id="same map")]
    fill(folder, found)
    with StoreWriter(folder, append=True) as writer:
        writer.append(random_segment("tagged", seed=9), tags={"kind": "merge"})
    store = SegmentStore(folder)
    with StoreWriter(tmp_path / "copy") as writer:
        assert [writer.copy(store, k) for k in range(5)] == list(range(5))
        assert [writer.index_of(name) for name in store.ids] == list(range(5))
        with pytest.raises(DataError, match="segment r1, field segment_id: a segment of this name"):
            writer.copy(store, 1)
    for file in files(folder):
        assert file.read_bytes() == (tmp_path / "copy" / file.relative_to(folder)).read_bytes()
    assert SegmentStore(tmp_path / "copy").tags(4) == {"kind": "merge"}
    assert SegmentStore(tmp_path / "copy").num_maps == 4
