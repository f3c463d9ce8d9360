"""Damaged, foreign and hostile files: always a named error, never a crash."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers_sources import (
    IN_FOLDER,
    RECTANGLE,
    ROAD,
    commonroad,
    driver,
    read_error,
    read_one,
    womd_scenario,
)
from symphony.data.convert import convert
from symphony.data.segment import RunSegment, content_hash, validate
from symphony.data.sources import get_reader, readers
from symphony.data.sources.base import Item
from symphony.data.sources.commonroad import NO_LANELET, NO_LIGHT, NO_OBSTACLE
from symphony.data.sources.tfrecord import masked_crc32c, write_records
from symphony.errors import DataError

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
        pytest.importorskip("helpers_argoverse2")
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


# WOMD


@pytest.fixture
def shard(tmp_path: Path) -> bytes:
    """Three small records."""
    scenarios = [womd_scenario(f"{k:016x}", tracks=1 + k, steps=3) for k in range(3)]
    write_records(tmp_path / "shard", [scenario.SerializeToString() for scenario in scenarios])
    return (tmp_path / "shard").read_bytes()


def ends(shard: bytes) -> list[int]:
    """Where the records of a shard end, from 0 on."""
    found = [0]
    while found[-1] < len(shard):
        found.append(found[-1] + 16 + int.from_bytes(shard[found[-1] : found[-1] + 8], "little"))
    return found


@IN_FOLDER
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
    error = items[broken]
    assert isinstance(error, DataError)
    assert error.field == f"record {broken}"
    # The other records of the shard are still the same; none follows a record of unknown length.
    rest = [] if bit // 8 < places[broken] + 12 else whole[broken + 1 :]
    assert found == [*whole[:broken], None, *rest]


def test_a_huge_length_is_not_allocated(tmp_path: Path) -> None:
    head = struct.pack("<Q", 2**62)
    path = tmp_path / "a"
    path.write_bytes(head + struct.pack("<I", masked_crc32c(head)) + b"abc\0\0\0\0")
    assert "cut short" in read_error("womd", path).message


# CommonRoad


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
    error = read_error("commonroad", path)
    assert (error.field, error.file) == ("DOCTYPE", path)


@pytest.mark.parametrize(("text", "field", "message"), [
    (commonroad(driver(7)), "lanelet", "has no lanes"),
    (commonroad(ROAD), "dynamicObstacle", "has no dynamic obstacles"),
    (commonroad(ROAD, driver(7, speed=0)), "dynamicObstacle", "no moving vehicle"),
    (GOOD.replace("2020a", "2017a"), "commonRoadVersion", "2018b or 2020a"),
    (GOOD.replace('timeStepSize="0.1"', ""), "timeStepSize", "not a number"),
    (GOOD.replace('timeStepSize="0.1"', 'timeStepSize="nan"'), "timeStepSize", "not finite"),
    (GOOD.replace("<exact>3</exact>", "<exact>90000</exact>", 1), "time", "at most"),
    (GOOD.replace("<length>4.5", "<length>0", 1), "size", "must be positive"),
    (GOOD.replace('lanelet id="11"', 'lanelet id="10"'), "road.lane_id", "not unique"),
    (GOOD.replace('Obstacle id="8"', 'Obstacle id="7"'), "agent_id", "not unique"),
    (commonroad(ROAD, driver(7, x=1e6), driver(8)), "position", "not re-centred"),
])  # fmt: skip
def test_commonroad_errors_are_named(text: str, field: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text(text)
    error = read_error("commonroad", path)
    assert error.file == path
    assert error.field == field
    assert message in error.message
    assert error.segment == (None if field == "commonRoadVersion" else "ZAM_Made-1_1_T-1")


@pytest.mark.parametrize(("old", "new", "kind", "example"), [
    ("<exact>3</exact>", "<exact>2</exact>", NO_OBSTACLE, "obstacle 7: time: two states at step"),
    ("<exact>1</exact>", "<intervalStart>1</intervalStart>", NO_OBSTACLE, "obstacle 7"),  # predicted
    ("<x>1.0</x>", "<x>NaN</x>", NO_OBSTACLE, "obstacle 7: position: nan is not finite"),
    ("<velocity><exact>10.0", "<velocity><exact>fast", NO_OBSTACLE, "obstacle 7: velocity: 'fast'"),
    (RECTANGLE, "", NO_OBSTACLE, "obstacle 7: shape: expected one rectangle"),
    ('Obstacle id="7"', 'Obstacle id="99999999999999999999"', NO_OBSTACLE, "64 bits"),
    ("<x>25</x>", "<x>inf</x>", NO_LANELET, "lanelet 10: bound: inf is not finite"),
    ('ref="11"', 'ref="next"', NO_LANELET, "lanelet 10: successor: 'next' is not an integer"),
    ("<color>red", "<color>pink", NO_LIGHT, "trafficLight 30: color: unknown colors ['pink']"),
    ("<duration>3</duration>", "", NO_LIGHT, "trafficLight 30: duration"),
])  # fmt: skip
def test_commonroad_odd_things(old: str, new: str, kind: str, example: str, tmp_path: Path) -> None:
    light = (
        '<trafficLight id="30"><cycle><cycleElement><duration>3</duration><color>red</color></cycleElement>'
        "</cycle></trafficLight>"
    )
    more = ROAD.replace('<predecessor ref="10"/>', '<trafficLightRef ref="30"/>')
    whole = commonroad(more, driver(7), driver(8, x=20), light)
    path = tmp_path / "a.xml"
    path.write_text(whole.replace(old, new, 1))
    found = read_one("commonroad", path)
    assert example in found.odd[kind]
    lost = [kind == each for each in (NO_OBSTACLE, NO_LANELET, NO_LIGHT)]
    assert [2 - found.num_agents, 2 - len(found.road.lanes), 1 - len(found.signal_lane)] == lost
    report = convert("commonroad", [path], tmp_path / "out", interactive=1)
    assert report.odd[kind] == 1
    with pytest.raises(DataError, match="field strict"):
        convert("commonroad", [path], tmp_path / "strict", interactive=1, strict=True)
