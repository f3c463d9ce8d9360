"""Saved rollouts as tensors and back, every field checked."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load

from symphony.data.segment import Polylines, RoadMap, RunSegment, validate
from symphony.errors import DataError
from symphony.saved.rollouts import SavedRollouts, SavedTrees

KEY = "symphony"
"""Of the JSON in the header of a file."""

MAX_PLACE, MAX_TURN, MAX_SPEED = 1e5, 1e4, 1e3
"""Metres, radians and m/s that a simulated state may have: some times those of a log, as nobody steers it back."""

MAX_LENGTH = 100_000
"""Rollouts, steps or agents."""

_NUMBER = re.compile(r"[0-9]{1,9}")
"""Of a rollout."""
_LINES = ("lanes", "boundary", "marks")
_ROAD = tuple(item.name for item in fields(RoadMap) if item.name not in _LINES)
_SCALARS = ("segment_id", "source", "dt", "ego", "current_step", "file", "group")
_LOG = tuple(
    item.name
    for item in fields(RunSegment)
    if item.name not in (*_SCALARS, "road") and item.metadata.get("hashed", True)
)
_TREE = tuple(item.name for item in fields(SavedTrees) if item.name != "prune_every")

# Shapes by letter: K rollouts, N driven agents, T steps, U = T + 1; R trees, S branches, P periods, L leaves.
_SHAPES: dict[str, tuple[Any, str]] = {
    "agents": (np.int64, "N"),
    "state": (np.float32, "KUN4"),
    "counted": (np.bool_, "KTN"),
    "collision": (np.bool_, "KTN"),
    "offroad": (np.bool_, "KTN"),
    "goal": (np.int64, "KN"),
}
_TREE_SHAPES: dict[str, tuple[Any, str]] = {
    "state": (np.float32, "RSTN4"),
    "there": (np.bool_, "RSTN"),
    "collision": (np.bool_, "RSTN"),
    "offroad": (np.bool_, "RSTN"),
    "score": (np.float32, "RSTN"),
    "totals": (np.float32, "RPS"),
    "parents": (np.int64, "RPS"),
    "slots": (np.int64, "RPL"),
}


def tensors_of(saved: SavedRollouts) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """All arrays of a file by name, and what JSON holds beside them."""
    segment, road = saved.segment, saved.segment.road
    arrays = {name: getattr(saved, name) for name in _SHAPES}
    arrays |= _split("routes", saved.routes)
    arrays |= {f"log.{name}": getattr(segment, name) for name in _LOG}
    arrays |= {f"road.{name}": getattr(road, name) for name in _ROAD}
    for name in _LINES:
        arrays |= _split(f"road.{name}", getattr(road, name))
    facts: dict[str, Any] = {name: getattr(segment, name) for name in _SCALARS}
    facts |= {"dt": float(segment.dt), "ego": int(segment.ego), "current_step": int(segment.current_step)}
    facts |= {"start": saved.start, "drivers": list(saved.drivers)}
    facts["failed"] = {str(number): reason for number, reason in saved.failed.items()}
    if saved.trees is not None:
        arrays |= {f"tree.{name}": getattr(saved.trees, name) for name in _TREE}
        facts["prune_every"] = int(saved.trees.prune_every)
    # Only contiguous arrays are written as they are meant.
    return {name: np.ascontiguousarray(value) for name, value in arrays.items()}, facts


def _split(name: str, lines: Polylines) -> dict[str, NDArray[Any]]:
    return {f"{name}.points": lines.points, f"{name}.offsets": lines.offsets}


def read_tensors(data: bytes, file: Path, segment_id: str) -> SavedRollouts:
    """Saved rollouts from the bytes of their file.

    Raises:
        DataError: damaged, something missing, of a wrong type or shape, not finite, or out of range; names the file,
            the segment and the field.
    """
    try:
        arrays = load(data)
    except (SafetensorError, ValueError) as error:  # the latter of NumPy, for shapes like 0 x 2^62 x 8
        raise DataError(f"damaged ({error})", file=file, segment=segment_id) from error
    try:
        facts = _facts(data)
        return _checked(_assembled(arrays, facts), facts, segment_id)
    except UnicodeDecodeError as error:
        raise DataError(f"damaged ({error})", file=file, segment=segment_id) from error
    except DataError as error:
        raise DataError(error.message, file=file, segment=segment_id, field=error.field) from error


def _facts(data: bytes) -> dict[str, Any]:
    """The JSON in the header of a safetensors file, which begins with its length as 8 bytes."""
    try:
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        facts = json.loads(header["__metadata__"][KEY])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError("damaged or missing", field=KEY) from error
    if not isinstance(facts, dict):
        raise DataError("not a JSON object", field=KEY)
    return facts


class _Reader:
    """Takes values out of what was read, each of which must be there."""

    def __init__(self, arrays: dict[str, NDArray[Any]], facts: dict[str, Any]) -> None:
        self.arrays, self.facts = arrays, facts

    def array(self, name: str) -> NDArray[Any]:
        if name not in self.arrays:
            raise DataError("is missing", field=name)
        return self.arrays[name]

    def lines(self, name: str) -> Polylines:
        lines = Polylines(self.array(f"{name}.points"), self.array(f"{name}.offsets"))
        flat = lines.offsets.ndim == 1 and len(lines.offsets) > 0 and lines.points.ndim == 2
        if not flat or lines.offsets.dtype != np.int64:
            raise DataError("must be points [P, 3] and int64 offsets", field=name)
        return lines

    def fact(self, name: str, kind: type | tuple[type, ...]) -> Any:
        if name not in self.facts:
            raise DataError("is missing", field=name)
        value = self.facts[name]
        if not isinstance(value, kind) or isinstance(value, bool):
            raise DataError(f"is {value!r}, which is of the wrong type", field=name)
        return value


def _assembled(arrays: dict[str, NDArray[Any]], facts: dict[str, Any]) -> SavedRollouts:
    if "log_weight" in arrays:
        raise DataError(
            "is of a search with a tilt, which needs these weights: simulate anew", field="log_weight"
        )
    reader = _Reader(arrays, facts)
    parts: dict[str, Any] = {name: reader.lines(f"road.{name}") for name in _LINES}
    road = RoadMap(**parts | {name: reader.array(f"road.{name}") for name in _ROAD})
    parts = {name: reader.array(f"log.{name}") for name in _LOG}
    parts |= {name: reader.fact(name, str) for name in ("segment_id", "source", "file", "group")}
    segment = RunSegment(
        **parts,
        road=road,
        dt=reader.fact("dt", float),
        ego=reader.fact("ego", int),
        current_step=reader.fact("current_step", int),
    )
    trees = None
    if "prune_every" in facts:
        # Files of before November 23, 2026 don't say who is there.
        arrays.setdefault("tree.there", np.ones(reader.array("tree.offroad").shape, np.bool_))
        parts = {name: reader.array(f"tree.{name}") for name in _TREE}
        trees = SavedTrees(**parts, prune_every=reader.fact("prune_every", int))
    failed = reader.fact("failed", dict)
    # Longer numbers than there are rollouts; thousands of digits would be no number to Python either.
    if not all(_NUMBER.fullmatch(number) for number in failed):
        raise DataError("must name rollouts by number", field="failed")
    drivers = reader.fact("drivers", list)
    if not all(isinstance(name, str) for name in drivers):
        raise DataError("must be names", field="drivers")
    return SavedRollouts(
        segment=segment,
        **{name: reader.array(name) for name in _SHAPES},
        routes=reader.lines("routes"),
        start=reader.fact("start", int),
        drivers=tuple(drivers),
        failed={int(number): str(reason) for number, reason in failed.items()},
        trees=trees,
    )


def _checked(saved: SavedRollouts, facts: dict[str, Any], segment_id: str) -> SavedRollouts:
    segment = validate(saved.segment)
    if segment.segment_id != segment_id:
        raise DataError(f"is of segment {segment.segment_id}", field="segment_id")
    sizes = {"4": 4}
    for name, (dtype, shape) in _SHAPES.items():
        _check_shape(name, getattr(saved, name), dtype, shape, sizes)
    if sizes["U"] != sizes["T"] + 1:
        raise DataError(f"{sizes['U']} states for {sizes['T']} steps", field="state")
    _check_range("agents", saved.agents, 0, segment.num_agents)
    if len(np.unique(saved.agents)) != len(saved.agents):
        raise DataError("names an agent twice", field="agents")
    _check_range("goal", saved.goal, -1, len(saved.routes))
    _check_lines(saved.routes)
    if saved.start < 0 or saved.last >= segment.num_steps:
        message = f"steps {saved.start} to {saved.last} are outside the {segment.num_steps} of the log"
        raise DataError(message, field="start")
    if len(saved.drivers) != sizes["N"]:
        raise DataError(f"{len(saved.drivers)} for {sizes['N']} agents", field="drivers")
    if any(number >= sizes["K"] for number in saved.failed):
        raise DataError(f"names a rollout outside the {sizes['K']}", field="failed")
    _check_state("state", saved.state[saved.there])
    if saved.trees is not None:
        _check_trees(saved.trees, sizes)
    return saved


def _check_trees(trees: SavedTrees, sizes: dict[str, int]) -> None:
    for name, (dtype, shape) in _TREE_SHAPES.items():
        _check_shape(f"tree.{name}", getattr(trees, name), dtype, shape, sizes)
    if trees.prune_every < 1 or sizes["P"] != -(-sizes["T"] // trees.prune_every):
        message = f"{sizes['P']} periods of {trees.prune_every} for {sizes['T']} steps"
        raise DataError(message, field="tree.prune_every")
    for name in ("parents", "slots"):
        _check_range(f"tree.{name}", getattr(trees, name), 0, sizes["S"])
    if sizes["R"] * sizes["L"] != sizes["K"]:
        message = f"{sizes['R']} trees of {sizes['L']} leaves are not {sizes['K']} rollouts"
        raise DataError(message, field="tree.slots")
    _check_state("tree.state", trees.state[trees.there])
    if np.isinf(trees.score).any():
        raise DataError("holds an infinite number", field="tree.score")


def _check_shape(name: str, value: NDArray[Any], dtype: Any, shape: str, sizes: dict[str, int]) -> None:
    """Check dtype and shape; a letter that is new takes the size it meets."""
    if value.dtype != dtype:
        raise DataError(f"dtype {value.dtype}, expected {np.dtype(dtype)}", field=name)
    if value.ndim != len(shape):
        raise DataError(f"shape {list(value.shape)}, expected {len(shape)} dimensions", field=name)
    if max(value.shape) > MAX_LENGTH:  # arrays without elements have any shape
        raise DataError(f"shape {list(value.shape)}, at most {MAX_LENGTH} along a dimension", field=name)
    for letter, size in zip(shape, value.shape, strict=True):
        if sizes.setdefault(letter, size) != size:
            raise DataError(
                f"shape {list(value.shape)}: {size} where {sizes[letter]} is expected", field=name
            )


def _check_range(name: str, value: NDArray[Any], low: int, high: int) -> None:
    if value.size and (value.min() < low or value.max() >= high):
        raise DataError(f"values outside {low} … {high - 1}", field=name)


def _check_finite(name: str, value: NDArray[Any]) -> None:
    bad = int((~np.isfinite(value)).sum())
    if bad:
        raise DataError(f"{bad} numbers that are not finite", field=name)


def _check_state(name: str, value: NDArray[Any]) -> None:
    _check_finite(name, value)
    far, most = (
        np.abs(value).max(tuple(range(value.ndim - 1)), initial=0),
        (MAX_PLACE, MAX_PLACE, MAX_TURN, MAX_SPEED),
    )
    for what, found, bound in zip(("x", "y", "heading", "speed"), far.tolist(), most, strict=True):
        if found > bound:
            raise DataError(f"a {what} of {found:.4g}, at most {bound:g} is plausible", field=name)


def _check_lines(lines: Polylines) -> None:
    offsets = lines.offsets
    whole = (
        offsets[0] == 0 and offsets[-1] == len(lines.points) and (offsets[1:] >= offsets[:-1]).all()
    )  # subtracted, damaged ones can overflow
    if not whole:
        raise DataError("offsets do not match the points", field="routes")
    if lines.points.dtype != np.float32 or lines.points.shape[1:] != (3,):
        raise DataError("must be float32 [P, 3]", field="routes")
    _check_finite("routes", lines.points)
