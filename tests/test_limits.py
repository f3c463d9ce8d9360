"""Small files that ask for gigabytes, and files that make a reader fail: an error, and the rest goes on."""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from helpers_convert import FakeReader
from helpers_sources import ROAD, commonroad, driver, obstacle, read_error, state, womd_scenario
from symphony.data import convert as converting
from symphony.data.convert import convert
from symphony.data.generate import generate
from symphony.data.plans import Plan
from symphony.data.segment import RunSegment
from symphony.data.sources import get_reader, tfrecord, womd
from symphony.data.sources.base import Item
from symphony.data.sources.lines import drivable_rings
from symphony.data.sources.tfrecord import write_records
from symphony.data.store import SegmentStore
from symphony.data.store_writer import StoreWriter
from symphony.data.unfinished import folder_of
from symphony.errors import ConfigError, DataError


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


def test_many_parked_cars_and_one_late_state(tmp_path: Path) -> None:
    parked = [obstacle(100 + k, [state(0, k, 5)], role="static") for k in range(700)]
    late = driver(7).replace("<exact>4</exact>", "<exact>9900</exact>", 1)
    path = tmp_path / "a.xml"
    path.write_text(commonroad(ROAD, late, driver(8), *parked))
    with little_memory(40e6):
        error = read_error("commonroad", path)
    assert error.field == "time"
    assert "states" in error.message


def test_lights_of_many_lanes_at_many_steps(tmp_path: Path) -> None:
    references = '<trafficLightRef ref="30"/>' * 300
    road = ROAD.replace('<successor ref="11"/>', f'<successor ref="11"/>{references}')
    path = tmp_path / "a.xml"
    path.write_text(commonroad(road, driver(7), driver(8)))
    error = read_error("commonroad", path)
    assert (error.field, error.message) == ("lanelet 10: trafficLightRef", "300 references, at most 200")


def test_files_beyond_all_measure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.xml"
    path.write_text(commonroad(ROAD, driver(7), driver(8)))
    monkeypatch.setattr("symphony.data.sources.base.MAX_FILE", path.stat().st_size - 1)
    assert "too large" in read_error("commonroad", path).message


def test_outlines_that_cross_without_end() -> None:
    rng = np.random.default_rng(0)
    for outlines, message in (
        ([rng.uniform(0, 100, (4000, 2))], "meet about"),
        ([rng.uniform(0, 100, (200, 2))], "cross themselves"),
        ([rng.uniform(0, 100, (4, 2)) for _ in range(200)], r"cross \d+ times, at most 50000"),
    ):
        with pytest.raises(DataError, match=message):
            drivable_rings(outlines)
    angle = np.linspace(0, 2 * np.pi, 4000)
    (ring,) = drivable_rings([100 * np.stack([np.cos(angle), np.sin(angle)], -1)])
    np.testing.assert_allclose(np.hypot(*ring.T), 100, atol=0.02)


def test_records_that_are_too_large_are_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    big = womd_scenario("big", tracks=9).SerializeToString()
    small = womd_scenario("small", tracks=2).SerializeToString()
    monkeypatch.setattr(tfrecord, "MAX_RECORD", len(big) - 1)
    write_records(tmp_path / "a", [big, small])
    error, item = get_reader("womd").read(tmp_path / "a")
    assert isinstance(error, DataError)
    assert error.field == "record 0"
    assert isinstance(item, RunSegment)
    assert item.segment_id == "small"


def test_scenarios_of_too_many_states(tmp_path: Path) -> None:
    scenario = womd_scenario()
    scenario.timestamps_seconds.extend(0.5 + 0.1 * k for k in range(20_000))
    write_records(tmp_path / "a", [scenario.SerializeToString()])
    assert "20005 steps" in read_error("womd", tmp_path / "a").message


