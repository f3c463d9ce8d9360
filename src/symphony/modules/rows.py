"""Networks that treat every row alike, whatever rows are computed beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

BLOCK = 64
"""Rows per block: large enough that the cost of the calls vanishes, small enough that padding stays cheap."""


def mlp(sizes: Sequence[int]) -> nn.Sequential:
    """Linear layers of the given widths (input first) with ReLU between them and none after the last."""
    if len(sizes) < 2:
        raise ValueError(f"a network needs an input and an output width, got {tuple(sizes)}")
    layers: list[nn.Module] = []
    for width_in, width_out in pairwise(sizes):
        layers += [nn.Linear(width_in, width_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def in_blocks(
    function: Callable[[Tensor], Tensor], x: Float[Tensor, "*b F"], rows: int = BLOCK
) -> Float[Tensor, "*b H"]:
    """Apply a row-wise function `[n, F] -> [n, H]` to `x` `[..., F]` in blocks of exactly `rows` rows.

    Matrix products pick their kernel, and with it their rounding, by the number of rows, so that a row computed
    alone and the same row computed among others may differ in the last bit. Blocks of one fixed size (the
    last one padded) take that away: on the CPU, in float32 and without gradients, the result of a row does not
    depend on the batch it is in. That rests on the kernels treating the rows of one product alike, which MKL's
    do in float32, but not in float64. With gradients enabled, or on another device, the function is called
    once on all rows.
    """
    flat = x.reshape(-1, x.shape[-1])
    if torch.is_grad_enabled() or x.device.type != "cpu" or flat.shape[0] == 0:
        out = function(flat)
    else:
        missing = -flat.shape[0] % rows
        padded = torch.cat([flat, flat.new_zeros(missing, flat.shape[1])]) if missing else flat
        out = torch.cat([function(block) for block in padded.split(rows)])[: flat.shape[0]]
    return out.reshape(*x.shape[:-1], out.shape[-1])
