"""Rollouts of the Waymo Open Sim Agents Challenge, made by anyone, as arrays in a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.npz import read_npz
from symphony.errors import DataError

STATES = ("x", "y", "z", "heading")


@dataclass(frozen=True)
class RolloutArrays:
    """R simulated futures of a scenario, 80 steps of 0.1 s of each of n agents.

    Attributes:
        object_id: [n].
        x, y, z: [R, n, 80] box centres in the world frame of the log, metres.
        heading: [R, n, 80] radians.
    """

    object_id: NDArray[np.integer[Any]]
    x: NDArray[np.floating[Any]]
    y: NDArray[np.floating[Any]]
    z: NDArray[np.floating[Any]]
    heading: NDArray[np.floating[Any]]


def read_rollouts(file: Path) -> RolloutArrays:
    """Read an ``.npz`` with ``object_id`` [n] and ``x``, ``y``, ``z``, ``heading`` [R, n, 80]; more is left alone.

    Raises:
        DataError: the file is damaged or something is missing or of a wrong kind; names file and field.
    """
    held = read_npz(file, ("object_id", *STATES))
    arrays: dict[str, Any] = {}
    for name in ("object_id", *STATES):
        if name not in held:
            raise DataError("missing", file=file, field=name)
        array = held[name]
        kind = np.integer if name == "object_id" else np.floating
        if not np.issubdtype(array.dtype, kind):
            wanted = "whole numbers" if name == "object_id" else "floating-point numbers"
            raise DataError(f"holds {array.dtype}, expected {wanted}", file=file, field=name)
        # Whatever width and byte order they come in.
        plain = np.int64 if name == "object_id" else np.float32 if array.dtype.itemsize <= 4 else np.float64
        with np.errstate(over="ignore"):
            arrays[name] = array.astype(plain)
    return RolloutArrays(**arrays)


def write_rollouts(file: Path, rollouts: RolloutArrays) -> None:
    """Write a file that :func:`read_rollouts` reads."""
    with file.open("wb") as out:
        np.savez_compressed(out, object_id=rollouts.object_id, **{k: getattr(rollouts, k) for k in STATES})
