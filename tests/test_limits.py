"""Small files that ask for gigabytes, and files that make a reader fail: an error, and the rest goes on."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers_convert import FakeReader
from helpers_sources import ROAD, commonroad, driver, obstacle, read_error, state, womd_scenario
from symphony.data import convert as converting
from symphony.data.convert import convert
from symphony.data.segment import RunSegment
from symphony.data.sources import get_reader, tfrecord, womd
from symphony.data.sources.base import Item
from symphony.data.sources.lines import drivable_rings
from symphony.data.sources.tfrecord import write_records
from symphony.errors import DataError


@contextmanager
def little_memory(most: float) -> Iterator[None]:
    """What is allocated inside stays below so many bytes."""
    tracemalloc.start()
    try:
        yield
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < most


def test_many_parked_cars_one_late_state_and_files_beyond_all_measure(tmp_path, monkeypatch):
    parked, path = (
        [obstacle(100 + k, [state(0, k, 5)], role="static") for k in range(700)],
        tmp_path / "a.xml",
    )
    late = driver(7).replace("<exact>4</exact>", "<exact>9900</exact>", 1)
    path.write_text(commonroad(ROAD, late, driver(8), *parked))
    with little_memory(40e6):
        error = read_error("commonroad", path)
    assert error.field == "time"
    assert "states" in error.message
    monkeypatch.setattr("symphony.data.sources.base.MAX_FILE", path.stat().st_size - 1)
    assert "too large" in read_error("commonroad", path).message


def test_outlines_that_cross_without_end() -> None:
    rng = np.random.default_rng(0)
    for outlines, message in (
        ([rng.uniform(0, 100, (4000, 2))], "meet about"),
        ([rng.uniform(0, 100, (200, 2))], r"themselves \d+ times"),
        ([rng.uniform(0, 100, (4, 2)) for _ in range(200)], r"cross \d+ times"),
    ):
        with pytest.raises(DataError, match=message):
            drivable_rings(outlines)
    angle = np.linspace(0, 2 * np.pi, 4000)
    (ring,) = drivable_rings([100 * np.stack([np.cos(angle), np.sin(angle)], -1)])
    np.testing.assert_allclose(np.hypot(*ring.T), 100, atol=0.02)


def test_records_that_are_too_large_are_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    big, small = (womd_scenario(f"of-{n}", tracks=n).SerializeToString() for n in (9, 2))
    monkeypatch.setattr(tfrecord, "MAX_RECORD", len(big) - 1)
    write_records(tmp_path / "a", [big, small])
    error, item = get_reader("womd").read(tmp_path / "a")
    assert isinstance(error, DataError)
    assert error.field == "record 0"
    assert isinstance(item, RunSegment)
    assert item.segment_id == "of-2"


def test_argoverse_rows_and_texts_beyond_all_measure(tmp_path: Path) -> None:
    helpers = pytest.importorskip("helpers_argoverse2", exc_type=ImportError)
    import pyarrow as pa
    from pyarrow import parquet

    path = helpers.write(tmp_path)
    names = parquet.read_schema(path).names
    long = pa.DictionaryArray.from_arrays(pa.array(np.zeros(300_000, np.int32)), ["x" * 100_000])
    texts = {name: pa.array([0] * 300_000) for name in names} | {"scenario_id": long}
    rows = {name: pa.array(np.zeros(500_001, np.int8)) for name in names}
    for columns, field, message in (
        (texts, "scenario_id", "a text of more than 64 characters"), (rows, None, "500001 rows"),
    ):  # fmt: skip
        parquet.write_table(pa.table(columns), path)
        with little_memory(100e6):
            error = read_error("argoverse2", path)
        assert field in (None, error.field)
        assert message in error.message
    columns = helpers.scenario()
    columns["track_id"] = [[name] for name in columns["track_id"]]
    error = read_error("argoverse2", helpers.write(tmp_path, columns))
    assert (error.field, error.message) == ("track_id", "expected string, is list<element: string>")


class Fragile(FakeReader):
    """Fails on every word that it does not know, as readers may on what nobody has thought of."""

    def _read(self, path: Path) -> Iterator[Item]:
        for line in path.read_text().splitlines():
            if line == "fail":
                raise TypeError("unhashable type: 'list'")
            (tmp := path.with_suffix(".one")).write_text(line)
            yield from super()._read(tmp)
            tmp.unlink()


@pytest.mark.parametrize("workers", [1, 2])
def test_whatever_a_reader_raises_is_counted(workers: int, tmp_path: Path) -> None:
    paths = []
    for k, text in enumerate(("straight 1\nfail\nstraight 2", "straight 3")):
        paths.append(tmp_path / f"{k}.scene")
        paths[-1].write_text(text)
    report = convert(Fragile(), paths, tmp_path / "out", workers=workers)
    assert report.converted == 2
    assert report.reasons == {"can't be read: TypeError: unhashable type: 'list'": 1}
    assert report.skipped[0].file == str(paths[0])


def test_a_segment_that_nothing_can_be_done_with_is_counted(tmp_path: Path, monkeypatch: Any) -> None:
    def fails(segment: RunSegment, count: int) -> None:
        if segment.segment_id == "straight-1":
            raise ZeroDivisionError("of paths")

    monkeypatch.setattr("symphony.data.parts.exclusion", fails)
    (tmp_path / "a.scene").write_text("straight 1\nstraight 2")
    report = convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "out")
    assert (report.converted, report.skipped[0].segment) == (1, "straight-1")


@pytest.mark.parametrize("name", ["\udcff.scene", "\udcff/a.scene"])
def test_names_of_files_that_are_not_text(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    try:
        path.parent.mkdir(exist_ok=True)
        path.write_text("straight 1")
    except (OSError, UnicodeError):
        pytest.skip("this file system has no such names")
    with pytest.raises(DataError, match="not UTF-8"):
        convert(FakeReader(), [tmp_path], tmp_path / "out")
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(
    "change", [{"converted": "many"}, {"skipped": [3]}, {"settings": []}, {"odd": 3}, {"files": None}]
)
def test_reports_that_are_none(change: dict[str, object], tmp_path: Path) -> None:
    (tmp_path / "a.scene").write_text("straight 1")
    convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "out")
    path = tmp_path / "out" / "report.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(DataError, match="not a conversion report"):
        converting.info(tmp_path / "out")


@pytest.mark.parametrize("field", ["exit_lanes", "lane_states", "map_features", "objects_of_interest"])
def test_womd_lists_without_end(field: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = womd_scenario()
    monkeypatch.setattr(womd, "MAX_LINKS", 1000)
    monkeypatch.setattr(womd, "MAX_FEATURES", 1000)
    lights = scenario.dynamic_map_states[0].lane_states
    entries, entry = {
        "exit_lanes": (scenario.map_features[0].lane.exit_lanes, 11),
        "lane_states": (lights, lights[0]),
        "map_features": (scenario.map_features, scenario.map_features[0]),
        "objects_of_interest": (scenario.objects_of_interest, 100),
    }[field]
    entries.extend([entry] * 5001)  # type: ignore[attr-defined]
    write_records(tmp_path / "a", [scenario.SerializeToString()])
    assert "entries, at most" in read_error("womd", tmp_path / "a").message