def test_argoverse_bounds_that_are_endless(tmp_path: Path) -> None:
    helpers = pytest.importorskip("helpers_argoverse2", exc_type=ImportError)
    city = helpers.city()
    node = city["lane_segments"]["10"]
    node["centerline"] = []
    node["left_lane_boundary"][1]["x"] = 9.9e7
    path = helpers.write(tmp_path, map_=city)
    with little_memory(40e6):
        error = read_error("argoverse2", path)
    assert error.field == "lane_segments"
    assert "at most 5000" in error.message


def test_argoverse_rows_and_texts_beyond_all_measure(tmp_path: Path) -> None:
    helpers = pytest.importorskip("helpers_argoverse2", exc_type=ImportError)
    import pyarrow as pa
    from pyarrow import parquet

    path = helpers.write(tmp_path)
    schema = parquet.read_schema(path)
    long = pa.DictionaryArray.from_arrays(pa.array(np.zeros(300_000, np.int32)), ["x" * 100_000])
    columns = {name: pa.array([0] * 300_000) for name in schema.names} | {"scenario_id": long}
    parquet.write_table(pa.table(columns), path)
    with little_memory(100e6):
        error = read_error("argoverse2", path)
    assert (error.field, error.message) == ("scenario_id", "a text of more than 64 characters")
    columns = {name: pa.array(np.zeros(500_001, np.int8)) for name in schema.names}
    parquet.write_table(pa.table(columns), path)
    with little_memory(40e6):
        assert "500001 rows" in read_error("argoverse2", path).message


def test_argoverse_columns_of_lists(tmp_path: Path) -> None:
    helpers = pytest.importorskip("helpers_argoverse2", exc_type=ImportError)
    columns = helpers.scenario()
    columns["track_id"] = [[name] for name in columns["track_id"]]
    error = read_error("argoverse2", helpers.write(tmp_path, columns))
    assert (error.field, error.message) == ("track_id", "expected text, is list<element: string>")


def test_a_reader_that_fails_does_not_end_the_conversion(tmp_path: Path) -> None:
    helpers = pytest.importorskip("helpers_argoverse2", exc_type=ImportError)
    files = []
    for k, kind in enumerate((["VEHICLE"], "VEHICLE")):
        name = f"{k}{helpers.NAME[1:]}"
        city = helpers.city()
        city["lane_segments"]["10"]["lane_type"] = kind
        columns = helpers.scenario()
        columns["scenario_id"] = [name] * len(columns["scenario_id"])
        files.append(helpers.write(tmp_path, columns, city, name))
    report = convert("argoverse2", files, tmp_path / "out")
    assert (report.converted, len(report.skipped)) == (1, 1)
    assert "lane_type" in report.skipped[0].field


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


def test_a_segment_that_nothing_can_be_done_with_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(segment: RunSegment, count: int) -> None:
        if segment.segment_id == "straight-1":
            raise ZeroDivisionError("of paths")

    monkeypatch.setattr("symphony.data.parts.exclusion", fails)
    (tmp_path / "a.scene").write_text("straight 1\nstraight 2")
    report = convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "out")
    assert (report.converted, report.skipped[0].segment) == (1, "straight-1")


@pytest.mark.parametrize("workers", [1, 2])
def test_what_is_odd_is_counted(workers: int, tmp_path: Path) -> None:
    for k in range(2):
        (tmp_path / f"{k}.scene").write_text(f"odd {k}\nstraight {k}")
    report = convert(Odd(), [tmp_path / "0.scene", tmp_path / "1.scene"], tmp_path / "out", workers=workers)
    assert report.odd == {"an agent faster than 70 m/s": 2}
    assert converting.info(tmp_path / "out")["odd"] == report.odd
    found = converting.info(tmp_path / "out")["odd_examples"]
    assert found == report.odd_examples == {"an agent faster than 70 m/s": "crossing-0"}
    assert SegmentStore(tmp_path / "out").tags(0) == {"odd": {"an agent faster than 70 m/s": ""}}


