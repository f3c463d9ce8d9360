"""Damaged, foreign and hostile files: always a named error, never a crash."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helpers_sources import (
    RECTANGLE,
    ROAD,
    commonroad,
    driver,
    obstacle,
    read_error,
    state,
    womd_scenario,
)
from symphony.data.segment import RunSegment, content_hash, validate
from symphony.data.sources import get_reader, readers
from symphony.data.sources.base import Item
from symphony.data.sources.tfrecord import write_records
from symphony.errors import DataError

IN_FOLDER = settings(
    deadline=None, max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture]
)

GOOD = commonroad(ROAD, driver(7), driver(8, x=20))


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
        pytest.importorskip(
            "pyarrow", reason="pyarrow is not installed (pip install 'symphony-traffic[argoverse2]')"
        )
    empty, noise, text = tmp_path / "empty", tmp_path / "noise", tmp_path / "text"
    empty.touch()
    noise.write_bytes(np.random.default_rng(0).bytes(5000))
    text.write_text("Not what you are looking for.\n" * 50)
    expected = {tmp_path: "folder", tmp_path / "nowhere": "No such file", empty: "empty"}
    expected |= {noise: "", text: ""}
    for path, message in expected.items():
        error = read_error(name, path)
        assert error.file == path
        assert message in error.message


def test_files_of_the_other_format(tmp_path: Path) -> None:
    xml, record = tmp_path / "a.xml", tmp_path / "a.tfrecord"
    xml.write_text(GOOD)
    write_records(record, [womd_scenario().SerializeToString()])
    assert "not a TFRecord file" in read_error("womd", xml).message
    assert "not well-formed XML" in read_error("commonroad", record).message


# WOMD


@pytest.fixture
def shard(tmp_path: Path) -> bytes:
    """Three small records."""
    scenarios = [womd_scenario(f"{k:016x}", tracks=1 + k, steps=3) for k in range(3)]
    write_records(tmp_path / "shard", [scenario.SerializeToString() for scenario in scenarios])
    return (tmp_path / "shard").read_bytes()


@IN_FOLDER
@given(data=st.data())
def test_womd_cut_anywhere(data: st.DataObject, shard: bytes, tmp_path: Path) -> None:
    whole = read_all("womd", tmp_path / "shard")
    size = data.draw(st.integers(0, len(shard) - 1))
    path = tmp_path / "cut"
    path.write_bytes(shard[:size])
    items = read_all("womd", path)
    good = [item for item in items if isinstance(item, RunSegment)]
    assert [g.segment_id for g in good] == [
        w.segment_id for w in whole[: len(good)] if isinstance(w, RunSegment)
    ]
    bad = items[len(good) :]
    assert len(bad) == 1 or (not bad and size in ends(shard))
    assert len(good) < 3


def ends(shard: bytes) -> list[int]:
    found = [0]
    while found[-1] < len(shard):
        length = int.from_bytes(shard[found[-1] : found[-1] + 8], "little")
        found.append(found[-1] + 16 + length)
    return found[1:]


@IN_FOLDER
@given(data=st.data())
def test_womd_no_flipped_bit_goes_unnoticed(data: st.DataObject, shard: bytes, tmp_path: Path) -> None:
    whole = hashes(
        [i.replace(file="flipped") for i in read_all("womd", tmp_path / "shard") if isinstance(i, RunSegment)]
    )
    bit = data.draw(st.integers(0, 8 * len(shard) - 1))
    damaged = bytearray(shard)
    damaged[bit // 8] ^= 1 << bit % 8
    (tmp_path / "flipped").write_bytes(damaged)
    items = read_all("womd", tmp_path / "flipped")
    found = hashes(items)
    assert found.count(None) == 1
    broken = found.index(None)
    error = items[broken]
    assert isinstance(error, DataError)
    assert error.field == f"record {broken}"
    # The other records of the shard are still the same; none follows a record of unknown length.
    start = [0, *ends(shard)][broken]
    assert start <= bit // 8 < ends(shard)[broken]
    assert found[:broken] == whole[:broken]
    assert found[broken + 1 :] == ([] if bit // 8 < start + 12 else whole[broken + 1 :])


@IN_FOLDER
@given(data=st.data())
def test_womd_wrong_records_with_right_checksums(data: st.DataObject, tmp_path: Path) -> None:
    payload = bytearray(womd_scenario(tracks=2, steps=3).SerializeToString())
    for _ in range(data.draw(st.integers(1, 4))):
        bit = data.draw(st.integers(0, 8 * len(payload) - 1))
        payload[bit // 8] ^= 1 << bit % 8
    payload = (
        payload[: data.draw(st.integers(len(payload) // 2, len(payload)))]
        if data.draw(st.booleans())
        else payload
    )
    write_records(tmp_path / "a", [bytes(payload)])
    assert len(read_all("womd", tmp_path / "a")) == 1


@IN_FOLDER
@given(payload=st.binary(max_size=200))
def test_womd_records_of_something_else(payload: bytes, tmp_path: Path) -> None:
    write_records(tmp_path / "a", [payload])
    error = read_error("womd", tmp_path / "a")
    assert error.field is not None
    assert error.field.startswith("record 0")


def test_womd_one_bad_record_among_good_ones(tmp_path: Path) -> None:
    bad = womd_scenario("bad")
    bad.tracks[2].states[0].center_x = float("nan")  # of the ego, from whose first place all is counted
    payloads = [womd_scenario("a"), bad, womd_scenario("c")]
    write_records(tmp_path / "a", [scenario.SerializeToString() for scenario in payloads])
    first, error, last = read_all("womd", tmp_path / "a")
    assert isinstance(first, RunSegment)
    assert isinstance(last, RunSegment)
    assert isinstance(error, DataError)
    assert str(error).startswith(f"file {tmp_path / 'a'}, segment bad, field position: ")


@pytest.mark.samples
def test_womd_sample_cut_and_flipped(samples: Path, tmp_path: Path) -> None:
    data = (samples / "womd" / "motion_data_one_scenario.tfrecord").read_bytes()
    path = tmp_path / "a"
    rng = np.random.default_rng(1)
    for size in [0, 5, 11, 12, 500, len(data) - 5, len(data) - 1, *rng.integers(13, len(data), 5).tolist()]:
        path.write_bytes(data[:size])
        read_error("womd", path)
    for bit in rng.integers(0, 8 * len(data), 20).tolist():
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        read_error("womd", path)


# CommonRoad


@pytest.mark.parametrize("share", [0.01, 0.3, 0.5, 0.9, 0.999])
def test_commonroad_cut(share: float, tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text(GOOD[: int(len(GOOD) * share)])
    error = read_error("commonroad", path)
    assert "not well-formed XML" in error.message
    assert "line" in error.message


@IN_FOLDER
@given(data=st.data())
def test_commonroad_flipped_bits_never_crash(data: st.DataObject, tmp_path: Path) -> None:
    # The format has no checksum: a digit that became another digit can't be noticed.
    damaged = bytearray(GOOD.encode())
    for _ in range(data.draw(st.integers(1, 3))):
        bit = data.draw(st.integers(0, 8 * len(damaged) - 1))
        damaged[bit // 8] ^= 1 << bit % 8
    (tmp_path / "a.xml").write_bytes(damaged)
    assert len(read_all("commonroad", tmp_path / "a.xml")) == 1


TAG = re.compile(r"<(\w+)[^<>]*>[^<>]*</\1>")


@IN_FOLDER
@given(data=st.data())
def test_commonroad_missing_and_absurd_values_never_crash(data: st.DataObject, tmp_path: Path) -> None:
    leaves = list(TAG.finditer(GOOD))
    leaf = data.draw(st.sampled_from(leaves))
    values = ["", "nan", "inf", "-1", "0", "1e300", "9" * 30, "abc", "0x1", "1e5", "-1e7"]
    tag = leaf.group(1)
    other = data.draw(st.sampled_from(["", *(f"<{tag}>{value}</{tag}>" for value in values)]))
    (tmp_path / "a.xml").write_text(GOOD[: leaf.start()] + other + GOOD[leaf.end() :])
    assert len(read_all("commonroad", tmp_path / "a.xml")) == 1


def laughs() -> str:
    """Each entity is ten times the one before: 10^20 characters once expanded."""
    bombs = [f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 20)]
    return f'<!DOCTYPE lolz [<!ENTITY e0 "ha">{"".join(bombs)}]>'


@pytest.mark.parametrize(
    "attack",
    [
        laughs(),
        '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE a SYSTEM "http://localhost/a.dtd">',
        "<!DOCTYPE commonRoad>",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_commonroad_document_types_are_refused(attack: str, encoding: str, tmp_path: Path) -> None:
    head, body = GOOD.split("\n", 1)
    path = tmp_path / "a.xml"
    text = head.replace("UTF-8", encoding) + attack + body.replace("ZAM_Made", "&e19;", 1)
    path.write_bytes(text.encode(encoding))
    error = read_error("commonroad", path)
    assert (error.field, error.file) == ("DOCTYPE", path)


def test_commonroad_in_another_encoding(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_bytes(GOOD.replace("UTF-8", "utf-16").encode("utf-16"))
    (item,) = read_all("commonroad", path)
    assert isinstance(item, RunSegment)
    path.write_text(GOOD.replace("UTF-8", "klingon"))
    assert "not well-formed XML" in read_error("commonroad", path).message


LANELESS = commonroad(driver(7))
NO_DRIVERS = commonroad(ROAD, obstacle(7, [state(0, 0, 0)], role="static"))


@pytest.mark.parametrize(
    ("text", "field", "message"),
    [
        (LANELESS, "lanelet", "has no lanes"),
        (NO_DRIVERS, "dynamicObstacle", "has no dynamic obstacles"),
        (commonroad(ROAD, driver(7, speed=0)), "dynamicObstacle", "no moving vehicle"),
        (commonroad(ROAD, driver(7, steps=range(1))), "dynamicObstacle", "no moving vehicle"),
        (
            GOOD.replace("2020a", "2017a"),
            "commonRoadVersion",
            "2018b, 2020a",
        ),
        (GOOD.replace('timeStepSize="0.1"', ""), "timeStepSize", "not a number"),
        (GOOD.replace('timeStepSize="0.1"', 'timeStepSize="-0.1"'), "timeStepSize", "positive"),
        (GOOD.replace('timeStepSize="0.1"', 'timeStepSize="nan"'), "timeStepSize", "not finite"),
        (GOOD.replace("<exact>3</exact>", "<exact>2</exact>", 1), "obstacle 7: time", "two states at step 2"),
        (GOOD.replace("<exact>3</exact>", "<exact>90000</exact>", 1), "time", "at most"),
        (GOOD.replace("<x>1.0</x>", "<x>NaN</x>", 1), "obstacle 7: position", "not finite"),
        (GOOD.replace("<x>1.0</x>", "", 1), "obstacle 7: position", "not a number"),
        (GOOD.replace("<velocity><exact>10.0", "<velocity><exact>fast", 1), "obstacle 7: velocity", "'fast'"),
        (
            GOOD.replace("<orientation><exact>0.0</exact></orientation>", "", 1),
            "obstacle 7: orientation",
            "missing",
        ),
        (GOOD.replace("initialState", "firstState"), "obstacle 7: initialState", "missing"),
        (GOOD.replace(RECTANGLE, "", 1), "obstacle 7: shape", "no rectangle"),
        (GOOD.replace("<length>4.5", "<length>0", 1), "size", "must be positive"),
        (GOOD.replace("<x>25</x>", "<x>inf</x>", 1), "lanelet 10: leftBound", "not finite"),
        (GOOD.replace('ref="11"', 'ref="next"'), "lanelet 10: successor", "not an integer"),
        (GOOD.replace('lanelet id="11"', 'lanelet id="10"'), "road.lane_id", "not unique"),
        (GOOD.replace('Obstacle id="8"', 'Obstacle id="7"'), "agent_id", "not unique"),
        (GOOD.replace('Obstacle id="8"', 'Obstacle id="99999999999999999999"'), "obstacle id", "64 bits"),
        (commonroad(ROAD, driver(7, x=1e6), driver(8)), "position", "not re-centred"),
    ],
)
def test_commonroad_errors_name_segment_and_field(
    text: str, field: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.xml"
    path.write_text(text)
    error = read_error("commonroad", path)
    assert error.file == path
    assert error.field == field
    assert message in error.message
    assert error.segment == (None if field == "commonRoadVersion" else "ZAM_Made-1_1_T-1")


def test_commonroad_other_xml(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text("<svg><g/></svg>")
    error = read_error("commonroad", path)
    assert "root is <svg>" in error.message
    path.write_text(GOOD.replace('benchmarkID="ZAM_Made-1_1_T-1"', ""))
    assert read_error("commonroad", path).field == "benchmarkID"


def test_commonroad_bad_lights(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    road = ROAD.replace('<successor ref="11"/>', '<successor ref="11"/><trafficLightRef ref="30"/>')
    for cycle, field in (
        ("<cycleElement><duration>3</duration><color>pink</color></cycleElement>", "color"),
        ("<cycleElement><duration>0</duration><color>red</color></cycleElement>", "cycle"),
        ("<cycleElement><color>red</color></cycleElement>", "duration"),
        ("<timeOffset>3</timeOffset>", "cycle"),
    ):
        text = f'<trafficLight id="30"><cycle>{cycle}</cycle></trafficLight>'
        path.write_text(commonroad(road, driver(7), text))
        assert read_error("commonroad", path).field == f"trafficLight 30: {field}"


@pytest.mark.samples
def test_commonroad_samples_cut_and_flipped(samples: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    rng = np.random.default_rng(2)
    for name in ("USA_Peach-4_8_T-1.xml", "FRA_Anglet-1_1_T-1.xml"):
        data = (samples / "commonroad" / name).read_bytes()
        path.write_bytes(data[: len(data) // 2])
        assert "not well-formed" in read_error("commonroad", path).message
        for bit in rng.integers(0, 8 * len(data), 25).tolist():
            damaged = bytearray(data)
            damaged[bit // 8] ^= 1 << bit % 8
            path.write_bytes(damaged)
            assert len(read_all("commonroad", path)) == 1
