"""Changes to files that keep their structure, so that they get past the first check; all drawn from one generator."""

from __future__ import annotations

import contextlib
import functools
import json
import pickle
import tempfile
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

Rng = np.random.Generator
Files = dict[str, bytes]
ACCEPTED, REFUSED, ABSURD, FOREIGN = "accepted", "refused", "absurd", "foreign"

NUMBERS: list[Any] = json.loads(
    "[0, 1, -1, 2, 3, 7, 100, 4999, 5001, 9999, 36000, 1000000, 99000000.0, 2147483647, 2147483648, 9007199254740992,"
    " 4611686018427387904, 9223372036854775807, 9223372036854775808, -9223372036854775808, 18446744073709551616,"
    " 1000000000000000000000000000000, 0.5, 1e-6, 1e-300, 5e-324, 1e4, 2.1e4, 1e8, 1e30, 3e38, 1e300, Infinity,"
    " -Infinity, NaN]"
)
TEXTS = tuple(f"| |nan|-1|1e999|0x10|\x1b[2J|\u202e|a/b|{'x' * 300}|٣|true|null|AV".split("|"))
SMALL = 1 << 20
"""Bytes that a changed file may have at most: what is asked for is that small files stay harmless."""


class Target(NamedTuple):
    """One thing that reads files. ``good`` gives its files by name, the first of which is opened; ``mutate`` changes
    some; ``run`` reads them from a folder and says what came of it and what is wrong, or raises whatever it raises.
    """

    good: Callable[[], Files]
    mutate: Callable[[Rng, Files], Files]
    run: Callable[[Path, str], tuple[str, str]]


def one_in(many: int, folder: Path) -> bool:
    """Return whether the files of a folder are among the few with which more is done; always the same ones."""
    return zlib.crc32(b"".join(each.read_bytes() for each in sorted(folder.rglob("*.*")))) % many == 0


def written(write: Callable[[Path], Path]) -> Callable[[], Files]:
    """The files that a function writes into a folder, the one it returns first."""

    @functools.cache
    def files() -> Files:
        with tempfile.TemporaryDirectory() as folder:
            log = write(Path(folder))
            paths = sorted((p for p in Path(folder).rglob("*") if p.is_file()), key=lambda path: path != log)
            return {str(path.relative_to(folder)): path.read_bytes() for path in paths}

    return files


def pick(rng: Rng, options: Any) -> Any:
    """One of the options."""
    return options[int(rng.integers(len(options)))]


def number(rng: Rng) -> Any:
    """A number of the sort that breaks things, or of any size."""
    return pick(rng, NUMBERS) if rng.random() < 0.8 else float(rng.normal() * 10.0 ** rng.integers(-8, 12))


