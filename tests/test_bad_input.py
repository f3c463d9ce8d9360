"""Damaged, foreign and hostile files, small ones that ask for gigabytes, too: a named error, never a crash."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import helpers_sources as sources
from helpers_convert import FakeReader
from symphony.data import convert as converting
from symphony.data.convert import convert
from symphony.data.segment import RunSegment, content_hash, validate
from symphony.data.sources import get_reader, readers, womd
from symphony.data.sources.base import Item
from symphony.data.sources.commonroad import NO_LANELET, NO_LIGHT, NO_OBSTACLE
from symphony.data.sources.lines import drivable_rings
from symphony.data.sources.sumo.roads import read_network
from symphony.data.sources.womd import masked_crc32c
from symphony.errors import DataError

GOOD = sources.commonroad(sources.ROAD, sources.driver(7), sources.driver(8, x=20))


def read_all(name: str, path: Path) -> list[Item]:
    """Whatever a file gives: every item is a valid segment or an error that names the file."""
    items = list(get_reader(name).read(path))
    for item in items:
        if isinstance(item, DataError):
            assert Path(str(item.file)) == path
            assert str(path) in str(item)
        else:
            validate(item)
    return items


def hashes(items: list[Item]) -> list[str | None]:
    return [content_hash(item) if isinstance(item, RunSegment) else None for item in items]


@pytest.mark.parametrize("name", readers())
def test_things_that_are_no_files_of_the_format(name: str, tmp_path: Path) -> None:
    if name == "argoverse2":
        pytest.importorskip("helpers_argoverse2")
    empty, noise, text = tmp_path / "empty", tmp_path / "noise", tmp_path / "text"
    empty.touch()
    noise.write_bytes(np.random.default_rng(0).bytes(5000))
    text.write_text("Not what you are looking for.\n" * 50)
    expected = {tmp_path: "folder", tmp_path / "nowhere": "No such file", empty: "empty"}
    expected |= {noise: "", text: ""}
    for path, message in expected.items():
        error = sources.read_error(name, path)
        assert error.file == path
        assert message in error.message


@pytest.fixture
def shard(tmp_path: Path) -> bytes:
    """Three small records."""
    scenarios = [sources.womd_scenario(f"{k:016x}", tracks=1 + k, steps=3) for k in range(3)]
    sources.write_records(tmp_path / "shard", [scenario.SerializeToString() for scenario in scenarios])
    return (tmp_path / "shard").read_bytes()


def ends(shard: bytes) -> list[int]:
    """Where the records of a shard end, from 0 on."""
    found = [0]
    while found[-1] < len(shard):
        found.append(found[-1] + 16 + int.from_bytes(shard[found[-1] : found[-1] + 8], "little"))
    return found


@sources.IN_FOLDER
@given(data=st.data())
def test_womd_cut_anywhere_or_with_a_flipped_bit(data: st.DataObject, shard: bytes, tmp_path: Path) -> None:
    whole, places, path = hashes(read_all("womd", tmp_path / "shard")), ends(shard), tmp_path / "shard"
    size = data.draw(st.integers(0, len(shard) - 1))
    path.write_bytes(shard[:size])
    found = hashes(read_all("womd", path))
    good = sum(end <= size for end in places[1:])
    assert found == whole[:good] + [None] * (size not in places or size == 0)
    bit = data.draw(st.integers(0, 8 * len(shard) - 1))
    damaged = bytearray(shard)
    damaged[bit // 8] ^= 1 << bit % 8
    path.write_bytes(damaged)
    items = read_all("womd", path)
    path.write_bytes(shard)
    found, broken = hashes(items), sum(end <= bit // 8 for end in places[1:])
    assert items[broken].field == f"record {broken}"
    # The other records of the shard are still the same; none follows a record of unknown length.
    rest = [] if bit // 8 < places[broken] + 12 else whole[broken + 1 :]
    assert found == [*whole[:broken], None, *rest]


def test_a_huge_length_is_not_allocated(tmp_path: Path) -> None:
    head, path = struct.pack("<Q", 2**62), tmp_path / "a"
    path.write_bytes(head + struct.pack("<I", masked_crc32c(head)) + b"abc\0\0\0\0")
    assert "cut short" in sources.read_error("womd", path).message


def laughs() -> str:
    """Each entity is ten times the one before: 10^20 characters once expanded."""
    bombs = [f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 20)]
    return f'<!DOCTYPE lolz [<!ENTITY e0 "ha">{"".join(bombs)}]>'


@pytest.mark.parametrize(
    "attack", [laughs(), '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>', "<!DOCTYPE commonRoad>"]
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_commonroad_document_types_are_refused(attack: str, encoding: str, tmp_path: Path) -> None:
    head, body = GOOD.split("\n", 1)
    path = tmp_path / "a.xml"
    text = head.replace("UTF-8", encoding) + attack + body.replace("ZAM_Made", "&e19;", 1)
    path.write_bytes(text.encode(encoding))
    error = sources.read_error("commonroad", path)
    assert (error.field, error.file) == ("DOCTYPE", path)


@pytest.mark.parametrize(("text", "field", "message"), [
    (sources.commonroad(sources.driver(7)), "lanelet", "has no lanes"),
    (sources.commonroad(sources.ROAD), "dynamicObstacle", "has no dynamic obstacles"),
    (sources.commonroad(sources.ROAD, sources.driver(7, speed=0)), "dynamicObstacle", "no moving vehicle"),
    (GOOD.replace("2020a", "2017a"), "commonRoadVersion", "2018b or 2020a"),
    (GOOD.replace('timeStepSize="0.1"', ""), "timeStepSize", "not a number"),
    (GOOD.replace('timeStepSize="0.1"', 'timeStepSize="nan"'), "timeStepSize", "not finite"),
    (GOOD.replace("<exact>3</exact>", "<exact>90000</exact>", 1), "time", "at most"),
    (GOOD.replace("<length>4.5", "<length>0", 1), "size", "must be positive"),
    (GOOD.replace('lanelet id="11"', 'lanelet id="10"'), "road.lane_id", "not unique"),
    (GOOD.replace('Obstacle id="8"', 'Obstacle id="7"'), "agent_id", "not unique"),
    (sources.commonroad(sources.ROAD, sources.driver(7, x=1e6), sources.driver(8)), "position", "not re-centred"),
])  # fmt: skip
def test_commonroad_errors_are_named(text: str, field: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text(text)
    error = sources.read_error("commonroad", path)
    assert error.file == path
    assert error.field == field
    assert message in error.message
    assert error.segment == (None if field == "commonRoadVersion" else "ZAM_Made-1_1_T-1")


@pytest.mark.parametrize(("old", "new", "kind", "example"), [
    ("<exact>3</exact>", "<exact>2</exact>", NO_OBSTACLE, "obstacle 7: time: two states at step"),
    ("<exact>1</exact>", "<intervalStart>1</intervalStart>", NO_OBSTACLE, "obstacle 7"),  # predicted
    ("<x>1.0</x>", "<x>NaN</x>", NO_OBSTACLE, "obstacle 7: position: nan is not finite"),
    ("<velocity><exact>10.0", "<velocity><exact>fast", NO_OBSTACLE, "obstacle 7: velocity: 'fast'"),
    ("<type>car</type>", "", NO_OBSTACLE, "obstacle 7: type: missing"),
    (sources.RECTANGLE, "", NO_OBSTACLE, "obstacle 7: shape: expected one rectangle"),
    ('Obstacle id="7"', 'Obstacle id="99999999999999999999"', NO_OBSTACLE, "64 bits"),
    ("<x>25</x>", "<x>inf</x>", NO_LANELET, "lanelet 10: bound: inf is not finite"),
    ("<leftBound>", "<leftBound/><leftBound>", NO_LANELET, "lanelet 10: bound: fewer than two points"),
    ('ref="11"', 'ref="next"', NO_LANELET, "lanelet 10: successor: 'next' is not an integer"),
    ("<color>red", "<color>pink", NO_LIGHT, "trafficLight 30: color: unknown colors ['pink']"),
    ("<duration>3</duration>", "", NO_LIGHT, "trafficLight 30: duration"),
])  # fmt: skip
def test_commonroad_odd_things(old: str, new: str, kind: str, example: str, tmp_path: Path) -> None:
    cycle = "<cycle><cycleElement><duration>3</duration><color>red</color></cycleElement></cycle>"
    more = sources.ROAD.replace('<predecessor ref="10"/>', '<trafficLightRef ref="30"/>')
    light = f'<trafficLight id="30">{cycle}</trafficLight>'
    whole = sources.commonroad(more, sources.driver(7), sources.driver(8, x=20), light)
    path = tmp_path / "a.xml"
    path.write_text(whole.replace(old, new, 1))
    found = sources.read_one("commonroad", path)
    assert example in found.odd[kind]
    lost = [kind == each for each in (NO_OBSTACLE, NO_LANELET, NO_LIGHT)]
    assert [2 - found.num_agents, 2 - len(found.road.lanes), 1 - len(found.signal_lane)] == lost
    report = convert("commonroad", [path], tmp_path / "out", interactive=1)
    assert report.odd[kind] == 1
    with pytest.raises(DataError, match="field strict"):
        convert("commonroad", [path], tmp_path / "strict", interactive=1, strict=True)
    path.write_text(whole.replace(light, light + light.replace("red", "green")))
    assert "trafficLight 30: two of one id" in str(sources.read_error("commonroad", path))


def test_many_parked_cars_one_late_state_and_files_beyond_all_measure(tmp_path, monkeypatch):
    path = tmp_path / "a.xml"
    parked = [sources.obstacle(100 + k, [sources.state(0, k, 5)], role="static") for k in range(700)]
    late = sources.driver(7).replace("<exact>4</exact>", "<exact>9900</exact>", 1)
    path.write_text(sources.commonroad(sources.ROAD, late, sources.driver(8), *parked))
    with sources.little_memory(40e6):
        error = sources.read_error("commonroad", path)
    assert error.field == "time"
    assert "states" in error.message
    monkeypatch.setattr("symphony.data.sources.base.MAX_FILE", path.stat().st_size - 1)
    assert "too large" in sources.read_error("commonroad", path).message


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
    big, small = (sources.womd_scenario(f"of-{n}", tracks=n).SerializeToString() for n in (9, 2))
    monkeypatch.setattr(womd, "MAX_RECORD", len(big) - 1)
    sources.write_records(tmp_path / "a", [big, small])
    error, item = get_reader("womd").read(tmp_path / "a")
    assert (error.field, item.segment_id) == ("record 0", "of-2")


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
        with sources.little_memory(100e6):
            error = sources.read_error("argoverse2", path)
        assert field in (None, error.field)
        assert message in error.message
    columns = helpers.scenario()
    columns["track_id"] = [[name] for name in columns["track_id"]]
    error = sources.read_error("argoverse2", helpers.write(tmp_path, columns))
    assert (error.field, error.message) == ("track_id", "expected string, is list<element: string>")


@pytest.mark.parametrize("workers", [1, 2])
def test_whatever_a_reader_raises_is_counted(workers: int, tmp_path: Path) -> None:
    paths = []
    for k, text in enumerate(("straight 1\nfail\nstraight 2", "straight 3")):
        paths.append(tmp_path / f"{k}.scene")
        paths[-1].write_text(text)
    report = convert(FakeReader(), paths, tmp_path / "out", workers=workers)
    assert report.converted == 2
    assert report.reasons == {"can't be read: ValueError: invalid literal for int() with base #: ''": 1}
    assert report.skipped[0].file == str(paths[0])


def test_a_segment_that_nothing_can_be_done_with_is_counted(tmp_path: Path, monkeypatch: Any) -> None:
    def fails(segment: RunSegment, count: int) -> None:
        if segment.segment_id == "straight-1":
            raise ZeroDivisionError("of paths")

    monkeypatch.setattr("symphony.data.convert.exclusion", fails)
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
    scenario = sources.womd_scenario()
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
    sources.write_records(tmp_path / "a", [scenario.SerializeToString()])
    assert "entries, at most" in sources.read_error("womd", tmp_path / "a").message


def test_places_to_walk_without_an_area_are_left_out(tmp_path: Path) -> None:
    lanes = '<lane shape="1,1 2,2" allow="no"/>', '<lane shape="1,1 1,1" width="4" allow="no"/>'
    text = '<net><edge id=":a" function="walkingarea">{}</edge><edge id=":b_0" function="crossing">{}</edge></net>'
    (file := tmp_path / "x.net.xml").write_text(text.format(*lanes))
    assert read_network(file).walked == read_network(file).crosswalks == []
