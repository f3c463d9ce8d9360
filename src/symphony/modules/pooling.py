"""Max-pooling over a set of encoded elements, with a backward pass through the winners only."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import pad

from symphony.geometry.nearest import on_host
from symphony.geometry.spans import spans
from symphony.modules.rows import FEWER, equal_rows, plain_layers, reusing
from symphony.modules.winners import own_channel, won

ALIGNED = 8
"""Sets begin at multiples of so many rows: some kernels add in another order where a row lies elsewhere in a tile."""
PoolMode = Literal["auto", "dense", "winner"]
ROWS = 2048
"""Elements encoded at a time, at most: their activations (512 KiB at width 64) stay in a core's L2 cache."""
AT_ONCE = 1 << 20
"""Elements encoded at once elsewhere than on the CPU, without a gradient: their activations take 256 MiB at width 64,
and larger products are hardly faster."""
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
        mode: `"dense"` encodes everything at once (without a gradient, whole sets of at most :data:`AT_ONCE`
            elements) and differentiates through all of it. `"winner"` encodes
            in chunks without a graph, and then, where a gradient is asked for, encodes the at
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
    # As many whole sets as fit: full blocks then lie together in memory.
    most = _aligned(count)
    rows = max(1, rows // most) * most
    if mode == "dense":
        # All at once only where a gradient wants it so.
        some = n if gradient else max(1, AT_ONCE // count)
        parts = [_dense(function, sets[a : a + some], valid[a : a + some]) for a in range(0, n, some)]
        pooled = torch.cat(parts) if len(parts) > 1 else parts[0]
    elif gradient:
        pooled = _through_winners(function, sets, valid, rows)
    else:
        with torch.no_grad():
            pooled, _ = _in_blocks(_values(function, sets), sets, valid, equal_rows(function, sets, rows))
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
    flat = sets.reshape(n * count, features)
    place = valid.flatten().nonzero().squeeze(-1) if on_host(valid) else None
    if place is None or len(place) in (0, n * count):
        encoded = function(torch.where(valid.view(-1, 1), flat, 0.0)).view(n, count, -1)
        encoded = encoded.masked_fill(~valid[..., None], -torch.inf)
    else:
        found = function(flat.index_select(0, place))
        nothing = found.new_full((n * count, found.shape[-1]), -torch.inf)
        encoded = nothing.index_copy(0, place, found).view(n, count, -1)
    # Not amax, which would share the gradient between equal elements.
    return torch.where(valid.any(1, keepdim=True), encoded.max(1).values, 0.0)


def _first_valid(valid: Bool[Tensor, "n K"]) -> Int[Tensor, " n"]:
    return valid.to(torch.uint8).argmax(1)


_Pool = Callable[[Tensor, torch.Size], tuple[Tensor, Tensor | None]]
"""Encodes elements `[rows, F]`, the first of which are s sets of w each; gives maxima `[s, H]`, and on request the
place of each in its set."""


def _values(function: Callable[[Tensor], Tensor], sets: Float[Tensor, "n K F"]) -> _Pool:
    # Elsewhere there is no cache to stay in, and layers may be anything.
    encode = reusing(function) if on_host(sets) else function
    return lambda block, shape: (encode(block)[: shape.numel()].unflatten(0, shape).amax(1), None)


def _winners(function: Callable[[Tensor], Tensor]) -> _Pool:
    return lambda block, shape: tuple(function(block)[: shape.numel()].unflatten(0, shape).max(1))


def _by_channel(linears: Sequence[nn.Linear]) -> _Pool:
    """The same of an :func:`symphony.modules.mlp` on the CPU: outputs lie channel by channel, where the place of a
    maximum is found five times as fast.
    """
    *before, (weight, bias) = ((layer.weight, layer.bias[:, None]) for layer in linears)
    memory: list[Tensor] = []

    def pool(block: Float[Tensor, "rows F"], shape: torch.Size) -> tuple[Tensor, Tensor]:
        if not memory or memory[-1].shape[1] != len(block):
            # Written to the same memory for each block, which stays in the cache.
            memory[:] = [weight.new_empty(len(block), len(inner)) for inner, _ in before]
            memory.append(weight.new_empty(len(weight), len(block)))
        *between, last = memory
        hidden = block
        for (inner, shift), out in zip(before, between, strict=True):
            hidden = torch.addmm(shift[:, 0], hidden, inner.t(), out=out).relu_()
        encoded = torch.addmm(bias, weight, hidden.t(), out=last)[:, : shape.numel()].unflatten(1, shape)
        where = torch.from_numpy(encoded.numpy().argmax(-1))
        return encoded.gather(2, where[..., None]).squeeze(2).t(), where.t()

    return pool


def _in_blocks(
    pool: _Pool, sets: Float[Tensor, "n K F"], valid: Bool[Tensor, "n K"], sizes: Sequence[int]
) -> tuple[Float[Tensor, "n H"], Int[Tensor, "n H"] | None]:
    """Maxima, 0 for sets without any element, and on request the place of each among the elements of all sets.

    On the CPU only valid elements are encoded.

    Args:
        pool: what is done to each block.
        sets: elements.
        valid: which of them count.
        sizes: rows that a block may have, ascending; each has as few as hold its elements. A number of rows fixes the
            kernel, hence the rounding, of every matrix product; what a block does not fill nobody looks at.
    """
    n, count, features = sets.shape
    flat, plan = sets.reshape(n * count, features), _plan(valid, sizes[-1])
    maxima, winners = [], []
    for start, some, width in plan.blocks:
        held = some * width
        rows = next(size for size in sizes if size >= held)
        if plan.places is None:
            block = flat[start : start + rows]
            block = pad(block, (0, 0, 0, rows - len(block))) if len(block) < rows else block
        else:
            block = flat.index_select(0, plan.places[start : start + rows])
        best, where = pool(block, torch.Size((some, width)))
        maxima.append(best)
        if where is not None:
            winners.append(where + torch.arange(start, start + held, width, device=sets.device)[:, None])
    found = torch.cat(maxima)
    place = torch.cat(winners) if winners else None
    if place is not None and plan.places is not None:
        place = plan.places[place]
    if plan.order is not None:
        found = found.new_zeros(n, found.shape[1]).index_copy(0, plan.order, found)
        if place is not None:
            place = place.new_zeros(n, place.shape[1]).index_copy(0, plan.order, place)
    elif not (on_host(valid) and valid.numpy().any()):  # on the CPU all sets are full then, or all are empty
        found = torch.where(valid.any(1, keepdim=True), found, 0.0)
    return found, place


class _Plan(NamedTuple):
    """Which elements are encoded together.

    Attributes:
        blocks: first element, number of sets, elements of each set.
        places: of the elements among those of all sets, block by block and enough of them for the last block's
            rows; None for all as they lie.
        order: of the sets [m] in the blocks; None for all as they are.
    """

    blocks: list[tuple[int, int, int]]
    places: Int[Tensor, " E"] | None = None
    order: Int[Tensor, " m"] | None = None


def _aligned(count: int) -> int:
    return -(-count // ALIGNED) * ALIGNED


def _plan(valid: Bool[Tensor, "n K"], rows: int) -> _Plan:
    n, count = valid.shape
    size = rows // _aligned(count)
    blocks = [(first * count, min(size, n - first), count) for first in range(0, n, size)]
    if not on_host(valid):
        # A masked element repeats a valid one: cheaper than masking the outputs, and the maximum is the same.
        place = torch.arange(n * count, device=valid.device).view(n, count)
        place = torch.where(valid, place, place.gather(1, _first_valid(valid)[:, None]))
        return _Plan(blocks, pad(place.flatten(), (0, rows)))
    mask = valid.numpy()  # whose reductions of flags take a tenth of the time
    if (count % ALIGNED == 0 and mask.all()) or not mask.any():
        return _Plan(blocks)
    element, number = np.flatnonzero(mask), np.count_nonzero(mask, axis=1)
    # Those with most elements first, so that sets of a block are almost equally large.
    order = np.argsort(-number, kind="stable")[: np.count_nonzero(number)]
    held = number[order].tolist()
    blocks, start, k = [], 0, 0
    while k < len(held):
        most = _aligned(held[k])
        size = min(rows // most, len(held) - k)
        blocks.append((start, size, most))
        start, k = start + size * most, k + size
    # Tiles of eight elements. Past its last element a set repeats that, and past its last tile that tile: an element
    # in the same place of a tile has the same bits.
    sizes, widths = np.array(blocks).T[1:]
    tiles = np.repeat(widths // ALIGNED, sizes)
    tile = spans(0, tiles)
    own, end = -(-number[order] // ALIGNED), number.cumsum()[order]
    # Of each tile its first place among the valid elements of all sets, and the last one of its set.
    first = np.repeat(end - number[order], tiles) + ALIGNED * np.minimum(tile, np.repeat(own - 1, tiles))
    at = np.minimum(first[:, None] + np.arange(ALIGNED), np.repeat(end - 1, tiles)[:, None])
    places = np.zeros(start + rows, np.int64)
    places[:start] = element.take(at.ravel())
    return _Plan(blocks, torch.from_numpy(places), torch.from_numpy(order))


def _through_winners(
    function: Callable[[Tensor], Tensor], sets: Float[Tensor, "n K F"], valid: Bool[Tensor, "n K"], rows: int
) -> Float[Tensor, "n H"]:
    linears = plain_layers(function) if on_host(sets) else []
    with torch.no_grad():
        pool = _by_channel(linears) if linears else _winners(function)
        best, place = _in_blocks(pool, sets.detach(), valid, (*(few for few in FEWER if few < rows), rows))
        if place is None:  # pragma: no cover - asked for just above
            raise RuntimeError("no winners were returned")
        occupied = valid.any(1, keepdim=True)
    n, count, features = sets.shape
    chosen = sets.reshape(n * count, features).index_select(0, place.flatten()).view(n, -1, features)
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
