"""Pickles of plain data are read; everything else is refused by name, and nothing in it is run."""

from __future__ import annotations

import contextlib
import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from fuzz_mutations import bytes_
from symphony.data.sources import safe_pickle
from symphony.data.sources.safe_pickle import Array, load_plain
from symphony.errors import DataError

PROTOCOLS = range(4, pickle.HIGHEST_PROTOCOL + 1)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=9)
ARRAYS = arrays.arrays(
    st.sampled_from([np.dtype(name) for name in ("<f8", ">f4", "<i8", "|u1", "|b1", "<U3", "|S4")]),
    arrays.array_shapes(max_dims=3, max_side=4, min_side=0),
)
TREES = st.recursive(
    SCALARS | ARRAYS | st.binary(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text(max_size=4), inner, max_size=4)
        | st.sets(st.integers(), max_size=3)
    ),
    max_leaves=12,
)


def load(data: bytes, folder: Path) -> Any:
    path = folder / "a.pkl"
    path.write_bytes(data)
    return load_plain(path)


def refused(data: bytes, folder: Path) -> str:
    with pytest.raises(DataError) as caught:
        load(data, folder)
    assert caught.value.file == folder / "a.pkl"
    return caught.value.message


def same(found: Any, expected: Any) -> bool:
    if isinstance(expected, np.ndarray):
        assert isinstance(found, Array)
        equal = np.array_equal(found.value, expected, equal_nan=expected.dtype.kind == "f")
        return equal and found.value.dtype == expected.dtype
    if isinstance(expected, dict):
        return list(found) == list(expected) and all(same(found[k], v) for k, v in expected.items())
    if isinstance(expected, list | tuple):
        both = type(found) is type(expected) and len(found) == len(expected)
        return both and all(map(same, found, expected))
    return type(found) is type(expected) and found == expected


@settings(max_examples=50)
@given(TREES, st.sampled_from(PROTOCOLS))
def test_plain_data_comes_back(tmp_path_factory: pytest.TempPathFactory, tree: Any, protocol: int) -> None:
    assert same(load(pickle.dumps(tree, protocol), tmp_path_factory.getbasetemp()), tree)


def test_arrays_of_any_order_and_scalars(tmp_path: Path) -> None:
    turned = np.arange(24.0).reshape(2, 3, 4).transpose(2, 0, 1)
    tree = {"a": np.asfortranarray(turned), "b": turned[::2], "c": turned.copy()}
    numbers = [np.float32(1.5), np.int64(-7), np.bool_(True), np.str_("ab")]
    for protocol in PROTOCOLS:
        assert same(load(pickle.dumps(tree, protocol), tmp_path), tree)
        assert load(pickle.dumps(numbers, protocol), tmp_path) == [1.5, -7, True, "ab"]


class Bomb:
    """Would leave a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self.path}",)


def test_code_is_refused_by_name_and_never_run(tmp_path: Path) -> None:
    for protocol in PROTOCOLS:
        message = refused(pickle.dumps({"id": [Bomb(tmp_path / "sprung")]}, protocol), tmp_path)
        assert "system, which no plain data needs" in message
    assert not (tmp_path / "sprung").exists()


OTHERS = {
    "collections.OrderedDict": OrderedDict(a=1),
    "path": Path("x"),
    "builtins.len": len,
    "numpy.random": np.random.default_rng(0),
    "an array of type 'O8'": np.array([{}], object),
    "an array of type 'V8'": np.zeros(2, [("a", "f8")]),
    "an array of type 'M8'": np.zeros(2, "M8[s]"),
    "an array of type 'U9999'": np.zeros(1, "U9999"),
}


def test_other_things_are_refused_by_name(tmp_path: Path) -> None:
    for name, value in OTHERS.items():
        assert name in refused(pickle.dumps(value), tmp_path)


def array_pickle(shape: Any, data: Any, kind: str = "f8", order: Any = "<") -> bytes:
    """An array whose state is made up."""

    class Kind:
        def __reduce__(self) -> Any:
            return np.dtype, (kind, False, True), (3, order, None, None, None, -1, -1, 0)

    class Made:
        def __reduce__(self) -> Any:
            maker = np._core.multiarray._reconstruct  # type: ignore[attr-defined]
            return maker, (np.ndarray, (0,), b"b"), (1, shape, Kind(), False, data)

    return pickle.dumps(Made())


def test_arrays_that_lie_are_refused(tmp_path: Path) -> None:
    eight = b"12345678"
    for message, *made in (
        ("impossible shape", (10**12,), b""),
        ("impossible shape", (-1,), b""),
        ("impossible shape", (2.0,), 2 * eight),
        ("impossible shape", (True,), eight),
        ("in 8 bytes", (10**5,) * 8, eight),
        ("without a shape", (0,) * 99, b""),
        ("without a shape", [1], eight),
        ("in 8 bytes", (2,), eight),
        ("of objects", (1,), "12345678"),
        ("of objects", (1,), [1.0]),
        ("of type 'O'", (1,), eight, "O"),
        ("of type", (1,), eight, "f8,f8"),
        ("structured", (1,), eight, "f8", "!"),
    ):
        assert message in refused(array_pickle(*made), tmp_path)


RAW = [
    (b"", "empty"),
    (pickle.dumps([1, 2])[:-1], "not a pickle"),
    (b"\xff" * 100, "not a pickle"),
    (b"\x80\x04)\x81.", "NEWOBJ"),  # an object of a class
    (pickle.dumps([1], 2), "protocol 2; 4 and 5 are read"),
    (b"Pabc\n.", "PERSID"),
    (b"\x80\x04B\xff\xff\xff\x7fabc.", "not a pickle"),  # more bytes than there are
    (b"\x80\x05\x96\xff\xff\xff\xff\xff\x00\x00\x00abc.", "not a pickle"),
    (b"\x80\x04\x8c\x05numpy\x8c\x0bos.path.sep\x93.", "refers to numpy.os.path.sep"),
]


@pytest.mark.parametrize(("data", "message"), RAW)
def test_raw_programs_are_refused(data: bytes, message: str, tmp_path: Path) -> None:
    assert message in refused(data, tmp_path)


def test_too_large_files_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for limit, message in (
        ("MAX_BYTES", "at most 99: too large"),
        ("MAX_OPCODES", "more than 99 instructions"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(safe_pickle, limit, 99)
            assert message in refused(pickle.dumps(list(range(200))), tmp_path)


def test_damaged_pickles_give_errors_or_plain_data(tmp_path: Path) -> None:
    tree = {"a": np.arange(6.0).reshape(2, 3), "b": ["x", 2, {"c": (1.5, None)}], "d": np.float64(2)}
    for seed in range(60):
        data = bytes_(np.random.default_rng(seed), pickle.dumps(tree, PROTOCOLS[seed % len(PROTOCOLS)]))
        with contextlib.suppress(DataError):
            assert type(load(data, tmp_path)).__module__ in {"builtins", safe_pickle.__name__}
