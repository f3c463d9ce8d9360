"""Pickles that hold nothing but containers, text, numbers and NumPy arrays.

A pickle is a program. This one is read instruction by instruction first: those that plain data does not need are
refused, and so is every name but NumPy's own few for arrays. These names then stand for functions of this module,
which look at shapes and types and take the bytes as they are: not even NumPy's own unpickling is run, since it
trusts what it reads.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symphony.data.sources.base import read_whole, refuse
from symphony.errors import DataError

MAX_BYTES = 1 << 28  # bytes of a file; scenarios have a few million
MAX_OPCODES = 20_000_000  # instructions of a file; scenarios have a few million

_PLAIN = (
    "PROTO FRAME STOP MARK POP POP_MARK NONE NEWTRUE NEWFALSE LONG1 LONG4 BININT BININT1 BININT2 BINFLOAT BINBYTES "
    "BINBYTES8 SHORT_BINBYTES BYTEARRAY8 BINUNICODE BINUNICODE8 SHORT_BINUNICODE EMPTY_LIST APPEND APPENDS "
    "EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_DICT SETITEM SETITEMS EMPTY_SET ADDITEMS FROZENSET MEMOIZE BINGET "
    "LONG_BINGET STACK_GLOBAL REDUCE BUILD"
)
_OPCODES = frozenset(_PLAIN.split())  # instructions of protocols 4 and 5 that plain data needs
_KINDS = "biufSU"
MAX_ITEM = 4096  # bytes of one element of an array: texts of up to 1024 characters


class _Named:
    """The stand-in for a name in a pickle; nothing can be set on it from there."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise DataError("sets the state of what has none")


class _Type:
    """Stands for ``numpy.dtype``: the text it is made from, and a byte order that may follow."""

    __slots__ = ("found",)

    def __init__(self, text: Any, *flags: Any) -> None:
        plain = isinstance(text, str) and 2 <= len(text) <= 6 and text[0] in _KINDS
        refuse(not plain, f"an array of type {str(text)[:20]!r}")
        self.found = np.dtype(text)
        plain = self.found.kind in _KINDS and 0 < self.found.itemsize <= MAX_ITEM
        refuse(not plain, f"an array of type {text!r}")

    def __setstate__(self, state: Any) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        # For plain types nothing but the order is ever given.
        plain = order in {"<", ">", "|", "="} and all(part is None for part in state[2:5])
        refuse(not plain, "an array of a structured type")
        self.found = self.found.newbyteorder(order)


class Array:
    """An array of a pickle; ``value`` holds it once its state was given."""

    __slots__ = ("value",)

    def __init__(self, *state: Any) -> None:
        self.value: NDArray[Any] = _array(*state) if state else np.zeros(0)

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, data = state
        self.value = _array(data, dtype, shape, "F" if fortran else "C")


def _array(data: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    known = isinstance(dtype, _Type) and isinstance(data, (bytes, bytearray))
    refuse(not known, "an array of objects")
    # Otherwise the product of many sizes could be anything.
    refuse(not isinstance(shape, tuple) or len(shape) > 8, "an array without a shape")
    sides = [type(side) is int and 0 <= side <= MAX_BYTES for side in shape]
    refuse(not all(sides), "an array of an impossible shape")
    size = math.prod(shape) * dtype.found.itemsize
    refuse(size != len(data), f"an array of shape {shape} in {len(data)} bytes")
    return np.frombuffer(data, dtype.found).reshape(shape, order="F" if order == "F" else "C")


def _never(*_: Any) -> Any:
    raise DataError("makes an array by itself")


_NAMES: dict[tuple[str, str], Any] = {("numpy", "ndarray"): _Named(_never), ("numpy", "dtype"): _Named(_Type)}
for _core in ("core", "_core"):
    _NAMES[f"numpy.{_core}.multiarray", "_reconstruct"] = _Named(lambda *_: Array())
    _NAMES[f"numpy.{_core}.multiarray", "scalar"] = _Named(lambda kind, data: _array(data, kind, (1,), "C")[0].item())
    _NAMES[f"numpy.{_core}.numeric", "_frombuffer"] = _Named(Array)


class _Plain(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return the stand-in for one of a few allowed names."""
        refuse((module, name) not in _NAMES, f"refers to {module}.{name}, which no plain data needs")
        return _NAMES[module, name]


def load_plain(path: Path) -> Any:
    """Read a pickle of plain data; its arrays are :class:`Array`. A :class:`DataError` names what is too large,
    empty, cut short, damaged, or anything else that it refers to.
    """
    data = read_whole(path, MAX_BYTES)
    try:
        _check(data)
        return _Plain(io.BytesIO(data)).load()
    # Damaged bytes make it do anything to anything.
    except Exception as error:
        raise DataError(f"not a pickle of plain data: {str(error)[:200]}", file=path) from error


def _check(data: bytes) -> None:
    count = 0
    for count, (opcode, argument, place) in enumerate(pickletools.genops(data), start=1):
        if opcode.name == "PROTO" and (argument or 0) < 4:
            raise DataError(f"protocol {argument}; 4 and 5 are read")
        if opcode.name not in _OPCODES:
            raise DataError(f"instruction {opcode.name} at byte {place}, which no plain data needs")
        if count > MAX_OPCODES:
            raise DataError(f"more than {MAX_OPCODES} instructions")
    refuse(count == 0, "no instructions")
