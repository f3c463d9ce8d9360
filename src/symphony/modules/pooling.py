"""Max-pooling over a set of encoded elements, with a backward pass through the winners only."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from symphony.geometry.nearest import on_host
from symphony.modules.rows import plain_layers, reusing
from symphony.modules.winners import own_channel, won

PoolMode = Literal["auto", "dense", "winner"]
ROWS = 2048
"""Elements encoded at a time: their activations (512 KiB at width 64) stay in a core's L2 cache."""
FEW = 48
"""Largest set for which encoding everything with a graph is faster than finding winners first (measured on one
CPU core at width 64: the two meet between 48 and 64 elements)."""


def pool_elements(
    function: Callable[[Tensor], Tensor],
    elements: Float[Tensor, "*b K F"],
    mask: Bool[Tensor, "*b K"],
    *,
    rows: int = ROWS,
    mode: PoolMode = "auto",
) -> Float[Tensor, "*b H"]:
    """Maximum over the valid elements of a row-wise network's outputs (paper, III-C).

    Masked elements have no influence whatever they hold. A set without a valid element gives zeros and no
    gradient. Among equal elements the first one receives the gradient.

    Args:
        function: row-wise network `[n, F] -> [n, H]`, e.g. :func:`symphony.modules.mlp`.
        elements: `[..., K, F]`.
        mask: `[..., K]` bool, True where an element is valid.
        rows: elements encoded at a time where work is done in chunks.
        mode: `"dense"` encodes everything at once and differentiates through all of it. `"winner"` encodes
            in chunks of fixed size without a graph, and then, where a gradient is asked for, encodes the at
            most H winning elements of each set again with one. Both have the same values and gradients, those
            of any order included, up to rounding. `"auto"` is `"winner"` on the CPU (but `"dense"` for the
            gradient of small sets, where that is faster) and `"dense"` elsewhere.

    Returns:
        `[..., H]`. With `"winner"`, on the CPU in float32 and without gradients, the result for one set does
        not depend on the sets beside it, to the last bit (see :func:`symphony.modules.in_blocks`).
    """
    if mask.shape != elements.shape[:-1] or mask.dtype != torch.bool:
        raise ValueError(
            f"expected a bool mask of shape {tuple(elements.shape[:-1])}, got {mask.dtype} {tuple(mask.shape)}"
        )
    if mode not in ("auto", "dense", "winner"):
        raise ValueError(f"unknown mode {mode!r}, expected 'auto', 'dense' or 'winner'")
    batch, (count, features) = elements.shape[:-2], elements.shape[-2:]
    n = math.prod(batch)
    sets, valid = elements.reshape(n, count, features), mask.reshape(n, count)
    if count == 0 or n == 0:
        width = function(elements.new_zeros(1, features)).shape[-1]
        return elements.new_zeros(*batch, width)
    gradient = _wants_gradient(function, elements)
    if mode == "auto":
        mode = "dense" if elements.device.type != "cpu" or (gradient and count <= FEW) else "winner"
    if mode == "dense":
        pooled = _dense(function, sets, valid)
    elif gradient:
        pooled = _through_winners(function, sets, valid, rows)
    else:
        with torch.no_grad():
            pooled, _ = _in_chunks(function, sets, valid, rows, index=False)
            pooled = torch.where(valid.any(1, keepdim=True), pooled, 0.0)
    return pooled.reshape(*batch, pooled.shape[-1])


def _wants_gradient(function: Callable[[Tensor], Tensor], elements: Float[Tensor, "*b K F"]) -> bool:
    if not torch.is_grad_enabled():
        return False
    if elements.requires_grad or not isinstance(function, nn.Module):
        return True
    return any(p.requires_grad for p in function.parameters())


def _dense(
    function: Callable[[Tensor], Tensor], sets: Float[Tensor, "n K F"], valid: Bool[Tensor, "n K"]
) -> Float[Tensor, "n H"]:
    n, count, features = sets.shape
    encoded = function(torch.where(valid[..., None], sets, 0.0).reshape(-1, features)).reshape(n, count, -1)
    # Not amax, which would share the gradient between equal elements.
    pooled = encoded.masked_fill(~valid[..., None], -torch.inf).max(1).values
    return torch.where(valid.any(1, keepdim=True), pooled, 0.0)


def _first_valid(valid: Bool[Tensor, "n K"]) -> Int[Tensor, " n"]:
    return valid.to(torch.uint8).argmax(1)