def bytes_(rng: Rng, data: bytes) -> bytes:
    """A few bits flipped, bytes set, stretches taken out, repeated or filled, or the end cut off."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        if not changed:
            break
        at, size = int(rng.integers(len(changed))), int(rng.integers(1, 65))
        way = int(rng.integers(7))
        if way == 0:
            changed[at] ^= 1 << int(rng.integers(8))
        elif way == 1:
            changed[at] = pick(rng, (0, 1, 0x7F, 0x80, 0xFF))
        elif way == 2:
            del changed[at : at + size]
        elif way == 3:
            changed[at:at] = changed[at : at + size] * int(rng.integers(1, 9))
        elif way == 4:
            changed[at : at + size] = bytes([pick(rng, (0, 0xFF))]) * size
        elif way == 5:
            del changed[at:]
        else:
            kind = pick(rng, ("<f4", "<f8", "<i4", "<i8"))
            with np.errstate(all="ignore"):
                value = np.float64(pick(rng, NUMBERS))
                safe = np.float64(0) if "i" in kind and not np.isfinite(value) else value
                raw = safe.astype(kind).tobytes()
            at -= at % len(raw)
            changed[at : at + len(raw)] = raw
    return bytes(changed[:SMALL])


def tree(rng: Rng, value: Any, times: int | None = None) -> Any:
    """Nested lists and tables with some places changed: another value, gone, repeated, or as deep as it goes."""
    for _ in range(int(rng.integers(1, 4)) if times is None else times):
        value = _change(rng, value, 0)
    return value


def _change(rng: Rng, value: Any, depth: int) -> Any:
    inside = isinstance(value, dict | list) and len(value) > 0
    if inside and rng.random() < 0.9:
        keys = list(value) if isinstance(value, dict) else range(len(value))
        key = pick(rng, keys)
        copy = dict(value) if isinstance(value, dict) else list(value)
        way = rng.random()
        if way < 0.05:
            del copy[key]
        elif way < 0.10 and isinstance(copy, list):
            copy[key:key] = [copy[key]] * int(rng.integers(1, 50))
        elif way < 0.10:
            copy[pick(rng, (*TEXTS, "0", str(key) + "0"))] = copy[key]
        elif way < 0.13:
            other = pick(rng, list(keys))
            copy[key], copy[other] = copy[other], copy[key]
        else:
            copy[key] = _change(rng, copy[key], depth + 1)
        return copy
    return leaf(rng, value)


def leaf(rng: Rng, value: Any) -> Any:
    """Another value, of the same kind more often than not."""
    if isinstance(value, np.ndarray) and rng.random() < 0.9:
        return _array(rng, value)
    if isinstance(value, bool) and rng.random() < 0.5:
        return not value
    if isinstance(value, int | float) and rng.random() < 0.8:
        return number(rng) if rng.random() < 0.7 else value * pick(rng, (-1, 1e3, 1e-3, 1 + 1e-7))
    if isinstance(value, str) and rng.random() < 0.7:
        return pick(rng, TEXTS)
    others = (None, number, TEXTS, [], {}, [value] * 3, {"a": value}, True)
    other = pick(rng, others)
    return number(rng) if other is number else pick(rng, TEXTS) if other is TEXTS else other


def _array(rng: Rng, value: Any) -> Any:
    """An array with some elements changed, of another shape or type."""
    way = rng.random()
    if way < 0.6 and value.size and value.dtype.kind in "fiub":
        copy = value.copy()
        with np.errstate(all="ignore"):
            wanted = float(number(rng)) if rng.random() < 0.5 else float(copy.flat[0]) * 1e3
            safe = wanted if value.dtype.kind == "f" or abs(wanted) < 2**31 else 0.0
            places = rng.integers(copy.size, size=int(rng.integers(1, 4)))
            copy.flat[places] = np.float64(safe).astype(copy.dtype)
        return copy
    if way < 0.7:
        return value[: int(rng.integers(len(value) + 1))] if value.ndim else value
    if way < 0.8:
        return np.concatenate([value] * int(rng.integers(2, 30))) if value.ndim else value
    if way < 0.9:
        return value[..., None] if rng.random() < 0.5 else value.reshape(-1)
    sound = value.dtype.kind not in "fiub" or np.isfinite(value).all()
    return value.astype(pick(rng, ("f4", "f8", "i8", "?", "O", "U8"))) if sound else value


def pickle_(rng: Rng, data: bytes) -> bytes:
    """A pickled tree with some places changed; at times its bytes."""
    if rng.random() < 0.25:
        return bytes_(rng, data)
    return pickle.dumps(tree(rng, pickle.loads(data)), protocol=int(rng.integers(2, 6)))  # noqa: S301 - made here


def csv(rng: Rng, data: bytes) -> bytes:
    """A table with cells changed, rows gone, repeated or moved, or columns renamed; at times as bytes."""
    if rng.random() < 0.15:
        return bytes_(rng, data)
    rows = [line.split(",") for line in data.decode().splitlines()]
    for _ in range(int(rng.integers(1, 5))):
        if not rows:
            break
        at, way = int(rng.integers(len(rows))), rng.random()
        if way < 0.1:
            del rows[at]
        elif way < 0.2:
            rows[at:at] = [list(rows[at]) for _ in range(int(rng.integers(1, 30)))]
        elif way < 0.3:
            rows[at] = list(pick(rng, rows))
        else:
            row = rows[0 if rng.random() < 0.05 else at]
            row[int(rng.integers(len(row)))] = _text(rng)
    return "\n".join(",".join(row) for row in [*rows, []]).encode("utf-8", "surrogatepass")


def json_(rng: Rng, data: bytes) -> bytes:
    """JSON with some of its places changed; at times with the deepest nesting, or as bytes."""
    way = rng.random()
    if way < 0.1:
        return bytes_(rng, data)
    if way < 0.11:
        return b"[" * 100_000 + b"]" * 100_000
    return json.dumps(tree(rng, json.loads(data))).encode("utf-8", "surrogatepass")[: 4 * SMALL]


def xml(rng: Rng, data: bytes) -> bytes:
    """XML with some elements changed, gone, repeated or moved; at times as bytes."""
    if rng.random() < 0.1:
        return bytes_(rng, data)
    root = ET.fromstring(data)  # noqa: S314 - made here
    for _ in range(int(rng.integers(1, 5))):
        parents = {child: parent for parent in root.iter() for child in parent}
        if not parents:
            break
        node = pick(rng, list(parents))
        parent, way = parents[node], int(rng.integers(8))
        if way == 0:
            parent.remove(node)
        elif way == 1:
            parent.extend([node] * int(rng.integers(1, 30)))
        elif way == 2 and len(node) == 0:
            parents[pick(rng, list(parents))].append(node)
        elif way == 3 and node.attrib:
            node.attrib[pick(rng, list(node.attrib))] = _text(rng)
        elif way == 4:
            node.tag = pick(rng, [other.tag for other in parents])
        else:
            leaves = [each for each in node.iter() if len(each) == 0]
            pick(rng, leaves).text = _text(rng)
    return ET.tostring(root)[: 4 * SMALL]


def _text(rng: Rng) -> str:
    text = str(number(rng)) if rng.random() < 0.8 else str(pick(rng, TEXTS))
    return "".join(letter for letter in text if letter >= " ")


def message(rng: Rng, record: Any) -> None:
    """A protobuf message with some fields changed, cleared or repeated, in place."""
    for _ in range(int(rng.integers(1, 5))):
        node = record
        while True:
            present = [field for field, _ in node.ListFields()]
            field = pick(rng, present if present and rng.random() < 0.85 else list(node.DESCRIPTOR.fields))
            value = getattr(node, field.name)
            many = hasattr(value, "__len__") and not isinstance(value, str | bytes)
            if field.message_type is None or rng.random() < 0.2:
                break
            if many and not len(value):
                value.add()
            node = pick(rng, value) if many else value
        way = rng.random()
        # A value that the field can't take is taken by nobody.
        with contextlib.suppress(ValueError, TypeError, OverflowError, IndexError):
            if way < 0.1:
                node.ClearField(field.name)
            elif many and way < 0.3:
                del value[int(rng.integers(len(value) + 1)) :]
            elif many and len(value) and way < 0.6:
                value.extend([pick(rng, value)] * int(rng.integers(1, 100)))
            elif field.message_type is None and many:
                value[int(rng.integers(len(value)))] = _scalar(rng, field)
            elif field.message_type is None:
                setattr(node, field.name, _scalar(rng, field))


def _scalar(rng: Rng, field: Any) -> Any:
    kind = field.cpp_type
    if kind in (field.CPPTYPE_DOUBLE, field.CPPTYPE_FLOAT):
        return float(number(rng))
    if kind == field.CPPTYPE_STRING:
        return pick(rng, TEXTS)
    return pick(rng, (0, 1, 2, 3, 5, 9, -1, 100, 2**31 - 1, -(2**31), 2**63 - 1))
