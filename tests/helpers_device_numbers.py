"""A device in name only whose tensors have numbers: for code whose shapes depend on them.

The numbers lie on the host, so that results can be compared; PyTorch's rules hold: tensors of two devices don't meet
in one operation, but for single numbers of the host. Without gradients.

    with numbered() as device:
        found = function(value.to(device))
    assert torch.equal(host(found), expected)
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from helpers_device import BACKEND, NAME, PretendDevice
from symphony.geometry import constants

_COPIES = (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)


class _Held(Tensor):
    """A tensor that says it is on the device."""

    numbers: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> _Held:
        made: _Held = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=torch.device(NAME, 0),
        )
        made.numbers = inner
        return made

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class _Everything(TorchDispatchMode):
    """Sees what makes tensors out of nothing, too."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [value for value in tree_leaves((args, kwargs)) if isinstance(value, Tensor)]
    held = [value for value in tensors if isinstance(value, _Held)]
    target = kwargs.get("device")
    if target is not None:
        kwargs = kwargs | {"device": torch.device("cpu")}
    if func not in _COPIES and held and any(not isinstance(v, _Held) and v.dim() for v in tensors):
        where = [(str(value.device), tuple(value.shape)) for value in tensors]
        raise RuntimeError(f"{func}: tensors of two devices: {where}")
    out = func(*tree_map(host, args), **tree_map(host, kwargs))
    if func._schema.is_mutable and isinstance(out, Tensor):
        return args[0]
    there = bool(held) if target is None else torch.device(target).type == NAME
    return tree_map(lambda value: _Held(value) if isinstance(value, Tensor) else value, out) if there else out


def _empty_strided(size: Any, stride: Any, *, dtype: Any = None, **_: Any) -> Tensor:
    """Where lists become tensors PyTorch asks the device itself for memory, past all modes."""
    return _Held(torch.empty_strided(size, stride, dtype=dtype))


def _copy_from(source: Tensor, to: Tensor, non_blocking: bool = False) -> Tensor:
    host(to).copy_(host(source))
    return to


_KERNELS = torch.library.Library("aten", "IMPL")
_KERNELS.impl("empty_strided", _empty_strided, "PrivateUse1")
_KERNELS.impl("_copy_from", _copy_from, "PrivateUse1")


def host(value: Any) -> Any:
    """The numbers of a tensor; anything else as it is."""
    return value.numbers if isinstance(value, _Held) else value


@contextmanager
def numbered() -> Iterator[torch.device]:
    """The device, whose tensors have numbers inside of this context."""
    BACKEND.pretended = PretendDevice()
    constants.made.cache_clear()
    try:
        with torch.no_grad(), _Everything():
            yield BACKEND.pretended.device
    finally:
        BACKEND.pretended = None
        constants.made.cache_clear()
