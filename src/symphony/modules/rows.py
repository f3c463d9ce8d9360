"""Networks that treat every row alike, whatever rows are computed beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from symphony.geometry.nearest import on_host, transformed

BLOCK = 64
"""Rows per block: large enough that the cost of the calls is small, small enough that padding stays cheap."""
MANY = 512
"""Rows of a block where there are so many, if that gives a row the same bits."""


def mlp(sizes: Sequence[int]) -> nn.Sequential:
    """Linear layers of the given widths (input first) with ReLU between them and none after the last."""
    if len(sizes) < 2:
        raise ValueError(f"a network needs an input and an output width, got {tuple(sizes)}")
    layers: list[nn.Module] = []
    for width_in, width_out in pairwise(sizes):
        # In place: nothing reads what comes out of a linear layer, and fresh memory costs more than the maximum.
        layers += [nn.Linear(width_in, width_out), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


FEWER = (64, 256, 1000)
"""Rows of smaller products, for what a block holds little of."""


def in_blocks(
    function: Callable[[Tensor], Tensor], x: Float[Tensor, "*b F"], rows: int = BLOCK
) -> Float[Tensor, "*b H"]:
    """Apply a row-wise function `[n, F] -> [n, H]` to `x` `[..., F]` in blocks of exactly `rows` rows.

    Matrix products pick their kernel, and with it their rounding, by the number of rows, so that a row computed
    alone and the same row computed among others may differ in the last bit. Blocks of one fixed size (the
    last one padded) take that away: on the CPU, in float32 and without gradients, the result of a row does not
    depend on the batch it is in. That rests on the kernels treating the rows of one product alike, which MKL's
    do in float32, but not in float64. With gradients enabled, on another device, or under a transform of
    `torch.func`, the function is called once on all rows.
    """
    flat = x.reshape(-1, x.shape[-1])
    if torch.is_grad_enabled() or x.device.type != "cpu" or flat.shape[0] == 0 or transformed():
        out = function(flat)
    else:
        count, missing = flat.shape[0], -flat.shape[0] % rows
        padded = torch.cat([flat, flat.new_zeros(missing, flat.shape[1])]) if missing else flat
        wide = MANY if count >= MANY and rows in equal_rows(function, flat, MANY) else rows
        whole, apply = count - count % wide, reusing(function)
        blocks = [(a, wide) for a in range(0, whole, wide)]
        blocks += [(a, rows) for a in range(whole, len(padded), rows)]
        out = flat.new_empty(0)
        for a, size in blocks:
            found = apply(padded[a : a + size])
            out = out if a else found.new_empty(len(padded), found.shape[1])
            out[a : a + size] = found
        out = out[:count]
    return out.reshape(*x.shape[:-1], out.shape[-1])


def plain_layers(function: Callable[[Tensor], Tensor]) -> list[nn.Linear]:
    """The linear layers of an :func:`mlp`; of anything else none, such as one with a normalisation of its weights."""
    if type(function) is not nn.Sequential:
        return []
    layers = list(function)
    if any(map(_hooked, (function, *layers))):
        return []
    linears = [layer for layer in layers if type(layer) is nn.Linear and layer.bias is not None]
    plain = bool(linears) and layers[::2] == linears and layers[-1] is linears[-1]
    return linears if plain and all(type(layer) is nn.ReLU for layer in layers[1::2]) else []


def equal_rows(function: Callable[[Tensor], Tensor], x: Float[Tensor, "*b F"], rows: int) -> tuple[int, ...]:
    """Numbers of rows, ascending up to ``rows``, with which a row-wise function gives a row the same bits.

    Known of an :func:`mlp` on the CPU in float32, of anything else ``rows`` alone.
    """
    if x.dtype != torch.float32 or not on_host(x):
        return (rows,)
    shapes = [tuple(layer.weight.shape) for layer in plain_layers(function)]
    few = [size for size in FEWER if size < rows] if shapes else []
    threads = torch.get_num_threads()
    return (*(size for size in few if all(_alike(*shape, size, rows, threads) for shape in shapes)), rows)


@cache
@torch.no_grad()
def _alike(outputs: int, inputs: int, few: int, rows: int, threads: int) -> bool:
    """Whether rows have the same bits in a product of few as in one of many, tried out with random numbers.

    Which kernel computes a product, and so in which order it adds, is decided by its shape on a machine.
    """
    rng = torch.Generator().manual_seed(0)
    x, weight, bias = (
        torch.randn(shape, generator=rng, device="cpu", dtype=torch.float32)
        for shape in ((rows, inputs), (outputs, inputs), (outputs,))
    )
    together = torch.addmm(bias, x, weight.t())
    parts = [slice(a, a + few) for a in (*range(0, rows - few, few), rows - few)]
    return all(torch.equal(torch.addmm(bias, x[part], weight.t()), together[part]) for part in parts)


def _hooked(module: nn.Module) -> bool:
    """Whether a module does more, when it is called or differentiated, than its weights tell."""
    # One by one, as this is asked at every call of a network.
    before, after = module._forward_pre_hooks, module._forward_hooks
    return bool(before or after or module._backward_pre_hooks or module._backward_hooks)


def reusing(function: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """The same row-wise function, for a loop over blocks of one size without gradients on the CPU.

    What it gives is only valid until it is called again: the layers of an :func:`mlp` write to the same memory each
    time, which stays in the cache, where fresh memory would take almost as long as the products.
    """
    linears = plain_layers(function)
    if not linears or torch.compiler.is_compiling() or transformed():
        return function
    parts = [(layer.bias.detach(), layer.weight.detach().t()) for layer in linears]
    kept: list[Tensor] = []

    def apply(block: Float[Tensor, "n F"]) -> Float[Tensor, "n H"]:
        if not kept or len(kept[0]) != len(block):
            kept[:] = [weight.new_empty(len(block), weight.shape[1]) for _, weight in parts]
        for k, ((bias, weight), out) in enumerate(zip(parts, kept, strict=True)):
            block = torch.addmm(bias, block.relu_() if k else block, weight, out=out)
        return block

    return apply
