"""Saved rollouts as tensors and back, every field checked."""

from __future__ import annotations

import json
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
"""The name of the JSON in the header of a file."""
MAX_STATE = {"x": 1e5, "y": 1e5, "heading": 1e4, "speed": 1e3}
"""Metres, radians and m/s that a simulated state may have: some times those of a log, as nobody steers it back."""
MAX_LENGTH = 100_000
"""Rollouts, steps or agents."""

_LINES = ("lanes", "boundary", "marks")
_ROAD = tuple(item.name for item in fields(RoadMap) if item.name not in _LINES)
_TEXTS = ("segment_id", "source", "file", "group")
_SCALARS = {**dict.fromkeys(_TEXTS, str), "dt": float, "ego": int, "current_step": int}
_LOG = tuple(
    item.name
    for item in fields(RunSegment)
    if item.name not in (*_SCALARS, "road") and item.metadata.get("hashed", True)
)
# Types, and shapes by letter: K rollouts, N driven agents, T steps, U = T + 1; R trees, S branches, P periods,
# L leaves.
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
    arrays |= {f"log.{name}": getattr(segment, name) for name in _LOG}
    arrays |= {f"road.{name}": getattr(road, name) for name in _ROAD}
    for name, lines in (
        ("routes", saved.routes),
        *((f"road.{name}", getattr(road, name)) for name in _LINES),
    ):
        arrays |= {f"{name}.points": lines.points, f"{name}.offsets": lines.offsets}
    facts: dict[str, Any] = {name: kind(getattr(segment, name)) for name, kind in _SCALARS.items()}
    facts |= {"start": saved.start, "drivers": list(saved.drivers)}
    facts["failed"] = {str(number): reason for number, reason in saved.failed.items()}
    if saved.trees is not None:
        arrays |= {f"tree.{name}": getattr(saved.trees, name) for name in _TREE_SHAPES}
        facts["prune_every"] = int(saved.trees.prune_every)
    # Only contiguous arrays are written as they are meant.
    return {name: np.ascontiguousarray(value) for name, value in arrays.items()}, facts


def read_tensors(data: bytes, file: Path, segment_id: str) -> SavedRollouts:
    """Saved rollouts from the bytes of their file.

    Raises:
        DataError: damaged, something missing, of a wrong type or shape, not finite, or out of range; names the file,
            the segment and the field.
    """
    try:
        arrays = load(data)
        # A safetensors file begins with the length of its header as 8 bytes.
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
        return _checked(_assembled(arrays, json.loads(header["__metadata__"][KEY])), segment_id)
    except DataError as error:
        raise DataError(error.message, file=file, segment=segment_id, field=error.field) from error
    except KeyError as error:
        raise DataError("is missing", file=file, segment=segment_id, field=error.args[0]) from error
    except (SafetensorError, ValueError, TypeError, RecursionError) as error:
        raise DataError(f"damaged ({error})", file=file, segment=segment_id) from error


def _assembled(arrays: dict[str, NDArray[Any]], facts: dict[str, Any]) -> SavedRollouts:
    """Saved rollouts of arrays whose shapes are not checked yet."""
    if "log_weight" in arrays:
        message = "is of a search with a tilt, which needs these weights: simulate anew"
        raise DataError(message, field="log_weight")
    kinds: dict[str, type] = {**_SCALARS, "start": int, "drivers": list, "failed": dict}
    trees = None
    if "prune_every" in facts:
        # Files of before November 23, 2026 don't say who is there.
        arrays.setdefault("tree.there", np.ones(arrays["tree.offroad"].shape, np.bool_))
        kinds["prune_every"] = int
    for name, kind in kinds.items():
        if type(facts[name]) is not kind:
            raise DataError(f"is {facts[name]!r:.80}, which is of the wrong type", field=name)
    if "prune_every" in facts:
        parts = {name: arrays[f"tree.{name}"] for name in _TREE_SHAPES}
        trees = SavedTrees(**parts, prune_every=facts["prune_every"])
    # Thousands of digits would be no number to Python either.
    if not all(number.isascii() and number.isdigit() and len(number) < 10 for number in facts["failed"]):
        raise DataError("must name rollouts by number", field="failed")
    if not all(isinstance(name, str) for name in facts["drivers"]):
        raise DataError("must be names", field="drivers")
    road: dict[str, Any] = {name: _polylines(arrays, f"road.{name}") for name in _LINES}
    road |= {name: arrays[f"road.{name}"] for name in _ROAD}
    log: dict[str, Any] = {name: facts[name] for name in _SCALARS}
    log |= {name: arrays[f"log.{name}"] for name in _LOG}
    return SavedRollouts(
        segment=RunSegment(**log, road=RoadMap(**road)),
        **{name: arrays[name] for name in _SHAPES},
        routes=_polylines(arrays, "routes"),
        start=facts["start"],
        drivers=tuple(facts["drivers"]),
        failed={int(number): str(reason) for number, reason in facts["failed"].items()},
        trees=trees,
    )


