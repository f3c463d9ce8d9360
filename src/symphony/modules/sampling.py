"""Drawing a category with a given random number."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def inverse_cdf(logits: Float[Tensor, "*b C"], noise: Float[Tensor, "*b"]) -> Int[Tensor, "*b"]:
    """Draw categories `[...]` int64 from logits `[..., C]` by uniform numbers `[...]` in [0, 1].

    The category is the one whose interval of the cumulative distribution holds the number; a category of
    probability zero is never drawn. Where there is no category at all it is 0.
    """
    if logits.shape[-1] == 0:
        return torch.zeros_like(noise, dtype=torch.int64)
    cumulative = torch.softmax(logits.detach(), -1).cumsum(-1)
    total = cumulative[..., -1:].contiguous()
    # It never falls, so a place in it is the number of elements at most, or less than, a value.
    drawn = torch.searchsorted(cumulative, noise[..., None] * total, right=True)
    # Rounding may carry the product up to the total, past the last category that is possible at all; where logits are
    # not numbers no place is right, but one must be named.
    last = torch.searchsorted(cumulative, total).clamp_max(logits.shape[-1] - 1)
    return torch.minimum(drawn, last).squeeze(-1)