class Odd(FakeReader):
    def _read(self, path: Path) -> Iterator[Item]:
        for line in path.read_text().splitlines():
            (tmp := path.with_suffix(".one")).write_text(line.replace("odd", "crossing"))
            for item in super()._read(tmp):
                assert isinstance(item, RunSegment)
                faster = item.velocity + np.float32(80) * line.startswith("odd")
                yield item.replace(velocity=faster.astype(np.float32), file=path.name)
            tmp.unlink()


@pytest.mark.parametrize(
    "option", [{"rate": 1e9}, {"rate": 1e-3}, {"smooth": 1e6}, {"workers": 10**6}, {"interactive": 10**9}]
)
def test_options_out_of_range(option: dict[str, float], tmp_path: Path) -> None:
    (tmp_path / "a.scene").write_text("straight 1")
    with pytest.raises(ConfigError, match=next(iter(option))):
        convert(FakeReader(), [tmp_path], tmp_path / "out", **option)  # type: ignore[arg-type]


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


def test_reports_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.scene").write_text("straight 1")
    convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "out")
    path = tmp_path / "out" / "report.json"
    good = json.loads(path.read_text())
    for key, value in (
        ("converted", "many"),
        ("skipped", [3]),
        ("settings", []),
        ("odd", 3),
        ("files", None),
    ):
        path.write_text(json.dumps(good | {key: value}))
        with pytest.raises(DataError, match="not a conversion report"):
            converting.info(tmp_path / "out")


def test_journals_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.scene").write_text("straight 1\ninterrupt")
    with pytest.raises(KeyboardInterrupt):
        convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "out")
    journal = folder_of(tmp_path / "out") / "journal.jsonl"
    head = json.loads(journal.read_text().splitlines()[0])
    line = {"files": 1, "converted": 1, "present": 0, "segments": 1, "skipped": []}
    assert json.dumps(head["job"]["files"][0]) in journal.read_text()
    for change in (
        {"files": 2},
        {"files": "1"},
        {"converted": -1},
        {"segments": True},
        {"odd": 3},
        {"skipped": [1]},
    ):
        journal.write_text(json.dumps(head) + "\n" + json.dumps(line | change) + "\n")
        with pytest.raises(DataError, match="not the journal") as caught:
            convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "out")
        assert caught.value.file == journal
    for text in ("[]", '{"job": 3}', json.dumps(head | {"job": {"files": [1]}}), "[" * 100_000):
        journal.write_text(text + "\n")
        with pytest.raises(DataError, match="not the journal"):
            convert(FakeReader(), [tmp_path / "a.scene"], tmp_path / "out")


def test_generations_that_are_none(tmp_path: Path) -> None:
    pytest.importorskip("sumo", reason="SUMO is not installed (pip install 'symphony-traffic[sumo]')")
    plan = Plan(3)
    with StoreWriter(tmp_path / "out") as writer:
        for found in (3, {"networks": "x"}, {"reasons": []}, {"complete": 1}):
            writer.write_report({"settings": plan.settings(), "generation": found})
            with pytest.raises(DataError, match="how far a generation is"):
                generate(plan, tmp_path / "out")


@pytest.mark.parametrize("field", ["exit_lanes", "lane_states", "map_features", "objects_of_interest"])
def test_womd_lists_without_end(field: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = womd_scenario()
    monkeypatch.setattr(womd, "MAX_LINKS", 1000)
    monkeypatch.setattr(womd, "MAX_FEATURES", 1000)
    if field == "exit_lanes":
        scenario.map_features[0].lane.exit_lanes.extend([11] * 1001)
    elif field == "lane_states":
        lights = scenario.dynamic_map_states[0].lane_states
        lights.extend([lights[0]] * 1001)
    elif field == "map_features":
        scenario.map_features.extend([scenario.map_features[0]] * 1001)
    else:
        scenario.objects_of_interest.extend([100] * 5001)
    write_records(tmp_path / "a", [scenario.SerializeToString()])
    assert "entries, at most" in read_error("womd", tmp_path / "a").message
