"""Drawing a category with a given random number."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def inverse_cdf(logits: Float[Tensor, "*b C"], noise: Float[Tensor, "*b"]) -> Int[Tensor, "*b"]:
    """Draw categories `[...]` int64 from logits `[..., C]` by uniform numbers `[...]` in [0, 1].

    The category is the one whose interval of the cumulative distribution holds the number; a category of
    probability zero is never drawn.
    """
    cumulative = torch.softmax(logits, -1).cumsum(-1)
    total = cumulative[..., -1:]
    drawn = (cumulative <= noise[..., None] * total).sum(-1)
    # Rounding may carry the product up to the total, past the last category that is possible at all.
    return torch.minimum(drawn, (cumulative < total).sum(-1))
