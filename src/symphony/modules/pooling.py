"""Max-pooling over a set of encoded elements, with a backward pass through the winners only."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from symphony.geometry.nearest import on_host

Pooled = Float[Tensor, "n H"]
Sets = Float[Tensor, "n K F"]
Masks = Bool[Tensor, "n K"]

PoolMode = Literal["auto", "dense", "winner"]
ROWS = 2048
"""Elements encoded at a time on the CPU: their activations (512 KiB at width 64) stay in a core's L2 cache."""
AT_ONCE = 1 << 20
"""Elements encoded at once elsewhere, without a gradient: their activations take 256 MiB at width 64."""
FEW = 48
"""Largest set for which encoding everything with a graph is faster than finding winners first (measured on one
CPU core at width 64: the two meet between 48 and 64 elements)."""

Function = Callable[[Tensor], Tensor]  # row-wise, `[n, F] -> [n, H]`


def pool_elements(
    function: Function, elements: Float[Tensor, "*b K F"], mask: Bool[Tensor, "*b K"], *, mode: PoolMode = "auto"
) -> Float[Tensor, "*b H"]:
    """Return the maximum over the valid elements of a row-wise network's outputs (paper, III-C).

    Masked elements have no influence whatever they hold. A set without a valid element gives zeros and no
    gradient. Among equal elements the first one receives the gradient.

    The network is `[n, F] -> [n, H]`, e.g. :func:`symphony.modules.mlp`. As for the gradient, mode `"dense"`
    differentiates through all elements, `"winner"` encodes them without a graph and the at most H winners of each set
    again with one. Both have the same values and gradients, those of any order included, up to rounding. `"auto"` is
    `"winner"` for large sets on the CPU, where that takes half of the time, and `"dense"` elsewhere.
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
        return elements.new_zeros(*batch, function(elements.new_zeros(1, features)).shape[-1])
    if not _wants_gradient(function, elements):
        with torch.no_grad():
            pooled = _maxima(function, sets, valid)
    elif mode == "winner" or (mode == "auto" and elements.device.type == "cpu" and count > FEW):
        pooled = _through_winners(function, sets, valid)
    else:
        pooled = _dense(function, sets, valid)
    return pooled.reshape(*batch, pooled.shape[-1])


def _wants_gradient(function: Function, elements: Float[Tensor, "*b K F"]) -> bool:
    if not torch.is_grad_enabled():
        return False
    if elements.requires_grad or not isinstance(function, nn.Module):
        return True
    return any(p.requires_grad for p in function.parameters())


def _maxima(function: Function, sets: Sets, valid: Masks) -> Pooled:
    """Return maxima without a gradient, 0 for sets without an element."""
    n, count, features = sets.shape
    if not on_host(valid):
        some = max(1, AT_ONCE // count)
        parts = [_dense(function, sets[a : a + some], valid[a : a + some]) for a in range(0, n, some)]
        return torch.cat(parts) if len(parts) > 1 else parts[0]
    # Most elements may be masked, so only the others are encoded, as many at a time as stay in the cache.
    flat, best = sets.reshape(n * count, features), sets.new_empty(0)
    for place in valid.flatten().nonzero().squeeze(-1).split(ROWS):
        encoded = function(flat.index_select(0, place))
        best = best if len(best) else encoded.new_full((n, encoded.shape[1]), -torch.inf)
        best.scatter_reduce_(0, (place // count)[:, None].expand_as(encoded), encoded, "amax")
    return torch.where(valid.any(1, keepdim=True), best, 0.0)


def _encoded(function: Function, flat: Float[Tensor, "e F"], valid: Bool[Tensor, " e"], dim: int = 0) -> Tensor:
    """Return all elements encoded, minus infinity where they are masked; on the CPU only the others are encoded. The
    function gives elements along dimension ``dim``, and so does the result.
    """
    place = valid.nonzero().squeeze(-1) if on_host(valid) else None
    if place is None or len(place) == 0:
        encoded = function(torch.where(valid[:, None], flat, 0.0))
        return encoded.masked_fill(~valid if dim else ~valid[:, None], -torch.inf)
    if len(place) == len(flat):
        return function(flat)
    found = function(flat.index_select(0, place))
    shape = (found.shape[0], len(flat)) if dim else (len(flat), found.shape[1])
    return found.new_full(shape, -torch.inf).index_copy(dim, place, found)


def _dense(function: Function, sets: Sets, valid: Masks) -> Pooled:
    encoded = _encoded(function, sets.flatten(0, 1), valid.flatten()).unflatten(0, valid.shape)
    # Not amax, which would share the gradient between equal elements.
    return torch.where(valid.any(1, keepdim=True), encoded.max(1).values, 0.0)


def _through_winners(function: Function, sets: Sets, valid: Masks) -> Pooled:
    """Return output channel c of the element that has its maximum there: no other element gets a gradient anyway."""
    n, count, features = sets.shape
    flat, each, places = sets.reshape(n * count, features), max(1, ROWS // count), []
    before, last = _split(function)

    def by_channel(x: Float[Tensor, "e F"]) -> Float[Tensor, "H e"]:
        # The place of a maximum is found much faster in numbers that lie side by side.
        if last is None:
            return before(x).t().contiguous()
        return torch.addmm(last.bias[:, None], last.weight, before(x).t())

    with torch.no_grad():
        for first in range(0, n, each):
            seen = valid[first : first + each]
            part = flat.detach()[first * count : (first + len(seen)) * count]
            encoded = _encoded(by_channel, part, seen.flatten(), dim=1).unflatten(1, seen.shape)
            # By NumPy in a sixth of the time of torch.
            where = torch.from_numpy(encoded.numpy().argmax(-1)) if on_host(encoded) else encoded.argmax(-1)
            row = torch.arange(first, first + len(seen), device=sets.device)
            places.append(where.t() + (count * row)[:, None])
        occupied = valid.any(1, keepdim=True)
    chosen = flat.index_select(0, torch.cat(places).flatten()).view(n, -1, features)
    chosen = torch.where(occupied[..., None], chosen, 0.0)
    return torch.where(occupied, _own_channel(before, last, chosen), 0.0)


def _split(function: Function) -> tuple[Function, nn.Linear | None]:
    """Return a network before its last layer, and that layer; or the whole and None if it has more than weights."""
    if type(function) is nn.Sequential and not _hooked(function):
        last = function[-1]
        if type(last) is nn.Linear and last.bias is not None and not _hooked(last):
            return function[:-1], last
    return function, None


def _own_channel(before: Function, last: nn.Linear | None, chosen: Float[Tensor, "n H F"]) -> Pooled:
    """Return output channel c of element c; of a last layer one output in H is computed."""
    hidden = before(chosen.flatten(0, 1)).unflatten(0, chosen.shape[:2])
    return hidden.diagonal(dim1=1, dim2=2) if last is None else (hidden * last.weight).sum(-1) + last.bias


def _hooked(module: nn.Module) -> bool:
    """Return whether a module does more, when it is called or differentiated, than its weights tell."""
    before, after = module._forward_pre_hooks, module._forward_hooks
    return bool(before or after or module._backward_pre_hooks or module._backward_hooks)
