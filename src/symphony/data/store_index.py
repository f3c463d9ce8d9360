"""Reading the indices of a segment store, which everything else is found by, and refusing what contradicts itself."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.bounds import MAX_AGENTS, MAX_POINTS, MAX_STEPS
from symphony.data.store_format import MAPS, SEGMENTS, Table, read_index
from symphony.errors import DataError


def read_indices(path: Path, limit: int | None = None) -> tuple[NDArray[Any], NDArray[Any]]:
    """Records of the segments (the first ``limit``), and of the maps they lie on.

    Raises:
        DataError: an index is missing or cut short, or a record contradicts itself or its neighbours.
    """
    segments = read_index(path, SEGMENTS, limit)
    count, axes = segments["count"], SEGMENTS.axes
    agents, lights, steps = count[:, axes["agents"]], count[:, axes["signals"]], segments["steps"]
    # Limits first: a product of numbers out of range may wrap around to a right one.
    sound = (steps >= 2) & (steps <= MAX_STEPS) & (agents <= MAX_AGENTS) & (lights <= MAX_POINTS)
    sound &= (
        (count[:, axes["states"]] == agents * steps)
        & (count[:, axes["signal_states"]] == lights * steps)
        & (segments["ego"] >= 0)
        & (segments["ego"] < agents)
        & (segments["map"] >= 0)
    )
    _check_sound(sound, SEGMENTS, path)
    # Maps no segment points at belong to an append that never finished.
    maps = read_index(path, MAPS, limit=int(segments["map"].max(initial=-1)) + 1)
    lines = [maps["count"][:, MAPS.axes[f"{name}.offsets"]] for name in ("lanes", "boundary", "marks")]
    sound = np.all([line >= 1 for line in lines], axis=0)
    for name, line in (("lanes", lines[0]), ("marks", lines[2])):
        sound &= maps["count"][:, MAPS.axes[name]] == line - 1
    _check_sound(sound, MAPS, path)
    return segments, maps


def _check_sound(sound: NDArray[np.bool_], table: Table, path: Path) -> None:
    if not sound.all():
        message = f"record {int(np.argmin(sound))} contradicts itself: the file is damaged"
        raise DataError(message, file=table.index_path(path))


def read_ids(path: Path, segments: NDArray[Any]) -> list[str]:
    """Segment ids in the order of the records.

    Raises:
        DataError: one is no text; names its number.
    """
    axis = SEGMENTS.axes["segment_id"]
    column = next(c for c in SEGMENTS.columns if c.name == "segment_id")
    data = SEGMENTS.column_path(path, column).read_bytes()
    begin, count = segments["begin"][:, axis].tolist(), segments["count"][:, axis].tolist()
    try:
        return [data[b : b + n].decode() for b, n in zip(begin, count, strict=True)]
    except UnicodeDecodeError:
        return [_id(data[b : b + n], k, path) for k, (b, n) in enumerate(zip(begin, count, strict=True))]


def _id(data: bytes, number: int, path: Path) -> str:
    try:
        return decoded(data, "segment_id")
    except DataError as error:
        raise error.at(file=path, segment=f"number {number}") from error


def decoded(data: bytes, field: str) -> str:
    """Text of a field.

    Raises:
        DataError: it is not UTF-8.
    """
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"damaged: not UTF-8 ({error.reason})", field=field) from error


def rows(table: Table, columns: Mapping[str, NDArray[Any]], record: Any) -> dict[str, Any]:
    """Views of one record's rows of every column."""
    begin, count = record["begin"].tolist(), record["count"].tolist()
    found = {}
    for column in table.columns:
        axis = table.axes[column.axis]
        found[column.name] = columns[column.name][begin[axis] : begin[axis] + count[axis]]
    return found
