"""Encoders that attend to an agent's surroundings, as alternatives to the paper's, which pools them.

symphony train bc --data STORE --out runs/attending --agent.encoder attention:Everything

`docs/ablations.md` says what they gain. The folder of this file must be on PYTHONPATH, or the current one.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention

from symphony.modules import mlp, pool_elements

HEADS, ROUNDS = 4, 2
MANY = 48
"""Sets of more elements, the map points, are pooled by :class:`Others`."""


class Everything(nn.Module):
    """An encoder with which an agent looks twice, the second time knowing the first, at all elements around it."""

    def __init__(self, own_features: int, group_features: list[int], *, hidden: int = 64):
        super().__init__()
        self.own = mlp((own_features, hidden, hidden))
        self.groups = nn.ModuleList(mlp((features, hidden, hidden)) for features in group_features)
        self.width = hidden * (1 + len(self.groups))
        asked = hidden * len(self.groups)
        self.query = nn.ModuleList(nn.Linear(hidden if k == 0 else self.width, asked) for k in range(ROUNDS))
        self.norm = nn.LayerNorm(hidden)

    def forward(self, own: Tensor, valid: Tensor, *elements_and_masks: Tensor) -> Tensor:
        """Encode own features under a mask, then elements [..., N, K, F] and mask of each group: [..., N, width]."""
        me = self.own(torch.where(valid[..., None], own, 0.0)).relu()
        pairs = zip(self.groups, elements_and_masks[::2], elements_and_masks[1::2], strict=True)
        encoded = [self.elements(encoder, e, mask & valid[..., None]) for encoder, e, mask in pairs]
        seen = me
        for query in self.query:
            asked = query(seen).chunk(len(self.groups), -1)
            seen = torch.cat([me, *(self.look(q, *one) for q, one in zip(asked, encoded, strict=True))], -1)
        return seen.relu()

    def elements(self, encoder: nn.Module, elements: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return elements as they are attended to, [..., K, hidden], and their mask."""
        return self.norm(encoder(torch.where(mask[..., None], elements, 0.0))), mask

    def look(self, query: Tensor, elements: Tensor, mask: Tensor) -> Tensor:
        """Return what a query [..., hidden] sees among elements: zeros where there is none."""
        parts, queries = elements.unflatten(-1, (HEADS, -1)), query.unflatten(-1, (HEADS, -1))
        weights = torch.einsum("...khd,...hd->...kh", parts, queries) / parts.shape[-1] ** 0.5
        weights = weights.masked_fill(~mask[..., None], -1e4).softmax(-2) * mask[..., None]
        return torch.einsum("...kh,...khd->...hd", weights, parts).flatten(-2)


class Others(Everything):
    """The same encoder for small sets, others and lights, with their own keys and values; map points are pooled."""

    def __init__(self, own_features: int, group_features: list[int], *, hidden: int = 64):
        super().__init__(own_features, group_features, hidden=hidden)
        self.keys = nn.ModuleList(nn.Linear(hidden, 2 * hidden) for _ in group_features)
        self.both = dict(zip(self.groups, self.keys, strict=True))

    def elements(self, encoder: nn.Module, elements: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return keys and values [..., 2, K, hidden], or of large sets their maximum [..., hidden]; and the mask."""
        if elements.shape[-2] > MANY:
            return pool_elements(encoder, elements, mask), mask
        encoded, _ = super().elements(encoder, elements, mask)
        return torch.stack(self.both[encoder](encoded).chunk(2, -1), -3), mask

    def look(self, query: Tensor, elements: Tensor, mask: Tensor) -> Tensor:
        """Return what a query [..., hidden] sees among elements: zeros where there is none."""
        if elements.ndim == query.ndim:
            return elements.relu()
        keys, values = elements.unflatten(-1, (HEADS, -1)).transpose(-2, -3).unbind(-4)  # [..., heads, K, d]
        bias = query.new_zeros(mask.shape).masked_fill(~mask, -1e4)[..., None, None, :]
        asked = query.unflatten(-1, (HEADS, 1, -1))
        found = scaled_dot_product_attention(asked, keys, values, bias).flatten(-3)
        return found.relu() * mask.any(-1, keepdim=True)
