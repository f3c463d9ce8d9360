"""Nested Python values and tensors as JSON and a flat mapping of tensors, and back without loss."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

TAG = "$"
"""Key of a JSON object that stands for something JSON lacks."""


def encode(value: Any, tensors: dict[str, Tensor], name: str) -> Any:
    """Turn `value` into JSON; tensors and arrays go to `tensors` (copies on the CPU), named by their place.

    Raises:
        TypeError: naming the place of a value that can't be stored.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, Mapping):
        if all(isinstance(key, str) for key in value) and TAG not in value:
            return {key: encode(item, tensors, f"{name}.{key}") for key, item in value.items()}
        items = [encode(item, tensors, f"{name}.{key}") for key, item in value.items()]
        return {TAG: "dict", "keys": encode(list(value), tensors, f"{name} (keys)"), "items": items}
    if isinstance(value, list):
        return [encode(item, tensors, f"{name}.{index}") for index, item in enumerate(value)]
    if isinstance(value, tuple):
        return {TAG: "tuple", "items": encode(list(value), tensors, name)}
    return _encode_leaf(value, tensors, name)


def _encode_leaf(value: Any, tensors: dict[str, Tensor], name: str) -> Any:
    if isinstance(value, float):
        # JSON knows no infinity. (A numpy float64 is a float too: hence the conversion.)
        return float(value) if math.isfinite(value) else {TAG: "float", "value": repr(float(value))}
    if isinstance(value, Tensor):
        return {TAG: "tensor", "value": _store(value.detach(), tensors, name)}
    if isinstance(value, np.ndarray):
        return {TAG: "array", "value": _store(torch.from_numpy(value.copy()), tensors, name)}
    raise TypeError(f"{name}: a value of type {type(value).__name__} can't be stored")


def _store(value: Tensor, tensors: dict[str, Tensor], name: str) -> str:
    unique, count = name, 1
    while unique in tensors:  # {"a.b": x, "a": {"b": y}} gives two tensors one name
        unique, count = f"{name}#{count}", count + 1
    tensors[unique] = value.to("cpu", copy=True).contiguous()
    return unique


def decode(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    """What :func:`encode` was given (mappings as plain dicts).

    Raises:
        KeyError, TypeError, ValueError: if it is not such a value.
    """
    if isinstance(value, list):
        return [decode(item, tensors) for item in value]
    if not isinstance(value, dict):
        return value
    kind = value.get(TAG)
    if kind is None:
        return {key: decode(item, tensors) for key, item in value.items()}
    if kind in _LEAVES:
        return _LEAVES[kind](value["value"], tensors)
    items = decode(value["items"], tensors)
    if kind == "dict":
        return dict(zip(decode(value["keys"], tensors), items, strict=True))
    if kind != "tuple":
        raise ValueError(f"unknown kind {kind!r}")
    return tuple(items)


_LEAVES: dict[str, Callable[[str, Mapping[str, Tensor]], Any]] = {
    "array": lambda text, tensors: tensors[text].numpy(),
    "float": lambda text, _: float(text),
    "tensor": lambda text, tensors: tensors[text],
}