def _polylines(arrays: dict[str, NDArray[Any]], name: str) -> Polylines:
    lines = Polylines(arrays[f"{name}.points"], arrays[f"{name}.offsets"])
    flat = lines.offsets.ndim == 1 and len(lines.offsets) > 0 and lines.points.ndim == 2
    if not flat or lines.offsets.dtype != np.int64:
        raise DataError("must be points [P, 3] and int64 offsets", field=name)
    return lines


def _checked(saved: SavedRollouts, segment_id: str) -> SavedRollouts:
    segment, trees = validate(saved.segment), saved.trees
    sizes = {"4": 4}
    for name, (dtype, shape) in _SHAPES.items():
        _check_shape(name, getattr(saved, name), dtype, shape, sizes)
    offsets = saved.routes.offsets
    whole = offsets[0] == 0 and offsets[-1] == len(saved.routes.points)
    whole &= bool((offsets[1:] >= offsets[:-1]).all())  # differences of damaged ones can overflow
    points = saved.routes.points
    outside = f"steps {saved.start} to {saved.last} are outside the {segment.num_steps} of the log"
    for field, good, message in (
        ("segment_id", segment.segment_id == segment_id, f"is of segment {segment.segment_id}"),
        ("state", sizes["U"] == sizes["T"] + 1, f"{sizes['U']} states for {sizes['T']} steps"),
        ("agents", len(np.unique(saved.agents)) == len(saved.agents), "names an agent twice"),
        ("routes", whole, "offsets do not match the points"),
        ("routes", points.dtype == np.float32 and points.shape[1:] == (3,), "must be float32 [P, 3]"),
        ("routes", bool(np.isfinite(points).all()), "holds numbers that are not finite"),
        ("start", saved.start >= 0 and saved.last < segment.num_steps, outside),
        ("drivers", len(saved.drivers) == sizes["N"], f"{len(saved.drivers)} for {sizes['N']} agents"),
        ("failed", all(k < sizes["K"] for k in saved.failed), f"names a rollout outside the {sizes['K']}"),
    ):
        if not good:
            raise DataError(message, field=field)
    _check_range("agents", saved.agents, 0, segment.num_agents)
    _check_range("goal", saved.goal, -1, len(saved.routes))
    _check_state("state", saved.state[saved.there])
    if trees is None:
        return saved
    for name, (dtype, shape) in _TREE_SHAPES.items():
        _check_shape(f"tree.{name}", getattr(trees, name), dtype, shape, sizes)
    if trees.prune_every < 1 or sizes["P"] != -(-sizes["T"] // trees.prune_every):
        message = f"{sizes['P']} periods of {trees.prune_every} for {sizes['T']} steps"
        raise DataError(message, field="tree.prune_every")
    if sizes["R"] * sizes["L"] != sizes["K"]:
        message = f"{sizes['R']} trees of {sizes['L']} leaves are not {sizes['K']} rollouts"
        raise DataError(message, field="tree.slots")
    for name in ("parents", "slots"):
        _check_range(f"tree.{name}", getattr(trees, name), 0, sizes["S"])
    _check_state("tree.state", trees.state[trees.there])
    if np.isinf(trees.score).any():
        raise DataError("holds an infinite number", field="tree.score")
    return saved


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
            message = f"shape {list(value.shape)}: {size} where {sizes[letter]} is expected"
            raise DataError(message, field=name)


def _check_range(name: str, value: NDArray[Any], low: int, high: int) -> None:
    if value.size and (value.min() < low or value.max() >= high):
        raise DataError(f"values outside {low} … {high - 1}", field=name)


def _check_state(name: str, value: NDArray[Any]) -> None:
    if not np.isfinite(value).all():
        raise DataError("holds numbers that are not finite", field=name)
    far = np.abs(value).max(tuple(range(value.ndim - 1)), initial=0)
    for (what, bound), found in zip(MAX_STATE.items(), far.tolist(), strict=True):
        if found > bound:
            raise DataError(f"a {what} of {found:.4g}, at most {bound:g} is plausible", field=name)
