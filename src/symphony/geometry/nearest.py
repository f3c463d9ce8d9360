"""The smallest of each row: on the CPU by NumPy's vectorised selection, elsewhere by one ``topk``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad


def transformed() -> bool:
    """Whether a transform of ``torch.func`` (``vmap``) is at work, under which nothing can be written in place."""
    return torch._C._functorch.peek_interpreter_stack() is not None


def on_host(tensor: Tensor) -> bool:
    """Whether values may steer the computation: on the CPU, outside of ``torch.compile`` and ``torch.func``.

    There a step may look at a few numbers to leave out work; elsewhere that would wait for the device.
    """
    return tensor.device.type == "cpu" and not torch.compiler.is_compiling() and not transformed()


SHARE = 4
"""One in so many elements gives a bound of what is looked for, in rows that are long."""
LONG = 1024
"""Elements of a row from which on that is faster than to partition it."""


MANY = 1024
"""Elements from which on it pays to find out that none is negative."""


def kth_smallest(values: NDArray[Any], count: int) -> NDArray[Any]:
    """The ``count``-th smallest of the real numbers in each row [R, W], as [R, 1]. NaN comes last."""
    width = values.shape[1]
    if count == 1:
        return np.fmin.reduce(values, axis=1, keepdims=True)
    if width < max(LONG, 2 * SHARE * count):
        return _partitioned(values.copy(), count)
    # Some more than the share of what is looked for, as a share is not quite even.
    few = count // SHARE + count // 32 + 4
    bound = _partitioned(np.ascontiguousarray(values[:, ::SHARE]), few)
    # Where maps differ in size most of a row is infinite, which is padding.
    bound = np.minimum(bound, np.finfo(values.dtype).max)
    below = values <= bound
    number = np.count_nonzero(below, axis=1)
    kept = np.full((len(values), max(number.max(initial=0), count)), np.inf, values.dtype)
    kept[np.arange(kept.shape[1]) < number[:, None]] = values.ravel().take(np.flatnonzero(below))
    found = _partitioned(kept, count)
    missed = np.flatnonzero(number < count)
    if len(missed):
        found[missed] = _partitioned(values[missed], count)
    return found


def _partitioned(own: NDArray[Any], count: int) -> NDArray[Any]:
    """The same, of an array that nobody else needs."""
    if own.size >= MANY and own.min() >= 0:  # not where there is NaN
        # Their bits, read as whole numbers, are in the same order, and quicker to compare.
        own.view(f"i{own.itemsize}").partition(count - 1, axis=-1)
    else:
        own.partition(count - 1, axis=-1)
    return own[:, count - 1 : count]


def smallest(values: NDArray[Any], count: int) -> NDArray[np.int64]:
    """Places, in the flattened array, of the ``count`` smallest elements of each row [R, W], ascending.

    Of equal elements the first ones are taken, so what else is in a row decides nothing. NaN comes last.
    """
    width = values.shape[1]
    if width <= count:
        return np.arange(values.size)
    cut = kth_smallest(values, count)
    chosen = values <= cut
    # Where no number is missing each row has as many at least. Counted by rows, which is slow, only for ties.
    if np.count_nonzero(chosen) != count * len(values) or np.isnan(cut).any():
        odd = np.flatnonzero(np.count_nonzero(chosen, axis=1) != count)
        if np.isnan(cut[odd]).any():
            order = np.argsort(values[odd], axis=-1, kind="stable")[:, :count]
            chosen[odd] = False
            chosen[odd[:, None], order] = True
        else:
            less, equal = values[odd] < cut[odd], values[odd] == cut[odd]
            room = count - np.count_nonzero(less, axis=1)[:, None]
            chosen[odd] = less | (equal & (equal.cumsum(1) <= room))
    return np.flatnonzero(chosen)


def first_smallest(values: Float[Tensor, "*b K"]) -> Int[Tensor, "*b"]:
    """Place of the smallest number along the last dimension; of equal ones the first.

    On the CPU by NumPy, whose search is vectorised: a quarter of the time of ``argmin``.
    """
    if on_host(values):
        return torch.from_numpy(np.asarray(values.detach().numpy().argmin(-1)))
    return values.argmin(-1)


def nearest(squared: Float[Tensor, "*b K"], count: int) -> tuple[Int[Tensor, "*b n"], Bool[Tensor, "*b n"]]:
    """Index [..., count] of the smallest elements and which of them are finite; the rest is padded with index 0.

    On the CPU in ascending order of the index, ties going to the elements that come first.
    """
    width = squared.shape[-1]
    available = min(count, width)
    if width <= count:
        index = torch.arange(width, device=squared.device).expand(squared.shape)
    elif on_host(squared):
        flat = squared.detach().reshape(-1, width).numpy()
        index = torch.from_numpy(smallest(flat, count) % width).view(*squared.shape[:-1], count)
    else:
        index = squared.topk(available, dim=-1, largest=False, sorted=False).indices
    found = squared.gather(-1, index).isfinite()
    if available < count:
        index, found = (pad(value, (0, count - available)) for value in (index, found))
    return index, found
