from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from symphony.data.sources.tfrecord import masked_crc32c, read_records, write_records
from symphony.errors import DataError

HEADER, TAIL = 12, 4


def crc32c_bit_by_bit(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


@given(st.binary(max_size=200))
def test_the_checksum_is_the_masked_crc_32c(data: bytes) -> None:
    crc = crc32c_bit_by_bit(data)
    rotated = (crc >> 15 | crc << 17) & 0xFFFFFFFF
    assert masked_crc32c(data) == (rotated + 0xA282EAD8) % 2**32


def test_the_layout_on_disk(tmp_path: Path) -> None:
    path = tmp_path / "a.tfrecord"
    write_records(path, [b"abc"])
    data = path.read_bytes()
    length = struct.pack("<Q", 3)
    assert data == (
        length + struct.pack("<I", masked_crc32c(length)) + b"abc" + struct.pack("<I", masked_crc32c(b"abc"))
    )


def drain(path: Path) -> tuple[list[bytes], list[DataError]]:
    """(good payloads, errors, raised ones included)."""
    payloads: list[bytes] = []
    errors: list[DataError] = []
    try:
        for item in read_records(path):
            if isinstance(item, DataError):
                errors.append(item)
            else:
                payloads.append(item)
    except DataError as error:
        errors.append(error)
    return payloads, errors


PAYLOADS = [b"first", b"", b"the third one"]


@pytest.fixture
def written(tmp_path: Path) -> bytes:
    write_records(tmp_path / "good", PAYLOADS)
    return (tmp_path / "good").read_bytes()


def test_cut_anywhere(tmp_path: Path, written: bytes) -> None:
    ends = [0]
    for payload in PAYLOADS:
        ends.append(ends[-1] + HEADER + len(payload) + TAIL)
    path = tmp_path / "cut"
    for size in range(len(written)):
        path.write_bytes(written[:size])
        payloads, errors = drain(path)
        whole = sum(end <= size for end in ends[1:])
        assert payloads == PAYLOADS[:whole]
        if size in ends[1:]:
            assert errors == []
            continue
        assert len(errors) == 1
        assert errors[0].file == path
        assert size == 0 or errors[0].field == f"record {whole}"


def test_any_flipped_bit_is_noticed(tmp_path: Path, written: bytes) -> None:
    path = tmp_path / "flipped"
    for bit in range(8 * len(written)):
        data = bytearray(written)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        payloads, errors = drain(path)
        assert len(errors) == 1
        assert all(payload in PAYLOADS for payload in payloads)


def test_a_damaged_payload_costs_only_its_own_record(tmp_path: Path, written: bytes) -> None:
    path = tmp_path / "flipped"
    path.write_bytes(written.replace(b"first", b"worst"))
    items = list(read_records(path))
    assert isinstance(items[0], DataError)
    assert items[0].field == "record 0"
    assert items[1:] == PAYLOADS[1:]


def test_a_huge_length_is_not_allocated(tmp_path: Path) -> None:
    length = struct.pack("<Q", 2**62)
    path = tmp_path / "huge"
    path.write_bytes(length + struct.pack("<I", masked_crc32c(length)) + b"abc")
    _, (error,) = drain(path)
    assert "cut short" in str(error)
