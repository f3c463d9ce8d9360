"""TFRecord framing without TensorFlow.

A record is its length (uint64), the masked CRC-32C of those 8 bytes (uint32), the payload, and the payload's
masked CRC-32C (uint32), all little endian.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path

import google_crc32c

from symphony.errors import DataError

MAX_RECORD = 32 << 20
"""Bytes of a record; a scenario has about one million, and takes many times as much once it is parsed."""
_HEADER, _CHECK = struct.Struct("<QI"), struct.Struct("<I")


def masked_crc32c(data: bytes) -> int:
    """Return the CRC-32C rotated right by 15 bits plus a constant: a CRC of data that holds CRCs stays sound."""
    crc = google_crc32c.value(data)
    return (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def read_records(path: Path) -> Iterator[bytes | DataError]:
    """Yield the payload of each record; both checksums are verified.

    A payload with a wrong checksum, or of more than :data:`MAX_RECORD` bytes, is yielded as a :class:`DataError`, and
    reading goes on with the next record. One is raised where the file is empty or cut short, or a length has a wrong
    checksum, so that there is no telling where the next record begins.
    """
    with path.open("rb") as file:
        left = os.fstat(file.fileno()).st_size
        if left == 0:
            raise DataError("the file is empty", file=path)
        index = 0
        while left > 0:
            where = f"record {index}"
            header = file.read(_HEADER.size)
            if len(header) < _HEADER.size:
                message = f"cut short: {len(header)} of {_HEADER.size} header bytes"
                raise DataError(message, file=path, field=where)
            length, check = _HEADER.unpack(header)
            if masked_crc32c(header[:8]) != check:
                kind = "not a TFRecord file, or damaged" if index == 0 else "damaged"
                message = f"{kind}: the checksum of the record's length is wrong"
                raise DataError(message, file=path, field=where)
            size = length + _CHECK.size
            left -= _HEADER.size + size
            if left < 0:
                raise DataError(f"cut short: {left + size} of {size} payload bytes", file=path, field=where)
            index += 1
            if length > MAX_RECORD:
                file.seek(size, os.SEEK_CUR)
                yield DataError(f"{length} bytes, at most {MAX_RECORD} are read", file=path, field=where)
                continue
            payload, tail = file.read(length), file.read(_CHECK.size)
            good = masked_crc32c(payload) == int.from_bytes(tail, "little")
            message = "damaged: the checksum of the payload is wrong"
            yield payload if good else DataError(message, file=path, field=where)
