"""Statistics of how well scores tell two kinds apart."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def auc(
    scores: Float[Tensor, "*b"], positive: Bool[Tensor, "*b"], valid: Bool[Tensor, "*b"] | None = None
) -> Float[Tensor, ""]:
    """Return the probability that a positive scores higher than a negative, ties counting half (the area under ROC).

    The rank statistic of Mann and Whitney, O(n log n), over all entries. No gradient.

    Args:
        scores: float `[...]`; infinite ones are ordered like any other.
        positive: bool `[...]`, True for positives, False for negatives.
        valid: bool `[...]`, entries that count; all of them if None.

    Returns:
        A scalar in [0, 1]; NaN without positives or negatives, or if a score that counts is NaN.

    Raises:
        ValueError: for masks that are not bool or of another shape than the scores.
    """
    valid = torch.ones_like(positive) if valid is None else valid
    for name, mask in (("positive", positive), ("valid", valid)):
        if mask.shape != scores.shape or mask.dtype != torch.bool:
            raise ValueError(f"{name} is {mask.dtype} {tuple(mask.shape)}, expected torch.bool {tuple(scores.shape)}")
    flat = scores.detach().flatten()
    above, below = (positive & valid).flatten(), (~positive & valid).flatten()
    positives, negatives = above.sum(), below.sum()
    # Non-negatives are sorted to the end; counts stop at the number of negatives. Nothing waits for a device.
    ordered = torch.where(below, flat, torch.inf).sort().values
    fewer = torch.searchsorted(ordered, flat.contiguous(), right=False).minimum(negatives)
    no_more = torch.searchsorted(ordered, flat.contiguous(), right=True).minimum(negatives)
    doubled = torch.where(above, fewer + no_more, 0).sum()
    unordered = ((above | below) & flat.isnan()).any()
    return torch.where(unordered, torch.nan, doubled / (2 * positives * negatives))