def _blocks(
    sets: Float[Tensor, "n K F"], valid: Bool[Tensor, "n K"], size: int
) -> Iterator[tuple[Float[Tensor, "sK F"], int]]:
    """The elements of ``size`` sets at a time, and how many of these there are; the last block is filled up."""
    n, count, features = sets.shape
    flat = sets.reshape(n * count, features)
    order = None
    if not (on_host(valid) and bool(valid.all())):
        # A masked element repeats a valid one: cheaper than masking the H-wide outputs, and the maximum is the same.
        place = torch.arange(n * count, device=sets.device).view(n, count)
        order = torch.where(valid, place, place.gather(1, _first_valid(valid)[:, None])).view(-1)
    for start in range(0, n * count, size * count):
        stop = start + size * count
        block = flat[start:stop] if order is None else flat.index_select(0, order[start:stop])
        missing = size * count - block.shape[0]
        if missing:
            # A fixed number of rows fixes the kernel, hence the rounding, of every matrix product.
            block = torch.cat([block, block.new_zeros(missing, features)])
        yield block, size - missing // count


def _in_chunks(
    function: Callable[[Tensor], Tensor],
    sets: Float[Tensor, "n K F"],
    valid: Bool[Tensor, "n K"],
    rows: int,
    *,
    index: bool,
) -> tuple[Float[Tensor, "n H"], Int[Tensor, "n H"] | None]:
    """Maxima `[n, H]`, and on request the element `[n, H]` of each; arbitrary for sets without valid elements."""
    count = sets.shape[1]
    size = max(1, rows // count)
    # Elsewhere there is no cache to stay in, and layers may be anything.
    function = reusing(function) if on_host(sets) else function
    maxima, winners = [], []
    for block, sets_in_it in _blocks(sets, valid, size):
        encoded = function(block).reshape(size, count, -1)[:sets_in_it]
        if index:
            best, where = encoded.max(1)
            winners.append(where)
        else:
            best = encoded.amax(1)
        maxima.append(best)
    return torch.cat(maxima), torch.cat(winners) if index else None


def _by_channel(
    linears: Sequence[nn.Linear], sets: Float[Tensor, "n K F"], valid: Bool[Tensor, "n K"], rows: int
) -> tuple[Float[Tensor, "n H"], Int[Tensor, "n H"]]:
    """The same of an :func:`symphony.modules.mlp` on the CPU: outputs lie channel by channel, where the place of a
    maximum is found five times as fast.
    """
    count = sets.shape[1]
    size = max(1, rows // count)
    *before, (weight, bias) = ((layer.weight, layer.bias[:, None]) for layer in linears)
    # Written to the same memory for each block, which stays in the cache.
    between = [weight.new_empty(size * count, len(inner)) for inner, _ in before]
    out = weight.new_empty(len(weight), size * count)
    maxima, winners = [], []
    for block, sets_in_it in _blocks(sets, valid, size):
        hidden = block
        for (inner, shift), place in zip(before, between, strict=True):
            hidden = torch.addmm(shift[:, 0], hidden, inner.t(), out=place).relu_()
        encoded = torch.addmm(bias, weight, hidden.t(), out=out).view(-1, size, count)[:, :sets_in_it]
        where = torch.from_numpy(encoded.numpy().argmax(-1))
        winners.append(where.t())
        maxima.append(encoded.gather(-1, where[..., None])[..., 0].t())
    return torch.cat(maxima), torch.cat(winners)


def _through_winners(
    function: Callable[[Tensor], Tensor], sets: Float[Tensor, "n K F"], valid: Bool[Tensor, "n K"], rows: int
) -> Float[Tensor, "n H"]:
    linears = plain_layers(function) if on_host(sets) else []
    with torch.no_grad():
        if linears:
            best, winners = _by_channel(linears, sets.detach(), valid, rows)
        else:
            best, found = _in_chunks(function, sets, valid, rows, index=True)
            if found is None:  # pragma: no cover - asked for just above
                raise RuntimeError("no winners were returned")
            winners = found
        occupied = valid.any(1, keepdim=True)
        # A winning masked element is a copy of the first valid one.
        winners = torch.where(valid.gather(1, winners), winners, _first_valid(valid)[:, None])
    n, count, features = sets.shape
    # Of a place [n, H] in a set the one among the elements of all sets.
    place = (winners + torch.arange(0, n * count, count, device=sets.device)[:, None]).flatten()
    chosen = sets.reshape(n * count, features).index_select(0, place).view(n, -1, features)
    if not (on_host(occupied) and bool(occupied.all())):
        chosen = torch.where(occupied[..., None], chosen, 0.0)
    if linears:
        return torch.where(occupied, won(best, chosen, linears), 0.0)
    return torch.where(occupied, _own_channel(function, chosen), 0.0)


def _own_channel(
    function: Callable[[Tensor], Tensor], chosen: Float[Tensor, "n H F"]
) -> Float[Tensor, "n H"]:
    """Output channel c of element c: `[n, H, F] -> [n, H]`."""
    linears = plain_layers(function)
    if linears:
        return own_channel(chosen, [(layer.weight, layer.bias) for layer in linears])
    return function(chosen.flatten(0, 1)).unflatten(0, chosen.shape[:2]).diagonal(dim1=1, dim2=2)
