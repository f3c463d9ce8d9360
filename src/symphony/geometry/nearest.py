"""The smallest of each row: on the CPU by NumPy's vectorised selection, elsewhere by one ``topk``; and ranges."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import pad


def has_values() -> bool:
    """Return whether values may be looked at: not inside ``torch.compile`` or transforms of ``torch.func``."""
    return not torch.compiler.is_compiling() and torch._C._functorch.peek_interpreter_stack() is None


def on_host(tensor: Tensor) -> bool:
    """Return whether values may steer the computation: on the CPU, where there are any. There a step may look at a
    few numbers to leave out work; elsewhere that would wait for the device.
    """
    return tensor.device.type == "cpu" and has_values()


def places(flags: Bool[Tensor, "M N"]) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
    """Return row and column of what is set; on a device, which would wait to tell, of everything."""
    if on_host(flags):
        row, column = flags.nonzero(as_tuple=True)
        return row, column
    row, column = (torch.arange(size, device=flags.device) for size in flags.shape)
    return row.repeat_interleave(len(column)), column.repeat(len(row))


def spans(begin: NDArray[np.int64] | int, length: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the numbers from ``begin`` on, ``length`` [R] of each, one after the other."""
    before = length.cumsum() - length
    return np.arange(length.sum()) + np.repeat(begin - before, length)


def smallest(values: NDArray[Any], count: int) -> NDArray[np.int64]:
    """Return the places, in the flattened array, of the ``count`` smallest of each row [R, W], ascending. Of equal
    elements the first ones are taken, so the other elements of a row do not matter. NaN counts as infinity.
    """
    if values.shape[1] <= count:
        return np.arange(values.size)
    cut = np.partition(values, count - 1, axis=1)[:, count - 1 : count]
    if not np.isfinite(cut).all():
        values, cut = (np.where(np.isnan(part), np.inf, part) for part in (values, cut))
    chosen = values <= cut
    # Ties are rare: only then rows are handled one by one.
    if np.count_nonzero(chosen) != count * len(values):
        odd = np.flatnonzero(np.count_nonzero(chosen, axis=1) != count)
        less, equal = values[odd] < cut[odd], values[odd] == cut[odd]
        room = count - np.count_nonzero(less, axis=1)[:, None]
        chosen[odd] = less | (equal & (equal.cumsum(1) <= room))
    return np.flatnonzero(chosen)


def nearest(squared: Float[Tensor, "*b K"], count: int) -> tuple[Int[Tensor, "*b n"], Bool[Tensor, "*b n"]]:
    """Return the indices [..., count] of the smallest elements and which are finite; the rest is padded with index 0.
    In ascending order of the index; ties go to the elements that come first.
    """
    width = squared.shape[-1]
    if width <= count:
        index = torch.arange(width, device=squared.device).expand(squared.shape)
    elif on_host(squared):
        flat = squared.detach().reshape(-1, width).numpy()
        index = torch.from_numpy(smallest(flat, count) % width).view(*squared.shape[:-1], count)
    else:
        # Numbers of bits in the order of what is not negative, and among equals in that of their places.
        bits = squared.detach().float().contiguous().view(torch.int32).long()
        order = (bits << 32) + torch.arange(width, device=squared.device)
        index = order.topk(count, dim=-1, largest=False, sorted=False).indices.sort(-1).values
    found = squared.gather(-1, index) < torch.inf
    if width < count:
        index, found = (pad(value, (0, count - width)) for value in (index, found))
    return index, found
