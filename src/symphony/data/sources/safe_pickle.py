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

from symphony.errors import DataError

MAX_BYTES = 1 << 28
"""Bytes of a file; scenarios have a few million."""
MAX_OPCODES = 20_000_000
"""Instructions of a file; scenarios have a few million."""

_PLAIN = (
    "PROTO FRAME STOP MARK POP POP_MARK NONE NEWTRUE NEWFALSE LONG1 LONG4 BININT BININT1 BININT2 BINFLOAT BINBYTES "
    "BINBYTES8 SHORT_BINBYTES BYTEARRAY8 BINUNICODE BINUNICODE8 SHORT_BINUNICODE EMPTY_LIST APPEND APPENDS "
    "EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_DICT SETITEM SETITEMS EMPTY_SET ADDITEMS FROZENSET MEMOIZE BINGET "
    "LONG_BINGET STACK_GLOBAL REDUCE BUILD"
)
_OPCODES = frozenset(_PLAIN.split())
"""Instructions of protocols 4 and 5 that plain data needs."""
_KINDS = "biufSU"
MAX_ITEM = 4096
"""Bytes of one element of an array: texts of up to 1024 characters."""


class _Named:
    """What a name in a pickle stands for; nothing can be set on it from there."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("sets the state of what has none")


class _Type:
    """Stands for ``numpy.dtype``: the text it is made from, and a byte order that may follow."""

    __slots__ = ("found",)

    def __init__(self, text: Any, *flags: Any) -> None:
        if not isinstance(text, str) or not 2 <= len(text) <= 6 or text[0] not in _KINDS:
            raise pickle.UnpicklingError(f"an array of type {str(text)[:20]!r}")
        self.found = np.dtype(text)
        if self.found.kind not in _KINDS or not 0 < self.found.itemsize <= MAX_ITEM:
            raise pickle.UnpicklingError(f"an array of type {text!r}")

    def __setstate__(self, state: Any) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else None
        # For plain types nothing but the order is ever given.
        if order not in {"<", ">", "|", "="} or any(part is not None for part in state[2:5]):
            raise pickle.UnpicklingError("an array of a structured type")
        self.found = self.found.newbyteorder(order)


class Array:
    """An array of a pickle; ``value`` is it, once its state was given."""

    __slots__ = ("value",)

    def __init__(self) -> None:
        self.value: NDArray[Any] = np.zeros(0)

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, data = state
        self.value = _array(data, dtype, shape, "F" if fortran else "C")


def _array(data: Any, dtype: Any, shape: Any, order: str) -> NDArray[Any]:
    if not isinstance(dtype, _Type) or not isinstance(data, (bytes, bytearray)):
        raise pickle.UnpicklingError("an array of objects")
    # Otherwise the product of many sizes could be anything.
    if not isinstance(shape, tuple) or len(shape) > 8:
        raise pickle.UnpicklingError("an array without a shape")
    if not all(type(side) is int and 0 <= side <= MAX_BYTES for side in shape):
        raise pickle.UnpicklingError("an array of an impossible shape")
    if math.prod(shape) * dtype.found.itemsize != len(data):
        raise pickle.UnpicklingError(f"an array of shape {shape} in {len(data)} bytes")
    return np.frombuffer(data, dtype.found).reshape(shape, order="F" if order == "F" else "C")


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any) -> Array:
    found = Array()
    found.value = _array(data, dtype, shape, order)
    return found


def _scalar(dtype: Any, data: Any) -> Any:
    return _array(data, dtype, (1,), "C")[0].item()


def _never(*_: Any) -> Any:
    raise pickle.UnpicklingError("makes an array by itself")


_NUMPY = {"_reconstruct": lambda *_: Array(), "scalar": _scalar}
_NAMES: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Named(_never),
    ("numpy", "dtype"): _Named(_Type),
    **{(f"numpy.{core}.multiarray", n): _Named(f) for core in ("core", "_core") for n, f in _NUMPY.items()},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _Named(_from_buffer) for core in ("core", "_core")},
}


class _Plain(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """One of a few names, none of which is what it says."""
        try:
            return _NAMES[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"refers to {module}.{name}, which no plain data needs") from None


def load_plain(path: Path) -> Any:
    """Read a pickle of plain data; its arrays are :class:`Array`.

    A :class:`DataError` names what is too large, empty, cut short, damaged, or anything else that it refers to.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise DataError(f"{size} bytes, at most {MAX_BYTES} can be read", file=path)
    data = path.read_bytes()
    if not data:
        raise DataError("the file is empty", file=path)
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
            raise pickle.UnpicklingError(f"protocol {argument}; 4 and 5 are read")
        if opcode.name not in _OPCODES:
            message = f"instruction {opcode.name} at byte {place}, which no plain data needs"
            raise pickle.UnpicklingError(message)
        if count > MAX_OPCODES:
            raise pickle.UnpicklingError(f"more than {MAX_OPCODES} instructions")
    if count == 0:
        raise pickle.UnpicklingError("no instructions")
